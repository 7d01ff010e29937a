"""The interval's half width: order statistics by hand, coverage by simulation."""

from math import sqrt

import numpy as np
import pytest

from rts2.model.errors import UsageError
from rts2.profiles.conformal import half_width

NINE = [0.3, -0.1, 0.5, -0.9, 0.2, 0.7, -0.4, 0.8, -0.6]
"""Their sizes are 0.1 … 0.9, so the k-th smallest is k / 10."""


@pytest.mark.parametrize(
    ("confidence", "rank"),
    [(0.9, 9), (0.81, 9), (0.8, 8), (0.79, 8), (0.5, 5), (0.11, 2), (0.1, 1), (0.01, 1)],
)
def test_the_order_statistic_by_hand(confidence: float, rank: int) -> None:
    """With nine residuals it is the ⌈10 · confidence⌉-th smallest size."""
    assert half_width(NINE, confidence) == pytest.approx(rank / 10)


@pytest.mark.parametrize(
    ("count", "confidence", "rank"), [(25, 0.9, 24), (15, 0.9, 15), (11, 0.9, 11)]
)
def test_the_rank_at_the_sizes_of_real_profiles(count: int, confidence: float, rank: int) -> None:
    assert half_width([float(n) for n in range(1, count + 1)], confidence) == rank


def test_a_rank_is_not_lost_to_rounding() -> None:
    """50 · 0.14 is 7 to a person and 7.000000000000001 to a computer."""
    assert 50 * 0.14 > 7
    assert half_width([float(n) for n in range(1, 50)], 0.14) == 7


def test_signs_and_order_do_not_matter() -> None:
    assert half_width([-value for value in reversed(NINE)], 0.6) == half_width(NINE, 0.6)


@pytest.mark.parametrize("count", [1, 4, 9, 15, 99])
def test_the_limit_is_n_over_n_plus_one(count: int) -> None:
    residuals = [float(n) for n in range(count)]
    limit = count / (count + 1)
    assert half_width(residuals, limit) == count - 1
    with pytest.raises(UsageError, match=f"{count} calibration points"):
        half_width(residuals, limit + 1e-6)


def test_no_points_bound_nothing() -> None:
    with pytest.raises(UsageError, match="0 calibration points"):
        half_width([], 0.5)


@pytest.mark.parametrize(("count", "confidence"), [(15, 0.94), (11, 0.92), (15, 0.9999)])
def test_a_refusal_tells_the_two_confidences_apart(count: int, confidence: float) -> None:
    """The bound that it names is not the one that it refuses, and 99.99% is not called 100%."""
    with pytest.raises(UsageError) as refusal:
        half_width([0.1] * count, confidence)
    words = str(refusal.value).replace(",", " ").replace(";", " ").split()
    allowed, asked, *_ = (float(word.rstrip("%")) for word in words if word.endswith("%"))
    assert allowed < asked < 100
    assert asked == pytest.approx(100 * confidence)
    assert half_width([0.1] * count, allowed / 100) == 0.1


@pytest.mark.parametrize(("count", "confidence"), [(15, 0.9), (11, 0.9), (25, 0.9), (20, 0.5)])
def test_coverage_holds_for_exchangeable_residuals(count: int, confidence: float) -> None:
    """Coverage is rank / (n + 1) for any continuous distribution: here a skewed heavy-tailed one.

    The share among 4000 trials strays from it by no more than four standard deviations.
    """
    trials = 4000
    draws = np.random.default_rng(7).standard_t(2, (trials, count + 1)) + 0.3
    held = sum(abs(row[-1]) <= half_width(list(row[:-1]), confidence) for row in draws)
    exact = np.ceil((count + 1) * confidence) / (count + 1)
    assert exact >= confidence
    assert held / trials == pytest.approx(exact, abs=4 * sqrt(exact * (1 - exact) / trials))
