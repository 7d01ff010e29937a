"""The exact Pareto front, and the pick on it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import product

import moocore
import numpy as np
from numpy.typing import NDArray

from ..profiles.latency import Floats
from .accuracy import LOWER_IS_BETTER, Metric
from .result import Point


def nondominated(objectives: Floats) -> NDArray[np.bool_]:
    """Which rows no other row beats, all objectives to be minimized: (n, objectives) → (n,).

    Of equal rows the first stays (moocore's dimension-sweep in C).
    """
    if len(objectives) == 0:
        return np.zeros(0, dtype=bool)
    return np.asarray(moocore.is_nondominated(np.ascontiguousarray(objectives)), dtype=bool)


def unbeaten(objectives: Floats, doubtful: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which of (n, 2) objectives and (n, 2) doubts no other beats: first among those of like
    doubts, which leaves few, then among all.
    """
    kept = np.zeros(len(objectives), dtype=bool)
    for alike in product((False, True), repeat=2):
        own = np.flatnonzero((doubtful == alike).all(axis=1))
        kept[own] = nondominated(objectives[own])
    left = np.flatnonzero(kept)
    kept[left] = nondominated(np.column_stack([objectives[left], doubtful[left]]))
    return kept


def pick(
    front: Iterable[Point], target_fps: float, objective: Metric, at_lower_bound: bool
) -> Point | None:
    """The most accurate of `front` that meets the target, the faster one of equals.

    `at_lower_bound` asks the interval's lower end to meet it, not the nominal value.
    """
    meeting = [
        point for point in front if (point.fps_low if at_lower_bound else point.fps) >= target_fps
    ]
    return min(meeting, key=lambda point: (loss(point, objective), -point.fps), default=None)


def fastest(front: Sequence[Point]) -> Point | None:
    """The fastest on proven numbers, or the fastest of all where none are."""
    proven = [point for point in front if point.proven]
    return max(proven or front, key=lambda point: point.fps, default=None)


def loss(point: Point, objective: Metric) -> float:
    """The objective with lower always better."""
    value = point.metric(objective)
    if value is None:
        return float("inf")
    return value if LOWER_IS_BETTER[objective] else -value
