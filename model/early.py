"""A graph that stops early: what comes before a stage's answer, and that answer enlarged.

A runtime computes every node of a graph that it opens, whichever outputs are asked for; so a graph
that stops early is one that holds nothing of the later stages. It is cut out of the whole one in
memory: one file serves every number of stages.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import onnx
from onnx import TensorProto, helper

from .graph import DISPARITY, SEMANTIC, GraphHeader, put_header


def stops(model: onnx.ModelProto, header: GraphHeader) -> tuple[int, ...]:
    """The stages that the graph can stop after; its last one is always among them."""
    shapes, count = _shapes(model), 1 + header.arch.semantic
    early = (
        stage
        for stage, values in enumerate(header.answers or (), 1)
        if stage < header.stages and len(values) == count and shapes.keys() >= set(values)
    )
    return (*early, header.stages)


def stopped(model: onnx.ModelProto, header: GraphHeader, stage: int) -> onnx.ModelProto:
    """The graph with one of `stops` for its last stage; its outputs are those of any graph.

    They are what the network says after as many stages: bilinear maps of the stage's disparity
    and class scores at full resolution, and the most probable class of each pixel.
    """
    if stage == header.stages:
        return model
    graph, (width, height) = model.graph, header.size
    told = header.answers or ()
    values = told[stage - 1]
    nodes = _before(graph.node, values)
    shown = [(DISPARITY, TensorProto.FLOAT), (SEMANTIC, TensorProto.INT32)][: len(values)]
    nodes += _enlarged(values[0], (height, width))
    if header.arch.semantic:
        classes = _shapes(model)[values[1]][1]
        nodes += _classified(values[1], classes, (height, width))
    used = {value for node in nodes for value in node.input}
    outputs = [helper.make_tensor_value_info(*each, [1, height, width]) for each in shown]
    weights = [tensor for tensor in graph.initializer if tensor.name in used]
    body = helper.make_graph(nodes, graph.name, graph.input, outputs, weights)
    cut = helper.make_model(body, opset_imports=model.opset_import, ir_version=model.ir_version)
    own = {
        "arch": header.arch.up_to(stage),
        "forms": None if header.forms is None else header.forms[:stage],
        "answers": told[: stage - 1] or None,
    }
    put_header(cut, header.model_copy(update=own))
    return cut


def _before(nodes: Sequence[onnx.NodeProto], values: Iterable[str]) -> list[onnx.NodeProto]:
    """The nodes that these values rest on, in the order of the graph."""
    maker = {value: index for index, node in enumerate(nodes) for value in node.output}
    open_values, found = list(values), set()
    while open_values:
        index = maker.get(open_values.pop())
        if index is not None and index not in found:
            found.add(index)
            open_values.extend(nodes[index].input)
    return [nodes[index] for index in sorted(found)]


def _enlarged(name: str, size: Sequence[int]) -> list[onnx.NodeProto]:
    """(1, 1, h, w) → (1, H, W); AnyNet's are at full size already."""
    return [
        *_resized(name, f"{name}.full", [1, 1, *size]),
        _constant(f"{name}.shape", TensorProto.INT64, [1, *size]),
        helper.make_node("Reshape", [f"{name}.full", f"{name}.shape"], [f"{name}.map"]),
        helper.make_node("Cast", [f"{name}.map"], [DISPARITY], to=TensorProto.FLOAT),
    ]


def _classified(name: str, classes: int, size: Sequence[int]) -> list[onnx.NodeProto]:
    """(1, classes, h, w) → (1, H, W), with the scores of a pixel side by side: half the time."""
    rows, full = f"{name}.rows", f"{name}.full"
    return [
        helper.make_node("Transpose", [name], [rows], perm=[0, 2, 3, 1]),
        *_resized(rows, full, [1, *size, classes]),
        helper.make_node("ArgMax", [full], [f"{name}.ids"], axis=3, keepdims=0),
        helper.make_node("Cast", [f"{name}.ids"], [SEMANTIC], to=TensorProto.INT32),
    ]


def _resized(name: str, into: str, shape: Sequence[int]) -> list[onnx.NodeProto]:
    """Bilinear, pixel centres aligned, as `layers.enlarge`."""
    sides = _constant(f"{into}.shape", TensorProto.INT64, shape)
    half = {"mode": "linear", "coordinate_transformation_mode": "half_pixel"}
    return [sides, helper.make_node("Resize", [name, "", "", f"{into}.shape"], [into], **half)]


def _constant(name: str, kind: int, values: Sequence[int]) -> onnx.NodeProto:
    tensor = helper.make_tensor(name, kind, [len(values)], list(values))
    return helper.make_node("Constant", [], [name], value=tensor)


def _shapes(model: onnx.ModelProto) -> dict[str, list[int]]:
    return {
        value.name: [side.dim_value for side in value.type.tensor_type.shape.dim]
        for value in model.graph.value_info
    }
