"""OpenVINO's own format: the marks in it, and that it says nothing of the process that wrote it."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from rts2.model.arch import Arch
from rts2.model.box import named_model
from rts2.model.checkpoint import build, load
from rts2.model.export import export
from rts2.model.predictor import OnnxPredictor
from rts2.profiles.runtimes import precisions
from rts2.quant.fp16 import kept_float
from rts2.quant.half import OpenVinoPredictor
from rts2.quant.intermediate import to_ir
from rts2.quant.source import opened


@pytest.fixture
def graph(tmp_path: Path) -> Path:
    pytest.importorskip("openvino", reason="needs OpenVINO: pip install 'rts2[openvino]' brings it")
    return exported(Arch(c=1, stages=2, d_max=6, conv3d=(4, 2)), (96, 64), tmp_path)


def exported(arch: Arch, resolution: tuple[int, int], folder: Path) -> Path:
    path = folder / "model.onnx"
    export(build(arch), path, resolution, "untrained", runtime="openvino")
    return path


def test_equal_graphs_give_equal_bytes_whatever_the_process_made_before(
    graph: Path, tmp_path: Path
) -> None:
    copies = [tmp_path / name / graph.name for name in ("a", "b")]
    for copy in copies:
        copy.parent.mkdir()
        copy.write_bytes(graph.read_bytes())
    first, second = map(to_ir, copies)
    assert first.read_bytes() == second.read_bytes()
    assert first.with_suffix(".bin").read_bytes() == second.with_suffix(".bin").read_bytes()
    assert str(tmp_path) not in first.read_text()


def test_what_carries_a_disparity_is_marked_and_names_stay_distinct(graph: Path) -> None:
    path = to_ir(graph)
    layers = ElementTree.parse(path).findall("layers/layer")
    names = [layer.get("name", "") for layer in layers]
    assert len(set(names)) == len(names)
    marked = {
        layer.get("name", ""): layer.get("type", "")
        for layer in layers
        if layer.find("rt_info/attribute[@name='precise']") is not None
    }
    kept = {layer for layer, _ in kept_float(opened(graph)[0])}
    assert kept
    assert kept & set(names) <= marked.keys()
    others = {marked[name] for name in marked.keys() - kept}
    # Anchors, the other half of a clip, and what turns coordinates into whole numbers.
    assert others == {"Maximum", "Convert"}


def test_its_fp32_is_that_of_the_graph(graph: Path) -> None:
    path = to_ir(graph)
    left, right = np.random.default_rng(0).integers(0, 256, (2, 64, 96, 3), dtype=np.uint8)
    wanted = OnnxPredictor(graph).predict(left, right)
    found = OpenVinoPredictor(graph, path, "fp32", 1).predict(left, right)
    np.testing.assert_allclose(found.disparity, wanted.disparity, atol=1e-3)


def test_nothing_that_carries_a_disparity_is_computed_in_bf16(graph: Path) -> None:
    if "bf16" not in precisions("openvino"):
        pytest.skip("this processor computes no bf16")
    import openvino

    path = to_ir(graph)
    hint = {"INFERENCE_PRECISION_HINT": "bf16"}
    compiled = openvino.Core().compile_model(path, "CPU", hint)
    kept = {layer for layer, _ in kept_float(opened(graph)[0])}
    lowered, spared = set(), set()
    for node in compiled.get_runtime_model().get_ordered_ops():
        told = node.get_rt_info()
        if "originalLayersNames" in told:
            names = told["originalLayersNames"].astype(str).split(",")
            half = told["runtimePrecision"].astype(str) == "bf16"
            (lowered if half else spared).update(names)
    assert any("Conv" in name for name in lowered)
    # What refinement is told of the stage before is an input of its convolutions like others.
    assert {name.partition(".")[0] for name in kept & lowered} <= {"refine"}
    assert len(kept & spared) > len(kept) / 2


def test_far_columns_are_warped_in_bf16_as_in_fp32(tmp_path: Path) -> None:
    """Beyond the 256th column bf16 has no odd numbers, and between 128 and 256 no fractions."""
    pytest.importorskip("openvino", reason="needs OpenVINO: pip install 'rts2[openvino]' brings it")
    if "bf16" not in precisions("openvino"):
        pytest.skip("this processor computes no bf16")
    path = tmp_path / "model.onnx"
    export(load(named_model("c1"))[0], path, (2048, 64), "the box", runtime="openvino")
    own = to_ir(path)
    right = np.random.default_rng(0).integers(0, 256, (64, 2048, 3), dtype=np.uint8)
    left = np.roll(right, 8, 1)
    wanted = OnnxPredictor(path).predict(left, right).disparity
    found = OpenVinoPredictor(path, own, "bf16", 1).predict(left, right).disparity
    off = np.abs(found - wanted)
    near, far = off[:, 64:512].mean(), off[:, 1024:].mean()
    assert far < 2 * near
