"""A device in one JSON file: what it can do, how fast, and where each number comes from."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    field_validator,
    model_validator,
)

from ..model.arch import Arch, Form, Precision
from ..model.errors import UsageError
from ..model.files import parse_json, read_json
from ..model.ops import Kind
from .features import FEATURES
from .latency import LatencyModel
from .parts import PartModel
from .trtexec import Generation

Runtime = Literal["pytorch", "onnxruntime", "openvino", "tensorrt"]
Side = Annotated[int, Field(ge=32, le=16384)]
Resolution = tuple[Side, Side]
Factor = Annotated[float, Field(gt=0, le=100)]

START = "start"
"""The key of the cost of starting a step among a derivation's factors."""


class Frozen(BaseModel):
    """A value of a profile: unknown fields are refused, known ones never change."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)


class Fact(Frozen):
    """One property of the hardware or its software, with its source."""

    name: str
    value: str
    source: str


class PrecisionSupport(Frozen):
    """Whether a precision is worth running on the device; a refusal says why and what instead."""

    precision: Precision
    supported: bool
    reason: str
    source: str


class RuntimeSupport(Frozen):
    """A runtime of the device and its limits."""

    runtime: Runtime
    version: str
    opset: Annotated[int, Field(ge=9, le=30)] | None = None
    """The highest ONNX opset that it reads."""
    operators: str | None = None
    """The name of the table of operators that it reads, among `opsets/`."""
    generations: tuple[Generation, ...] = ()
    """Of TensorRT: those that the device may have, the usual one first; without any, `version`
    tells the only one."""
    source: str


class Point(Frozen):
    """One timing of one network, batch 1, the network alone."""

    arch: Arch
    runtime: Runtime
    precision: Precision
    resolution: Resolution
    forms: tuple[Form, ...] | None = None
    """Of the stages' 3D convs; all are 3d without them."""
    fps: Annotated[float, Field(ge=1e-3, le=1e6)]
    evidence: Literal["published", "measured"]
    source: str
    parts_ms: dict[str, Annotated[float, Field(ge=0)]] | None = None
    """What of it each part of the network took, where it was timed node by node."""

    @property
    def latency_ms(self) -> float:
        return 1000 / self.fps


def _form(model: Any) -> str:
    """Which of the two kinds of latency model a value is."""
    known = isinstance(model, PartModel) or (isinstance(model, dict) and "tables" in model)
    return "parts" if known else "steps"


class Misses(Frozen):
    """Relative errors of the frame rates of `n` points that a fit has not seen, as fractions.

    Without a mean where nothing could be fitted to the points that remained.
    """

    n: Annotated[int, Field(ge=0)]
    mean: Annotated[float, Field(ge=0)] | None = None
    worst: Annotated[float, Field(ge=0)] | None = None


class HoldOut(Misses):
    """Every group of points left out at once in turn: all their errors, and those of each group."""

    groups: dict[str, Misses]


class HeldOut(Frozen):
    """What a fit is worth on networks unlike any that it has seen."""

    family: HoldOut
    """By variant: disparity, disparity+semantic, full; anynet."""
    stages: HoldOut
    """By the number of stages."""


class Calibration(Frozen):
    """A latency model fitted to the profile's points of one runtime and precision."""

    runtime: Runtime
    precision: Precision
    model: Annotated[
        Annotated[LatencyModel, Tag("steps")] | Annotated[PartModel, Tag("parts")],
        Discriminator(_form),
    ]
    residuals: tuple[Annotated[float, Field(ge=-7, le=7)], ...]
    """Leave-one-out ln(true / predicted), in the order of the points."""
    source: str
    prior: LatencyModel | None = None
    """What was known before, where the points were too few to fit by themselves."""
    held_out: HeldOut | None = None
    """The errors of whole groups left out; profiles of before have none."""

    @field_validator("model")
    @classmethod
    def _something(cls, value: LatencyModel | PartModel) -> LatencyModel | PartModel:
        if isinstance(value, LatencyModel) and not any([value.start_ms, *value.ms_per.values()]):
            raise ValueError("one coefficient at least must be above 0")
        return value

    @property
    def by_steps(self) -> LatencyModel:
        """The model, where it is one of steps; `UsageError` where it is one of parts."""
        if isinstance(self.model, PartModel):
            raise UsageError(f"{self.precision} on {self.runtime} is known by parts, not by steps")
        return self.model


class Derivation(Frozen):
    """A latency model that nobody calibrated: another one's, scaled by hardware ratios.

    `factors` multiplies coefficients by name (`start` is the cost of starting a step).
    """

    runtime: Runtime
    precision: Precision
    base: tuple[Runtime, Precision]
    factors: dict[str, Factor]
    folded: tuple[Kind, ...] = ()
    source: str

    @field_validator("factors")
    @classmethod
    def _known(cls, value: dict[str, float]) -> dict[str, float]:
        unknown = sorted(value.keys() - FEATURES.keys() - {START})
        if unknown:
            raise ValueError(
                f"{unknown[0]} is no coefficient; known are {START}, {', '.join(FEATURES)}"
            )
        return value

    @model_validator(mode="after")
    def _something(self) -> Derivation:
        if not self.factors and not self.folded:
            raise ValueError("factors or folded must say what changes against the base")
        return self

    def scale(self, model: LatencyModel) -> LatencyModel:
        """`model` with this derivation's factors applied."""
        return LatencyModel.model_validate(
            {
                **model.model_dump(),
                "start_ms": model.start_ms * self.factors.get(START, 1.0),
                "ms_per": {n: ms * self.factors.get(n, 1.0) for n, ms in model.ms_per.items()},
                "folded": sorted({*model.folded, *self.folded}),
            }
        )


class Machine(Frozen):
    """Where and when a profile's measurements were taken."""

    processor: str
    threads: Annotated[int, Field(ge=1)]
    system: str
    versions: dict[str, str]
    """Of all runtimes that the profile was timed in."""
    date: str
    """Of the first fit that still counts: what was timed since stands at its reference's speed."""
    reference_ms: Annotated[float, Field(gt=0, le=1e6)] | None = None
    """What the reference network took then: how a later day's drift is told."""


class Profile(Frozen):
    """Everything that rts2 knows of one device."""

    schema_: Literal["rts2.profile/1"] = Field(alias="schema")
    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9._-]*$")]
    title: str
    hardware: tuple[Fact, ...]
    precisions: tuple[PrecisionSupport, ...]
    runtimes: tuple[RuntimeSupport, ...]
    calibrations: Annotated[tuple[Calibration, ...], Field(min_length=1)]
    derivations: tuple[Derivation, ...] = ()
    points: tuple[Point, ...]
    machine: Machine | None = None

    @model_validator(mode="after")
    def _distinct(self) -> Profile:
        models = [f"{known.runtime} {known.precision}" for known in self.calibrations]
        models += [f"{derived.runtime} {derived.precision}" for derived in self.derivations]
        precisions: list[str] = [support.precision for support in self.precisions]
        for names in (models, precisions):
            repeated = [name for name in names if names.count(name) > 1]
            if repeated:
                raise ValueError(f"{repeated[0]} occurs twice")
        return self

    @model_validator(mode="after")
    def _consistent(self) -> Profile:
        calibrated = {
            (known.runtime, known.precision)
            for known in self.calibrations
            if isinstance(known.model, LatencyModel)
        }
        for known in self.calibrations:
            points = len(self.points_of(known.runtime, known.precision))
            if len(known.residuals) != points:
                raise ValueError(
                    f"{known.runtime} {known.precision} has {points} points "
                    f"and {len(known.residuals)} residuals"
                )
        for derived in self.derivations:
            if derived.base not in calibrated:
                raise ValueError(
                    f"{derived.runtime} {derived.precision} derives from no calibration of steps"
                )
        return self

    def points_of(self, runtime: Runtime, precision: Precision) -> tuple[Point, ...]:
        """The timings of one runtime and precision."""
        return tuple(p for p in self.points if (p.runtime, p.precision) == (runtime, precision))

    def calibration(self, runtime: Runtime, precision: Precision) -> Calibration:
        """What was fitted for a runtime and precision; `UsageError` where nothing was."""
        for known in self.calibrations:
            if (known.runtime, known.precision) == (runtime, precision):
                return known
        known_ones = ", ".join(f"{c.precision} on {c.runtime}" for c in self.calibrations)
        raise UsageError(
            f"{self.title} is not calibrated for {precision} on {runtime}; it is for {known_ones}"
        )

    def refusal(self, precision: Precision) -> PrecisionSupport | None:
        """Why the device does not run a precision; None where it does."""
        for support in self.precisions:
            if support.precision == precision:
                return None if support.supported else support
        return PrecisionSupport(
            precision=precision, supported=False, reason="the profile does not list it", source=""
        )


def names() -> list[str]:
    """The devices that rts2 ships a profile of."""
    folder = resources.files(__package__) / "devices"
    return sorted(entry.name[:-5] for entry in folder.iterdir() if entry.name.endswith(".json"))


def load(device: str) -> Profile:
    """A profile by its name, or from a JSON file.

    Raises:
        UsageError: neither a known name nor a file.
        Rts2Error: the file is no profile; names the first wrong field.
    """
    if device in names():
        text = (resources.files(__package__) / "devices" / f"{device}.json").read_text("utf-8")
        return parse_json(text, Profile, f"the profile of {device}")
    if device.endswith(".json") or "/" in device:
        return read_json(Path(device), Profile, "a device profile")
    raise UsageError(
        f"unknown device {device!r}; known are {', '.join(names())}, or give a profile's JSON file"
    )
