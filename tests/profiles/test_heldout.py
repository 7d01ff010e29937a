"""Whole groups left out: by hand, on made-up devices, and on the paper's."""

from collections.abc import Sequence

import pytest

from rts2.model.arch import Arch
from rts2.model.errors import Rts2Error
from rts2.profiles.calibrate import calibrated, fit, recalibrated
from rts2.profiles.heldout import errors_told, hold_outs
from rts2.profiles.latency import LatencyModel, predict_ms
from rts2.profiles.profile import HoldOut, Misses, Point, load

KITTI = (1242, 375)
LAUNCHES = LatencyModel(
    combine="sum", starts="kernels", start_ms=0.2, ms_per={"gmac_2d": 3.0, "gbyte": 40.0}
)


def point(latency_ms: float, **arch: object) -> Point:
    return Point(
        arch=Arch.model_validate(arch),
        runtime="pytorch",
        precision="fp32",
        resolution=KITTI,
        fps=1000 / latency_ms,
        evidence="measured",
        source="by hand",
    )


PLAIN = {"semantic": False, "refinement": False}


def flat(points: Sequence[Point]) -> LatencyModel:
    """A fit of one coefficient, by hand: the first point's latency over its number of steps.

    It wants two points at least.
    """
    if len(points) < 2:
        raise Rts2Error("two points at least")
    unit = LatencyModel(combine="sum", starts="steps", start_ms=1.0, ms_per={})
    first = points[0]
    return unit.model_copy(
        update={"start_ms": first.latency_ms / predict_ms(unit, first.arch, KITTI)}
    )


def test_errors_of_groups_by_hand() -> None:
    """162, 125 and 85 steps: full, without refinement, without semantics (three stages each).

    At 1 ms a step, but the second takes 250 ms (not 125) and the last 100 (not 85): leaving out
    the first family costs the fit its scale (2 ms a step), each other family is predicted at 1.
    """
    points = [
        point(162, c=8),
        point(250, c=8, refinement=False),
        point(100, c=8, **PLAIN),
    ]
    found = hold_outs(points, flat).family
    by_hand = {"full": 0.5, "disparity+semantic": 1.0, "disparity": 15 / 85}
    assert found.groups.keys() == by_hand.keys()
    for name, error in by_hand.items():
        assert found.groups[name].n == 1
        assert found.groups[name].mean == found.groups[name].worst == pytest.approx(error)
    assert found.n == 3
    assert found.mean == pytest.approx((0.5 + 1 + 15 / 85) / 3)
    assert found.worst == pytest.approx(1.0)


def test_what_cannot_be_fitted_is_unknown() -> None:
    """One point with one stage remains beside two with three."""
    points = [point(100, c=8), point(100, c=4), point(40, c=8, stages=1)]
    found = hold_outs(points, flat).stages
    assert found.groups["3"] == Misses(n=0, mean=None, worst=None)
    assert found.groups["1"].n == found.n == 1
    assert found.worst == found.groups["1"].worst
    alone = hold_outs(points[:2], flat).stages
    assert (alone.n, alone.mean, alone.worst) == (0, None, None)


def test_anynet_is_a_family_of_its_own() -> None:
    anynet = {"family": "anynet", "c": 1, **PLAIN}
    points = [point(50, c=1, **PLAIN), point(60, c=2, **PLAIN), point(70, **anynet)]
    assert [*hold_outs(points, flat).family.groups] == ["disparity", "anynet"]


def test_a_device_that_is_its_model_is_known_from_any_part_of_it() -> None:
    archs = [
        Arch(c=c, stages=stages, semantic=semantic, refinement=semantic)
        for c in (1, 8, 32)
        for stages in (1, 2, 3)
        for semantic in (False, True)
    ]
    points = [
        point(predict_ms(LAUNCHES, arch, KITTI), **arch.model_dump(mode="json")) for arch in archs
    ]
    found = calibrated(points, LAUNCHES, "planted").held_out
    assert found is not None
    assert (found.family.n, found.stages.n) == (18, 18)
    assert found.family.worst == pytest.approx(0, abs=1e-6)
    assert found.stages.worst == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("device", ["tx2", "rtx2080ti"])
def test_families_of_the_paper_are_refits_by_hand(device: str) -> None:
    profile = load(device)
    (known,) = profile.calibrations
    assert known.held_out is not None
    errors = []
    for name in ("disparity", "disparity+semantic", "full"):
        left_out = [p for p in profile.points if p.arch.branches == name]
        model = fit([p for p in profile.points if p not in left_out], known.model)
        own = [abs(1000 / predict_ms(model, p.arch, KITTI) / p.fps - 1) for p in left_out]
        misses = known.held_out.family.groups[name]
        assert misses.n == len(own)
        assert misses.mean == pytest.approx(sum(own) / len(own), abs=1e-6)
        assert misses.worst == pytest.approx(max(own), abs=1e-6)
        errors += own
    assert known.held_out.family.n == len(errors) == len(profile.points)
    assert known.held_out.family.mean == pytest.approx(sum(errors) / len(errors), abs=1e-6)
    assert known.held_out.family.worst == pytest.approx(max(errors), abs=1e-6)


def test_stage_counts_of_the_paper() -> None:
    """On a TX2 four points have fewer than three stages, too few for five coefficients; on the
    other device every point has three."""
    tx2, turing = (load(device).calibrations[0].held_out for device in ("tx2", "rtx2080ti"))
    assert tx2 is not None
    assert turing is not None
    assert {name: misses.n for name, misses in tx2.stages.groups.items()} == {
        "1": 2,
        "2": 2,
        "3": 0,
    }
    assert (turing.stages.n, turing.stages.mean) == (0, None)


@pytest.mark.parametrize("device", ["tx2", "rtx2080ti"])
def test_what_a_profile_stores_is_what_its_points_give(device: str) -> None:
    profile = load(device)
    (stored,), (again,) = profile.calibrations, recalibrated(profile).calibrations
    assert stored.held_out is not None
    assert again.held_out is not None
    for old, new in (
        (stored.held_out.family, again.held_out.family),
        (stored.held_out.stages, again.held_out.stages),
    ):
        assert (new.n, new.groups.keys()) == (old.n, old.groups.keys())
        assert new.mean == pytest.approx(old.mean, abs=1e-6)
        assert new.worst == pytest.approx(old.worst, abs=1e-6)


@pytest.mark.parametrize(
    ("device", "family", "stages"),
    [("tx2", (0.07, 0.17), (0.02, 0.03)), ("rtx2080ti", (0.04, 0.08), None)],
)
def test_bars_of_the_shipped_profiles(
    device: str, family: tuple[float, float], stages: tuple[float, float] | None
) -> None:
    found = load(device).calibrations[0].held_out
    assert found is not None
    for misses, bar in ((found.family, family), (found.stages, stages)):
        if bar is not None:
            assert misses.mean is not None
            assert misses.worst is not None
            assert 0 < misses.mean < bar[0]
            assert 0 < misses.worst < bar[1]


def test_a_hold_out_in_words() -> None:
    some = HoldOut(n=4, mean=0.0123, worst=0.05, groups={"1": Misses(n=4, mean=0, worst=0)})
    assert errors_told(some) == "1.2% mean, 5.0% worst of 4"
    lacking = some.model_copy(update={"groups": {**some.groups, "3": Misses(n=0)}})
    assert errors_told(lacking) == "1.2% mean, 5.0% worst of 4; too few points remain without 3"
    none = HoldOut(n=0, groups={"3": Misses(n=0)})
    assert errors_told(none) == "too few points remain without 3"
