"""The front held against the device itself: predictions give way to timings."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import exp
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np

from ..model.arch import Arch
from ..model.errors import UsageError
from ..model.machine import cores
from ..profiles.here import elsewhere
from ..profiles.profile import Profile
from .accuracy import LOWER_IS_BETTER
from .exhaustive import Question, choices
from .front import nondominated
from .result import Found, Point, Verified

if TYPE_CHECKING:
    from ..model.rts2net import RTS2Net
    from ..profiles.timing import Timing

Clock = Callable[[Point], "Timing | None"]
"""Times one point; None where this machine cannot run it as it is meant."""


def verified(
    found: Found, question: Question, network: Callable[[Arch], RTS2Net], clock: Clock | None = None
) -> Found:
    """The same front with every point timed that can be, and the pick chosen anew.

    `network` gives a point's weights. What another point beats once timed leaves the front; a pick
    that misses its target is told as demoted. Raises `UsageError` where this machine is not the
    device.
    """
    require_here(question.profile)
    clock = clock or timed_here(question, network)
    front = list(_timed(found, clock))
    timed = sum(point.evidence.latency == "measured" for point in front)
    chosen = choices(question, _kept(front, found))
    again = next((p for p in front if found.selected and _same(p, found.selected)), None)
    missed = again is not None and again.fps < question.target_fps
    told = Verified(timed=timed, predicted=len(front) - timed, demoted=again if missed else None)
    return found.model_copy(
        update={"front": tuple(_kept(front, found)), **chosen, "verified": told}
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


def timed_here(question: Question, network: Callable[[Arch], RTS2Net]) -> Clock:
    """Times points on this machine, as its profile was timed."""
    from ..model.checkpoint import build
    from ..profiles import timing
    from ..profiles.measure import REFERENCE
    from ..profiles.runtimes import Sized, open_session, precisions_of

    arch, size = REFERENCE
    threads = cores()
    first = open_session("onnxruntime", Sized(build(arch), size), "fp32", threads)
    reference = timing.Reference(first.run)

    def timed(point: Point) -> timing.Timing | None:
        sized = Sized(network(point.arch), question.resolution, point.arch.stages)
        if point.precision not in precisions_of(point.runtime, sized):
            return None
        session = open_session(point.runtime, sized, point.precision, threads)
        return timing.measure(session.run, reference)

    return timed


def _timed(found: Found, clock: Clock) -> Iterator[Point]:
    """Every point, timed where the clock can."""
    doubt = NormalDist().inv_cdf((1 + found.confidence) / 2)
    for point in found.front:
        timing = clock(point)
        if timing is None:
            yield point
            continue
        latency = timing.ratio * timing.own_ms
        fps, half = 1000 / latency, doubt * timing.error
        yield point.model_copy(
            update={
                "latency_ms": latency,
                "fps": fps,
                "fps_low": fps * exp(-half),
                "fps_high": fps * exp(half),
                "evidence": point.evidence.model_copy(update={"latency": "measured"}),
            }
        )


def _kept(front: list[Point], found: Found) -> list[Point]:
    """What no other point beats, by falling FPS."""
    direction = 1 if LOWER_IS_BETTER[found.objective] else -1
    losses = [direction * (point.metric(found.objective) or 0.0) for point in front]
    promised = [not point.proven for point in front]
    kept = nondominated(np.column_stack([[p.latency_ms for p in front], losses, promised]))
    chosen = [point for point, keep in zip(front, kept, strict=True) if keep]
    return sorted(chosen, key=lambda point: -point.fps)


def _same(one: Point, other: Point) -> bool:
    """Whether two points are one candidate."""
    return (one.arch, one.precision, one.runtime) == (other.arch, other.precision, other.runtime)
