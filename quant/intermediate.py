"""OpenVINO's own format, with what must stay float said in the file.

OpenVINO takes one precision for a whole network: in bf16, which has 8 bits, a disparity of 100 px
steps by half a pixel. Operators marked as precise in the file keep float; the marks come from the
same rule as those of fp16 graphs (`kept_float`).
"""

from __future__ import annotations

import re
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from xml.etree import ElementTree

from ..model.files import write_bytes
from .fp16 import kept_float
from .source import opened

COUNTED = re.compile(r"[A-Za-z]+_\d+")
"""The name that OpenVINO gives to what has none; the number counts what the process made before."""

PRECISE = {"name": "precise", "version": "0"}
"""The attribute of OpenVINO that keeps an operator from being lowered."""


def to_ir(graph: Path, path: Path) -> None:
    """Writes the float graph as OpenVINO IR: `path` (.xml), and its weights beside it (.bin).

    Equal graphs give equal bytes.
    """
    import openvino

    kept = tuple(layer for layer, _ in kept_float(opened(graph)[0]))
    with TemporaryDirectory() as folder:
        plain = Path(folder) / "plain.xml"
        openvino.save_model(openvino.Core().read_model(str(graph)), plain, compress_to_fp16=False)
        tree = ElementTree.parse(plain)
        for layer in tree.iterfind("layers/layer"):
            if COUNTED.fullmatch(layer.get("name", "")):
                layer.set("name", f"{layer.get('type')}_{layer.get('id')}")
            # An operator of the file may become several, named after it.
            if layer.get("name", "").startswith(kept):
                _mark(layer)
        write_bytes(path.with_suffix(".bin"), plain.with_suffix(".bin").read_bytes())
        write_bytes(path, ElementTree.tostring(tree.getroot(), "utf-8", xml_declaration=True))


def _mark(layer: Any) -> None:
    told = layer.find("rt_info")
    if told is None:
        told = ElementTree.Element("rt_info")
        # It stands behind the operator's data, where there is any.
        layer.insert(0 if layer.find("data") is None else 1, told)
    ElementTree.SubElement(told, "attribute", PRECISE)
