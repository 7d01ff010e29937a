"""Latency by parts: what each part of the network takes on one machine, as tables.

A network of the family `rts2net` is a chain of parts (the encoder, an embedding, a volume, …), and
each part depends on one or two numbers: channels c, planes, the width of its 3D convs. Timing whole
networks node by node fills a table of every part, at every value that was timed: what a runtime
makes of 15, 16 or 17 channels stands in the table as it is, and no curve smooths it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from math import prod
from typing import Annotated, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from ..model.arch import FACTORS, SPACE_C, SPACE_CONV3D, SPACE_D_MAX, STRIDES, Arch, Form
from ..model.errors import Rts2Error
from ..model.ops import Op

Floats = NDArray[np.float64]
Milliseconds = Annotated[float, Field(gt=0, le=1e6)]


class Part(NamedTuple):
    """One part of one network: what its cost depends on."""

    name: str
    at: tuple[int, ...]
    """What the part's axes say, in the order of `AXES`."""
    pixels: int
    """Of the network's input."""


AXES: dict[str, tuple[str, ...]] = {
    "encoder": ("c",),
    "context": ("c",),
    **{f"embedding.{stage}": ("c",) for stage in range(3)},
    **{f"volume.{stage}": ("c", "planes") for stage in range(3)},
    **{f"regularize.{stage}": ("width", "planes") for stage in range(3)},
    **{f"semantics.{stage}": ("c",) for stage in range(3)},
    **{f"refine.{stage}": ("planes",) for stage in range(3)},
    **{f"head.{stage}": ("semantic",) for stage in range(3)},
    **{f"banded.{stage}": ("width", "planes") for stage in range(3)},
}
"""The parts of a network, and what each depends on: `banded` is `regularize` in its other form."""

_VALUES = {"c": SPACE_C, "semantic": (0, 1)}


def axis_values(part: str) -> tuple[tuple[int, ...], ...]:
    """The values of the searched space along each axis of a part."""
    stage = int(part[-1]) if part[-1].isdigit() else 0
    planes = SPACE_D_MAX if stage == 0 else (Arch().planes(stage),)
    known = _VALUES | {"planes": planes, "width": SPACE_CONV3D[stage]}
    return tuple(known[axis] for axis in AXES[part])


_ROOMS = (
    (re.compile(r"encoder\.context\b"), "context"),
    (re.compile(r"encoder\b"), "encoder"),
    (re.compile(r"disparity\.levels\.(\d)"), "embedding"),
    (re.compile(r"(?:semantic\.levels|classify)\.(\d)"), "semantics"),
    (re.compile(r"(volume|regularize|refine)\.(\d)"), ""),
    (re.compile(r"output\b"), "head"),
)


def in_form(part: str, forms: Sequence[Form] | None) -> str:
    """The name of a part where the stages' 3D convs have these forms; all are 3d without them."""
    room, _, stage = part.partition(".")
    banded = room == "regularize" and forms and forms[int(stage)] == "banded"
    return f"banded.{stage}" if banded else part


def part_of(node: str, stages: int) -> str:
    """The part that a node of an exported graph belongs to, by its name.

    Raises `Rts2Error` for a node of no part.
    """
    for pattern, name in _ROOMS:
        if found := pattern.match(node):
            if name == "head":
                return f"head.{stages - 1}"
            return ".".join(filter(None, (name, *found.groups())))
    raise Rts2Error(f"the node {node} belongs to no part of the network, so its time is nobody's")


def per_part(
    node_ms: Mapping[str, float],
    arch: Arch,
    total_ms: float,
    forms: Sequence[Form] | None = None,
) -> dict[str, float]:
    """Sums of times by node over each part, scaled so that they add up to `total_ms`."""
    found: dict[str, float] = {}
    for node, ms in node_ms.items():
        part = in_form(part_of(node, arch.stages), forms)
        found[part] = found.get(part, 0.0) + ms
    scale = total_ms / sum(found.values())
    return {part: ms * scale for part, ms in found.items()}


_ANCHORS: dict[str, str] = {
    "encoder.stem.0.conv": "encoder",
    "encoder.context.pool": "context",
    **{f"disparity.{stage}.0.conv": f"embedding.{stage}" for stage in range(3)},
    **{f"volume.{stage}": f"volume.{stage}" for stage in range(3)},
    **{f"regularize.{stage}.0.conv": f"regularize.{stage}" for stage in range(3)},
    **{f"classify.{stage}": f"semantics.{stage}" for stage in range(3)},
    **{f"refine.{stage}.compress": f"refine.{stage}" for stage in range(3)},
    "head.disparity": "head",
}
"""The step of an op list that tells each part's numbers."""

_KNOWN = {"around", "semantic", *(name.split(".")[0] for name in _ANCHORS)}
"""How the names of the steps begin."""


def parts(steps: Sequence[Op], forms: Sequence[Form] | None = None) -> tuple[Part, ...]:
    """The parts that an op list of the family `rts2net` runs through, in these forms.

    Raises `Rts2Error` that names a step of another family.
    """
    for op in steps:
        if op.name.split(".")[0] not in _KNOWN:
            raise Rts2Error(
                f"{op.name} has no cost in a profile by parts, which knows rts2net alone; "
                "time the network itself: rts2-profile measure"
            )
    semantic = int(any(op.name == "head.semantic" for op in steps))
    found = (_part(_ANCHORS[op.name], op, semantic) for op in steps if op.name in _ANCHORS)
    return tuple(part._replace(name=in_form(part.name, forms)) for part in found)


def _part(name: str, op: Op, semantic: int) -> Part:
    inputs, output = op.inputs[0], op.output
    if name == "head":
        stride = output[-1] // inputs[-1]
        stage = STRIDES.index(stride)
        return Part(f"head.{stage}", (semantic,), output[-1] * output[-2])
    stage = int(name[-1]) if name[-1].isdigit() else 0
    room = name.split(".")[0]
    at = {
        "encoder": (output[1],),
        "context": (inputs[1] // FACTORS[0],),
        "embedding": (output[1] // FACTORS[stage],),
        "volume": (inputs[1] // FACTORS[stage], output[1]),
        "regularize": (output[1], output[2]),
        "semantics": (inputs[1] // FACTORS[stage],),
        "refine": (output[1],),
    }[room]
    stride = {"encoder": 1, "context": STRIDES[0]}.get(room, STRIDES[stage])
    sides = inputs if room == "context" else output
    return Part(name, at, sides[-1] * sides[-2] * stride**2)


class PartTable(BaseModel):
    """The cost of one part at every value of its axes, for each input size."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    axes: tuple[tuple[int, ...], ...]
    ms: tuple[tuple[Milliseconds, ...], ...]
    """One row a size; a row is laid out with the last axis running fastest."""

    @model_validator(mode="after")
    def _shaped(self) -> PartTable:
        cells = prod(len(axis) for axis in self.axes)
        if any(len(row) != cells for row in self.ms):
            raise ValueError(f"its axes have {cells} places and a row of ms has another number")
        if any(list(axis) != sorted(set(axis)) for axis in self.axes):
            raise ValueError("the values of an axis must rise")
        return self

    @cached_property
    def grid(self) -> Floats:
        """(sizes, len(axis), …), in milliseconds."""
        return np.array(self.ms).reshape(len(self.ms), *(len(axis) for axis in self.axes))

    def at(self, place: tuple[int, ...]) -> Floats:
        """The cost at each size, (sizes,): linear between values, the last one beyond them."""
        values = self.grid
        for axis, value in reversed(list(zip(self.axes, place, strict=True))):
            position = float(np.interp(value, axis, np.arange(len(axis))))
            low = min(int(position), max(len(axis) - 2, 0))
            share = position - low
            upper = values[..., min(low + 1, len(axis) - 1)]
            values = (1 - share) * values[..., low] + share * upper
        return values


class PartModel(BaseModel):
    """The latency of every network of the space on one machine, runtime and precision."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    form: Literal["parts"] = "parts"
    pixels: tuple[Annotated[int, Field(gt=0)], ...] = Field(min_length=1)
    """Of the input sizes that were timed, rising."""
    tables: dict[str, PartTable]

    @model_validator(mode="after")
    def _whole(self) -> PartModel:
        if list(self.pixels) != sorted(set(self.pixels)):
            raise ValueError("pixels must rise")
        for name, table in self.tables.items():
            if name not in AXES:
                raise ValueError(f"{name} is no part; known are {', '.join(AXES)}")
            if len(table.axes) != len(AXES[name]) or len(table.ms) != len(self.pixels):
                raise ValueError(f"{name} needs the axes {AXES[name]} and a row a size")
        return self

    def cost_ms(self, part: Part) -> float:
        """What one part takes; `Rts2Error` names a part that nobody timed."""
        table = self.tables.get(part.name)
        if table is None:
            raise Rts2Error(f"{part.name} has no cost in this profile; fit it again")
        return _scaled(self.pixels, table.at(part.at), part.pixels)

    def total_ms(self, found: Iterable[Part]) -> float:
        """What parts take one after the other."""
        return sum(self.cost_ms(part) for part in found)

    def forms(self, found: Iterable[Part]) -> tuple[Form, ...]:
        """For each stage of a network, given by its parts, the faster form of its 3D convs."""
        return tuple(
            "3d" if self._faster(part) is part else "banded"
            for part in found
            if part.name.startswith("regularize.")
        )

    def fastest_ms(self, found: Iterable[Part]) -> float:
        """What parts take, each in its faster form."""
        return self.total_ms(self._faster(part) for part in found)

    def _faster(self, part: Part) -> Part:
        """The part itself, or its banded form where that was timed and takes less."""
        banded = part._replace(name=part.name.replace("regularize.", "banded."))
        if banded.name == part.name or banded.name not in self.tables:
            return part
        return banded if self.cost_ms(banded) < self.cost_ms(part) else part


def _scaled(known: Sequence[int], costs: Floats, pixels: int) -> float:
    """A cost at another size: linear in the pixels, and below the smallest at least in proportion
    to it.
    """
    if len(known) == 1:
        return float(costs[0] * pixels / known[0])
    upper = min(max(int(np.searchsorted(known, pixels)), 1), len(known) - 1)
    low, high = known[upper - 1], known[upper]
    share = (pixels - low) / (high - low)
    linear = costs[upper - 1] + share * (costs[upper] - costs[upper - 1])
    return float(max(linear, costs[0] * min(pixels / known[0], 1.0)))
