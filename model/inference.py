"""The one door to ONNX Runtime: opening a graph on the CPU."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from .errors import Rts2Error
from .machine import cores


def session_options() -> Any:
    """ONNX Runtime's options, silent: what is wrong is raised, and told once."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    return options


def serving_options() -> Any:
    """Options of a session that runs now and then, beside others: on all cores of this process.

    Its threads do not spin on after a run, when another session wants the cores. It plans no
    memory ahead, which takes nearly twice as much and saves no time, and takes what it needs from
    one arena for all such sessions.
    """
    _open_arena()
    options = session_options()
    options.add_session_config_entry("session.use_env_allocators", "1")
    options.intra_op_num_threads = cores()
    options.add_session_config_entry("session.force_spinning_stop", "1")
    options.enable_mem_pattern = False
    return options


@cache
def _open_arena() -> None:
    """Registers the arena with ONNX Runtime, once in a process."""
    import onnxruntime

    kind = onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR
    place = onnxruntime.OrtMemoryInfo("Cpu", kind, 0, onnxruntime.OrtMemType.DEFAULT)
    onnxruntime.create_and_register_allocator(place, None)


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
