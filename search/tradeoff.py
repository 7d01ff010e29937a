"""What one more frame per second costs: the points of the front around one of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from .accuracy import LOWER_IS_BETTER, Metric
from .front import pick
from .report import NAMES, believable, number
from .result import Found, Point

REACH = 3
"""Neighbours on either side."""

POINTS: dict[Metric, str] = {
    "d1_all": "points",
    "epe": "px",
    "miou": "points",
    "pacc": "points",
}
"""The unit of a difference."""


@dataclass(frozen=True)
class Step:
    """From one point of the front to another."""

    base: Point
    point: Point

    @property
    def fps(self) -> float:
        """Frames per second more."""
        return self.point.fps - self.base.fps

    def change(self, metric: Metric) -> float | None:
        """By how much a metric rises; None where one of the two is unknown."""
        before, after = self.base.metric(metric), self.point.metric(metric)
        return None if before is None or after is None else after - before

    def worse(self, metric: Metric) -> float | None:
        """By how much a metric gets worse."""
        change = self.change(metric)
        return change if change is None or LOWER_IS_BETTER[metric] else -change

    def per_fps(self, metric: Metric) -> float | None:
        """What each frame per second costs of a metric, whichever way the step goes."""
        worse = self.worse(metric)
        return worse / self.fps if worse is not None and self.fps else None


def steps(found: Found, base: Point) -> list[Step]:
    """To the neighbours of `base` on its evidence or better, by falling FPS.

    At most `REACH` on either side; those as fast as it is are none.
    """
    others = _others(found, base)
    faster = [point for point in others if point.fps > base.fps]
    slower = [point for point in others if point.fps < base.fps]
    return [Step(base, point) for point in (*faster[-REACH:], *slower[:REACH])]


def price(found: Found, base: Point) -> Step | None:
    """To the best point that is at least one frame per second faster; None without any."""
    point = pick(_others(found, base), base.fps + 1, found.objective, at_lower_bound=False)
    return Step(base, point) if point else None


def sentence(found: Found, base: Point) -> str:
    """What one more frame per second costs, in words."""
    step, objective = price(found, base), found.objective
    if step is None:
        return "No network of the front is one FPS faster on the same evidence."
    worse = step.worse(objective)
    cost = "an unknown amount" if worse is None else f"{max(worse, 0):.2f} {POINTS[objective]}"
    told = number(objective, step.point.metric(objective))
    return (
        f"One more FPS costs {cost} of {NAMES[objective]}: {step.point.arch.label()} has "
        f"{step.point.fps:.1f} FPS and {told}."
    )


def _others(found: Found, base: Point) -> Sequence[Point]:
    """The believable front without `base`, by falling FPS."""
    return [point for point in believable(found) if point != base]
