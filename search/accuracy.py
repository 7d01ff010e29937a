"""What accuracy means: its metrics, and the columns that a source fills over a block."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from ..model.arch import Arch
from ..profiles.latency import Floats
from .space import Space

Metric = Literal["d1_all", "epe", "miou", "pacc"]
METRICS: tuple[Metric, ...] = ("d1_all", "epe", "miou", "pacc")

LOWER_IS_BETTER: dict[Metric, bool] = {"d1_all": True, "epe": True, "miou": False, "pacc": False}
"""The direction of each metric: an accuracy without one cannot be compared."""

Percent = Annotated[float, Field(ge=0, le=100)] | None
Pixels = Annotated[float, Field(ge=0, allow_inf_nan=False)] | None


class Row(BaseModel):
    """The accuracy of one network; None where it was not reported."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    arch: Arch
    d1_all: Percent = None
    epe: Pixels = None
    miou: Percent = None
    pacc: Percent = None
    source: str = ""

    def value(self, metric: Metric) -> float | None:
        """One metric by its name."""
        found: float | None = getattr(self, metric)
        return found


@dataclass(frozen=True)
class Accuracy:
    """The columns of one block; every array has, or broadcasts to, the block's shape."""

    metrics: dict[Metric, Floats]
    exact: NDArray[np.bool_]
    """Where a row of the source names this very network."""
    extrapolated: NDArray[np.bool_]


class AccuracySource(Protocol):
    """Anything that knows accuracies."""

    @property
    def exact_evidence(self) -> Literal["published", "measured"]:
        """What a row of the source counts as."""

    @property
    def named(self) -> tuple[Arch, ...]:
        """The networks that a user named himself, so that none is dropped in silence."""

    def columns(self, space: Space, stages: int) -> Accuracy:
        """The accuracy of every arch of one block."""


def over_c(cs: Sequence[int] | Floats, pairs: Iterable[tuple[int, float]]) -> Floats:
    """Linear in log2(c) between the pairs, constant beyond; NaN without any."""
    known = sorted(pairs)
    if not known:
        return np.full(len(cs), np.nan)
    xs, ys = zip(*known, strict=True)
    return np.asarray(np.interp(np.log2(cs), np.log2(xs), ys))
