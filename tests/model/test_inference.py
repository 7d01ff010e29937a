"""The door to ONNX Runtime."""

from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from rts2.model.errors import Rts2Error
from rts2.model.inference import open_session, session_options


def negation(operator: str = "Neg") -> bytes:
    x, y = (helper.make_tensor_value_info(n, TensorProto.FLOAT, [2]) for n in "xy")
    body = helper.make_graph([helper.make_node(operator, ["x"], ["y"])], "g", [x], [y])
    opset = [helper.make_opsetid("", 13)]
    model = helper.make_model(body, opset_imports=opset, ir_version=8)
    content: bytes = model.SerializeToString()
    return content


def test_a_graph_runs_from_its_file_or_from_what_stands_in_for_it(tmp_path: Path) -> None:
    path = tmp_path / "x.onnx"
    path.write_bytes(negation())
    given = {"x": np.array([1, -2], np.float32)}
    assert open_session(path).run(None, given)[0].tolist() == [-1, 2]
    options = session_options()
    options.intra_op_num_threads = 1
    other = open_session(path, options, negation("Abs"))
    assert other.run(None, given)[0].tolist() == [1, 2]
    assert onnx.load_model(path).graph.node[0].op_type == "Neg"


@pytest.mark.parametrize("content", [b"", b"junk", negation("Nonsense"), negation()[:-9]])
def test_what_cannot_be_opened_is_named(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.onnx"
    path.write_bytes(content)
    with pytest.raises(Rts2Error, match=r"x\.onnx is truncated or no ONNX file"):
        open_session(path)
