"""The schema rts2.deployment/1: everything that a target needs to know of the network that it runs.

A bundle's deployment.json is one of these; `rts2-search` writes one for its pick, without files.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field

from ...model.arch import MEAN, STD, Arch, Form, Precision
from ...model.bundle import MODEL, FileName
from ...profiles.evidence import Evidence
from ...profiles.profile import Frozen, Resolution, Runtime
from ...profiles.trtexec import Generation

Triple = tuple[float, float, float]
Count = Annotated[int, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Pixels = Annotated[float, Field(gt=0)]


class _Told(Frozen):
    """A value whose fields are described in the JSON Schema as they are here."""

    model_config = ConfigDict(use_attribute_docstrings=True)


class Input(_Told):
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


class Output(_Told):
    """What comes back; the padding is cut off again."""

    name: str
    shape: tuple[int, int, int]
    dtype: Literal["float32", "int32"]
    meaning: str


class Postprocessing(_Told):
    """How outputs become what a user wants."""

    crop: Resolution
    """Width and height that count, from the top left corner; the rest is padding."""
    depth: str = (
        "metres = focal length in pixels * baseline in metres / disparity; none at or below 0 px"
    )
    classes: tuple[str, ...] = ()
    """The name of each class id; none without a semantic output."""


class ExpectedEvidence(_Told):
    """Where the latency and the accuracies come from."""

    latency: Evidence
    accuracy: Evidence | None
    """None where no accuracy is known of the weights."""


class Expected(_Told):
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


class LayerPrecision(_Told):
    """What a layer is computed in, and why."""

    layer: str
    """Its name in the graph; `*` stands for all that no other row names."""
    precision: Precision
    reason: str


class Calibration(_Told):
    """What the ranges of integers were found on; nothing without integers."""

    dataset: str | None = None
    method: str | None = None
    seed: Count | None = None
    fingerprint: str | None = None
    """Names everything that the images depend on, but their index."""
    images: tuple[str, ...] = ()


class OrtExecution(_Told):
    """How ONNX Runtime is to be opened."""

    runtime: Literal["onnxruntime"] = "onnxruntime"
    file: FileName = MODEL
    provider: Literal["CPUExecutionProvider"] = "CPUExecutionProvider"
    intra_op_threads: Count
    """0 stands for as many as the processor has cores; so do the threads of OpenVINO."""
    inter_op_threads: Count = 1
    graph_optimization: Literal["all"] = "all"
    execution_mode: Literal["sequential"] = "sequential"


class OpenVinoExecution(_Told):
    """How OpenVINO is to compile the network."""

    runtime: Literal["openvino"] = "openvino"
    file: FileName
    """The graph itself, or OpenVINO's own format, in which what carries disparities stays fp32."""
    device: Literal["CPU"] = "CPU"
    properties: dict[str, str | int]


class TensorRtExecution(_Told):
    """How an engine is built, and run, by `trtexec`."""

    runtime: Literal["tensorrt"] = "tensorrt"
    file: FileName = "model.plan"
    """What is built on the device."""
    generation: Generation
    program: str
    """Where `trtexec` is looked for first."""
    build: tuple[str, ...]
    run: tuple[str, ...]


Execution = Annotated[
    OrtExecution | OpenVinoExecution | TensorRtExecution, Field(discriminator="runtime")
]


class TritonModel(_Told):
    """A model repository for Triton among the files."""

    repository: FileName
    name: str


class Sample(_Told):
    """A pair of images, and what the network says of it."""

    name: str
    images: tuple[FileName, FileName]
    """Left and right, as a camera gives them: binary PPM, 8 bits."""
    disparity: FileName
    """(height, width) of the images, little-endian float32, in pixels."""
    semantic: FileName | None
    """(height, width), uint8, class ids; None without a semantic output."""


class Check(_Told):
    """What verify.py compares on each pair, and how far a runtime may be off."""

    samples: tuple[Sample, Sample]
    tolerance_px: Pixels
    """Of the mean difference of the disparity."""
    percentile: Annotated[float, Field(gt=0, lt=100)]
    percentile_px: Pixels
    """Of the difference at that percentile."""
    equal_classes: Share
    """The share of pixels whose class must be the same."""


class File(_Told):
    """One file of the bundle."""

    name: FileName
    size_bytes: Count
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


class Deployment(_Told):
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
    postprocessing: Postprocessing
    expected: Expected | None
    """None where no search promised anything."""
    weights: str | None
    """How the weights came to be; None while there are none."""
    execution: Execution | None = None
    """None while there are no files; so are the layers."""
    layers: tuple[LayerPrecision, ...] = ()
    calibration: Calibration = Calibration()
    triton: TritonModel | None = None
    check: Check | None = None
    files: tuple[File, ...]
    versions: dict[str, str]


def json_schema() -> dict[str, Any]:
    """The schema as JSON Schema, for readers that are not rts2."""
    told = Deployment.model_json_schema(by_alias=True, mode="serialization")
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **told}
