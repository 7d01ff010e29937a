"""The door to the runtimes: what can run, what it runs, and what it says when it cannot."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper

from rts2.model.errors import Rts2Error, UsageError
from rts2.profiles import runtimes
from rts2.profiles.runtimes import (
    RUNTIMES,
    Sized,
    available,
    open_session,
    ov,
    precisions,
    precisions_of,
    versions,
)
from rts2.profiles.runtimes.session import stored_precision


def test_what_rts2_brings_is_available() -> None:
    assert {"onnxruntime", "pytorch"} <= set(available()) <= set(RUNTIMES)
    assert versions("onnxruntime") == {"onnxruntime": onnxruntime.__version__}
    assert versions("pytorch") == {"torch": torch.__version__}
    assert precisions("onnxruntime") == precisions("pytorch") == ("fp32",)


def test_no_runtime_is_imported_before_it_is_used() -> None:
    heavy = "torch", "onnx", "onnxruntime", "openvino"
    text = f"import sys, rts2.profiles.runtimes; print([m for m in {heavy} if m in sys.modules])"
    found = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    assert found.stdout == "[]\n"


def test_a_runtime_that_is_not_installed_names_its_extra(
    monkeypatch: pytest.MonkeyPatch, graph: Path
) -> None:
    monkeypatch.setattr(ov, "find_spec", lambda name: None)
    for ask in (
        lambda: open_session("openvino", graph),
        lambda: versions("openvino"),
        lambda: precisions("openvino"),
    ):
        with pytest.raises(Rts2Error, match=r"not installed; pip install 'rts2\[openvino\]'"):
            ask()
    assert "openvino" not in available()


def test_an_unknown_runtime_is_refused_with_those_that_are_known() -> None:
    with pytest.raises(UsageError, match=r"onnxruntime, openvino, .*; tensorrt is none of them"):
        versions("tensorrt")


def test_pytorch_refuses_a_graph(graph: Path) -> None:
    with pytest.raises(UsageError, match=r"small.onnx is a graph; give the checkpoint"):
        open_session("pytorch", graph)


@pytest.mark.parametrize("runtime", ["onnxruntime", "pytorch"])
def test_a_network_runs_in_every_runtime(sized: Sized, runtime: str) -> None:
    open_session(runtime, sized).run()


def test_the_file_of_an_exported_network_lives_as_long_as_its_session(sized: Sized) -> None:
    session = open_session("onnxruntime", sized)
    folder = session._path.parent  # type: ignore[attr-defined]
    assert session.node_times_ms(1)
    assert folder.is_dir()
    del session
    assert not folder.exists()


def test_an_early_stop_is_exported(sized: Sized) -> None:
    early = replace(sized, stages=1)
    names = open_session("onnxruntime", early).node_times_ms(1)
    assert any(".0" in name for name in names)
    assert not any(name.startswith("regularize.1") for name in names)


@pytest.mark.parametrize("runtime", ["onnxruntime", "pytorch"])
def test_a_precision_that_a_runtime_does_not_run_is_refused(sized: Sized, runtime: str) -> None:
    with pytest.raises(UsageError, match="in fp32 on this machine, not in fp16; choose another"):
        open_session(runtime, sized, "fp16")


def stored(path: Path, precision: str) -> Path:
    """A graph of one addition, in the precision."""
    kind = TensorProto.FLOAT16 if precision == "fp16" else TensorProto.FLOAT
    dtype = np.float16 if precision == "fp16" else np.float32
    body = [helper.make_node("Cast", ["x"], ["h"], name="in", to=kind)]
    body += [helper.make_node("Add", ["h", "one"], ["s"], name="add")]
    body += [helper.make_node("Cast", ["s"], ["f"], name="out", to=TensorProto.FLOAT)]
    if precision == "int8":
        body += [helper.make_node("QuantizeLinear", ["f", "scale", "zero"], ["q"], name="q")]
        body += [helper.make_node("DequantizeLinear", ["q", "scale", "zero"], ["y"], name="d")]
    else:
        body += [helper.make_node("Identity", ["f"], ["y"], name="same")]
    constants = [
        numpy_helper.from_array(np.array([1], dtype), "one"),
        numpy_helper.from_array(np.array(0.5, np.float32), "scale"),
        numpy_helper.from_array(np.array(0, np.int8), "zero"),
    ]
    x, y = (helper.make_tensor_value_info(n, TensorProto.FLOAT, [2]) for n in "xy")
    known = constants if precision == "int8" else constants[:1]
    onnx.save(
        helper.make_model(
            helper.make_graph(body, "g", [x], [y], known),
            opset_imports=[helper.make_opsetid("", 13)],
            ir_version=8,
        ),
        path,
    )
    return path


@pytest.mark.parametrize("precision", ["fp32", "fp16", "int8"])
def test_onnx_runtime_computes_a_graph_as_it_is_stored(tmp_path: Path, precision: str) -> None:
    path = stored(tmp_path / "x.onnx", precision)
    assert stored_precision(onnx.load_model(path)) == precision
    assert precisions_of("onnxruntime", path) == (precision,)
    open_session("onnxruntime", path, precision).run()  # type: ignore[arg-type]
    for other in {"fp32", "fp16", "int8"} - {precision}:
        with pytest.raises(UsageError, match=f"in {precision} on this machine, not in {other}"):
            open_session("onnxruntime", path, other)  # type: ignore[arg-type]


def test_openvino_keeps_integers(tmp_path: Path) -> None:
    pytest.importorskip("openvino", reason="needs OpenVINO: pip install 'rts2[openvino]'")
    path = stored(tmp_path / "x.onnx", "int8")
    assert precisions_of("openvino", path) == ("int8",)
    open_session("openvino", path, "int8").run()
    assert precisions_of("openvino", stored(tmp_path / "y.onnx", "fp32"))[0] == "fp32"
    assert runtimes.usable("openvino").title == "OpenVINO"
