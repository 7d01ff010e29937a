"""fp16 graphs: what is kept float, what is rounded, and that roundings are those of fp16."""

from collections import Counter
from collections.abc import Callable
from itertools import product
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

from rts2.model.arch import Arch
from rts2.model.checkpoint import Network
from rts2.model.errors import Rts2Error
from rts2.model.export import export
from rts2.model.graph import load_graph
from rts2.profiles.opset import load_opset, operators, unsupported
from rts2.quant.fp16 import FLOAT, HALF, REASONS, emulated, kept_float, to_fp16
from rts2.quant.parity import sqnr_db

Make = Callable[[Arch], Network]

BRANCHES = ({"semantic": False}, {"refinement": False}, {})
ARCHS = [
    *(
        Arch(c=1, d_max=4, stages=stages, conv3d=(2, 1, 1)[:stages], **branches)
        for stages, branches in product((1, 3), BRANCHES)
    ),
    *(Arch(family="anynet", c=1, d_max=4, stages=stages) for stages in (1, 3)),
]


def exported(make: Make, arch: Arch, folder: Path, runtime: str = "onnxruntime") -> onnx.ModelProto:
    export(make(arch), folder / "a.onnx", (96, 64), "x", opset=13, runtime=runtime)
    return load_graph(folder / "a.onnx")


@pytest.mark.parametrize("runtime", ["onnxruntime", "openvino"])
@pytest.mark.parametrize("arch", ARCHS, ids=Arch.label)
def test_all_that_carries_a_disparity_is_kept(
    network: Make, arch: Arch, runtime: str, tmp_path: Path
) -> None:
    model = exported(network, arch, tmp_path, runtime)
    kept = dict(kept_float(model))
    counts = Counter(kept.values())
    # A soft-argmin a stage: least cost, difference, exponential, shape, sums, one and the other;
    # with refinement two, but none for the coarse disparity of the last, which nobody asks for.
    regressions = 2 * arch.stages - 1 if arch.refinement else arch.stages
    assert counts[REASONS["soft-argmin"]] == 7 * regressions
    # A residual volume: x - disparity, floor, clip, fraction and its shape; an index is no float.
    assert counts[REASONS["coordinate"]] == 5 * (arch.stages - 1)
    ends = {node.name for node in model.graph.node if "disparity" in node.output}
    assert ends <= kept.keys()
    assert not [name for name in kept if name.endswith(("/Conv", "/Relu", "Gather"))]


@pytest.mark.parametrize("arch", ARCHS, ids=Arch.label)
def test_all_else_runs_in_fp16_and_nothing_is_cast_twice(
    network: Make, arch: Arch, tmp_path: Path
) -> None:
    model = exported(network, arch, tmp_path)
    kept = {layer for layer, _ in kept_float(model)}
    lowered = to_fp16(model)
    onnx.checker.check_model(lowered, full_check=True)
    kinds = kinds_of(lowered)
    casts = {name for node in lowered.graph.node if is_cast(node) for name in node.output}
    for node in lowered.graph.node:
        if is_cast(node):
            assert not casts & set(node.input)
            continue
        given = [kinds[n] for i, n in enumerate(node.input) if n and (node.op_type, i) != SCALES]
        floats = {kind for kind in given + [kinds[n] for n in node.output] if kind in (FLOAT, HALF)}
        assert floats <= {FLOAT if node.name in kept else HALF}
    assert len({node.name for node in lowered.graph.node}) == len(lowered.graph.node)
    assert list(lowered.graph.input) == list(model.graph.input)
    assert list(lowered.graph.output) == list(model.graph.output)


SCALES = ("Resize", 2)
"""Of this operator, this input is fp32 by definition."""


def is_cast(node: onnx.NodeProto) -> bool:
    """Whether a node is a cast between the two float types."""
    return node.op_type == "Cast" and node.attribute[0].i in (FLOAT, HALF)


def kinds_of(model: onnx.ModelProto) -> dict[str, int]:
    graph = model.graph
    values = [*graph.input, *graph.value_info, *graph.output]
    kinds = {value.name: value.type.tensor_type.elem_type for value in values}
    return kinds | {tensor.name: tensor.data_type for tensor in graph.initializer}


def test_weights_are_rounded_and_nearly_half_the_size(network: Make, tmp_path: Path) -> None:
    model = exported(network, Arch(c=8), tmp_path)
    lowered = to_fp16(model)
    before = {t.name: numpy_helper.to_array(t) for t in model.graph.initializer}
    halves = [t for t in lowered.graph.initializer if t.data_type == HALF]
    assert len(halves) > 80
    for tensor in halves:
        value = before[tensor.name.removesuffix(":fp16")]
        np.testing.assert_array_equal(numpy_helper.to_array(tensor), value.astype(np.float16))
    assert lowered.ByteSize() < 0.56 * model.ByteSize()


def test_the_graph_given_is_left_alone(network: Make, tmp_path: Path) -> None:
    model = exported(network, ARCHS[0], tmp_path)
    before = model.SerializeToString()
    emulated(to_fp16(model))
    assert model.SerializeToString() == before


def test_an_fp16_graph_still_fits_tensorrt(network: Make, tmp_path: Path) -> None:
    lowered = to_fp16(exported(network, Arch(c=1), tmp_path))
    onnx.save(lowered, tmp_path / "b.onnx")
    version, found = operators(tmp_path / "b.onnx")
    assert version == 13
    assert unsupported(found, load_opset("tensorrt-8.2")) == []


def answers(model: onnx.ModelProto, pair: np.ndarray) -> dict[str, np.ndarray]:
    session = onnxruntime.InferenceSession(
        model.SerializeToString(), providers=["CPUExecutionProvider"]
    )
    found = session.run(None, {"left": pair[0], "right": pair[1]})
    return dict(zip([output.name for output in session.get_outputs()], found, strict=True))


@pytest.mark.parametrize("arch", ARCHS, ids=Arch.label)
def test_answers_stay_near_the_float_ones(network: Make, arch: Arch, tmp_path: Path) -> None:
    model = exported(network, arch, tmp_path)
    lowered = to_fp16(model)
    pair = np.random.default_rng(0).standard_normal((2, 1, 3, 64, 96), dtype=np.float32)
    wanted, direct, rounded = (answers(m, pair) for m in (model, lowered, emulated(lowered)))
    for found in (direct, rounded):
        assert found["disparity"].dtype == np.float32
        assert sqnr_db(wanted["disparity"], found["disparity"]) > 50
        assert not np.array_equal(wanted["disparity"], found["disparity"])
        if arch.semantic:
            assert np.mean(wanted["semantic"] != found["semantic"]) < 0.01


def by_hand(nodes: list[onnx.NodeProto], constants: dict[str, float]) -> onnx.ModelProto:
    """A graph from left and right, (1, 1, 1, 512), to disparity."""
    left, right, disparity = (
        helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 1, 1, 512])
        for name in ("left", "right", "disparity")
    )
    weights = [numpy_helper.from_array(np.float32(v), name) for name, v in constants.items()]
    graph = helper.make_graph(nodes, "g", [left, right], [disparity], weights)
    versions = [helper.make_opsetid("", 13), helper.make_opsetid("com.microsoft", 1)]
    model = helper.make_model(graph, opset_imports=versions)
    model.ir_version = 7
    return model


def test_emulation_rounds_after_every_operator() -> None:
    nodes = [
        helper.make_node("Sub", ["left", "right"], ["a"], name="Sub"),
        helper.make_node("Mul", ["a", "third"], ["b"], name="Mul"),
        helper.make_node("Add", ["b", "offset"], ["c"], name="Add"),
        helper.make_node("Softmax", ["c"], ["disparity"], name="Softmax", axis=3),
    ]
    model = by_hand(nodes, {"third": 1 / 3, "offset": 7.7})
    lowered = to_fp16(model)
    assert kept_float(model) == [("Softmax", REASONS["soft-argmin"])]
    emulator = emulated(lowered)
    emulator.graph.output.append(helper.make_tensor_value_info("c", HALF, [1, 1, 1, 512]))
    pair = np.random.default_rng(0).standard_normal((2, 1, 1, 1, 512), dtype=np.float32)
    left, right = pair.astype(np.float16)
    wanted = (left - right) * np.float16(1 / 3) + np.float16(7.7)  # numpy rounds each time
    np.testing.assert_array_equal(answers(emulator, pair)["c"], wanted)


def test_a_weight_that_does_not_fit_is_named() -> None:
    nodes = [
        helper.make_node("Mul", ["left", "large"], ["a"], name="Mul"),
        helper.make_node("Softmax", ["a"], ["disparity"], name="Softmax"),
    ]
    with pytest.raises(Rts2Error, match="large holds 70000; fp16 ends at 65504"):
        to_fp16(by_hand(nodes, {"large": 7e4}))


@pytest.mark.parametrize(
    ("node", "said"),
    [
        (helper.make_node("Conv", ["left", "right"], ["a"], name="C"), "the graph is broken"),
        (helper.make_node("Zoo", ["left"], ["a"], name="C"), "C is no operator of ONNX"),
        (
            helper.make_node("Zoo", ["left"], ["a"], name="C", domain="com.microsoft"),
            "C is no operator of ONNX; export the checkpoint again",
        ),
    ],
)
def test_a_broken_graph_is_refused(node: onnx.NodeProto, said: str) -> None:
    end = helper.make_node("Softmax", ["a"], ["disparity"], name="Softmax")
    model = by_hand([node, end], {})
    with pytest.raises(Rts2Error, match=said):
        to_fp16(model)
