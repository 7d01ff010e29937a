"""The one door to ONNX Runtime: opening a graph on the CPU."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .errors import Rts2Error


def session_options() -> Any:
    """ONNX Runtime's options, silent: what is wrong is raised, and told once."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    return options


def open_session(path: Path, options: Any = None, model: bytes | None = None) -> Any:
    """An ONNX Runtime session on the graph at `path`, on the CPU.

    `model` stands in for the file's content where the caller has changed it; errors name `path`
    all the same. Raises `Rts2Error` for what ONNX Runtime does not read.
    """
    import onnxruntime

    try:
        return onnxruntime.InferenceSession(
            model or path, options or session_options(), providers=["CPUExecutionProvider"]
        )
    except Exception as error:  # ONNX Runtime's errors share no other base
        raise Rts2Error(
            f"{path} is truncated or no ONNX file that ONNX Runtime reads: {error}"
        ) from error
