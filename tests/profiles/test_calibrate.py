"""Fits against planted coefficients and against the paper's frame rates, written down by hand."""

from collections.abc import Sequence
from itertools import product

import numpy as np
import pytest

from rts2.model.arch import CONV3D, Arch
from rts2.model.errors import Rts2Error
from rts2.profiles.calibrate import (
    FORMS,
    fit,
    leave_one_out,
    recalibrated,
    summary,
)
from rts2.profiles.latency import LatencyModel, predict_ms
from rts2.profiles.profile import Point, load, names

STEPS = {name: form for name, form in FORMS.items() if isinstance(form, LatencyModel)}
"""The forms that are coefficients by step."""

PLAIN, SEMANTIC, FULL = (False, False), (True, False), (True, True)
"""Semantic branch, refinement."""

TX2 = {
    (1, PLAIN, 3): 10.4,
    (1, FULL, 3): 8.3,
    (4, PLAIN, 3): 9.3,
    (4, FULL, 3): 7.4,
    (8, PLAIN, 3): 8.1,
    (8, FULL, 3): 6.3,
    (16, PLAIN, 3): 6.2,
    (16, FULL, 3): 4.5,
    (32, PLAIN, 3): 3.5,
    (32, FULL, 3): 2.3,
    (8, SEMANTIC, 3): 6.6,
    (1, PLAIN, 1): 34.6,
    (1, PLAIN, 2): 20.5,
    (8, FULL, 1): 17.2,
    (8, FULL, 2): 10.9,
}
RTX2080TI = {
    (1, PLAIN, 3): 96.8,
    (1, FULL, 3): 60.5,
    (4, PLAIN, 3): 96.2,
    (4, FULL, 3): 60.5,
    (8, PLAIN, 3): 96.2,
    (8, FULL, 3): 60.4,
    (16, PLAIN, 3): 95.8,
    (16, FULL, 3): 60.4,
    (32, PLAIN, 3): 64.1,
    (32, FULL, 3): 42.2,
    (8, SEMANTIC, 3): 76.9,
}
"""The paper's frame rates (tables II, III and IV) by c, branches and stages."""

PUBLISHED = {"tx2": TX2, "rtx2080ti": RTX2080TI}


@pytest.mark.parametrize("device", PUBLISHED)
def test_every_published_frame_rate_is_a_number_of_the_paper(device: str) -> None:
    points = [p for p in load(device).points if p.evidence == "published"]
    found = {(p.arch.c, (p.arch.semantic, p.arch.refinement), p.arch.stages): p.fps for p in points}
    assert found == PUBLISHED[device]
    assert len(points) == len(found)
    for point in points:
        assert (point.runtime, point.precision) == ("pytorch", "fp32")
        assert point.resolution == (1242, 375)
        assert (point.arch.family, point.arch.d_max, point.arch.classes) == ("rts2net", 12, 19)
        assert point.arch.conv3d == (16, 4, 4)[: point.arch.stages]
        assert "ICRA 2020, table I" in point.source


@pytest.mark.parametrize(
    ("device", "points", "mean", "worst"), [("tx2", 15, 0.03, 0.10), ("rtx2080ti", 11, 0.02, 0.06)]
)
def test_a_frame_rate_left_out_is_predicted(
    device: str, points: int, mean: float, worst: float
) -> None:
    (known,) = load(device).calibrations
    errors = np.abs(np.exp(-np.array(known.residuals)) - 1)
    assert len(errors) == points
    assert errors.mean() <= mean
    assert errors.max() <= worst


@pytest.mark.parametrize("device", PUBLISHED)
def test_shipped_coefficients_are_what_their_points_give(device: str) -> None:
    profile = load(device)
    again = recalibrated(profile)
    for known, refitted in zip(profile.calibrations, again.calibrations, strict=True):
        assert refitted.model.start_ms == pytest.approx(known.model.start_ms, rel=1e-6)
        assert dict(refitted.model.ms_per) == pytest.approx(dict(known.model.ms_per), rel=1e-6)
        assert refitted.residuals == pytest.approx(known.residuals, abs=1e-6)
    shipped = profile.model_dump(exclude={"calibrations"})
    assert again.model_dump(exclude={"calibrations"}) == shipped


@pytest.mark.parametrize("device", PUBLISHED)
def test_shipped_coefficients_are_optimal(device: str) -> None:
    """No coefficient moved by half a percent brings the predictions nearer to the paper."""
    profile = load(device)
    (known,) = profile.calibrations

    def misses(model: LatencyModel) -> float:
        return sum(
            np.log(predict_ms(model, p.arch, p.resolution) * p.fps / 1000) ** 2
            for p in profile.points
        )

    best = misses(known.model)
    for step in (0.995, 1.005):
        nudged = [known.model.model_copy(update={"start_ms": known.model.start_ms * step})]
        for name, value in known.model.ms_per.items():
            per = {**known.model.ms_per, name: value * step}
            nudged.append(known.model.model_copy(update={"ms_per": per}))
        assert all(misses(model) > best for model in nudged)


def test_residuals_of_the_shipped_profiles_are_refits_by_hand() -> None:
    for device, index in product(PUBLISHED, (0, 9)):
        profile = load(device)
        (known,) = profile.calibrations
        left_out = profile.points[index]
        others = [point for point in profile.points if point is not left_out]
        predicted = predict_ms(fit(others, known.model), left_out.arch, left_out.resolution)
        expected = np.log(1000 / left_out.fps / predicted)
        assert known.residuals[index] == pytest.approx(expected, abs=1e-6)


GRID = [
    Arch(c=c, stages=stages, d_max=d_max, conv3d=(width, 4, 4)[:stages], semantic=s, refinement=s)
    for c, stages, d_max, width, s in product((1, 8, 32), (1, 3), (6, 24), (8, 32), (False, True))
]
SUMS = [
    STEPS["eager"].model_copy(
        update={
            "start_ms": 0.2,
            "ms_per": {"gmac_2d": 3.0, "gmac_2d_single": 5.0, "gbyte": 40.0, "mvoxel_warp": 200.0},
        }
    ),
    STEPS["fused_cpu"].model_copy(
        update={
            "start_ms": 0.02,
            "ms_per": {"gmac_2d_blocked": 1.5, "gmac_3d": 9.0, "gbyte": 60.0, "mvoxel_warp": 20.0},
        }
    ),
]
MAXIMA = [
    STEPS["launch_bound"].model_copy(update={"start_ms": start, "ms_per": per})
    for start, per in (
        (0.12, {"gmac": 0.2, "extra_kernel": 0.04}),
        (0.05, {"gmac": 0.9, "extra_kernel": 0.01}),
    )
]


def timed(model: LatencyModel, archs: Sequence[Arch] = GRID) -> list[Point]:
    """Timings of a device that is exactly `model`."""
    return [
        Point(
            arch=arch,
            runtime="pytorch",
            precision="fp32",
            resolution=(1242, 375),
            fps=1000 / predict_ms(model, arch, (1242, 375)),
            evidence="measured",
            source="planted",
        )
        for arch in archs
    ]


def blank(model: LatencyModel) -> LatencyModel:
    """The form alone: a fit must not see the values that it looks for."""
    return model.model_copy(update={"start_ms": 7.0, "ms_per": dict.fromkeys(model.ms_per, 7.0)})


@pytest.mark.parametrize("planted", SUMS)
def test_planted_coefficients_of_the_sum_form_are_recovered(planted: LatencyModel) -> None:
    found = fit(timed(planted), blank(planted))
    assert found.start_ms == pytest.approx(planted.start_ms, rel=1e-9)
    assert found.ms_per == pytest.approx(planted.ms_per, rel=1e-9)
    assert (found.combine, found.starts, found.folded) == (
        planted.combine,
        planted.starts,
        planted.folded,
    )


@pytest.mark.parametrize("planted", MAXIMA)
def test_planted_coefficients_of_the_max_form_are_recovered(planted: LatencyModel) -> None:
    found = fit(timed(planted), blank(planted))
    assert found.start_ms == pytest.approx(planted.start_ms, rel=1e-3)
    assert found.ms_per == pytest.approx(planted.ms_per, rel=1e-3)


@pytest.mark.parametrize("planted", [SUMS[0], MAXIMA[0]])
def test_a_coefficient_of_zero_stays_at_zero(planted: LatencyModel) -> None:
    """It is found from above, so it may end a little over zero and never below."""
    name = [*planted.ms_per][1]
    without = planted.model_copy(update={"ms_per": {**planted.ms_per, name: 0.0}})
    points = timed(without)
    found = fit(points, blank(planted))
    assert 0 <= found.ms_per[name] < 0.01 * planted.ms_per[name]
    for point in points:
        predicted = predict_ms(found, point.arch, point.resolution)
        assert predicted == pytest.approx(point.latency_ms, rel=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_coefficients_are_never_negative(seed: int) -> None:
    """Not even on timings that fall as the work grows."""
    random = np.random.default_rng(seed)
    noise = np.exp(random.normal(0, 1, len(GRID)))
    falling = sorted((point.latency_ms for point in timed(SUMS[0])), reverse=True)
    points = [
        point.model_copy(update={"fps": 1000 / (latency * wild)})
        for point, latency, wild in zip(timed(SUMS[0]), falling, noise, strict=True)
    ]
    for form in STEPS.values():
        found = fit(points, form)
        assert found.start_ms >= 0
        assert min(found.ms_per.values()) >= 0
        assert all(np.isfinite([found.start_ms, *found.ms_per.values()]))


def test_leaving_one_out_equals_refitting_by_hand() -> None:
    random = np.random.default_rng(3)
    points = [
        point.model_copy(update={"fps": point.fps * np.exp(random.normal(0, 0.05))})
        for point in timed(SUMS[0])
    ][::3]
    found = leave_one_out(points, SUMS[0])
    by_hand = []
    for left_out in points:
        others = [point for point in points if point is not left_out]
        model = fit(others, SUMS[0])
        predicted = predict_ms(model, left_out.arch, left_out.resolution)
        by_hand.append(np.log(left_out.latency_ms / predicted))
    assert found == pytest.approx(by_hand, abs=1e-9)
    assert np.abs(found).max() > 0.01


def test_exact_timings_leave_no_residual() -> None:
    assert leave_one_out(timed(SUMS[0])[::3], SUMS[0]) == pytest.approx(0, abs=1e-9)


def test_a_calibration_takes_its_own_points_alone() -> None:
    """Timings of another precision in the same profile change nothing."""
    profile = load("tx2")
    other = timed(SUMS[1])[0].model_copy(update={"precision": "fp16", "fps": 1.0})
    wider = profile.model_copy(update={"points": (other, *profile.points)})
    assert recalibrated(wider).calibrations == recalibrated(profile).calibrations


@pytest.mark.parametrize("form", STEPS.values(), ids=STEPS.keys())
def test_too_few_timings_are_refused(form: LatencyModel) -> None:
    coefficients = 1 + len(form.ms_per)
    points = timed(SUMS[0])[::5]
    assert fit(points[:coefficients], form).ms_per.keys() == form.ms_per.keys()
    with pytest.raises(Rts2Error, match=f"{coefficients} coefficients .* not {coefficients - 1}$"):
        fit(points[: coefficients - 1], form)
    with pytest.raises(Rts2Error, match=r"not 0$"):
        fit([], form)


def test_leaving_one_out_of_too_few_is_refused_with_the_number_that_is_needed() -> None:
    """Five coefficients need six timings here: each is left out once."""
    with pytest.raises(Rts2Error, match=r"\b6\b.* not 5$"):
        leave_one_out(timed(SUMS[0])[::9][:5], SUMS[0])


def test_a_coefficient_that_no_timing_exercises_is_refused() -> None:
    """Without a network with semantics, nothing is known of what the semantic branch costs."""
    plain = [point for point in timed(SUMS[0]) if not point.arch.semantic]
    with pytest.raises(Rts2Error, match="gmac_2d_single"):
        fit(plain, SUMS[0])


def test_a_summary_by_hand() -> None:
    """Frame rates predicted as 1.00, 1.04, 0.92 and 1.20 of the truth."""
    residuals = [np.log(ratio) for ratio in (1.0, 1.04, 0.92, 1.2)]
    assert summary(residuals) == pytest.approx(
        {"mape": 0.08, "max_ape": 0.2, "within_5": 0.5, "within_10": 0.75}
    )


def test_the_forms_are_blank_and_serve_the_shipped_profiles() -> None:
    for form in STEPS.values():
        assert not any([form.start_ms, *form.ms_per.values()])
    shapes = [blank(form) for form in STEPS.values()]
    for device in names():
        for known in load(device).calibrations:
            if isinstance(known.model, LatencyModel):
                assert blank(known.model) in shapes
    assert CONV3D == (16, 4, 4)
