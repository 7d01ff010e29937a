"""OpenVINO's own format, with what must stay float said in the file.

OpenVINO takes one precision for a whole network: in bf16, which has 8 bits, a disparity of 100 px
steps by half a pixel, and a column beyond the 256th by two. Operators marked as precise in the file
keep float; the marks come from the same rule as those of fp16 graphs (`kept_float`).
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final
from xml.etree import ElementTree

import numpy as np

from ..model.files import write_bytes
from ..profiles.runtimes.ov import IR
from .fp16 import kept_float
from .source import opened

COUNTED: Final = re.compile(r"[A-Za-z]+_\d+")
"""The name that OpenVINO gives to what has none; the number counts what the process made before."""

PRECISE: Final = {"name": "precise", "version": "0"}
"""The attribute of OpenVINO that keeps an operator from being lowered."""

FORGETFUL: Final = frozenset(("Subtract", "Divide"))
"""Operators that OpenVINO replaces by others, without their mark."""

LOWEST: Final = np.finfo(np.float32).min


def to_ir(graph: Path) -> Path:
    """Writes the graph as OpenVINO IR beside it: the file that is returned, and its weights (.bin).

    Equal graphs give equal bytes.
    """
    import openvino

    path = graph.with_suffix(IR)
    kept = {layer for layer, _ in kept_float(opened(graph)[0])}
    model = openvino.Core().read_model(str(graph))
    kept |= _anchored(model, kept)
    with TemporaryDirectory() as folder:
        plain = Path(folder) / "plain.xml"
        openvino.save_model(model, plain, compress_to_fp16=False)
        tree = ElementTree.parse(plain)
        layers = {layer.get("id", ""): layer for layer in tree.iterfind("layers/layer")}
        for each in _precise(layers, tree.findall("edges/edge"), kept):
            _mark(layers[each])
        for each, layer in layers.items():
            if COUNTED.fullmatch(layer.get("name", "")):
                layer.set("name", f"{layer.get('type')}_{each}")
        write_bytes(path.with_suffix(".bin"), plain.with_suffix(".bin").read_bytes())
        write_bytes(path, ElementTree.tostring(tree.getroot(), "utf-8", xml_declaration=True))
    return path


def _anchored(model: Any, kept: set[str]) -> set[str]:
    """Puts a maximum that changes nothing behind what would lose its mark, and gives their names.

    OpenVINO computes a chain of such operators in one kernel, in float if one of them is marked:
    the maximum keeps its mark, and the operator before it its precision.
    """
    from openvino import opset8

    names = set()
    for node in model.get_ordered_ops():
        name = node.get_friendly_name()
        if name not in kept or node.get_type_name() not in FORGETFUL:
            continue
        readers = [
            each
            for each in node.output(0).get_target_inputs()
            if each.get_node().get_type_name() != "Result"  # it bears this operator's name
        ]
        lowest = opset8.constant(LOWEST, name=f"{name}/lowest")
        anchor = opset8.maximum(node, lowest, name=f"{name}/kept")
        for each in readers:
            each.replace_source_output(anchor.output(0))
        names.add(anchor.get_friendly_name())
    return names


def _precise(layers: dict[str, Any], edges: Iterable[Any], kept: set[str]) -> set[str]:
    """The layers to mark: those of these names, what stands between two of them (one operator of
    the file may become several), and the conversions to whole numbers behind them.
    """
    sources, readers = defaultdict(set), defaultdict(set)
    for edge in edges:
        sources[edge.get("to-layer")].add(edge.get("from-layer"))
        readers[edge.get("from-layer")].add(edge.get("to-layer"))
    named = {each for each, layer in layers.items() if layer.get("name") in kept}
    behind = {each for each in layers if sources[each] & named}
    between = {each for each in behind if readers[each] & named}
    return named | between | {each for each in behind if layers[each].get("type") == "Convert"}


def _mark(layer: Any) -> None:
    told = layer.find("rt_info")
    if told is None:
        told = ElementTree.Element("rt_info")
        # It stands behind the operator's data, where there is any.
        layer.insert(0 if layer.find("data") is None else 1, told)
    ElementTree.SubElement(told, "attribute", PRECISE)
