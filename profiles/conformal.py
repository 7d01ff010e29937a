"""Intervals that hold by counting, not by assuming a distribution."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, floor

from ..model.errors import UsageError


def half_width(residuals: Sequence[float], confidence: float) -> float:
    """How far, in natural logarithm, the truth strays from a prediction at most.

    `residuals` are leave-one-out ln(true / predicted). Among n exchangeable residuals a new one
    stays below the ⌈(n + 1) · confidence⌉-th smallest with at least that probability
    (split-conformal prediction, Vovk et al. 2005).

    Raises:
        UsageError: so few points have no bound at that confidence.
    """
    count = len(residuals)
    rank = ceil((count + 1) * confidence - 1e-9)
    if rank > count:
        limit = floor(1000 * count / (count + 1)) / 10
        raise UsageError(
            f"{count} calibration points bound nothing above {limit:g}% confidence, "
            f"and {100 * confidence:g}% was asked for; ask for {limit:g}% or less"
        )
    return sorted(abs(residual) for residual in residuals)[max(rank, 1) - 1]
