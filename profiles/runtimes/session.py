"""What every runtime makes of a network: something that runs, on inputs of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from ...model.arch import UNTRAINED, Precision
from ...model.errors import Rts2Error

if TYPE_CHECKING:
    from ...model.checkpoint import Network

QUANTIZED = "QLinear", "Quantize", "Dequantize", "DynamicQuantize", "ConvInteger", "MatMulInteger"
"""How the names of the operators begin that a graph of integers has."""


class Session(Protocol):
    """A network that is loaded, ready to be timed."""

    def run(self) -> None:
        """One pair through the network; returns when the result is there."""

    def node_times_ms(self, runs: int) -> dict[str, float]:
        """What each node of the ONNX file takes, at its fastest run, by the node's name.

        Their sum is that of all that the runtime did. Raises `Rts2Error` where a runtime cannot
        tell.
        """


@dataclass(frozen=True, eq=False)
class Sized:
    """A network at one resolution: what PyTorch runs, and what a graph is exported from."""

    network: Network
    resolution: tuple[int, int]
    """Width and height of the images."""
    stages: int | None = None
    """Where it stops early; None for all stages."""
    origin: str = UNTRAINED


@dataclass(frozen=True)
class Runtime:
    """One row of the table of runtimes."""

    title: str
    takes: Literal["graph", "network"]
    """An ONNX file, or the network itself."""
    open: Callable[[Any, Precision, int], Session]
    """The path or the network, its precision, the threads."""
    precisions: Callable[[Precision], tuple[Precision, ...]]
    """What it runs natively on this machine, by the precision that a graph is stored in."""
    versions: Callable[[], dict[str, str]]
    missing: Callable[[], str | None]
    """Why it cannot run here and what brings it; None where it can."""


def stored_precision(model: Any) -> Precision:
    """What an ONNX model computes in as it stands."""
    from onnx import TensorProto

    if any(node.op_type.startswith(QUANTIZED) for node in model.graph.node):
        return "int8"
    half = (tensor.data_type == TensorProto.FLOAT16 for tensor in model.graph.initializer)
    return "fp16" if any(half) else "fp32"


def noise(
    path: Path, inputs: Iterable[tuple[str, str, Any]], float32: str
) -> Mapping[str, NDArray[np.float32]]:
    """Random inputs for a graph, each given as name, type and shape, in the runtime's own words.

    Raises `Rts2Error` for what is not `float32` of a fixed shape.
    """
    chance = np.random.default_rng(0)
    made = {}
    for name, kind, shape in inputs:
        if kind != float32 or not all(isinstance(side, int) for side in shape):
            raise Rts2Error(
                f"{path}: inputs must be float32 of fixed shapes; {name} is {kind} {shape}"
            )
        made[name] = chance.standard_normal(shape, dtype=np.float32)
    return made
