"""What a fit is worth where it extrapolates: whole groups of points left out at once.

Leaving out one point asks about its neighbours; leaving out a family of networks, or a stage count,
asks about networks unlike any that was timed. The intervals of extrapolated latencies are judged by
these errors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..model.arch import Arch
from ..model.errors import Rts2Error
from ..model.ops import ops
from .latency import Floats, LatencyModel, Steps, latencies_ms
from .parts import PartModel, parts
from .profile import HeldOut, HoldOut, Misses, Point

Refit = Callable[[Sequence[Point]], LatencyModel | PartModel]
"""Points → the model fitted to them; `Rts2Error` where they are too few."""

GROUPS: dict[str, Callable[[Arch], str]] = {
    "family": lambda arch: arch.branches if arch.family == "rts2net" else arch.family,
    "stages": lambda arch: str(arch.stages),
}
"""How points are grouped: by the variant of the network, by its number of stages."""


def hold_outs(points: Sequence[Point], refit: Refit) -> HeldOut:
    """Each group of each grouping predicted by a fit on all the others."""
    return HeldOut(**{by: _hold_out(points, group, refit) for by, group in GROUPS.items()})


def _hold_out(points: Sequence[Point], group: Callable[[Arch], str], refit: Refit) -> HoldOut:
    errors = {}
    for name in dict.fromkeys(group(point.arch) for point in points):
        left_out = [point for point in points if group(point.arch) == name]
        others = [point for point in points if group(point.arch) != name]
        errors[name] = _errors(left_out, others, refit)
    everything = [error for found in errors.values() for error in found]
    return HoldOut(
        **_misses(everything).model_dump(),
        groups={name: _misses(found) for name, found in errors.items()},
    )


def _errors(left_out: Sequence[Point], others: Sequence[Point], refit: Refit) -> list[float]:
    """Relative errors of the frame rates; none where the others are too few to fit or to tell."""
    true = np.array([point.latency_ms for point in left_out])
    try:
        predicted = _predicted(refit(others), left_out)
    except Rts2Error:
        return []
    return [float(error) for error in np.abs(true / predicted - 1)]


def _predicted(model: LatencyModel | PartModel, points: Sequence[Point]) -> Floats:
    """Latencies of the points, in the forms that they were timed in."""
    steps = [ops(point.arch, point.resolution) for point in points]
    if isinstance(model, LatencyModel):
        return latencies_ms(model, Steps.of(steps))
    timed = zip(steps, points, strict=True)
    return np.array([model.total_ms(parts(found, point.forms)) for found, point in timed])


def _misses(errors: Sequence[float]) -> Misses:
    if not errors:
        return Misses(n=0)
    return Misses(n=len(errors), mean=float(np.mean(errors)), worst=max(errors))


def errors_told(found: HoldOut) -> str:
    """A hold-out in one line."""
    unknown = [name for name, misses in found.groups.items() if not misses.n]
    rest = f"too few points remain without {', '.join(unknown)}" if unknown else ""
    if found.mean is None or found.worst is None:
        return rest
    known = f"{found.mean:.1%} mean, {found.worst:.1%} worst of {found.n}"
    return f"{known}; {rest}" if rest else known
