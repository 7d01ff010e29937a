"""What 3D widths and planes of the first volume do to accuracy, where no network was trained so.

Measured on networks that share the weights of a supernet, as differences from the paper's widths
and planes. Carried over to other weights and images they are extrapolations, and have intervals.

An effect is a difference on the scale of `accuracy.unbounded`: of the logarithm of a percentage's
odds, and of the EPE.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from math import hypot
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from ..model.arch import CONV3D, Arch, Branches
from ..model.files import parse_json
from ..profiles.evidence import BRANCHES
from ..profiles.latency import Floats
from .accuracy import Metric
from .space import Space

UNTRIED: Final = 2.0
"""By how much more than measured an effect is in doubt for weights and images that nobody tried."""

Spread = Annotated[float, Field(ge=0, le=1)]


class Curve(BaseModel):
    """The effect of one dimension's values."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    values: tuple[Annotated[int, Field(ge=1)], ...]
    effects: tuple[Annotated[float, Field(ge=-3, le=3)], ...]

    @model_validator(mode="after")
    def _matching(self) -> Curve:
        if len(self.values) != len(self.effects) or list(self.values) != sorted(set(self.values)):
            raise ValueError("values must rise, with one of effects each")
        return self

    def at(self, wanted: Sequence[int]) -> Floats:
        """Linear in the logarithm of the value; NaN beyond what was measured."""
        x, known = np.log2(wanted), np.log2(self.values)
        return np.interp(x, known, self.effects, left=np.nan, right=np.nan)


class Row(BaseModel):
    """The effects on one metric of networks of one stage count and variant."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    stages: Annotated[int, Field(ge=1, le=3)]
    branches: Branches
    metric: Metric
    d_max: Curve
    conv3d: tuple[Curve, ...]
    """One for each stage."""
    spread: Spread
    """The standard deviation of what the sum of effects misses: between networks of other c, and
    of several changes at once."""

    @model_validator(mode="after")
    def _whole(self) -> Row:
        if len(self.conv3d) != self.stages:
            raise ValueError(f"conv3d must have one curve for each of {self.stages} stages")
        return self


class EffectRows(BaseModel):
    """The effects that were measured."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    schema_: Literal["rts2.effects/1"] = Field(alias="schema")
    protocol: str
    """Which supernet on which images, where and when."""
    inherited: Spread
    """The standard deviation by which the effect on the D1-all of networks trained alone differs
    from what is inherited."""
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class Effects:
    """The effects of every network's widths and planes, from the paper's."""

    table: EffectRows

    def of(self, space: Space, stages: int, metric: Metric) -> tuple[Floats, Floats]:
        """The effects over a block, and how far they are in doubt as a standard deviation: both
        (variants, 1, d_max, one axis a stage).

        NaN where nothing was measured; zeros for the paper's own widths and planes.
        """
        axes = (space.d_max, *space.conv3d[:stages])
        found: Floats = np.full((len(BRANCHES), 1, *map(len, axes)), np.nan)
        doubts = np.zeros_like(found)
        for row in self.table.rows:
            if (row.stages, row.metric) == (stages, metric):
                level = BRANCHES.index(row.branches)
                found[level, 0] = _sum(row, axes)
                # Class scores see neither the volumes nor their regularization.
                inherited = self.table.inherited if metric in ("d1_all", "epe") else 0.0
                doubts[level] = UNTRIED * hypot(row.spread, inherited)
        usual = _usual(axes)
        found[:, :, usual], doubts[:, :, usual] = 0.0, 0.0
        return found, doubts


def _sum(row: Row, axes: Sequence[Sequence[int]]) -> Floats:
    """The effects of all dimensions together."""
    found = np.zeros(())
    for curve, values in zip((row.d_max, *row.conv3d), axes, strict=True):
        found = found[..., None] + curve.at(values)
    return found


def _usual(axes: Sequence[Sequence[int]]) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Where the paper's own widths and planes stand."""
    found = np.ones((), dtype=bool)
    for values, usual in zip(axes, (Arch().d_max, *CONV3D), strict=False):
        found = found[..., None] & (np.array(values) == usual)
    return found


@cache
def measured_effects() -> Effects:
    """The effects that come with rts2."""
    text = (resources.files(__package__) / "measured" / "effects.json").read_text("utf-8")
    return Effects(parse_json(text, EffectRows, "the effects of 3D widths and planes"))
