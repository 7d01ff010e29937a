"""Operator tables: what they hold, and whether every network of ours fits TensorRT 8.2."""

from itertools import product
from pathlib import Path

import onnx
import pytest
from onnx import TensorProto, defs, helper

from rts2.model.arch import Arch
from rts2.model.checkpoint import UNTRAINED, build
from rts2.model.errors import Rts2Error, UsageError
from rts2.model.export import export
from rts2.profiles.opset import load_opset, operators, opset_names, unsupported

TENSORRT = "tensorrt-8.2"
BRANCHES = ({"semantic": False}, {"refinement": False}, {})
ARCHS = [
    *(Arch(c=1, stages=stages, **branches) for stages, branches in product((1, 2, 3), BRANCHES)),
    *(Arch(family="anynet", c=1, stages=stages) for stages in (1, 2, 3)),
]
FORMER = {"ImageScaler", "ParametricSoftplus", "ScaledTanh", "Scatter", "Upsample"}
"""Operators of the table that ONNX has dropped since."""


def test_the_table_is_what_tensorrt_publishes() -> None:
    table = load_opset(TENSORRT)
    assert (table.name, table.max_opset, len(table.operators)) == (TENSORRT, 13, 129)
    assert table.operators["Conv"].types == ("fp32", "fp16", "int8")
    assert "zero point 0" in table.operators["QuantizeLinear"].limits
    assert table.operators.keys() >= {"ScatterND", "GatherElements", "Einsum", "ConvTranspose"}


def test_the_table_names_operators_of_onnx() -> None:
    known = {schema.name for schema in defs.get_all_schemas_with_history() if not schema.domain}
    assert load_opset(TENSORRT).operators.keys() <= known | FORMER


def test_what_it_lacks_is_named_once_in_order() -> None:
    asked = ["Reciprocal", "Conv", "GridSample", "Xor", "GridSample", "com.microsoft.FusedConv"]
    assert unsupported(asked, load_opset(TENSORRT)) == [
        "GridSample",
        "Reciprocal",
        "Xor",
        "com.microsoft.FusedConv",
    ]


@pytest.mark.parametrize("arch", ARCHS, ids=Arch.label)
def test_every_network_fits_tensorrt_on_a_tx2(arch: Arch, tmp_path: Path) -> None:
    path, table = tmp_path / "a.onnx", load_opset(TENSORRT)
    export(build(arch), path, (96, 64), UNTRAINED, opset=table.max_opset)
    version, found = operators(path)
    assert version == 13
    assert unsupported(found, table) == []
    assert {"Conv", "Exp"} <= set(found)


def test_operators_are_read_from_any_onnx_file(tmp_path: Path) -> None:
    image = helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 1, 4, 4])
    grid = helper.make_tensor_value_info("g", TensorProto.FLOAT, [1, 4, 4, 2])
    nodes = [
        helper.make_node("GridSample", ["x", "g"], ["a"]),
        helper.make_node("Relu", ["a"], ["b"]),
        helper.make_node("Gelu", ["b"], ["c"], domain="com.microsoft"),
        helper.make_node("Relu", ["c"], ["y"], domain="ai.onnx"),
    ]
    output = helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, 1, 4, 4])
    versions = [helper.make_opsetid("com.microsoft", 1), helper.make_opsetid("", 16)]
    graph = helper.make_graph(nodes, "g", [image, grid], [output])
    onnx.save(helper.make_model(graph, opset_imports=versions), tmp_path / "a.onnx")
    version, found = operators(tmp_path / "a.onnx")
    assert (version, found) == (16, ["GridSample", "Relu", "com.microsoft.Gelu"])
    assert unsupported(found, load_opset(TENSORRT)) == ["GridSample", "com.microsoft.Gelu"]


def test_an_unknown_table_names_the_known_ones() -> None:
    assert TENSORRT in opset_names()
    with pytest.raises(UsageError, match=r"no operator table is named '\.\./x'; known: .*8\.2"):
        load_opset("../x")


def test_a_file_that_is_no_graph_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.onnx").write_bytes(b"no graph")
    with pytest.raises(Rts2Error, match="no ONNX file"):
        operators(tmp_path / "a.onnx")
    with pytest.raises(UsageError, match="there is no such file"):
        operators(tmp_path / "b.onnx")
