"""A network as one ONNX file: a pair goes in, a disparity map and class ids come out."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from copy import deepcopy
from importlib.metadata import version
from itertools import chain, pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import onnx
import onnxruntime
import torch
from torch import Tensor, nn

from .arch import STRIDES, Form
from .checkpoint import Network
from .errors import UsageError
from .forms import formed, forms_run, rewritten, steps_for
from .graph import DISPARITY, SEMANTIC, GraphHeader, read_header, save_graph
from .layers import enlarge
from .ops import padded
from .rts2net import Stage

OPSETS = range(13, 21)
"""From the first in which softmax works along one axis, to the exporter's last."""

OPSET = 17
"""What current runtimes read at their best; TensorRT 8.2 needs 13."""


class Parity(NamedTuple):
    """How far an exported graph is from its network."""

    disparity_px: float
    """The largest difference of two disparities, in pixels of the full resolution."""
    semantic_share: float | None
    """The share of pixels whose class differs; None without a semantic branch."""


class Deployed(nn.Module):
    """A network as a target runs it: the answer of the last stage alone, at full resolution.

    With `forms`, one for each stage of the network, it runs a copy that holds its 3D convs so.
    """

    def __init__(
        self, network: Network, stages: int | None = None, forms: Sequence[Form] | None = None
    ) -> None:
        super().__init__()
        self.network = formed(network, forms) if forms else network
        self.arch = network.arch.up_to(stages)
        self.forms = forms_run(forms, self.arch.stages)
        # AnyNet's maps come at full resolution.
        self.factor = STRIDES[self.arch.stages - 1] if self.arch.family == "rts2net" else 1

    def forward(self, left: Tensor, right: Tensor) -> tuple[Tensor, ...]:
        """(B, 3, H, W) twice, normalised → disparity (B, H, W) in pixels, class ids (B, H, W)."""
        return self._answer(self.network(left, right, self.arch.stages)[-1])

    def _answer(self, stage: Stage) -> tuple[Tensor, ...]:
        disparity = self._disparity(stage.best).flatten(0, 1)
        if stage.scores is None:
            return (disparity,)
        return disparity, self._classes(stage.scores)

    def _disparity(self, best: Tensor) -> Tensor:
        return best if self.factor == 1 else enlarge(best, self.factor)

    def _classes(self, scores: Tensor) -> Tensor:
        return enlarge(scores, self.factor).argmax(1).int()


class Exported(Deployed):
    """The same as a graph for a runtime holds it: in forms that give the same and are faster there.

    Behind the answer it tells those of the earlier stages, as `GraphHeader.answers` has them.
    """

    def __init__(
        self,
        network: Network,
        stages: int | None = None,
        forms: Sequence[Form] | None = None,
        runtime: str = "onnxruntime",
    ) -> None:
        super().__init__(network, stages, forms)
        self.network, self.steps = rewritten(self.network, runtime), steps_for(runtime)

    def forward(self, left: Tensor, right: Tensor) -> tuple[Tensor, ...]:
        *earlier, last = self.network(left, right, self.arch.stages)
        told = [(stage.best, stage.scores) for stage in earlier]
        return self._answer(last) + tuple(
            maps for pair in told for maps in pair if maps is not None
        )

    def _disparity(self, best: Tensor) -> Tensor:
        return best if self.factor == 1 else self.steps.matching.enlarge(best, self.factor)

    def _classes(self, scores: Tensor) -> Tensor:
        return self.steps.class_ids(scores, self.factor)


def export(
    network: Network,
    path: Path,
    resolution: tuple[int, int],
    origin: str,
    opset: int = OPSET,
    stages: int | None = None,
    forms: Sequence[Form] | None = None,
    runtime: str = "onnxruntime",
) -> GraphHeader:
    """Writes the network as ONNX for one resolution (W, H), batch 1, all shapes static.

    Inputs `left` and `right` are (1, 3, H, W), normalised, at the padded size; outputs are
    `disparity` (1, H, W) float32 and, with a semantic branch, `semantic` (1, H, W) int32. Constants
    are folded, the operators are ONNX's own, and equal arguments give equal bytes. `forms` tells
    for each stage of the network how its 3D convs are held (see `formed`): all 3d without it. Every
    runtime reads every graph; it is in the steps that suit `runtime` (see `steps_for`).

    Raises:
        UsageError: the arch has fewer stages, the opset is none of `OPSETS`, or the forms are not
            for this network.
    """
    if opset not in OPSETS:
        raise UsageError(f"opset must be {OPSETS[0]} to {OPSETS[-1]}, not {opset}")
    deployed = Exported(network, stages, forms, runtime).eval()
    height, width = padded(resolution, deployed.arch.multiple)
    header = GraphHeader(
        arch=deployed.arch,
        resolution=resolution,
        size=(width, height),
        forms=deployed.forms,
        origin=origin,
        rts2=version("rts2"),
    )
    model, answers = _traced(deployed, header, opset)
    header = header.model_copy(update={"answers": answers})
    save_graph(model, header, path)
    return header


def parity(path: Path, network: Network, left: Tensor, right: Tensor) -> Parity:
    """Runs the graph at `path` and its network on one normalised pair, and compares.

    `left`, `right`: (1, 3, H, W) at the graph's input size.
    """
    deployed = Deployed(deepcopy(network), read_header(path).stages).eval()
    with torch.inference_mode():
        expected = [output.numpy() for output in deployed(left, right)]
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    found = session.run(None, {"left": left.numpy(), "right": right.numpy()})
    share = float(np.mean(expected[1] != found[1])) if len(expected) > 1 else None
    return Parity(float(np.abs(expected[0] - found[0]).max()), share)


def _traced(
    deployed: Exported, header: GraphHeader, opset: int
) -> tuple[onnx.ModelProto, tuple[tuple[str, ...], ...] | None]:
    """The network as a folded ONNX model at the padded size, and the answers within it."""
    width, height = header.size
    outputs = [DISPARITY, SEMANTIC] if header.arch.semantic else [DISPARITY]
    earlier = [[f"{stage} {name}" for name in outputs] for stage in range(1, header.stages)]
    # Two images that differ: of equal ones the exporter would make a single input.
    pair = torch.rand(2, 1, 3, height, width, generator=torch.Generator().manual_seed(0))
    with TemporaryDirectory() as folder, warnings.catch_warnings():
        # Tracing warns of its own deprecation, and of sizes that are constants here by intent.
        warnings.simplefilter("ignore")
        file = Path(folder) / "graph.onnx"
        torch.onnx.export(
            deployed,
            tuple(pair),
            file,
            input_names=["left", "right"],
            output_names=[*outputs, *chain(*earlier)],
            opset_version=opset,
            dynamo=False,  # the new exporter has no opset 13
        )
        model = _folded(file)
    del model.graph.output[len(outputs) :]  # the earlier answers stay, as values within
    names = _rename(model.graph)
    answers = tuple(tuple(names[name] for name in each) for each in earlier)
    del model.opset_import[:]
    model.opset_import.extend([onnx.helper.make_opsetid("", opset)])
    model.producer_name, model.producer_version = "rts2", header.rts2
    model.graph.name = header.arch.family
    return onnx.shape_inference.infer_shapes(model, strict_mode=True), answers or None


def _folded(file: Path) -> onnx.ModelProto:
    """The model with all that is constant computed: ONNX Runtime's basic level.

    That level stays within ONNX's own operators, so that every other runtime reads the result.
    """
    options = onnxruntime.SessionOptions()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
    options.optimized_model_filepath = str(file.with_name("folded.onnx"))
    onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])
    return onnx.load_model(options.optimized_model_filepath)


def _rename(graph: Any) -> dict[str, str]:
    """Names every node after its module and operator, every value after its node; returns the
    new names of the values.
    """
    fixed = {value.name for value in [*graph.input, *graph.output]}
    renamed: dict[str, str] = {}
    for node in graph.node:
        node.name = _readable(node.name)
        for index, output in enumerate(node.output):
            if output not in fixed:
                renamed[output] = f"{node.name}:{index}"
    for node in graph.node:
        node.input[:] = [renamed.get(name, name) for name in node.input]
        node.output[:] = [renamed.get(name, name) for name in node.output]
    return renamed


def _readable(name: str) -> str:
    """`/network/encoder/stem/stem.0/stem.0.0/Conv` → `encoder.stem.0.0/Conv`."""
    *scopes, operator = name.strip("/").split("/")
    scopes = scopes[1:] if scopes[:1] == ["network"] else ["output", *scopes]
    # A sequence repeats its own name in those of its members.
    module = ".".join(a for a, b in pairwise([*scopes, ""]) if not b.startswith(f"{a}."))
    return f"{module}/{operator}" if module else operator
