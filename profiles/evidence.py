"""Where a number comes from, told by where a candidate lies among the known points."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

from ..model.arch import Arch, Branches

Evidence = Literal["published", "measured", "interpolated", "extrapolated"]

BRANCHES: tuple[Branches, ...] = ("disparity", "disparity+semantic", "full")
"""The variants by rising number of branches."""

Range = tuple[int, int]
"""Lowest and highest, both known."""


@dataclass(frozen=True)
class Box:
    """The ranges that the known points of one stage count span, per searched dimension."""

    c: Range
    branches: Range
    """As positions in `BRANCHES`."""
    d_max: Range
    conv3d: tuple[Range, ...]

    def holds(self, arch: Arch) -> bool:
        """Whether known points lie on both sides of `arch` (or at it) in every dimension."""
        level = BRANCHES.index(arch.branches)
        values = (arch.c, level, arch.d_max, *arch.conv3d)
        ranges = (self.c, self.branches, self.d_max, *self.conv3d)
        return all(low <= value <= high for value, (low, high) in zip(values, ranges, strict=True))


def boxes(archs: Iterable[Arch]) -> dict[int, Box]:
    """The box of each stage count among `archs`."""
    known = list(archs)
    return {
        stages: _box([arch for arch in known if arch.stages == stages])
        for stages in sorted({arch.stages for arch in known})
    }


def part_boxes(archs: Iterable[Arch]) -> dict[int, Box]:
    """The box of each stage count, where latencies are sums of parts: a stage takes what it takes
    in every network that runs through it, and only the head is a stage count's own.
    """
    known = list(archs)
    return {
        stages: _with_heads(
            _box([arch.up_to(stages) for arch in known if arch.stages >= stages]),
            {arch.semantic for arch in known if arch.stages == stages},
        )
        for stages in sorted({arch.stages for arch in known})
    }


def _with_heads(box: Box, semantic: set[bool]) -> Box:
    """The box less the variants whose head nobody timed."""
    low, high = box.branches
    return replace(box, branches=(low if False in semantic else 1, high if True in semantic else 0))


def _box(archs: list[Arch]) -> Box:
    return Box(
        c=_range(arch.c for arch in archs),
        branches=_range(BRANCHES.index(arch.branches) for arch in archs),
        d_max=_range(arch.d_max for arch in archs),
        conv3d=tuple(_range(widths) for widths in zip(*(a.conv3d for a in archs), strict=True)),
    )


def _range(values: Iterable[int]) -> Range:
    known = list(values)
    return min(known), max(known)
