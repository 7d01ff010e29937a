"""Graphs in integers: which layers there are, what flows, and that the answers stay near."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

from rts2.model.arch import Arch
from rts2.model.checkpoint import build
from rts2.model.errors import Rts2Error
from rts2.model.export import export
from rts2.model.graph import load_graph
from rts2.model.inference import open_session
from rts2.model.qdq import (
    Ranges,
    flows,
    integers,
    layers,
    nominal,
    quantized_values,
    seldom,
    usual,
)

SIZE = (96, 64)


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> onnx.ModelProto:
    path = tmp_path_factory.mktemp("qdq") / "full.onnx"
    torch.manual_seed(0)
    network = build(Arch(c=2, d_max=4, conv3d=(4, 2, 2)))
    export(network, path, SIZE, "made up", forms=("banded", "3d", "banded"))
    return load_graph(path)


def pair() -> dict[str, np.ndarray]:
    chance = np.random.default_rng(1)
    return {n: chance.standard_normal((1, 3, 64, 96)).astype(np.float32) for n in ("left", "right")}


def seen(model: onnx.ModelProto) -> Ranges:
    """The extremes of every value on one pair, from a graph that shows them all."""
    shown = onnx.ModelProto()
    shown.CopyFrom(model)
    names = [name for name in quantized_values(model) if name not in ("left", "right")]
    known = {value.name: value for value in (*model.graph.value_info, *model.graph.output)}
    del shown.graph.output[:]
    shown.graph.output.extend(known[name] for name in names)
    found = open_session(Path("shown"), model=shown.SerializeToString()).run(names, pair())
    values = dict(zip(names, found, strict=True)) | pair()
    return {name: (float(v.min()), float(v.max())) for name, v in values.items()}


def answers(model: onnx.ModelProto) -> np.ndarray:
    session = open_session(Path("made"), model=model.SerializeToString())
    (found,) = session.run(["disparity"], pair())
    assert isinstance(found, np.ndarray)
    return found


def test_every_convolution_is_a_layer_and_no_node_belongs_to_two(
    exported: onnx.ModelProto,
) -> None:
    found = layers(exported)
    convs = [node.name for node in exported.graph.node if node.op_type == "Conv"]
    assert [layer.name for layer in found] == convs
    members = [name for layer in found for name in layer.members]
    assert len(members) == len(set(members))
    kinds = {node.name: node.op_type for node in exported.graph.node}
    assert {kinds[name] for name in members} <= {"Conv", "Relu", "MaxPool", "Concat", "Slice"}


def test_what_flows_is_given_by_one_layer_and_taken_by_another(exported: onnx.ModelProto) -> None:
    found = layers(exported)
    order = {layer.name: index for index, layer in enumerate(found)}
    outputs = {layer.name: layer.output for layer in found}
    inputs = {layer.name: layer.inputs for layer in found}
    for flow in flows(exported):
        assert outputs[flow.giver] in inputs[flow.taker]
        assert order[flow.giver] < order[flow.taker]
    first = next(flow for flow in flows(exported) if flow.giver.startswith("encoder.stem.0"))
    assert (first.taker, first.elements) == ("encoder.stem.1.0/Conv", 2 * 2 * 64 * 96)


def test_integers_answer_nearly_what_float_does(exported: onnx.ModelProto) -> None:
    ranges = seen(exported)
    names = [layer.name for layer in layers(exported)]
    wanted = answers(exported)
    every = answers(integers(exported, names, ranges))
    half = answers(integers(exported, names[::2], ranges))
    errors = [np.abs(found - wanted).mean() for found in (half, every)]
    assert 0 < errors[0] < errors[1] < 0.05 * np.abs(wanted).mean()
    np.testing.assert_array_equal(answers(integers(exported, [], ranges)), wanted)


def test_symmetric_pairs_have_zero_points_of_zero_and_stand_at_inputs_alone(
    exported: onnx.ModelProto,
) -> None:
    chosen = usual(exported)
    made = integers(exported, chosen, seen(exported), symmetric=True)
    values = {t.name: onnx.numpy_helper.to_array(t) for t in made.graph.initializer}
    quantizers = [n for n in made.graph.node if n.op_type in ("QuantizeLinear", "DequantizeLinear")]
    assert {values[n.input[2]].dtype for n in quantizers} == {np.dtype(np.int8)}
    assert all(not values[n.input[2]].any() for n in quantizers)
    maker = {value: n for n in made.graph.node for value in n.output}
    for conv in (n for n in made.graph.node if n.name in chosen):
        assert [maker[name].op_type for name in conv.input[:2]] == ["DequantizeLinear"] * 2
        assert conv.input[2] in values  # the bias stays float
    assert np.isfinite(answers(made)).all()


@pytest.mark.parametrize("symmetric", [False, True])
def test_what_is_made_is_valid_onnx_and_float_nodes_keep_their_order(
    exported: onnx.ModelProto, symmetric: bool
) -> None:
    chosen = [name for name in usual(exported) if "MaxPool" not in name]
    made = integers(exported, chosen, nominal(exported), symmetric)
    onnx.checker.check_model(made, full_check=True)
    order = [node.name for node in made.graph.node]
    convolutions = [node.name for node in exported.graph.node if node.op_type == "Conv"]
    assert [name for name in order if name in convolutions] == convolutions


def test_every_node_bears_the_name_of_its_part(exported: onnx.ModelProto) -> None:
    made = integers(exported, usual(exported), nominal(exported))
    known = ("encoder", "disparity", "semantic", "classify", "volume", "regularize", "refine")
    for node in made.graph.node:
        assert node.name.startswith((*known, "output", "left", "right")), node.name
    names = [node.name for node in made.graph.node]
    assert all(a != b for a, b in pairwise(sorted(names)))


def test_the_usual_layers_leave_out_the_first_ones_and_3d(exported: onnx.ModelProto) -> None:
    chosen = set(usual(exported))
    others = {layer.name for layer in layers(exported)} - chosen
    assert others == {
        "encoder.stem.0.0/Conv",
        "encoder.stem.1.0/Conv",
        "regularize.0.layers.0/Conv",
        "regularize.2.layers.0/Conv",
        *(f"regularize.1.layers.{index}/Conv" for index in (0, 3, 6)),
    }
    reasons = seldom(exported)
    assert reasons.keys() == others
    assert "few channels" in reasons["encoder.stem.1.0/Conv"]
    assert "few channels" in reasons["regularize.1.layers.0/Conv"]
    assert "3D" in reasons["regularize.1.layers.3/Conv"]


def test_a_layer_that_is_not_there_and_a_value_without_a_range(exported: onnx.ModelProto) -> None:
    with pytest.raises(Rts2Error, match=r"encoder\.x/Conv is no layer of the graph"):
        integers(exported, ["encoder.x/Conv"], nominal(exported))
    with pytest.raises(Rts2Error, match="the graph cannot be quantized"):
        integers(exported, ["encoder.stem.0.0/Conv"], {})


def test_equal_arguments_give_equal_bytes(exported: onnx.ModelProto) -> None:
    made = [
        integers(exported, usual(exported), nominal(exported)).SerializeToString(deterministic=True)
        for _ in range(2)
    ]
    assert made[0] == made[1]


def test_a_quantization_does_not_pass_a_pooling_in_float(exported: onnx.ModelProto) -> None:
    """The ReLU comes behind the pooling, clips something, and the answers are those of before."""
    ranges = seen(exported)
    chosen = usual(exported)
    made = integers(exported, chosen, ranges)
    nodes = {node.name: node for node in made.graph.node}
    relu, pool = nodes["encoder.stem.1.2/Relu"], nodes["encoder.quarter.0/MaxPool"]
    assert pool.input[0] == nodes["encoder.stem.1.0/Conv"].output[0]
    assert relu.input[0] == pool.output[0]
    quantizer = nodes["encoder.quarter.0/MaxPool:0_QuantizeLinear"]
    assert quantizer.input[0] == relu.output[0]
    values = {t.name: onnx.numpy_helper.to_array(t) for t in made.graph.initializer}
    assert values[quantizer.input[2]] == 1
    symmetric = integers(exported, chosen, ranges, symmetric=True)
    order = [node.op_type for node in symmetric.graph.node if node.name in (relu.name, pool.name)]
    assert order == ["Relu", "MaxPool"]
    wanted = answers(exported)
    assert np.abs(answers(made) - wanted).mean() < 0.05 * np.abs(wanted).mean()


def test_a_bias_that_two_layers_share_stays_a_constant_of_the_one_in_float(
    exported: onnx.ModelProto,
) -> None:
    """Untrained norms leave biases of zero, and equal tensors are stored once."""
    convs = {node.name: node for node in exported.graph.node if node.op_type == "Conv"}
    biases = [conv.input[2] for conv in convs.values()]
    shared = {name for name in biases if biases.count(name) > 1}
    assert shared
    chosen = usual(exported)
    made = integers(exported, chosen, nominal(exported))
    constants = {tensor.name for tensor in made.graph.initializer}
    for node in made.graph.node:
        if node.op_type == "Conv" and node.name not in chosen:
            assert set(node.input[1:]) <= constants, node.name
