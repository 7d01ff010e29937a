"""The space: every arch of it laid out as arrays, with what is additive summed by broadcasting.

A network is a chain of parts and each part depends on few dimensions, so a quantity that adds up
over steps (latency, weights, multiply-adds) is known for the whole space once it is known for
about a thousand parts.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from math import prod

import numpy as np
from numpy.typing import NDArray

from ..model.arch import SPACE_C, SPACE_CONV3D, SPACE_D_MAX, Arch
from ..model.ops import (
    Op,
    Size,
    embedding,
    encoder,
    head,
    padded,
    refinement,
    regularization,
    semantics,
    volume,
)
from ..profiles.evidence import BRANCHES, Box
from ..profiles.latency import Floats, Steps

CLASSES = 19
"""KITTI's and Cityscapes' train ids."""


@dataclass(frozen=True)
class Space:
    """The values that each searched dimension takes."""

    c: tuple[int, ...] = SPACE_C
    stages: tuple[int, ...] = (1, 2, 3)
    d_max: tuple[int, ...] = SPACE_D_MAX
    conv3d: tuple[tuple[int, ...], ...] = SPACE_CONV3D

    def axes(self, stages: int) -> tuple[tuple[int, ...], ...]:
        """The dimensions of a block: branches (as positions), c, d_max, one width per stage."""
        levels = tuple(range(len(BRANCHES)))
        return (levels, self.c, self.d_max, *self.conv3d[:stages])

    def shape(self, stages: int) -> tuple[int, ...]:
        """How long each axis of a block is."""
        return tuple(len(axis) for axis in self.axes(stages))

    def size(self) -> int:
        """How many archs there are; widths of stages that an arch lacks are not counted."""
        return sum(prod(self.shape(stages)) for stages in self.stages)

    def arch(self, stages: int, position: tuple[int, ...]) -> Arch:
        """The arch at one position of a block."""
        values = [axis[at] for axis, at in zip(self.axes(stages), position, strict=True)]
        level, c, d_max, *widths = values
        return Arch(
            c=c,
            stages=stages,
            d_max=d_max,
            conv3d=tuple(widths),
            semantic=level >= 1,
            refinement=level == 2,
            classes=CLASSES,
        )

    def position(self, arch: Arch) -> tuple[int, ...] | None:
        """Where `arch` stands in its block; None outside the space."""
        values = (BRANCHES.index(arch.branches), arch.c, arch.d_max, *arch.conv3d)
        axes = self.axes(arch.stages)
        inside = arch.family == "rts2net" and arch.classes == CLASSES and arch.stages in self.stages
        if not inside or any(v not in axis for v, axis in zip(values, axes, strict=True)):
            return None
        return tuple(axis.index(value) for value, axis in zip(values, axes, strict=True))

    def along(self, stages: int, axis: int) -> NDArray[np.int64]:
        """The values of one axis, shaped to broadcast over its block."""
        values = self.axes(stages)[axis]
        shape = [1] * len(self.axes(stages))
        shape[axis] = len(values)
        return np.array(values).reshape(shape)

    def inside(self, stages: int, box: Box) -> NDArray[np.bool_]:
        """Which archs of a block lie in `box`, one flag each."""
        flags = np.ones((1,) * len(self.axes(stages)), dtype=bool)
        for axis, (low, high) in enumerate(_ranges(box)):
            values = self.along(stages, axis)
            flags = flags & (values >= low) & (values <= high)
        return np.broadcast_to(flags, self.shape(stages))

    def nearest(self, stages: int, box: Box) -> tuple[NDArray[np.int64], ...]:
        """For each axis of a block, the positions of its values moved into `box`."""
        return tuple(
            np.array([_closest(values, value, low, high) for value in values])
            for values, (low, high) in zip(self.axes(stages), _ranges(box), strict=True)
        )


def _closest(values: tuple[int, ...], target: int, low: int, high: int) -> int:
    """The position of the value nearest to `target` in low … high, or nearest to that range."""
    away = [(max(low - value, value - high, 0), abs(value - target)) for value in values]
    return away.index(min(away))


def _ranges(box: Box) -> tuple[tuple[int, int], ...]:
    return (box.branches, box.c, box.d_max, *box.conv3d)


@dataclass(frozen=True)
class Parts:
    """The parts of every network of a space at one input size, as one flat list of op lists."""

    space: Space
    steps: Steps
    shapes: dict[str, tuple[int, ...]]

    @classmethod
    @lru_cache(maxsize=4)
    def of(cls, space: Space, resolution: tuple[int, int]) -> Parts:
        """Tabulates each part over the dimensions that it depends on; the last few are kept."""
        size = padded(resolution, Arch().multiple)
        tables = dict(_tables(space, size))
        lists = [steps for table in tables.values() for steps in table.steps]
        return cls(space, Steps.of(lists), {name: table.shape for name, table in tables.items()})

    def totals(self, stages: int, per_list: Floats) -> Floats:
        """Sums of a quantity over each network of a block, from its value per op list.

        Returns an array of `space.shape(stages)`.
        """
        value = self._split(per_list)
        full = BRANCHES.index("full")
        per_c = value["encoder"].copy()
        for stage in range(stages):
            per_c += value["embedding"][stage]
            per_c[1:] += value["semantics"][stage]
            if stage:
                per_c += value["volume"][stage - 1]
                per_c[full] += value["refinement"][stage - 1]
        per_c += value["head"][stages - 1][:, None]
        total = per_c[:, :, None] + value["first_volume"][None]
        total[full] += value["first_refinement"][None]
        total = total[..., None] + value["first_regularization"]
        for stage in range(1, stages):
            total = total[..., None] + value[f"regularization.{stage}"]
        return total

    def _split(self, per_list: Floats) -> dict[str, Floats]:
        found, start = {}, 0
        for name, shape in self.shapes.items():
            found[name] = per_list[start : start + prod(shape)].reshape(shape)
            start += prod(shape)
        return found


@dataclass(frozen=True)
class _Table:
    shape: tuple[int, ...]
    steps: list[tuple[Op, ...]]


def _tables(space: Space, size: Size) -> Iterator[tuple[str, _Table]]:
    cs, d_maxs, all_stages = space.c, space.d_max, range(3)
    later = (1, 2)
    planes = Arch().planes(1)

    def table(shape: tuple[int, ...], lists: Iterator[Iterator[Op]]) -> _Table:
        return _Table(shape, [tuple(ops) for ops in lists])

    yield (
        "encoder",
        table((3, len(cs)), (encoder(c, branches, size) for branches in BRANCHES for c in cs)),
    )
    yield (
        "embedding",
        table((3, len(cs)), (embedding(c, stage, size) for stage in all_stages for c in cs)),
    )
    yield (
        "semantics",
        table(
            (3, len(cs)), (semantics(c, stage, CLASSES, size) for stage in all_stages for c in cs)
        ),
    )
    yield (
        "volume",
        table((2, len(cs)), (volume(c, stage, planes, size) for stage in later for c in cs)),
    )
    yield (
        "first_volume",
        table((len(cs), len(d_maxs)), (volume(c, 0, d_max, size) for c in cs for d_max in d_maxs)),
    )
    yield (
        "first_refinement",
        table((len(d_maxs),), (refinement(0, d_max, CLASSES, size) for d_max in d_maxs)),
    )
    yield (
        "refinement",
        table((2,), (refinement(stage, planes, CLASSES, size) for stage in later)),
    )
    yield (
        "first_regularization",
        table(
            (len(d_maxs), len(space.conv3d[0])),
            (regularization(w, 0, d_max, size) for d_max in d_maxs for w in space.conv3d[0]),
        ),
    )
    for stage in later:
        widths = space.conv3d[stage]
        yield (
            f"regularization.{stage}",
            table((len(widths),), (regularization(w, stage, planes, size) for w in widths)),
        )
    yield (
        "head",
        table(
            (3, 3),
            (head(stage, level > 0, CLASSES, size) for stage in all_stages for level in range(3)),
        ),
    )
