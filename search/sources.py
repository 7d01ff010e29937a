"""Where accuracies come from: the paper's tables, or a file of measurements."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from ..model.arch import STRIDES, Arch, Branches
from ..model.files import parse_json, read_json
from ..profiles.evidence import BRANCHES, boxes
from ..profiles.latency import Floats
from .accuracy import METRICS, Accuracy, AccuracySource, Metric, Row, bounded, over_c, unbounded
from .effects import Effects, measured_effects
from .space import Space


class Disparities(BaseModel):
    """How often each disparity occurs, in bins of one pixel from zero on."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    counts: tuple[Annotated[int, Field(ge=0)], ...]
    source: str

    @model_validator(mode="after")
    def _some(self) -> Disparities:
        if not sum(self.counts):
            raise ValueError("counts are all zero")
        return self

    def share_from(self, pixels: int) -> float:
        """The percentage of ground truth at `pixels` of disparity or more."""
        return 100 * sum(self.counts[pixels:]) / sum(self.counts)

    def overshoot(self, pixels: int) -> float:
        """By how many pixels, on average over all ground truth, disparities exceed `pixels`."""
        excess = sum((at + 0.5 - pixels) * n for at, n in enumerate(self.counts) if at >= pixels)
        return excess / sum(self.counts)


class PublishedRows(BaseModel):
    """The paper's accuracy tables."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    schema_: Literal["rts2.published-accuracy/1"] = Field(alias="schema")
    protocol: str
    rows: tuple[Row, ...]
    disparities: Disparities


class MeasuredRows(BaseModel):
    """Accuracies that a user measured, one row an arch."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    schema_: Literal["rts2.accuracy/1"] = Field(alias="schema")
    rows: Annotated[tuple[Row, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _distinct(self) -> MeasuredRows:
        seen: set[Arch] = set()
        for at, row in enumerate(self.rows):
            if row.arch in seen:
                raise ValueError(f"rows.{at} names {row.arch.label()} twice")
            seen.add(row.arch)
            if all(row.value(metric) is None for metric in METRICS):
                raise ValueError(f"rows.{at} measures nothing; give one of {', '.join(METRICS)}")
        return self


def source(name: str) -> AccuracySource:
    """The source that `--accuracy` names: `published`, or a JSON file of measured rows.

    Raises:
        UsageError: there is no such file.
        Rts2Error: the file is no accuracy table; names the first wrong field.
    """
    if name == "published":
        return Published(published(), measured_effects())
    return Measured(read_json(Path(name), MeasuredRows, "a table of accuracies"))


def published() -> PublishedRows:
    """The paper's accuracy tables, which come with rts2."""
    text = (resources.files(__package__) / "published" / "kitti2015.json").read_text("utf-8")
    return parse_json(text, PublishedRows, "the published accuracies")


@dataclass(frozen=True)
class Published:
    """Monotone interpolation of the paper's tables; exact at each of their rows.

    Over c it is linear in log2(c). A stage count other than three keeps the ratio of its D1 to
    the full network's, known at few c and held constant beyond them (then extrapolated). The
    variant without refinement lies between its neighbours by the share that the ablation gives.
    A first volume too small for a disparity loses the pixels that have it. What else other planes
    and 3D widths change is carried over from networks of shared weights.
    """

    table: PublishedRows
    effects: Effects
    exact_evidence: Literal["published"] = "published"
    named: tuple[Arch, ...] = ()

    def columns(self, space: Space, stages: int) -> Accuracy:
        """NaN where neither a row nor an effect says anything."""
        effects = {metric: self.effects.of(space, stages, metric) for metric in METRICS}
        metrics = {
            metric: bounded(metric, unbounded(metric, self._metric(space, stages, metric)) + effect)
            for metric, (effect, _) in effects.items()
        }
        doubt = {
            metric: np.broadcast_to(d, space.shape(stages)) for metric, (_, d) in effects.items()
        }
        box = boxes(row.arch for row in self.table.rows)[stages]
        exact = _mark_rows(space, stages, self.table.rows, metrics)
        return Accuracy(metrics, exact, ~space.inside(stages, box), doubt)

    def _metric(self, space: Space, stages: int, metric: Metric) -> Floats:
        """With the paper's 3D widths, (variants, c, d_max, 1 for each stage)."""
        per_c = np.full((len(BRANCHES), len(space.c)), np.nan)
        known = self._by_c(space.c, metric) * self._stage_ratio(space.c, stages, metric)
        per_c[:] = known
        values = per_c[:, :, None] + self._lost(space.d_max, metric)
        return values.reshape(*values.shape, *[1] * stages)

    def _by_c(self, cs: Sequence[int], metric: Metric) -> Floats:
        """The metric of three-stage networks, (variants, c)."""
        least, _, most = BRANCHES
        low, high = (over_c(cs, self._pairs(b, metric)) for b in (least, most))
        return np.stack([low, low + (high - low) * self._share(metric), high])

    def _share(self, metric: Metric) -> float:
        """How far from disparity alone to the full network the variant between them lies."""
        least, between, most = BRANCHES
        cs, values = np.array(self._pairs(between, metric)).T
        low, high = (over_c(cs, self._pairs(b, metric)) for b in (least, most))
        return float(np.mean((values - low) / (high - low)))

    def _stage_ratio(self, cs: Sequence[int], stages: int, metric: Metric) -> Floats | float:
        """How much worse than three stages this stage count is, (c,)."""
        if stages == 3:
            return 1.0
        pairs = []
        for row in self.table.rows:
            value = row.value(metric) if row.arch.stages == stages else None
            whole = dict(self._pairs(row.arch.branches, metric)).get(row.arch.c)
            if value is not None and whole is not None:
                pairs.append((row.arch.c, value / whole))
        return over_c(cs, pairs)

    def _lost(self, d_maxs: Sequence[int], metric: Metric) -> Floats:
        """What a first volume of each size loses against the paper's, (d_max,)."""
        counted: dict[Metric, Callable[[int], float]] = {
            "d1_all": self.table.disparities.share_from,
            "epe": self.table.disparities.overshoot,
        }
        if metric not in counted:
            return np.zeros(len(d_maxs))
        paper = counted[metric](STRIDES[0] * Arch().d_max)
        return np.array([counted[metric](STRIDES[0] * d_max) - paper for d_max in d_maxs])

    def _pairs(self, branches: Branches, metric: Metric) -> list[tuple[int, float]]:
        """(c, value) of the three-stage rows of a variant."""
        return [
            (row.arch.c, value)
            for row in self.table.rows
            if (row.arch.branches, row.arch.stages) == (branches, 3)
            and (value := row.value(metric)) is not None
        ]


@dataclass(frozen=True)
class Measured:
    """Rows that a user measured: each network named is known exactly, every other one not."""

    table: MeasuredRows
    exact_evidence: Literal["measured"] = "measured"

    @property
    def named(self) -> tuple[Arch, ...]:
        return tuple(row.arch for row in self.table.rows)

    def columns(self, space: Space, stages: int) -> Accuracy:
        """NaN wherever no row names the network."""
        shape = space.shape(stages)
        metrics: dict[Metric, Floats] = {m: np.full(shape, np.nan) for m in METRICS}
        exact = _mark_rows(space, stages, self.table.rows, metrics)
        return Accuracy(metrics, exact, np.zeros(shape, dtype=bool))


def _mark_rows(
    space: Space, stages: int, rows: Iterable[Row], metrics: dict[Metric, Floats]
) -> NDArray[np.bool_]:
    """Writes the rows' own values into `metrics`; returns where they stand."""
    exact = np.zeros(space.shape(stages), dtype=bool)
    for row in rows:
        position = space.position(row.arch) if row.arch.stages == stages else None
        if position is None:
            continue
        exact[position] = True
        for metric in METRICS:
            value = row.value(metric)
            metrics[metric][position] = np.nan if value is None else value
    return exact
