"""The kernel audit: in which kernels of the runtime each layer runs, and how long it takes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import onnx

from ..model.graph import GraphHeader, save_graph
from ..model.qdq import PAIR, Flow, Layer, Ranges, flows, integers, layers
from .selection import Cost, checkered, converted, total_ms

if TYPE_CHECKING:
    from ..profiles.runtimes.attribution import Kernel

RUNS: Final = 5
"""Of a graph whose kernels are timed; the fastest of each counts."""

MOVES: Final = frozenset(("Transpose", "ReorderInput", "ReorderOutput", "Cast"))
"""Kernels that tell nothing of where a layer runs."""


@dataclass(frozen=True)
class Kernels:
    """One graph as the runtime runs it."""

    layer_ms: Mapping[str, float]
    """What each layer takes, with the conversions at its sides that no other layer wants."""
    layer_kernels: Mapping[str, tuple[str, ...]]
    """The runtime's names of the kernels of each layer."""
    total_ms: float
    """Everything."""


@dataclass(frozen=True)
class Audited:
    """A float graph and its integers, timed layer by layer in one runtime."""

    costs: tuple[Cost, ...]
    flows: tuple[Flow, ...]
    ms_per_element: float
    """Of converting a value between layers of different kinds."""
    float_kernels: Mapping[str, tuple[str, ...]]
    integer_kernels: Mapping[str, tuple[str, ...]]


class Audit:
    """Times graphs of one network kernel by kernel, in files of its own."""

    def __init__(self, header: GraphHeader, folder: Path, threads: int) -> None:
        self._header, self._folder, self._threads = header, folder, threads

    def kernels(self, made: onnx.ModelProto, source: onnx.ModelProto) -> Kernels:
        """A graph that was made of the float graph `source`, or that very graph."""
        from ..profiles.runtimes.ort import Session

        path = self._folder / "audited.onnx"
        save_graph(made, self._header, path)
        return _by_layer(Session(path, self._threads).kernels(RUNS), source)

    def of(self, model: onnx.ModelProto, ranges: Ranges) -> Audited:
        """Float, integers throughout, and every other layer in integers."""
        found, flowing = layers(model), flows(model)
        names = [layer.name for layer in found]
        plain = self.kernels(model, model)
        whole = self.kernels(integers(model, names, ranges), model)
        every_other = checkered(names, flowing)
        mixed = self.kernels(integers(model, every_other, ranges), model)
        costs = tuple(Cost(n, plain.layer_ms[n], whole.layer_ms[n]) for n in names)
        return Audited(
            costs,
            flowing,
            _conversion(costs, flowing, every_other, plain, mixed),
            plain.layer_kernels,
            whole.layer_kernels,
        )


def _conversion(
    costs: Sequence[Cost],
    flowing: Sequence[Flow],
    chosen: frozenset[str],
    plain: Kernels,
    mixed: Kernels,
) -> float:
    """What the mixed graph takes beyond its layers, by the number of what it converts."""
    shared = plain.total_ms - total_ms(costs, (), 0.0, frozenset())
    own = total_ms(costs, (), 0.0, chosen)
    elements = converted(flowing, chosen)
    return max(mixed.total_ms - shared - own, 0.0) / elements if elements else 0.0


def _by_layer(found: Sequence[Kernel], model: onnx.ModelProto) -> Kernels:
    known = layers(model)
    owner = _owners(known)
    ms: dict[str, float] = dict.fromkeys((layer.name for layer in known), 0.0)
    kinds: dict[str, dict[str, None]] = defaultdict(dict)
    for kernel in found:
        layer = _owner(kernel.origin.node, owner)
        if layer is None:
            continue
        ms[layer] += kernel.ms
        if kernel.kind and kernel.kind not in MOVES:
            kinds[layer][kernel.kind] = None
    return Kernels(
        ms,
        {name: tuple(kinds.get(name, ())) for name in ms},
        sum(kernel.ms for kernel in found),
    )


def _owners(found: Iterable[Layer]) -> dict[str, str]:
    """The layer of each of its nodes, and of the values at its sides."""
    owner: dict[str, str] = {}
    for layer in found:
        owner |= dict.fromkeys(layer.members, layer.name)
        owner[layer.output] = layer.name
    for layer in found:
        for value in layer.inputs:
            owner.setdefault(value, layer.name)
    return owner


def _owner(node: str, owner: Mapping[str, str]) -> str | None:
    """The layer that a node of a graph with integers works for; None for what is no layer's."""
    if node in owner:
        return owner[node]
    value = node
    for kind in PAIR:
        value = value.removesuffix(f"_{kind}")
    # What quantizes a weight bears its layer's name in front.
    return owner.get(value) or owner.get(node.partition(":")[0])
