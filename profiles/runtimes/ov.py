"""OpenVINO on the CPU."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ...model.arch import Precision
from ...model.errors import Rts2Error
from ...model.machine import features
from .attribution import Kernel, Node, Step, distinctly_named, kernels, node_times_ms, nodes_of
from .session import noise

HINTS: Final[dict[Precision, str]] = {"fp32": "f32", "bf16": "bf16", "fp16": "f16"}
"""The precision of float operators, said in every case: left alone, OpenVINO takes bf16 where the
processor has it."""

NATIVE: Final[dict[Precision, tuple[str, frozenset[str]]]] = {
    "bf16": ("BF16", frozenset(("avx512_bf16", "amx_bf16", "avx_ne_convert", "bf16"))),
    "fp16": ("FP16", frozenset(("avx512_fp16", "amx_fp16", "avx_ne_convert", "asimdhp"))),
}
"""What OpenVINO says where it can, and the processor's features of which one must be there: it
also says so where it would only emulate."""

IR: Final = ".xml"
"""How a file of OpenVINO's own format ends."""

PROFILED_WARM_UP = 3
"""Runs before the first that counts."""


class Session:
    """An ONNX file, or OpenVINO's own format, compiled for the CPU, with inputs of its own."""

    def __init__(self, path: Path, precision: Precision, threads: int) -> None:
        self._path = path
        self._precision = precision
        self._threads = threads
        self._request = self._compiled(profiled=False)[1]
        self._given: list[NDArray[np.float32]] = []

    def run(self) -> None:
        """One pair through the network."""
        self._request.infer()

    def answer(
        self, outputs: Sequence[str], inputs: Mapping[str, NDArray[np.float32]]
    ) -> list[NDArray[Any]]:
        """What the graph gives for these inputs, arrays that can be written, by its outputs."""
        import openvino

        # Read where they lie: they must live as long as the request knows of them.
        self._given = [np.ascontiguousarray(values) for values in inputs.values()]
        for name, values in zip(inputs, self._given, strict=True):
            self._request.set_tensor(name, openvino.Tensor(values, shared_memory=True))
        self._request.infer()
        return [self._request.get_tensor(name).data.copy() for name in outputs]

    def node_times_ms(self, runs: int) -> dict[str, float]:
        """What each node of the file takes, by its name (see `kernels`)."""
        return node_times_ms(self.kernels(runs))

    def kernels(self, runs: int) -> tuple[Kernel, ...]:
        """What each step takes, from OpenVINO's own performance counters."""
        from ...model.graph import load_graph

        compiled, request = self._compiled(profiled=True)
        times = []
        for _ in range(PROFILED_WARM_UP + runs):
            request.infer()
            times.append(
                {
                    each.node_name: each.real_time.total_seconds() * 1000
                    for each in request.get_profiling_info()
                    if each.real_time
                }
            )
        model = load_graph(self._path)
        distinctly_named(model)
        steps = list(_steps(compiled.get_runtime_model()))
        return kernels(times[PROFILED_WARM_UP:], nodes_of(model), steps)

    def _compiled(self, profiled: bool) -> tuple[Any, Any]:
        import openvino

        from ...model.graph import load_graph

        source: Any = str(self._path)
        if self._path.suffix != IR:
            model = load_graph(self._path)
            source = model.SerializeToString() if distinctly_named(model) else source
        settings = {
            "INFERENCE_PRECISION_HINT": hint(self._precision),
            "INFERENCE_NUM_THREADS": self._threads,
            "NUM_STREAMS": 1,
            "PERFORMANCE_HINT": "LATENCY",
            # The system may move a thread away from a core that others use.
            "ENABLE_CPU_PINNING": False,
            "PERF_COUNT": profiled,
        }
        core = openvino.Core()
        try:
            compiled = core.compile_model(core.read_model(source), "CPU", settings)
        except Exception as error:  # OpenVINO's errors share no other base
            raise Rts2Error(f"{self._path} is no graph that OpenVINO runs: {error}") from error
        self._require_precision(compiled)
        request = compiled.create_infer_request()
        given = [
            (each.get_any_name(), each.get_element_type().get_type_name(), _shape(each))
            for each in compiled.inputs
        ]
        for name, values in noise(self._path, given, "f32").items():
            request.set_tensor(name, openvino.Tensor(values))
        return compiled, request

    def _require_precision(self, compiled: Any) -> None:
        """OpenVINO takes another precision without a word where the processor lacks the one."""
        taken = compiled.get_property("INFERENCE_PRECISION_HINT").get_type_name()
        wanted = hint(self._precision)
        if taken != wanted:
            raise Rts2Error(
                f"OpenVINO computes in {taken} on this processor, not in {wanted}; "
                "choose another --precision"
            )


def hint(precision: Precision) -> str:
    """What OpenVINO is told for a precision on this processor.

    Between integers it computes in bf16, where the processor does.
    """
    if precision == "int8":
        return HINTS["bf16" if "bf16" in _half() else "fp32"]
    return HINTS[precision]


def precisions(stored: Precision) -> tuple[Precision, ...]:
    """What this processor computes natively; a graph of integers stays one."""
    return ("int8",) if stored == "int8" else ("fp32", *_half())


def _half() -> tuple[Precision, ...]:
    """The half precisions that this processor computes natively."""
    import openvino

    able = openvino.Core().get_property("CPU", "OPTIMIZATION_CAPABILITIES")
    known = features()
    return tuple(
        precision
        for precision, (capability, native) in NATIVE.items()
        if capability in able and (not known or known & native)
    )


def versions() -> dict[str, str]:
    """The runtime's version, as a profile records it."""
    import openvino

    return {"openvino": openvino.__version__.partition("-")[0]}


def missing() -> str | None:
    """What to install where OpenVINO is not."""
    if find_spec("openvino") is not None:
        return None
    return "OpenVINO is not installed; pip install 'rts2[openvino]' brings it"


def _shape(given: Any) -> list[Any]:
    """The sides of an input: whole numbers, or text where one is open."""
    sides = given.get_partial_shape()
    return [side.get_length() if side.is_static else str(side) for side in sides]


def _steps(compiled: Any) -> Iterator[Step]:
    """The steps of a compiled model; what moves data alone stands for no operator of the file."""
    for operator in compiled.get_ordered_ops():
        told = operator.get_rt_info()
        kind = told["layerType"].astype(str)
        if kind == "Const":
            continue
        names = told["originalLayersNames"].astype(str) if "originalLayersNames" in told else ""
        sources = (each.get_source_output() for each in operator.inputs())
        node = Node(
            operator.get_friendly_name(),
            kind,
            tuple(f"{s.get_node().get_friendly_name()}:{s.get_index()}" for s in sources),
            tuple(f"{operator.get_friendly_name()}:{o.get_index()}" for o in operator.outputs()),
        )
        yield Step(node, tuple(filter(None, names.split(","))), moves=not names)
