"""What a search found, as it stands in front.json: written by one command, read by another."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
)

from ..model.arch import Arch, Precision
from ..model.files import read_json
from ..profiles.evidence import Evidence
from ..profiles.profile import Resolution, Runtime
from .accuracy import Metric

Task = Literal["semantic-stereo", "stereo"]
Number = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Seconds = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=0)]


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)


class PointEvidence(_Frozen):
    """Where a point's two numbers come from."""

    latency: Evidence
    accuracy: Evidence


class Point(_Frozen):
    """One candidate with everything known of it; None where nobody knows."""

    arch: Arch
    precision: Precision
    runtime: Runtime
    latency_ms: Positive
    fps: Positive
    fps_low: Positive
    fps_high: Positive
    d1_all: Number | None
    epe: Number | None
    miou: Number | None
    pacc: Number | None
    params: Count
    size_bytes: Count
    macs: Count
    evidence: PointEvidence
    ranges: dict[Metric, tuple[Number, Number]] | None = None
    """Where metrics lie at the search's confidence, of an accuracy that was carried over; None
    where no interval is known."""

    @model_serializer(mode="wrap")
    def _told(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        told: dict[str, Any] = handler(self)
        return {name: each for name, each in told.items() if name != "ranges" or each}

    def metric(self, name: Metric) -> float | None:
        """One accuracy by its name."""
        value: float | None = getattr(self, name)
        return value

    @property
    def proven(self) -> bool:
        """Whether neither number is extrapolated."""
        return "extrapolated" not in (self.evidence.latency, self.evidence.accuracy)


class LeftOut(_Frozen):
    """Candidates that could not enter the front, and why."""

    reason: str
    count: Count


class Coverage(_Frozen):
    """How many candidates there are, and how many were looked at."""

    size: Count
    evaluated: Count
    exhaustive: bool


class Cost(_Frozen):
    """What a measured search took."""

    wall_s: Seconds
    """Of this run."""
    evaluations: Count
    """Chains judged in this study, in all its runs."""
    fresh: Count
    """Of them in this run, by all workers."""
    cache_hits: Count
    """Of all evaluations those that the cache on disk told."""
    failed: Count
    workers: Count
    """Processes that judged, in all runs."""
    evaluation_s: Seconds
    """What the evaluations took, all workers together."""
    candidates: Count
    """Chains that hold a network which meets the target."""
    training_s: Seconds | None
    """How long the supernet trained; None where no record tells."""


class Verified(_Frozen):
    """What was tried on the device itself."""

    timed: Count
    unreliable: Count
    """Points that were timed while the machine was busy: their latencies stay predictions."""
    predicted: Count
    """Points that could not be tried here, and keep their predictions."""
    demoted: Point | None
    """The pick by prediction, as timed, where it misses the target."""


class Found(_Frozen):
    """The result of a search: schema rts2.search/1."""

    schema_: Literal["rts2.search/1"] = Field(default="rts2.search/1", alias="schema")
    device: str
    target_fps: Positive
    resolution: Resolution
    task: Task
    objective: Metric
    confidence: Annotated[float, Field(gt=0, lt=1)]
    space: Coverage
    front: tuple[Point, ...]
    """By falling FPS."""
    selected: Point | None
    prospect: Point | None
    nearest: Point | None
    left_out: tuple[LeftOut, ...]
    elapsed_s: Seconds
    cost: Cost | None = None
    """Of a measured search."""
    verified: Verified | None = None
    """Where the front was timed."""

    @model_serializer(mode="wrap")
    def _told(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """A search that measured nothing tells no cost of it."""
        told: dict[str, Any] = handler(self)
        optional = ("cost", "verified")
        return {name: each for name, each in told.items() if name not in optional or each}


def read(path: Path) -> Found:
    """A front.json. Raises `UsageError` where there is none, `Rts2Error` where it is another's."""
    return read_json(path, Found, "a search result")
