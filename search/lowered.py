"""What a lower precision costs in accuracy: measured on the networks in the box, for all others.

A row tells by how much each metric of one network changed. Between rows of a stage count and
variant a change is linear in log2(c); it is the same for every d_max and 3D width.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Annotated, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from ..model.arch import Arch, Branches, Precision
from ..model.files import parse_json
from ..profiles.evidence import BRANCHES
from ..profiles.latency import Floats
from .accuracy import LOWER_IS_BETTER, METRICS, Accuracy, Metric, over_c
from .space import Space

KEEPS_ACCURACY: tuple[Precision, ...] = ("fp32", "fp16")
"""Half precision of 11 bits rounds far below the tables' last digit."""

Kind = TypeVar("Kind", bound=np.generic)

Points = Annotated[float, Field(ge=-100, le=100)] | None


class Row(BaseModel):
    """By how much one network's metrics changed: points, and pixels for the EPE."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    arch: Arch
    precision: Precision
    d1_all: Points = None
    epe: Points = None
    miou: Points = None
    pacc: Points = None

    def change(self, metric: Metric) -> float | None:
        """A change for the worse; what got better by chance counts as no change."""
        value: float | None = getattr(self, metric)
        if value is None:
            return None
        return max(value, 0.0) if LOWER_IS_BETTER[metric] else min(value, 0.0)


class LoweredRows(BaseModel):
    """The changes that were measured."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    schema_: Literal["rts2.lowered/1"] = Field(alias="schema")
    protocol: str
    """Which weights on which frames, how quantized, where and when."""
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class Lowered:
    """The accuracy of networks in lower precisions, from their accuracy in fp32."""

    table: LoweredRows

    def knows(self, precision: Precision) -> bool:
        """Whether anything is known of a precision."""
        return precision in KEEPS_ACCURACY or bool(self._rows(precision))

    def applied(
        self, accuracy: Accuracy, space: Space, stages: int, precision: Precision
    ) -> Accuracy:
        """The accuracy of one block in a precision: no row of a source is one any more.

        NaN for variants that were not measured; beyond the measured c it is extrapolated.
        """
        if precision in KEEPS_ACCURACY:
            return accuracy
        dimensions = len(space.axes(stages))
        changed: dict[Metric, Floats] = {
            metric: accuracy.metrics[metric]
            + _wide(self._change(space.c, stages, precision, metric), dimensions)
            for metric in METRICS
        }
        inside = _wide(self._inside(space.c, stages, precision), dimensions)
        outside = accuracy.extrapolated | ~inside
        return Accuracy(changed, np.zeros_like(accuracy.exact), outside, accuracy.doubt)

    def _change(
        self, cs: Sequence[int], stages: int, precision: Precision, metric: Metric
    ) -> Floats:
        """(variants, c)"""
        known = (
            (
                (row.arch.c, change)
                for row in self._of(precision, stages, branches)
                if (change := row.change(metric)) is not None
            )
            for branches in BRANCHES
        )
        return np.stack([over_c(cs, pairs) for pairs in known])

    def _inside(self, cs: Sequence[int], stages: int, precision: Precision) -> NDArray[np.bool_]:
        """Which lie between rows, (variants, c)."""
        found = np.zeros((len(BRANCHES), len(cs)), dtype=bool)
        for level, branches in enumerate(BRANCHES):
            known = [row.arch.c for row in self._of(precision, stages, branches)]
            if known:
                found[level] = (np.array(cs) >= min(known)) & (np.array(cs) <= max(known))
        return found

    def _of(self, precision: Precision, stages: int, branches: Branches) -> list[Row]:
        wanted = stages, branches
        return [r for r in self._rows(precision) if (r.arch.stages, r.arch.branches) == wanted]

    def _rows(self, precision: Precision) -> list[Row]:
        return [row for row in self.table.rows if row.precision == precision]


@cache
def measured() -> Lowered:
    """The changes that come with rts2."""
    text = (resources.files(__package__) / "measured" / "lowered.json").read_text("utf-8")
    return Lowered(parse_json(text, LoweredRows, "the accuracies in lower precision"))


def _wide(values: NDArray[Kind], dimensions: int) -> NDArray[Kind]:
    """(variants, c) shaped to broadcast over a block."""
    return values.reshape(*values.shape, *[1] * (dimensions - 2))
