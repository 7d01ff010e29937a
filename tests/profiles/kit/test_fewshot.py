"""A dozen timings on top of what is known."""

import random

import numpy as np
import pytest

from rts2.model.ops import ops
from rts2.profiles.conformal import half_width
from rts2.profiles.kit.fewshot import calibrated, leave_one_out, posterior, shares
from rts2.profiles.kit.plan import networks
from rts2.profiles.kit.prior import prior
from rts2.profiles.latency import Floats, LatencyModel, Steps, latencies_ms, predict_ms
from rts2.profiles.plan import Candidate, random_candidate
from rts2.profiles.profile import Point, load

KNOWN = prior(load("tx2"), "tensorrt", "fp32").model
BOUND = prior(load("rtx2080ti"), "tensorrt", "fp32").model
PLAN = networks(KNOWN)


def unseen() -> list[Candidate]:
    chance = random.Random(5)
    return [random_candidate(chance) for _ in range(100)]


UNSEEN = Steps.of([ops(*candidate) for candidate in unseen()])


def points(truth: LatencyModel, noise: float = 0.0, seed: int = 0) -> list[Point]:
    wrong = np.exp(noise * np.random.default_rng(seed).standard_normal(len(PLAN)))
    return [
        Point(
            arch=arch,
            runtime="tensorrt",
            precision="fp32",
            resolution=resolution,
            fps=1000 / (predict_ms(truth, arch, resolution) * factor),
            evidence="measured",
            source="made up",
        )
        for (arch, resolution), factor in zip(PLAN, wrong, strict=True)
    ]


def device(start: float, work: float, warp: float, gmac_3d: float = 0.0) -> LatencyModel:
    """The prior with its coefficients multiplied, and 3D convs that it knows nothing of."""
    per = {name: work * ms for name, ms in KNOWN.ms_per.items()}
    per |= {"mvoxel_warp": warp * KNOWN.ms_per["mvoxel_warp"], "gmac_3d": gmac_3d}
    return KNOWN.model_copy(update={"start_ms": start * KNOWN.start_ms, "ms_per": per})


def errors(model: LatencyModel, truth: LatencyModel) -> Floats:
    found: Floats = np.abs(latencies_ms(model, UNSEEN) / latencies_ms(truth, UNSEEN) - 1)
    return found


def test_a_device_as_fast_as_the_prior_says_keeps_the_prior() -> None:
    assert errors(posterior(points(KNOWN), KNOWN), KNOWN).mean() < 0.015


def test_a_device_that_is_slower_in_all_is_scaled() -> None:
    """The common factor costs the prior nearly nothing: 3 times everything is still that device."""
    slow = device(3, 3, 3)
    assert errors(posterior(points(slow), KNOWN), slow).mean() < 0.015


@pytest.mark.parametrize("truth", [device(0.2, 1.5, 0.1), device(0.3, 0.7, 0.2, gmac_3d=30.0)])
@pytest.mark.parametrize("seed", range(2))
def test_twelve_noisy_timings_predict_unseen_networks(truth: LatencyModel, seed: int) -> None:
    """The prior alone is off by a factor; the bar is 6% on average, at 3% of noise."""
    assert errors(KNOWN, truth).mean() > 0.5
    found = calibrated(points(truth, 0.03, seed), KNOWN, "made up")
    assert isinstance(found.model, LatencyModel)
    missed = errors(found.model, truth)
    assert missed.mean() < 0.06
    inside = np.log1p(missed) <= half_width(found.residuals, 0.9)
    assert inside.mean() >= 0.85


def test_a_form_that_waits_for_launches_is_fitted_too() -> None:
    per = {name: 3 * ms for name, ms in BOUND.ms_per.items()}
    truth = BOUND.model_copy(update={"start_ms": BOUND.start_ms / 3, "ms_per": per})
    found = posterior(points(truth, 0.02), BOUND)
    assert errors(found, truth).mean() < 0.06
    assert errors(BOUND, truth).mean() > 0.3


def test_no_coefficient_is_negative_and_the_shares_add_up() -> None:
    found = posterior(points(device(0.01, 2, 0.01), 0.05), KNOWN)
    assert min(found.start_ms, *found.ms_per.values()) >= 0
    for model in (found, BOUND):
        parts = shares(model, UNSEEN)
        assert parts.shape == (100, 1 + len(model.ms_per))
        assert parts.min() >= 0
        assert parts.sum(1) == pytest.approx(1)


def test_a_share_is_the_slope_of_the_logarithm() -> None:
    """Against a finite difference, for both ways to combine."""
    for model in (device(1, 1, 1, gmac_3d=10), BOUND):
        parts, before = shares(model, UNSEEN), np.log(latencies_ms(model, UNSEEN))
        for index, name in enumerate(model.ms_per, 1):
            more = {**model.ms_per, name: model.ms_per[name] * np.exp(1e-5)}
            after = np.log(latencies_ms(model.model_copy(update={"ms_per": more}), UNSEEN))
            assert (after - before) / 1e-5 == pytest.approx(parts[:, index], abs=1e-3)


def test_a_point_says_nothing_about_its_own_residual() -> None:
    """Doubling one time moves its own residual by ln 2 and nothing else of it."""
    known = points(device(0.5, 1, 1), 0.02)
    before = leave_one_out(known, KNOWN)
    spoiled = [*known[:4], known[4].model_copy(update={"fps": known[4].fps / 2}), *known[5:]]
    assert leave_one_out(spoiled, KNOWN)[4] - before[4] == pytest.approx(np.log(2))
