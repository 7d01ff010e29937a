"""How well a profile predicts: against points left out, and against a machine that is made up."""

import warnings
from itertools import islice
from math import exp, log

import numpy as np
import pytest

from rts2.model.arch import Arch
from rts2.profiles.calibrate import fit, leave_one_out
from rts2.profiles.check import Comparison, fresh, held_out, report
from rts2.profiles.latency import predict_ms
from rts2.profiles.measure import Bench, candidates
from rts2.profiles.profile import Resolution, load
from rts2.profiles.timing import Timing
from rts2.search.space import Space

KEYS = [
    *("schema", "device", "n", "mape", "max_ape", "within_5", "within_10", "spearman", "points"),
]


def compared(true: float, predicted: float) -> Comparison:
    return Comparison(Arch(c=1), "fp32", "pytorch", (1242, 375), true, predicted)


class Off(Bench):
    """A machine that is always `factor` times as slow as the cpu profile says.

    On a day when everything, the reference too, takes `drift` times as long.
    """

    def __init__(self, factor: float, drift: float = 1.0) -> None:
        self.factor, self.drift = factor, drift
        self.timed: list[tuple[Arch, Resolution]] = []

    def time(self, arch: Arch, resolution: Resolution) -> Timing:
        self.timed.append((arch, resolution))
        model = load("cpu").calibration("onnxruntime", "fp32").model
        latency_ms = self.drift * self.factor * predict_ms(model, arch, resolution)
        machine = load("cpu").machine
        assert machine is not None
        assert machine.reference_ms is not None
        return Timing(latency_ms, latency_ms, 10, self.drift * machine.reference_ms)


def test_a_residual_is_of_latency() -> None:
    """A network that is slower than predicted (10 FPS, not 20) has a positive one."""
    assert compared(10, 20).residual == pytest.approx(log(2))


@pytest.mark.parametrize("device", ["tx2", "rtx2080ti"])
def test_each_point_is_predicted_by_a_fit_on_all_the_others(device: str) -> None:
    profile = load(device)
    found = held_out(profile)
    assert len(found) == sum(
        len(profile.points_of(known.runtime, known.precision)) for known in profile.calibrations
    )
    known = profile.calibrations[0]
    points = profile.points_of(known.runtime, known.precision)
    residuals = leave_one_out(points, known.model)
    for comparison, point, residual in zip(found, points, residuals, strict=False):
        assert (comparison.arch, comparison.resolution) == (point.arch, point.resolution)
        assert (comparison.runtime, comparison.precision) == (point.runtime, point.precision)
        assert comparison.fps_true == point.fps
        assert comparison.residual == pytest.approx(residual, abs=1e-12)
    for index in (0, len(points) // 2, len(points) - 1):
        others = [point for at, point in enumerate(points) if at != index]
        left_out = points[index]
        predicted = predict_ms(fit(others, known.model), left_out.arch, left_out.resolution)
        assert found[index].fps_predicted == pytest.approx(1000 / predicted)


def test_what_the_profile_stores_is_what_the_check_finds() -> None:
    profile = load("tx2")
    stored = [residual for known in profile.calibrations for residual in known.residuals]
    assert [c.residual for c in held_out(profile)] == pytest.approx(stored, abs=1e-6)


def test_a_report_has_the_keys_of_the_contract_and_its_points() -> None:
    profile = load("tx2")
    comparisons = [compared(10, 11), compared(20, 19)]
    found = report(profile, comparisons)
    assert list(found) == KEYS
    assert (found["schema"], found["device"], found["n"]) == ("rts2.profile-check/1", "tx2", 2)
    for point, comparison in zip(found["points"], comparisons, strict=True):
        assert point.keys() >= {
            *("arch", "precision", "runtime", "fps_true", "fps_predicted"),
        }
        assert Arch.model_validate(point["arch"]) == comparison.arch
        assert point["fps_true"] == comparison.fps_true
        assert point["fps_predicted"] == comparison.fps_predicted


def test_a_report_by_hand() -> None:
    """Predicted frame rates that are 0, +4, −8 and +20% off."""
    true = (10.0, 20.0, 30.0, 40.0)
    ratios = (1.0, 1.04, 0.92, 1.2)
    found = report(load("tx2"), [compared(t, t * r) for t, r in zip(true, ratios, strict=True)])
    assert found["mape"] == pytest.approx(0.08)
    assert found["max_ape"] == pytest.approx(0.2)
    assert found["within_5"] == 0.5
    assert found["within_10"] == 0.75
    assert found["spearman"] == pytest.approx(1)


def test_the_rank_by_hand() -> None:
    """Ranks 1 2 3 4 against 2 1 4 3: 1 − 6·4 / (4·15) = 0.6."""
    pairs = ((10, 12), (11, 10), (12, 14), (13, 13))
    assert report(load("tx2"), [compared(*p) for p in pairs])["spearman"] == pytest.approx(0.6)


@pytest.mark.parametrize("pairs", [[(10, 10)], [(10, 11), (10, 12)], [(10, 12), (11, 12)]])
def test_a_rank_that_does_not_exist_is_unknown(pairs: list[tuple[float, float]]) -> None:
    """One point has no order, equal ones neither; JSON has no NaN."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert report(load("tx2"), [compared(*pair) for pair in pairs])["spearman"] is None


def test_fresh_networks_are_judged_by_the_profile_that_claims_them() -> None:
    profile = load("cpu")
    found = list(fresh(profile, Off(exp(0.07)), 5, seed=0))
    assert [c.residual for c in found] == pytest.approx([0.07] * 5)
    told = report(profile, found)
    assert (told["n"], told["within_5"], told["within_10"]) == (5, 0.0, 1.0)


def test_what_the_reference_drifted_is_divided_out_and_told() -> None:
    found = list(fresh(load("cpu"), Off(exp(0.07), drift=1.5), 5, seed=0))
    assert [c.residual for c in found] == pytest.approx([0.07] * 5)
    assert [c.drift for c in found] == pytest.approx([1.5] * 5)


def test_fresh_networks_are_none_that_a_fit_was_made_of() -> None:
    bench = Off(1)
    list(fresh(load("cpu"), bench, 40, seed=0))
    assert all(Space().position(arch) is not None for arch, _ in bench.timed)
    for seed in (0, 1):
        assert not set(bench.timed) & set(islice(candidates(seed), 24, 400))


def test_fresh_networks_depend_on_the_seed_alone() -> None:
    benches = [Off(1), Off(1), Off(1)]
    for bench, seed in zip(benches, (0, 0, 1), strict=True):
        list(fresh(load("cpu"), bench, 10, seed))
    same, again, other = (bench.timed for bench in benches)
    assert same == again
    assert not set(same) & set(other)


def test_errors_are_finite_fractions() -> None:
    for device in ("tx2", "rtx2080ti"):
        profile = load(device)
        told = report(profile, held_out(profile))
        assert 0 < told["mape"] <= told["max_ape"] < 1
        assert 0 <= told["within_5"] <= told["within_10"] <= 1
        assert np.isfinite(told["spearman"])
