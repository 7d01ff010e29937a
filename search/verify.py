"""The front held against the device itself: predictions give way to measurements."""

from __future__ import annotations

from collections.abc import Callable
from math import exp
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np

from ..model.console import progress
from ..model.errors import UsageError
from ..model.machine import cores
from ..profiles.here import elsewhere
from ..profiles.profile import Profile
from .accuracy import METRICS
from .exhaustive import Question, choices
from .front import loss, unbeaten
from .result import Found, Point, Verified

if TYPE_CHECKING:
    from ..model.metrics import Score
    from ..profiles.timing import Timing
    from .tried import Tried

Trying = Callable[[Point], "Tried | None"]
"""Tries one point; None where this machine cannot run it as it is meant."""


def verified(found: Found, question: Question, trying: Trying) -> Found:
    """The same front with every point timed and judged that can be, and the pick chosen anew.

    What another point beats once tried leaves the front; a pick that misses its target is told as
    demoted. Raises `UsageError` where this machine is not the device.
    """
    require_here(question.profile)
    shown = progress(found.front, "verifying", len(found.front))
    tried = [(point, trying(point)) for point in shown]
    unreliable = sum(each is not None and not each.timing.reliable for _, each in tried)
    front = [_measured(point, each, found.confidence) for point, each in tried]
    timed = sum(point.evidence.latency == "measured" for point in front)
    kept = _kept(front, question)
    again = next((p for p in front if found.selected and _same(p, found.selected)), None)
    missed = again is not None and _holding_fps(again, question) < question.target_fps
    told = Verified(
        timed=timed,
        unreliable=unreliable,
        predicted=len(front) - timed - unreliable,
        demoted=again if missed else None,
    )
    return found.model_copy(
        update={"front": tuple(kept), **choices(question, kept), "verified": told}
    )


def require_here(profile: Profile) -> None:
    """Raises `UsageError` unless the profile is of the machine at hand."""
    told = ["its profile is of no machine"]
    if profile.machine is not None:
        told = elsewhere(profile.machine, cores())
    if told:
        raise UsageError(
            f"--verify times on the device itself, and {profile.title} is not this machine "
            f"({told[0]}); leave it out, or rts2-profile fit makes this machine's profile"
        )


def _measured(point: Point, tried: Tried | None, confidence: float) -> Point:
    """A point as it turned out; on a busy machine nothing is learnt of its latency."""
    if tried is None:
        return point
    judged = {} if tried.score is None else _figures(tried.score)
    timed = _timed(tried.timing, confidence) if tried.timing.reliable else {}
    told = {name: "measured" for name, new in (("latency", timed), ("accuracy", judged)) if new}
    evidence = point.evidence.model_copy(update=told)
    return point.model_copy(update={**timed, **judged, "evidence": evidence})


def _timed(timing: Timing, confidence: float) -> dict[str, float]:
    """Latency and FPS with the interval of the timing."""
    latency = timing.ratio * timing.own_ms
    half = NormalDist().inv_cdf((1 + confidence) / 2) * timing.error
    fps = 1000 / latency
    ends = {"fps_low": fps * exp(-half), "fps_high": fps * exp(half)}
    return {"latency_ms": latency, "fps": fps, **ends}


def _figures(score: Score) -> dict[str, float | None]:
    return {metric: getattr(score, metric) for metric in METRICS}


def _kept(front: list[Point], question: Question) -> list[Point]:
    """What no other point beats, by falling FPS; by the rules of the search."""
    objectives = [
        (1 / _holding_fps(point, question), loss(point, question.objective)) for point in front
    ]
    doubtful = [
        (point.evidence.latency == "extrapolated", point.evidence.accuracy == "extrapolated")
        for point in front
    ]
    kept = unbeaten(np.array(objectives).reshape(-1, 2), np.array(doubtful, bool).reshape(-1, 2))
    chosen = [point for point, keep in zip(front, kept, strict=True) if keep]
    return sorted(chosen, key=lambda point: -point.fps)


def _holding_fps(point: Point, question: Question) -> float:
    """The frame rate that must meet the target."""
    return point.fps_low if question.at_lower_bound else point.fps


def _same(one: Point, other: Point) -> bool:
    """Whether two points are one candidate."""
    return (one.arch, one.precision, one.runtime) == (other.arch, other.precision, other.runtime)
