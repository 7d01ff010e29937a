"""Half precision on the CPU at hand, through OpenVINO, which has kernels for it.

ONNX Runtime has none on a CPU. The weights stay float: OpenVINO is told to compute in fp16 or bf16,
whichever the processor has, when it compiles the network; what carries disparities it keeps float.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ..model.arch import Form, Precision
from ..model.data.scene import Sample
from ..model.errors import UsageError
from ..model.graph import GraphHeader
from ..model.predictor import OnnxPredictor
from ..profiles.runtimes import precisions
from .budget import Budget
from .intermediate import to_ir
from .parity import Measured, judge
from .race import Duel, Runner, duel, race
from .source import Source, opened

RUNTIME: Final = "openvino"


@dataclass(frozen=True)
class Halved:
    """What half precision is worth on this machine."""

    parent: Path
    """The float graph, in the form that ONNX Runtime runs fastest."""
    graph: Path
    """OpenVINO's own format (.xml, a .bin beside it), in the form that it runs fastest."""
    predictor: OnnxPredictor
    """The network as OpenVINO computes it."""
    header: GraphHeader
    float_forms: tuple[Form, ...] | None
    measured: Measured
    duel: Duel
    within: bool

    @property
    def delivered(self) -> bool:
        """Whether it is faster than fp32 in ONNX Runtime, and within the budget."""
        return self.within and self.duel.faster


class OpenVinoPredictor(OnnxPredictor):
    """An ONNX graph of one size, computed by OpenVINO at a precision from its own format."""

    def __init__(self, path: Path, compiled: Path, precision: Precision, threads: int) -> None:
        from ..profiles.runtimes.ov import Session

        super().__init__(path)
        self._compiled = Session(compiled, precision, threads)

    def _answer(self, pair: Mapping[str, NDArray[np.float32]]) -> list[NDArray[Any]]:
        return self._compiled.answer(self.outputs, pair)


def quantize(
    source: Source, precision: Precision, frames: Sequence[Sample], budget: Budget, threads: int
) -> Halved:
    """The network in half precision against fp32 in ONNX Runtime, each in its own faster form.

    Raises:
        UsageError: the processor has no such precision, or no frame has the truth that judges.
        Rts2Error: OpenVINO is not installed.
    """
    able = precisions(RUNTIME)
    if precision not in able:
        others = [each for each in able if each != "fp32"]
        instead = f"give --precision {others[0]}" if others else "int8 or fp32 remain"
        raise UsageError(f"this processor does not compute in {precision}; {instead}")
    graphs = {forms: source.graph(forms or None) for forms in source.forms or ((),)}
    plain = _fastest([Runner(path, "fp32") for path in graphs.values()], threads)
    suited = [source.graph(forms or None, RUNTIME) for forms in graphs]
    lowered = {to_ir(path): path for path in suited}
    own = _fastest([Runner(compiled, precision, RUNTIME) for compiled in lowered], threads)
    graph = lowered[own.path]
    other = OpenVinoPredictor(graph, own.path, precision, threads)
    measured = judge(OnnxPredictor(plain.path), other, frames)
    return Halved(
        plain.path,
        own.path,
        other,
        opened(graph)[1],
        opened(plain.path)[1].forms,
        measured,
        duel(own, plain, threads),
        budget.holds(measured),
    )


def _fastest(runners: Sequence[Runner], threads: int) -> Runner:
    ratios = race(runners, threads)
    return runners[min(range(len(runners)), key=ratios.__getitem__)]
