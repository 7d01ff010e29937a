"""ONNX Runtime on the CPU."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from ...model.arch import Precision
from ...model.inference import open_session, session_options
from .attribution import Kernel, Node, Step, distinctly_named, kernels, node_times_ms, nodes_of
from .session import noise

LAYOUT: Final = frozenset(("ReorderInput", "ReorderOutput"))
"""Steps that lay channels out in blocks, or back."""

BLOCKED = re.compile(r"(?P<value>.+)_nchwc(_token_\d+)?")
"""A step on channels in blocks has the name of the value that it gives."""

FUSED = re.compile(r"(?P<node>.+)_token_\d+")
"""A step of integers has the name of the node that it was made of."""

TRANSPOSED = re.compile(r"Transpose(_token_\d+)?")
"""What a layout of channels last brings along; nodes of a file of ours have longer names."""

PROFILED_WARM_UP = 1
"""Runs before the first that counts: the arena grows in the first."""


class Session:
    """An ONNX file that is ready to run on inputs of its own, for timing."""

    def __init__(self, path: Path, threads: int) -> None:
        self._path = path
        self._threads = threads
        self._session = open_session(path, _options(threads))
        given = [(each.name, each.type, each.shape) for each in self._session.get_inputs()]
        self._inputs = noise(path, given, "tensor(float)")

    def run(self) -> None:
        """One pair through the network."""
        self._session.run(None, self._inputs)

    def node_times_ms(self, runs: int) -> dict[str, float]:
        """What each node of the file takes, by its name (see `kernels`)."""
        return node_times_ms(self.kernels(runs))

    def kernels(self, runs: int) -> tuple[Kernel, ...]:
        """What each node of the optimized graph takes, from ONNX Runtime's own profiler."""
        from ...model.graph import load_graph

        model = load_graph(self._path)
        renamed = distinctly_named(model)
        with TemporaryDirectory() as folder:
            options = _options(self._threads)
            options.enable_profiling = True
            options.profile_file_prefix = str(Path(folder) / "profile")
            options.optimized_model_filepath = str(Path(folder) / "optimized.onnx")
            content = model.SerializeToString() if renamed else None
            session = open_session(self._path, options, content)
            for _ in range(PROFILED_WARM_UP + runs):
                session.run(None, self._inputs)
            events = json.loads(Path(session.end_profiling()).read_text("utf-8"))
            optimized = load_graph(Path(options.optimized_model_filepath))
        return kernels(
            list(_by_run(events))[PROFILED_WARM_UP:],
            nodes_of(model),
            _steps(optimized),
        )


def open_graph(path: Path, _precision: Precision, threads: int) -> Session:
    """The graph at `path`, computed as it stands."""
    return Session(path, threads)


def precisions(stored: Precision) -> tuple[Precision, ...]:
    """A graph is computed in the precision that it is stored in."""
    return (stored,)


def versions() -> dict[str, str]:
    """The runtime's version, as a profile records it."""
    import onnxruntime

    return {"onnxruntime": onnxruntime.__version__}


def missing() -> None:
    """It comes with rts2."""


def _options(threads: int) -> Any:
    options = session_options()
    options.intra_op_num_threads = threads
    # Threads that spin on after a run would take the cores from the session timed beside it.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    return options


def _by_run(events: Iterable[Mapping[str, Any]]) -> Iterable[dict[str, float]]:
    """For every run in a profile what each step took, in ms, in the order in which they ran."""
    ordered = sorted(events, key=lambda event: event["ts"])
    for run in (event for event in ordered if event["name"] == "model_run"):
        times: dict[str, float] = {}
        for event in ordered:
            inside = 0 <= event["ts"] - run["ts"] <= run["dur"]
            if inside and event["cat"] == "Node" and event["name"].endswith("_kernel_time"):
                name = event["name"].removesuffix("_kernel_time")
                times[name] = times.get(name, 0.0) + event["dur"] / 1000
        yield times


def _steps(optimized: Any) -> list[Step]:
    distinctly_named(optimized)
    return [_step(node) for node in nodes_of(optimized)]


def _step(node: Node) -> Step:
    blocked, fused = BLOCKED.fullmatch(node.name), FUSED.fullmatch(node.name)
    told = blocked["value"] if blocked else fused["node"] if fused else node.name
    moves = node.kind in LAYOUT or TRANSPOSED.fullmatch(node.name) is not None
    return Step(node, (told,), moves)
