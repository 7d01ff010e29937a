"""What accuracy means: its metrics, and the columns that a source fills over a block."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
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
    doubt: dict[Metric, Floats] = field(default_factory=dict)
    """The standard deviation of each metric, on the scale of `unbounded`, where it was carried
    over, zero elsewhere; no entry where nothing is known of it."""


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


def unbounded(metric: Metric, values: Floats) -> Floats:
    """A metric on a scale on which differences carry over from weak networks to strong ones: the
    natural logarithm of a percentage's odds, and of the EPE.
    """
    return np.log(values) if metric == "epe" else np.log(values / (100 - values))


def bounded(metric: Metric, values: Floats) -> Floats:
    """The inverse of `unbounded`."""
    return np.exp(values) if metric == "epe" else 100 / (1 + np.exp(-values))
