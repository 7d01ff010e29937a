"""Which ONNX operators a runtime takes, as a table: is this graph one that it can build?"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from importlib import resources
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from ..model.errors import Rts2Error, UsageError
from ..model.files import parse_json
from .profile import RuntimeSupport

Type = Literal["fp32", "fp16", "int8", "int32", "bool"]


class Operator(BaseModel):
    """What a runtime takes of one operator."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    types: tuple[Type, ...]
    limits: str = ""


class OpSet(BaseModel):
    """The operators that a runtime's importer takes, by name."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    max_opset: Annotated[int, Field(ge=1)]
    """The last version of ONNX's operator set that it reads."""
    source: str
    """The publication that the table was taken from."""
    operators: Mapping[str, Operator]


def opset_names() -> list[str]:
    """The names that `load_opset` knows."""
    files = (resources.files(__package__) / "opsets").iterdir()
    return sorted(file.name.removesuffix(".json") for file in files if file.name.endswith(".json"))


def load_opset(name: str) -> OpSet:
    """The table of a runtime, such as `tensorrt-8.2`.

    Raises `UsageError` with the known names for any other.
    """
    if name not in opset_names():
        raise UsageError(f"no operator table is named {name!r}; known: {', '.join(opset_names())}")
    file = resources.files(__package__) / "opsets" / f"{name}.json"
    return parse_json(file.read_text(encoding="utf-8"), OpSet, f"the operator table {name}")


def unsupported(op_types: Iterable[str], opset: OpSet) -> list[str]:
    """Those of `op_types` that the runtime does not take, sorted, each once."""
    return sorted(set(op_types) - opset.operators.keys())


def refuse_operators(path: Path, support: RuntimeSupport) -> None:
    """Raises `Rts2Error` naming each operator of the graph that the runtime does not take."""
    if support.operators is None:
        return
    table = load_opset(support.operators)
    version, used = operators(path)
    missing = unsupported(used, table)
    if version > table.max_opset or missing:
        what = ", ".join(missing) or f"opset {version}"
        raise Rts2Error(
            f"{table.name} takes opset {table.max_opset} at most and its own operators; "
            f"the graph needs {what}"
        )


def operators(path: Path) -> tuple[int, list[str]]:
    """An ONNX file's opset version, and its operator types sorted, each once.

    An operator that is not ONNX's own bears its domain: `com.microsoft.FusedConv`. Raises
    `UsageError` where there is no such file and `Rts2Error` where it is no ONNX file.
    """
    from ..model.graph import load_graph

    model = load_graph(path)
    version = next((entry.version for entry in model.opset_import if entry.domain == ""), 0)
    return version, sorted({_name(node.domain, node.op_type) for node in model.graph.node})


def _name(domain: str, op_type: str) -> str:
    return f"{domain}.{op_type}" if domain not in ("", "ai.onnx") else op_type
