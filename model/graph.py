"""The ONNX files of rts2: what they say of themselves, reading and writing them."""

from __future__ import annotations

from pathlib import Path

import onnx
from google.protobuf.message import DecodeError  # type: ignore[import-untyped]
from pydantic import BaseModel, ConfigDict, ValidationInfo, field_validator

from .arch import MEAN, STD, Arch, Form, Precision
from .errors import Rts2Error
from .files import existing_file, parse_json, write_bytes

HEADER = "rts2"
"""The key of our entry in the file's metadata."""

DISPARITY, SEMANTIC = "disparity", "semantic"
"""The outputs: what the last stage says, at full resolution."""


class GraphHeader(BaseModel):
    """What an ONNX file of ours says of itself."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    arch: Arch
    """Cut to the stages that the graph runs."""
    resolution: tuple[int, int]
    """Width and height of the images it was made for."""
    size: tuple[int, int]
    """Width and height of its inputs: the resolution, padded."""
    precision: Precision = "fp32"
    forms: tuple[Form, ...] | None = None
    """One for each stage; None where all are 3d."""
    answers: tuple[tuple[str, ...], ...] | None = None
    """The values that hold what each stage but the last says, before it is enlarged: the best
    disparity, (1, 1, h, w) in pixels of the full resolution, and with a semantic branch the class
    scores, (1, classes, h, w). They lie on the way to the last stage's answer: a graph that is cut
    behind them stops early. None where there are none, or nobody told.
    """
    mean: tuple[float, float, float] = MEAN
    std: tuple[float, float, float] = STD
    origin: str
    """How the weights came to be, as the checkpoint has it."""
    rts2: str
    """The version of rts2 that wrote the file."""

    @field_validator("forms")
    @classmethod
    def _one_a_stage(
        cls, forms: tuple[Form, ...] | None, info: ValidationInfo
    ) -> tuple[Form, ...] | None:
        arch = info.data.get("arch")  # absent where it is wrong itself
        if forms is None or arch is None:
            return forms
        if len(forms) != arch.stages:
            raise ValueError(f"forms must be one per stage, {arch.stages} in all")
        return forms

    @property
    def stages(self) -> int:
        return self.arch.stages


def save_graph(model: onnx.ModelProto, header: GraphHeader, path: Path) -> None:
    """Writes an ONNX model with our header, whole or not at all."""
    put_header(model, header)
    write_bytes(path, model.SerializeToString(deterministic=True))


def put_header(model: onnx.ModelProto, header: GraphHeader) -> None:
    """Lets a model say of itself what `header` says."""
    # What is not set is not written: a file without forms is one that earlier versions read.
    onnx.helper.set_model_props(model, {HEADER: header.model_dump_json(exclude_none=True)})


def load_graph(path: Path) -> onnx.ModelProto:
    """The ONNX model at `path`.

    Raises:
        UsageError: there is no such file.
        Rts2Error: it is truncated or no ONNX file.
    """
    try:
        return onnx.load_model_from_string(existing_file(path, "an ONNX file").read_bytes())
    except (DecodeError, OSError) as error:
        raise Rts2Error(f"{path} is truncated or no ONNX file: {error}") from error


def read_header(path: Path) -> GraphHeader:
    """What the ONNX file at `path` says of itself.

    Raises as `load_graph` does, and `Rts2Error` for a file that rts2 did not write.
    """
    return header_of(load_graph(path), path)


def header_of(model: onnx.ModelProto, path: Path) -> GraphHeader:
    """Our header in the model that was read from `path`; `Rts2Error` where it has none."""
    header = found_header(model, path)
    if header is None:
        raise Rts2Error(f"{path} holds no arch; rts2 reads the ONNX files that rts2 writes")
    return header


def found_header(model: onnx.ModelProto, path: Path) -> GraphHeader | None:
    """Our header in the model that was read from `path`; None where another tool wrote it."""
    entry = {entry.key: entry.value for entry in model.metadata_props}.get(HEADER)
    return None if entry is None else parse_json(entry, GraphHeader, f"the header of {path}")
