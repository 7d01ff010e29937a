"""Networks whose numbers were published: beside a front they tell where it stands.

They are no candidates. The paper's own rows are held against this device; the networks of the KITTI
benchmarks ran on other hardware and were judged on other images, and wherever they appear that is
said.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from ..model.arch import Arch
from ..model.files import parse_json
from ..model.ops import padded
from ..profiles.profile import Profile, Resolution
from .accuracy import METRICS, Metric
from .sources import published

Percent = Annotated[float, Field(ge=0, le=100)]
Runtime = Annotated[float, Field(gt=0)] | None
"""Seconds of one pair; None where the benchmark lists none."""

Origin = Literal["paper", "benchmark"]
"""The paper's networks on this device, or a benchmark's on other hardware."""


class _Row(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    network: Annotated[str, Field(min_length=1)]
    runtime_s: Runtime


class StereoRow(_Row):
    """A network of the KITTI 2015 stereo benchmark."""

    d1_bg: Percent
    d1_fg: Percent
    d1_all: Percent


class SemanticRow(_Row):
    """A network of the KITTI 2015 segmentation benchmark."""

    iou_class: Percent
    iiou_class: Percent
    iou_category: Percent
    iiou_category: Percent


class Benchmarks(BaseModel):
    """What the paper quotes of both benchmarks."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    schema_: Literal["rts2.published-benchmarks/1"] = Field(alias="schema")
    source: str
    protocol: str
    stereo: Annotated[tuple[StereoRow, ...], Field(min_length=1)]
    semantic: Annotated[tuple[SemanticRow, ...], Field(min_length=1)]


@dataclass(frozen=True)
class Published:
    """One network with its published speed and accuracies."""

    name: str
    origin: Origin
    fps: float
    metrics: Mapping[Metric, float]
    """What is known; other metrics are missing."""
    notes: tuple[str, ...]
    """Where the numbers come from, line by line."""


def benchmarks() -> Benchmarks:
    """The benchmark tables that come with rts2."""
    text = (resources.files(__package__) / "published" / "benchmarks.json").read_text("utf-8")
    return parse_json(text, Benchmarks, "the published benchmarks")


def context(profile: Profile, resolution: Resolution) -> list[Published]:
    """The paper's networks as published for this device at this input size, and the benchmarks'."""
    return [*of_paper(profile, resolution), *of_benchmarks(benchmarks())]


def of_paper(profile: Profile, resolution: Resolution) -> list[Published]:
    """The networks that the paper timed on the device; none at another input size."""
    size = padded(resolution, Arch().multiple)
    known = {row.arch: row for row in published().rows}
    found = []
    for point in profile.points:
        row = known.get(point.arch)
        same = padded(point.resolution, Arch().multiple) == size
        if row is None or point.evidence != "published" or not same:
            continue
        values = {metric: row.value(metric) for metric in METRICS}
        metrics = {metric: value for metric, value in values.items() if value is not None}
        found.append(Published(point.arch.label(), "paper", point.fps, metrics, (point.source,)))
    return found


def of_benchmarks(tables: Benchmarks) -> list[Published]:
    """Each row that lists a runtime; the class IoU of the benchmark is the mean IoU."""
    stereo: list[tuple[_Row, Metric, float]] = [(r, "d1_all", r.d1_all) for r in tables.stereo]
    semantic: list[tuple[_Row, Metric, float]] = [(r, "miou", r.iou_class) for r in tables.semantic]
    return [
        Published(row.network, "benchmark", 1 / row.runtime_s, {metric: value}, (tables.source,))
        for row, metric, value in (*stereo, *semantic)
        if row.runtime_s is not None
    ]
