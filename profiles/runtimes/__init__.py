"""What networks are timed in: one interface, one row a runtime.

No runtime is imported before it is used.
"""

from __future__ import annotations

import weakref
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from typing import Final

from ...model.arch import Precision
from ...model.errors import Rts2Error, UsageError
from . import eager, ort, ov
from .session import Runtime, Session, Sized, stored_precision

__all__ = ["RUNTIMES", "Runtime", "Session", "Sized", "available", "open_session"]
__all__ += ["precisions", "precisions_of", "versions"]

RUNTIMES: Final[dict[str, Runtime]] = {
    "onnxruntime": Runtime(
        "ONNX Runtime", "graph", ort.open_graph, ort.precisions, ort.versions, ort.missing
    ),
    "openvino": Runtime("OpenVINO", "graph", ov.Session, ov.precisions, ov.versions, ov.missing),
    "pytorch": Runtime(
        "PyTorch eager",
        "network",
        eager.eager_cpu,
        eager.precisions_cpu,
        eager.versions,
        eager.missing,
    ),
    "pytorch-compiled": Runtime(
        "PyTorch compiled",
        "network",
        eager.compiled_cpu,
        eager.precisions_cpu,
        eager.versions,
        eager.missing_compiler,
    ),
    "pytorch-cuda": Runtime(
        "PyTorch eager on CUDA",
        "network",
        eager.eager_cuda,
        eager.precisions_cuda,
        eager.versions_cuda,
        eager.missing_gpu,
    ),
    "pytorch-cuda-graphs": Runtime(
        "PyTorch as a CUDA graph",
        "network",
        eager.captured_cuda,
        eager.precisions_cuda,
        eager.versions_cuda,
        eager.missing_gpu,
    ),
}


def available() -> tuple[str, ...]:
    """The runtimes that can run on this machine as it is."""
    return tuple(name for name, known in RUNTIMES.items() if known.missing() is None)


def versions(runtime: str) -> dict[str, str]:
    """The versions that a timing in a runtime depends on; raises as `open_session` does."""
    return usable(runtime).versions()


def precisions(runtime: str) -> tuple[Precision, ...]:
    """What a runtime makes of a float network on this machine, natively.

    Raises as `open_session` does.
    """
    return usable(runtime).precisions("fp32")


def precisions_of(runtime: str, model: Path | Sized) -> tuple[Precision, ...]:
    """The precisions that a runtime runs a model in, the usual one first.

    Raises as `open_session` does.
    """
    known = usable(runtime)
    if isinstance(model, Sized):
        return known.precisions("fp32")
    _require_graph_runtime(known, model)
    from ...model.graph import load_graph

    stored = stored_precision(load_graph(model))
    found = known.precisions(stored)
    return tuple(sorted(found, key=lambda precision: precision != stored))


def open_session(
    runtime: str, model: Path | Sized, precision: Precision = "fp32", threads: int = 1
) -> Session:
    """A model, loaded in a runtime on inputs of its own: an ONNX file, or a network at a size.

    For a runtime of graphs a network is exported to a file that lives as long as the session.

    Raises:
        UsageError: an unknown runtime, one that takes no ONNX file, or a precision that it does
            not run the model in.
        Rts2Error: the runtime cannot run here (the error names what brings it), or not this file.
    """
    known = usable(runtime)
    allowed = precisions_of(runtime, model)
    if precision not in allowed:
        what = "networks" if isinstance(model, Sized) else str(model)
        raise UsageError(
            f"{known.title} runs {what} in {' or '.join(allowed)} on this machine, not in "
            f"{precision}; choose another --precision"
        )
    if known.takes == "network" or not isinstance(model, Sized):
        return known.open(model, precision, threads)
    from ...model.export import export

    folder = mkdtemp(prefix="rts2.")
    try:
        path = Path(folder) / "network.onnx"
        network, size = model.network, model.resolution
        export(network, path, size, model.origin, stages=model.stages, runtime=runtime)
        session = known.open(path, precision, threads)
    except BaseException:
        rmtree(folder, ignore_errors=True)
        raise
    weakref.finalize(session, rmtree, folder, ignore_errors=True)
    return session


def usable(runtime: str) -> Runtime:
    """The row of a runtime that can run on this machine.

    Raises:
        UsageError: no runtime of that name can be timed.
        Rts2Error: it cannot run here; the error names what brings it.
    """
    known = RUNTIMES.get(runtime)
    if known is None:
        raise UsageError(f"networks are timed in {', '.join(RUNTIMES)}; {runtime} is none of them")
    reason = known.missing()
    if reason is not None:
        raise Rts2Error(reason)
    return known


def _require_graph_runtime(known: Runtime, path: Path) -> None:
    if known.takes == "network":
        raise UsageError(
            f"{known.title} runs networks, and {path} is a graph; "
            "give the checkpoint or the name of a network in the box, or another --runtime"
        )
