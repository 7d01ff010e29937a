"""deployment.json: everything that the target needs to know of the network that it runs."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from ...model.arch import MEAN, STD, Arch, Form, Precision
from ...model.box import Figures
from ...model.files import read_json, sha256
from ...model.ops import padded
from ...profiles.evidence import Evidence
from ...profiles.latency import fastest_forms
from ...profiles.profile import Profile, Resolution, Runtime
from ..result import Found
from ..result import Point as FrontPoint

Triple = tuple[float, float, float]


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)


class Input(_Frozen):
    """How an image becomes an input: the same for `left` and `right`."""

    names: tuple[str, str] = ("left", "right")
    resolution: Resolution
    """Width and height of the camera's images."""
    shape: tuple[int, int, int, int]
    """Batch, channels, height, width: the resolution, padded."""
    dtype: Literal["float32"] = "float32"
    channels: Literal["RGB"] = "RGB"
    scale: float = 1 / 255
    """Bytes are brought to 0 … 1 by it, then normalised."""
    mean: Triple = MEAN
    std: Triple = STD
    padding: str = "zeros at the right and at the bottom, after normalising"


class Output(_Frozen):
    """What comes back; the padding is cut off again."""

    name: str
    shape: tuple[int, int, int]
    dtype: Literal["float32", "int32"]
    meaning: str


class ExpectedEvidence(_Frozen):
    """Where the latency and the accuracies come from."""

    latency: Evidence
    accuracy: Evidence | None
    """None where no accuracy is known of the weights."""


class Expected(_Frozen):
    """What was promised, of which runtime, and on what evidence."""

    runtime: Runtime
    fps: float
    fps_low: float
    fps_high: float
    confidence: float
    latency_ms: float
    d1_all: float | None
    epe: float | None
    miou: float | None
    evidence: ExpectedEvidence
    judged_on: str | None = None
    """What measured the accuracies of these very weights; None where nothing did."""
    boundary: str = "one pair, batch 1, the network alone, median latency"


class Check(_Frozen):
    """What the check script compares: little-endian float32, shaped like the inputs and outputs."""

    inputs: tuple[str, str] = ("sample_left.bin", "sample_right.bin")
    disparity: str = "sample_disparity.bin"
    tolerance_px: float
    """What the runtime may differ from PyTorch, on average."""


class File(_Frozen):
    """One file of the bundle."""

    name: str
    size_bytes: Annotated[int, Field(ge=0)]
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


class Deployment(_Frozen):
    """The configuration of one deployed network: schema rts2.deployment/1."""

    schema_: Literal["rts2.deployment/1"] = Field(default="rts2.deployment/1", alias="schema")
    device: str
    target_fps: float | None
    arch: Arch
    precision: Precision
    runtime: Runtime
    forms: tuple[Form, ...] | None = None
    """Of each stage's 3D convs in the graph: the faster ones there; None where all are 3d."""
    input: Input
    outputs: tuple[Output, ...]
    expected: Expected | None
    """None where no search promised anything."""
    weights: str | None
    """How the weights came to be; None while there are none."""
    check: Check | None = None
    files: tuple[File, ...]
    versions: dict[str, str]


def of_point(point: FrontPoint, found: Found, profile: Profile) -> Deployment:
    """The configuration of a point of a front, before any file exists."""
    expected = Expected(
        runtime=point.runtime,
        fps=point.fps,
        fps_low=point.fps_low,
        fps_high=point.fps_high,
        confidence=found.confidence,
        latency_ms=point.latency_ms,
        d1_all=point.d1_all,
        epe=point.epe,
        miou=point.miou,
        evidence=ExpectedEvidence(**point.evidence.model_dump()),
    )
    return of_arch(
        point.arch, profile, point.precision, point.runtime, found.resolution
    ).model_copy(update={"target_fps": found.target_fps, "expected": expected})


def as_judged(expected: Expected, found: tuple[Figures, str] | None) -> Expected:
    """The same promise of speed, with the accuracies that the weights at hand were judged to have.

    Without such figures nothing is known of them.
    """
    figures, frames = found or (None, None)
    return expected.model_copy(
        update={
            "d1_all": figures and figures.d1_all,
            "epe": figures and figures.epe,
            "miou": figures and figures.miou,
            "judged_on": frames,
            "evidence": expected.evidence.model_copy(
                update={"accuracy": "measured" if figures else None}
            ),
        }
    )


def of_arch(
    arch: Arch, profile: Profile, precision: Precision, runtime: Runtime, resolution: Resolution
) -> Deployment:
    """The configuration of a network that no search promised anything of."""
    height, width = padded(resolution, arch.multiple)
    outputs = [
        Output(
            name="disparity",
            shape=(1, height, width),
            dtype="float32",
            meaning="pixels; the point lies at x − disparity in the right image",
        )
    ]
    if arch.semantic:
        outputs.append(
            Output(
                name="semantic",
                shape=(1, height, width),
                dtype="int32",
                meaning="Cityscapes train ids",
            )
        )
    return Deployment(
        device=profile.name,
        target_fps=None,
        arch=arch,
        precision=precision,
        runtime=runtime,
        forms=_forms(arch, profile, precision, runtime, resolution),
        input=Input(resolution=resolution, shape=(1, 3, height, width)),
        outputs=tuple(outputs),
        expected=None,
        weights=None,
        files=(),
        versions={"rts2": version("rts2")},
    )


def _forms(
    arch: Arch, profile: Profile, precision: Precision, runtime: Runtime, resolution: Resolution
) -> tuple[Form, ...] | None:
    """The forms that the device runs fastest, as far as both were timed there."""
    for known in profile.calibrations:
        same = (known.runtime, known.precision) == (runtime, precision)
        if same and arch.family == "rts2net":
            forms = fastest_forms(known.model, arch, resolution) or ()
            return forms if "banded" in forms else None
    return None


def describe(path: Path) -> File:
    """A file's name, size and hash."""
    return File(name=path.name, size_bytes=path.stat().st_size, sha256=sha256(path))


def read(path: Path) -> Deployment:
    """A deployment.json. Errors name the first wrong field."""
    return read_json(path, Deployment, "a deployment configuration")
