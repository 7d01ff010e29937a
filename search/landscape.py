"""What a study searches: chains of networks that one evaluation judges, and how fast each runs.

A chain is a width, a first volume and one 3D width a stage. Judging its whole network judges every
network that it holds, of fewer stages or branches, at no cost.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import inf, prod

import numpy as np
from numpy.typing import NDArray

from ..model.arch import Arch, Precision
from ..model.errors import UsageError
from ..profiles.evidence import BRANCHES
from ..profiles.latency import Floats
from .accuracy import METRICS, Accuracy, Metric
from .exhaustive import Question, speeds
from .lowered import Lowered, measured
from .space import CLASSES, Space

Positions = NDArray[np.int64]


@dataclass(frozen=True)
class Chains:
    """The chains of a space that weights of `whole` hold."""

    space: Space
    whole: Arch

    @classmethod
    def of(cls, whole: Arch, space: Space) -> Chains:
        """The part of the space that a supernet's largest network holds.

        Raises `UsageError` where it holds nothing of a dimension, or has other classes.
        """
        if whole.classes != CLASSES:
            raise UsageError(
                f"the space is of {CLASSES} classes, and the supernet of {whole.classes}; train "
                "one of those classes"
            )
        widths = [
            _held(f"3D width of stage {stage}", values, most)
            for stage, (values, most) in enumerate(zip(space.conv3d, whole.conv3d, strict=False), 1)
        ]
        part = Space(
            c=_held("c", space.c, whole.c),
            stages=_held("number of stages", space.stages, whole.stages),
            d_max=_held("d_max", space.d_max, whole.d_max),
            conv3d=tuple(widths),
        )
        return cls(part, whole)

    @property
    def stages(self) -> int:
        """How many stages a whole chain has."""
        return self.space.stages[-1]

    @property
    def levels(self) -> int:
        """How many variants of branches a chain holds."""
        return 1 + BRANCHES.index(self.whole.branches)

    @property
    def size(self) -> int:
        """How many chains there are."""
        return self.count(self.stages)

    @cached_property
    def axes(self) -> dict[str, tuple[int, ...]]:
        """The dimensions by name."""
        c, d_max, *widths = self.space.axes(self.stages)[1:]
        named = {f"conv3d_{stage}": values for stage, values in enumerate(widths, 1)}
        return {"c": c, "d_max": d_max, **named}

    def shape(self, stages: int) -> tuple[int, ...]:
        """How many values each dimension has, up to `stages` stages."""
        return self.space.shape(stages)[1:]

    def count(self, stages: int) -> int:
        """How many beginnings of `stages` stages chains have."""
        return prod(self.shape(stages))

    def values(self, chain: int) -> dict[str, int]:
        """A chain by its number, as one value a dimension."""
        at = np.unravel_index(chain, self.shape(self.stages))
        return {name: axis[i] for (name, axis), i in zip(self.axes.items(), at, strict=True)}

    def number(self, values: Mapping[str, int]) -> int:
        """The inverse of `values`."""
        at = tuple(axis.index(values[name]) for name, axis in self.axes.items())
        return int(np.ravel_multi_index(at, self.shape(self.stages)))

    def arch(self, values: Mapping[str, int]) -> Arch:
        """The whole network of a chain."""
        c, d_max, *widths = (values[name] for name in self.axes)
        update = {"c": c, "d_max": d_max, "stages": self.stages, "conv3d": tuple(widths)}
        return self.whole.model_copy(update=update)

    def flat(self, arch: Arch) -> int | None:
        """Where a network stands in its block, flattened; None outside of the space."""
        position = self.space.position(arch)
        if position is None:
            return None
        return int(np.ravel_multi_index(position, self.space.shape(arch.stages)))

    def nearest(self, arch: Arch) -> int:
        """The chain that comes nearest to `arch`; stages that it lacks are as wide as usual."""
        wanted = (arch.c, arch.d_max, *arch.conv3d, *Arch().conv3d[arch.stages :])
        values = {
            name: axis[int(np.argmin(np.abs(np.subtract(axis, aim))))]
            for (name, axis), aim in zip(self.axes.items(), wanted, strict=False)
        }
        return self.number(values)

    def beginning(self, stages: int) -> Positions:
        """For every chain, the number of its first `stages` stages among all such beginnings."""
        own, whole = self.shape(stages), self.shape(self.stages)
        numbers = np.arange(prod(own)).reshape(*own, *(1 for _ in whole[len(own) :]))
        return np.broadcast_to(numbers, whole).reshape(-1)


def _held(name: str, values: Sequence[int], most: int) -> tuple[int, ...]:
    held = tuple(value for value in values if value <= most)
    if not held:
        raise UsageError(
            f"the supernet holds no network of the space: its {name} is at most {most}, the space "
            f"begins at {values[0]}; train a larger one"
        )
    return held


@dataclass(frozen=True)
class Course:
    """Networks of one stage count in one precision that meet the target."""

    stages: int
    precision: Precision
    proven: bool
    """Whether extrapolated latencies are left out."""
    at: Positions
    """Where they stand in their block, flattened, rising."""
    latency_ms: Floats
    changes: Mapping[Metric, Floats]
    """What the precision changes in each metric."""

    def of(self, position: int) -> float:
        """The latency of one network; infinite where it is not among them."""
        where = int(np.searchsorted(self.at, position))
        found = where < len(self.at) and self.at[where] == position
        return float(self.latency_ms[where]) if found else inf


@dataclass(frozen=True)
class Landscape:
    """All chains, and how fast every network that they hold is known to be."""

    chains: Chains
    target_ms: float
    courses: tuple[Course, ...]

    @classmethod
    def of(
        cls,
        question: Question,
        chains: Chains,
        metrics: Sequence[Metric],
        lowered: Lowered | None = None,
    ) -> Landscape:
        """What `question` admits; raises `UsageError` as the search does.

        A network is in it with its proven latency, which a pick needs, and with its smallest of
        all, which a prospect needs.
        """
        target_ms = 1000 / question.target_fps
        lowered = lowered or measured()
        found = []
        for (stages, precision, proven), latency in _fastest(question, chains.space).items():
            if lowered.knows(precision) and not (proven and question.allow_extrapolated):
                changes, known = _changes(chains, stages, precision, metrics, lowered)
                at = np.flatnonzero(known & (latency <= target_ms))
                own = {metric: values[at] for metric, values in changes.items()}
                found.append(Course(stages, precision, proven, at, latency[at], own))
        return cls(chains, target_ms, tuple(course for course in found if len(course.at)))

    @cached_property
    def admitted(self) -> Positions:
        """The chains that hold a network which meets the target."""
        flags = np.zeros(self.chains.size, dtype=bool)
        for course in self.courses:
            meeting = np.zeros(self.chains.count(course.stages), dtype=bool)
            meeting[course.at % len(meeting)] = True
            flags |= meeting[self.chains.beginning(course.stages)]
        return np.flatnonzero(flags)

    def latency_ms(self, arch: Arch) -> float:
        """The smallest latency of a network; infinite where it does not meet the target."""
        flat = self.chains.flat(arch)
        if flat is None:
            return inf
        own = (course.of(flat) for course in self.courses if course.stages == arch.stages)
        return min(own, default=inf)


def _fastest(question: Question, space: Space) -> dict[tuple[int, Precision, bool], Floats]:
    """The smallest latency by stages, precision, and whether it must be proven."""
    found: dict[tuple[int, Precision, bool], Floats] = {}
    for speed in speeds(question, space):
        for proven in (True, False):
            own = np.where(speed.proven | (not proven), speed.latency_ms, np.inf)
            key = (speed.stages, speed.executor.precision, proven)
            found[key] = np.minimum(found.get(key, np.inf), own)
    return found


def _changes(
    chains: Chains, stages: int, precision: Precision, metrics: Sequence[Metric], lowered: Lowered
) -> tuple[dict[Metric, Floats], NDArray[np.bool_]]:
    """What a precision changes in each network of a block, and for which that is known."""
    none: Floats = np.zeros(chains.space.shape(stages))
    flat = Accuracy(dict.fromkeys(METRICS, none), none > 0, none > 0)
    changed = lowered.applied(flat, chains.space, stages, precision).metrics
    changes = {metric: changed[metric].reshape(-1) for metric in metrics}
    known = np.arange(none.size) < chains.levels * chains.count(stages)
    for values in changes.values():
        known &= ~np.isnan(values)
    return changes, known
