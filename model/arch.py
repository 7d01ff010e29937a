"""The frozen value that names one network, and the presets."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from .errors import UsageError
from .files import first_fault

Family = Literal["rts2net", "anynet"]
Branches = Literal["disparity", "disparity+semantic", "full"]
Precision = Literal["fp32", "bf16", "fp16", "int8"]
Form = Literal["3d", "banded"]
"""How a graph holds the 3D convs of a stage: as such, or as 2D convs with banded weights."""

UNTRAINED = "untrained"
"""The origin of random weights."""

MEAN = (0.485, 0.456, 0.406)
STD = (0.229, 0.224, 0.225)
"""ImageNet's, for RGB in 0 … 1: what every network expects its images normalised with."""

STRIDES = (16, 8, 4)
"""The resolution of stages 1, 2, 3 as a divisor of the image's (paper, section III-C)."""

FACTORS = (8, 4, 2)
"""Features of both embeddings at stages 1, 2, 3, in multiples of c (AnyNet's way up)."""

RADIUS = 2
"""Residual volumes look this many planes to both sides (paper, section III-C)."""

CONV3D = (16, 4, 4)
"""The paper's 3D convolution widths for stages 1, 2, 3."""

SPACE_C = tuple(range(1, 33))
SPACE_D_MAX = tuple(range(6, 25))
SPACE_CONV3D = ((4, 8, 12, 16, 24, 32), (2, 4, 6, 8, 12, 16), (2, 4, 6, 8, 12, 16))
"""What each dimension takes in the space that is searched and timed."""


class Arch(BaseModel):
    """One network of the space: hashable, serializable, the only thing a network is built from.

    `c` is the paper's width factor, `stages` how many of the three run, `d_max` the planes of the
    first volume (each 16 pixels wide), `conv3d` one 3D convolution width per stage.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    family: Family = "rts2net"
    c: Annotated[int, Field(ge=1, le=64)] = 8
    stages: Annotated[int, Field(ge=1, le=3)] = 3
    d_max: Annotated[int, Field(ge=2, le=48)] = 12
    conv3d: tuple[Annotated[int, Field(ge=1, le=64)], ...] = CONV3D
    semantic: bool = True
    refinement: bool = True
    classes: Annotated[int, Field(ge=2, le=256)] = 19

    @model_validator(mode="before")
    @classmethod
    def _fill(cls, values: Any) -> Any:
        """Widths default to the paper's for the stages there are; AnyNet has no other branches."""
        if not isinstance(values, dict):
            return values
        filled = dict(values)
        stages = filled.get("stages", 3)
        if "conv3d" not in filled and isinstance(stages, int):
            filled["conv3d"] = CONV3D[:stages]
        if filled.get("family") == "anynet":
            filled.setdefault("semantic", False)
        if filled.get("semantic") is False:
            filled.setdefault("refinement", False)
        return filled

    @model_validator(mode="after")
    def _consistent(self) -> Arch:
        if len(self.conv3d) != self.stages:
            raise ValueError(f"conv3d needs one width per stage, {self.stages} in all")
        if self.refinement and not self.semantic:
            raise ValueError("refinement needs the semantic branch")
        if self.family == "anynet" and self.semantic:
            raise ValueError("the anynet family has no semantic branch")
        return self

    @property
    def branches(self) -> Branches:
        """The variant: which branches this arch has."""
        if self.refinement:
            return "full"
        return "disparity+semantic" if self.semantic else "disparity"

    @property
    def multiple(self) -> int:
        """Image sides are padded to a multiple of this."""
        return 32 if self.family == "rts2net" else 16

    def planes(self, stage: int) -> int:
        """Disparity planes of the volume of `stage` (0, 1 or 2)."""
        return self.d_max if stage == 0 else 2 * RADIUS + 1

    def up_to(self, stages: int | None) -> Arch:
        """The arch stopped early after `stages` stages (all of them for None)."""
        if stages in (None, self.stages):
            return self
        if not 1 <= stages <= self.stages:
            raise UsageError(f"stages must be 1 to {self.stages} for this network, not {stages}")
        return self.model_copy(update={"stages": stages, "conv3d": self.conv3d[:stages]})

    def missing_from(self, other: Arch) -> list[str]:
        """What keeps this arch from being cut out of `other`'s weights; empty when nothing does."""
        same = [
            f"{name} is {getattr(other, name)}, {getattr(self, name)} was asked for"
            for name in ("family", "c", "d_max", "classes")
            if getattr(self, name) != getattr(other, name)
            and not (name == "classes" and not self.semantic)
        ]
        if self.stages > other.stages:
            same.append(f"stages is {other.stages}, {self.stages} was asked for")
        elif self.conv3d != other.conv3d[: self.stages]:
            same.append(f"conv3d is {list(other.conv3d)}, {list(self.conv3d)} was asked for")
        lacking = [b for b in ("semantic", "refinement") if getattr(self, b) > getattr(other, b)]
        return same + [f"it has no {branch} branch" for branch in lacking]

    def label(self) -> str:
        """A short name for tables and messages."""
        if self.family == "anynet":
            return f"AnyNet c={self.c}, {_count(self.stages, 'stage')}"
        return f"c={self.c}, {_count(self.stages, 'stage')}, {self.branches}"


LARGEST = Arch(
    c=SPACE_C[-1], d_max=SPACE_D_MAX[-1], conv3d=tuple(widths[-1] for widths in SPACE_CONV3D)
)
"""The network that holds all others of the space."""


def arch_from(values: dict[str, Any]) -> Arch:
    """An `Arch` from loose values; a wrong one raises a one-line `UsageError`."""
    try:
        return Arch.model_validate(values)
    except ValidationError as error:
        raise UsageError(f"arch: {first_fault(error)}") from error


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" + ("" if number == 1 else "s")
