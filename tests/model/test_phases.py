"""The stem of op lists in the form of graphs, against graphs."""

from math import prod
from pathlib import Path

import onnx
import pytest

from rts2.model.arch import Arch
from rts2.model.checkpoint import build
from rts2.model.export import export
from rts2.model.ops import ops
from rts2.model.phases import STEM, widened

SIZE = (96, 64)


@pytest.mark.parametrize("c", [1, 7, 8, 13, 16, 19, 24])
def test_a_widened_stem_has_the_shapes_and_multiply_adds_of_the_graphs(
    c: int, tmp_path: Path
) -> None:
    arch, path = Arch(c=c, stages=1, d_max=6, conv3d=(4,)), tmp_path / "model.onnx"
    export(build(arch), path, SIZE, "untrained")
    model = onnx.shape_inference.infer_shapes(onnx.load(path))
    values = (*model.graph.value_info, *model.graph.input)
    shapes = {v.name: tuple(d.dim_value for d in v.type.tensor_type.shape.dim) for v in values}
    weights = {tensor.name: tuple(tensor.dims) for tensor in model.graph.initializer}
    found = [
        (shapes[node.input[0]], shapes[node.output[0]], weights[node.input[1]])
        for node in model.graph.node
        if node.op_type == "Conv"
    ]
    convs = [widened(op) for op in ops(arch, SIZE) if op.name in STEM]
    assert [(op.inputs[0], op.output, op.macs) for op in convs] == [
        (inputs, output, prod(output) * prod(weight[1:])) for inputs, output, weight in found[:2]
    ]


def test_other_steps_stay_as_they_are() -> None:
    others = [op for op in ops(Arch(c=8), SIZE) if op.name not in STEM]
    assert [widened(op) for op in others] == others
