"""OpenVINO's own format: the marks in it, and that it says nothing of the process that wrote it."""

from pathlib import Path
from xml.etree import ElementTree

import pytest

from rts2.model.arch import Arch
from rts2.model.checkpoint import build
from rts2.model.export import export
from rts2.quant.fp16 import kept_float
from rts2.quant.intermediate import to_ir
from rts2.quant.source import opened


@pytest.fixture
def graph(tmp_path: Path) -> Path:
    pytest.importorskip("openvino", reason="needs OpenVINO: pip install 'rts2[openvino]' brings it")
    path = tmp_path / "model.onnx"
    export(build(Arch(c=1, stages=2, d_max=6, conv3d=(4, 2))), path, (96, 64), "untrained")
    return path


def test_equal_graphs_give_equal_bytes_whatever_the_process_made_before(
    graph: Path, tmp_path: Path
) -> None:
    first, second = (tmp_path / name / "model.xml" for name in ("a", "b"))
    for path in (first, second):
        path.parent.mkdir()
        to_ir(graph, path)
    assert first.read_bytes() == second.read_bytes()
    assert first.with_suffix(".bin").read_bytes() == second.with_suffix(".bin").read_bytes()
    assert str(tmp_path) not in first.read_text()


def test_what_carries_a_disparity_is_marked_and_names_stay_distinct(graph: Path) -> None:
    path = graph.with_suffix(".xml")
    to_ir(graph, path)
    layers = ElementTree.parse(path).findall("layers/layer")
    names = [layer.get("name", "") for layer in layers]
    assert len(set(names)) == len(names)
    marked = {
        layer.get("name", "")
        for layer in layers
        if layer.find("rt_info/attribute[@name='precise']") is not None
    }
    kept = [layer for layer, _ in kept_float(opened(graph)[0])]
    assert kept
    assert marked
    assert all(any(name.startswith(layer) for layer in kept) for name in marked)
    assert not any("Conv" in name for name in marked)
