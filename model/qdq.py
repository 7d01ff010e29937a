"""A graph in integers: convolutions in 8 bits, each value quantized and dequantized in the file.

The file says by pairs of QuantizeLinear and DequantizeLinear (QDQ) what is computed in integers; a
runtime that has integer kernels fuses them away. What is chosen is a layer: a convolution with the
ReLU and the pooling behind it and the concatenation before it, which carry integers at no cost.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from math import prod
from typing import Final

import numpy as np
import onnx

from .errors import Rts2Error

LAYER: Final = "Conv"

BEHIND: Final = ("Relu", "MaxPool")
BEFORE: Final = ("Concat", "Slice", "MaxPool")
"""Operators that belong to the layer whose result they take, and to the one that takes theirs."""

OPERATORS: Final = tuple(dict.fromkeys((LAYER, *BEHIND, *BEFORE)))
"""What a layer is made of."""

LAST_BITS: Final = 1e-6
"""What a range is widened to, in the unit of its values: a scale must not be 0."""

Ranges = Mapping[str, tuple[float, float]]
"""The smallest and the largest of each value that is quantized, by its name."""


@dataclass(frozen=True)
class Layer:
    """What is computed in integers as a whole, or not at all."""

    name: str
    """Of its convolution."""
    members: tuple[str, ...]
    """The names of its nodes, in the order of the graph."""
    inputs: tuple[str, ...]
    """The values that it takes, weights left out."""
    output: str
    """The value that it gives."""


@dataclass(frozen=True)
class Flow:
    """A value that one layer gives and another takes."""

    giver: str
    taker: str
    elements: int


def layers(model: onnx.ModelProto) -> tuple[Layer, ...]:
    """The layers of a float graph, in its order."""
    return _View(model).layers()


def flows(model: onnx.ModelProto) -> tuple[Flow, ...]:
    """What flows from layer to layer without an operator of neither in between."""
    view = _View(model)
    found = view.layers()
    giver = {layer.output: layer.name for layer in found}
    return tuple(
        Flow(giver[value], layer.name, view.elements(value))
        for layer in found
        for value in layer.inputs
        if value in giver
    )


def usual(model: onnx.ModelProto) -> tuple[str, ...]:
    """The layers that are usually worth computing in integers, where nobody has timed this graph:
    all but the `seldom` ones.
    """
    left = seldom(model)
    return tuple(layer.name for layer in layers(model) if layer.name not in left)


def seldom(model: onnx.ModelProto) -> dict[str, str]:
    """The layers that are seldom worth computing in integers, each with the reason."""
    view = _View(model)
    return {
        layer.name: CONVERTED if SELDOM.match(layer.name) else NO_3D_KERNEL
        for layer in view.layers()
        if SELDOM.match(layer.name) or not view.is_2d(layer.name)
    }


SELDOM: Final = re.compile(r"encoder\.stem\.|features\.stem\.|regularize\.\d\.layers\.0/")
"""Layers of large maps and few channels, and those that take one channel."""

CONVERTED: Final = "large maps of few channels: converting them costs more than integers save"
NO_3D_KERNEL: Final = "a 3D convolution: runtimes have no fast kernel of integers for it"


def nominal(model: onnx.ModelProto) -> Ranges:
    """Ranges for a graph whose answers do not matter: what is timed does not depend on them."""
    return dict.fromkeys(quantized_values(model), (0.0, 1.0))


def quantized_values(model: onnx.ModelProto) -> tuple[str, ...]:
    """The values whose ranges `integers` needs where every layer is chosen."""
    view = _View(model)
    found: dict[str, None] = {}
    for layer in view.layers():
        for member in layer.members:
            node = view.nodes[member]
            found |= dict.fromkeys(v for v in (*node.input, *node.output) if v in view.floats)
            if node.op_type == LAYER and view.follower(node) is not None:
                found.pop(node.output[0], None)  # the ReLU behind it bounds it
    return tuple(found)


def integers(
    model: onnx.ModelProto, chosen: Collection[str], ranges: Ranges, symmetric: bool = False
) -> onnx.ModelProto:
    """The graph with the chosen layers, by their names, in 8 bits.

    Activations are uint8 with a zero point, weights int8 per output channel. `symmetric` is what
    TensorRT takes: int8 with a zero point of 0 throughout, a pair before each input alone.

    Raises:
        Rts2Error: a layer that the graph does not have, or a value without a range.
    """
    view = _View(model)
    known = {layer.name: layer for layer in view.layers()}
    missing = [name for name in chosen if name not in known]
    if missing:
        raise Rts2Error(f"{missing[0]} is no layer of the graph that can be computed in integers")
    members = [name for layer in known.values() if layer.name in chosen for name in layer.members]
    if not members:
        return model
    copy = onnx.ModelProto()
    copy.CopyFrom(model)
    _unshare(copy.graph)
    held = () if symmetric else _hold_back(copy, members)
    made = _quantizer(
        copy, members, _tensor_ranges({**ranges, **_below_zero(ranges, held)}), symmetric
    )
    _sort(made.graph)
    _name_pairs(made.graph)
    return made


def _quantizer(
    model: onnx.ModelProto, members: list[str], ranges: object, symmetric: bool
) -> onnx.ModelProto:
    from onnxruntime.quantization import QuantType
    from onnxruntime.quantization.qdq_quantizer import QDQQuantizer

    options = {"ActivationSymmetric": True, **TENSORRT} if symmetric else {}
    with _silent():
        quantizer = QDQQuantizer(
            model,
            per_channel=True,
            reduce_range=False,
            weight_qType=QuantType.QInt8,
            activation_qType=QuantType.QInt8 if symmetric else QuantType.QUInt8,
            tensors_range=ranges,
            nodes_to_quantize=members,
            nodes_to_exclude=[],
            op_types_to_quantize=list(OPERATORS),
            extra_options=options,
        )
        try:
            quantizer.quantize_model()
        except ValueError as error:
            raise Rts2Error(f"the graph cannot be quantized: {error}") from error
    made: onnx.ModelProto = quantizer.model.model
    return made


def _unshare(graph: onnx.GraphProto) -> None:
    """Gives every convolution weights of its own: two equal biases are stored once, and one that is
    quantized for another layer would no longer be a constant to this one.
    """
    tensors = {tensor.name: tensor for tensor in graph.initializer}
    taken: set[str] = set()
    for node in graph.node:
        for index, name in enumerate(node.input):
            if name in taken and node.op_type == LAYER:
                own = graph.initializer.add()
                own.CopyFrom(tensors[name])
                own.name = node.input[index] = f"{name}:{node.name}"
        taken |= tensors.keys() & set(node.input)


def _hold_back(model: onnx.ModelProto, members: Collection[str]) -> tuple[str, ...]:
    """Puts a ReLU behind the float pooling that follows it, where integers follow that; returns
    the values that it gives.

    max(0, ·) and the largest of a window commute. ONNX Runtime moves a quantization ahead of a
    pooling, and computes the pooling in integers on planes, six times as slow as in float on
    blocks of channels; a ReLU that clips something (see `_below_zero`) is not passed.
    """
    view = _View(model)
    held = []
    for pool in view.nodes.values():
        relu = view.maker.get(pool.input[0]) if pool.op_type == "MaxPool" else None
        takers = view.takers.get(pool.output[0], [])
        if relu is None or relu.op_type != "Relu" or {relu.name, pool.name} & set(members):
            continue
        if len(view.takers[relu.output[0]]) == 1 and any(t.name in members for t in takers):
            given, between, last = relu.input[0], relu.output[0], pool.output[0]
            pool.input[0], pool.output[0] = given, between
            relu.input[0], relu.output[0] = between, last
            held.append(last)
            _swap(model.graph, relu, pool)
            shape = view.floats[last]
            _reshape(model.graph, between, shape)
    return tuple(held)


def _swap(graph: onnx.GraphProto, first: onnx.NodeProto, second: onnx.NodeProto) -> None:
    """Exchanges the places of two nodes in a graph that lists them in the order of their work."""
    names = [node.name for node in graph.node]
    a, b = names.index(first.name), names.index(second.name)
    kept = onnx.NodeProto()
    kept.CopyFrom(graph.node[a])
    graph.node[a].CopyFrom(graph.node[b])
    graph.node[b].CopyFrom(kept)


def _reshape(graph: onnx.GraphProto, value: str, shape: tuple[int, ...]) -> None:
    for known in graph.value_info:
        if known.name == value:
            for side, length in zip(known.type.tensor_type.shape.dim, shape, strict=True):
                side.dim_value = length


def _below_zero(ranges: Ranges, names: Iterable[str]) -> Ranges:
    """The ranges of what a ReLU gives, one step of 255 below zero: so the ReLU is not swallowed."""
    return {name: (-ranges[name][1] / STEPS, ranges[name][1]) for name in names}


STEPS: Final = 255

TENSORRT: Final = {
    "AddQDQPairToWeight": True,
    "QuantizeBias": False,
    "DedicatedQDQPair": True,
    "OpTypesToExcludeOutputQuantization": list(OPERATORS),
}
"""Pairs where TensorRT looks for them: at the inputs and weights of convolutions."""


def _tensor_ranges(ranges: Ranges) -> object:
    from onnxruntime.quantization.calibrate import CalibrationMethod, TensorsData

    told = {name: _array(pair) for name, pair in ranges.items()}
    return TensorsData(CalibrationMethod.MinMax, told)


def _array(pair: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """A range that holds 0 and is not empty."""
    low, high = min(pair[0], 0.0), max(pair[1], LAST_BITS)
    return np.array(low, np.float32), np.array(high, np.float32)


@contextmanager
def _silent() -> Iterator[None]:
    """The quantizer tells on the root logger what its caller knows."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)


def _sort(graph: onnx.GraphProto) -> None:
    """Puts every node behind those whose results it takes, else in the order in which it was.

    The quantizer appends its pairs at the end; ONNX wants them before, and not every runtime sorts.
    """
    nodes = list(graph.node)
    maker = {value: index for index, node in enumerate(nodes) for value in node.output}
    order: dict[int, None] = {}
    stack = list(reversed(range(len(nodes))))
    while stack:
        index = stack.pop()
        makers = (maker[value] for value in nodes[index].input if value in maker)
        before = [each for each in makers if each not in order]
        if before:
            stack += [index, *reversed(before)]
        else:
            order[index] = None
    del graph.node[:]
    graph.node.extend(nodes[index] for index in order)


def _name_pairs(graph: onnx.GraphProto) -> None:
    """Names what quantizes a weight after the layer whose weight it is: every node of a graph of
    ours begins with the name of the part that it belongs to.
    """
    taker = {value: node.name for node in graph.node for value in node.input}
    weights = {tensor.name for tensor in graph.initializer}
    weights |= {node.output[0] for node in graph.node if node.input[0] in weights}
    for node in reversed(graph.node):
        if node.op_type in PAIR and node.input[0] in weights:
            node.name = f"{taker[node.output[0]]}:{node.name}"
            taker[node.input[0]] = node.name


PAIR: Final = ("QuantizeLinear", "DequantizeLinear")


class _View:
    """A float graph, looked at node by node."""

    def __init__(self, model: onnx.ModelProto) -> None:
        graph = model.graph
        self.nodes = {node.name: node for node in graph.node}
        self.order = {name: index for index, name in enumerate(self.nodes)}
        self.maker = {value: node for node in graph.node for value in node.output}
        self.takers: dict[str, list[onnx.NodeProto]] = {}
        for node in graph.node:
            for value in node.input:
                self.takers.setdefault(value, []).append(node)
        self.weights = {tensor.name: tuple(tensor.dims) for tensor in graph.initializer}
        self.shown = {value.name for value in graph.output}
        self.floats = {
            value.name: tuple(side.dim_value for side in value.type.tensor_type.shape.dim)
            for value in (*graph.input, *graph.value_info, *graph.output)
            if value.type.tensor_type.elem_type == onnx.TensorProto.FLOAT
        }

    def is_2d(self, name: str) -> bool:
        """Whether a convolution is one of two dimensions."""
        return len(self.weights[self.nodes[name].input[1]]) == 4

    def elements(self, value: str) -> int:
        """How many numbers a value holds."""
        return prod(self.floats[value])

    def follower(self, node: onnx.NodeProto) -> onnx.NodeProto | None:
        """The ReLU that alone takes a node's result."""
        takers = self.takers.get(node.output[0], [])
        alone = len(takers) == 1 and node.output[0] not in self.shown
        return takers[0] if alone and takers[0].op_type == "Relu" else None

    def layers(self) -> tuple[Layer, ...]:
        """Every convolution with what belongs to it."""
        taken: set[str] = set()
        found = []
        for node in self.nodes.values():
            if node.op_type == LAYER:
                layer = self._layer(node, taken)
                taken |= set(layer.members)
                found.append(layer)
        return tuple(found)

    def _layer(self, conv: onnx.NodeProto, taken: set[str]) -> Layer:
        members = [conv, *self._behind(conv), *self._before(conv, taken)]
        members.sort(key=lambda node: self.order[node.name])
        own = {value for node in members for value in node.output}
        inputs = (v for node in members for v in node.input if v in self.floats and v not in own)
        *_, last = (conv, *self._behind(conv))
        return Layer(
            conv.name,
            tuple(node.name for node in members),
            tuple(dict.fromkeys(inputs)),
            last.output[0],
        )

    def _behind(self, node: onnx.NodeProto) -> Iterator[onnx.NodeProto]:
        """The operators that alone take what the layer gives, one after the other."""
        takers = self.takers.get(node.output[0], [])
        if len(takers) == 1 and takers[0].op_type in BEHIND and node.output[0] not in self.shown:
            yield takers[0]
            yield from self._behind(takers[0])

    def _before(self, node: onnx.NodeProto, taken: set[str]) -> Iterator[onnx.NodeProto]:
        """The operators whose results this layer alone takes."""
        for value in node.input[:1] if node.op_type != "Concat" else node.input:
            maker = self.maker.get(value)
            if maker is None or maker.op_type not in BEFORE or maker.name in taken:
                continue
            alone = len(self.takers[value]) == 1 and value not in self.shown
            if alone and self._carries(maker):
                yield maker
                yield from self._before(maker, taken)

    def _carries(self, node: onnx.NodeProto) -> bool:
        """Whether a layer may stand before it: else its result is quantized in one go."""
        makers = (self.maker.get(value) for value in node.input)
        return any(maker is not None and maker.op_type in OPERATORS for maker in makers)
