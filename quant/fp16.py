"""Half precision: an ONNX graph of ours with fp16 weights and arithmetic, disparities kept float.

Targets with fp16 units (TensorRT, CUDA) run the result. ONNX Runtime on a CPU has next to no fp16
kernels: it computes in fp32 between casts, is no faster, and leaves out roundings that a target
performs. `emulated` performs them, so that accuracy can be measured on any machine.

The converter that comes with ONNX Runtime casts every kept operator on its own, so that disparities
pass through fp16 between two of them, and gives casts of equal names; hence a pass of our own.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import prod
from typing import Final, Literal, NamedTuple

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper, shape_inference

from ..model.errors import Rts2Error

FLOAT: Final = TensorProto.FLOAT
HALF: Final = TensorProto.FLOAT16

ALWAYS_FLOAT: Final = {"Resize": (1, 2)}
"""Inputs that ONNX wants in fp32 whatever the rest is: the region and the scales of Resize."""

BEGIN: Final = frozenset(("ReduceMin", "Softmax"))
END: Final = frozenset(("Div", "ReduceSum"))
"""Operators that begin and end a soft-argmin, in graphs of this version and of earlier ones."""

Role = Literal["soft-argmin", "disparity", "coordinate"]

REASONS: Final[dict[Role, str]] = {
    "soft-argmin": "soft-argmin: its weights must add up to one",
    "disparity": "disparity in pixels: from 128 px on, half precision steps by 1/8 px or more",
    "coordinate": "warp coordinate: from 256 px on, half precision steps by 1/4 px or more",
}


class Kept(NamedTuple):
    """An operator that stays float, and why."""

    layer: str
    reason: str


def kept_float(model: onnx.ModelProto) -> list[Kept]:
    """The operators that `to_fp16` leaves in fp32: all that carry a disparity, in graph order.

    They are found by where their values come from. The least cost begins a soft-argmin, or a
    softmax does, and a quotient or a sum ends it; what descends from there is a disparity as long
    as it has a single channel, and from where it is taken from the columns of the image it is a
    coordinate. Whatever joins features ends the way.
    """
    constants = {tensor.name for tensor in model.graph.initializer}
    shapes = _values(model)
    sizes = {name: prod(shape) for name, (_, shape) in shapes.items()}
    roles: dict[str, Role] = {}
    kept = []
    for node in model.graph.node:
        if shapes[node.output[0]][0] != FLOAT:
            continue
        above = [name for name in node.input if name in roles]
        grows = sizes[node.output[0]] > max((sizes[name] for name in above), default=0)
        role = _role(node, [roles[name] for name in above], grows, constants)
        if role is not None:
            roles |= dict.fromkeys(node.output, role)
            kept.append(Kept(node.name, REASONS[role]))
    return kept


def _role(node: onnx.NodeProto, above: list[Role], grows: bool, constants: set[str]) -> Role | None:
    """What a node's output carries, given what its inputs do."""
    if node.op_type in BEGIN:
        return "soft-argmin"
    if not above:
        return None
    if above[0] == "soft-argmin":
        return "disparity" if node.op_type in END else "soft-argmin"
    if grows and not _enlarges(node, above):
        return None
    from_columns = node.op_type == "Sub" and node.input[0] in constants
    return "coordinate" if from_columns or "coordinate" in above else "disparity"


def _enlarges(node: onnx.NodeProto, above: list[Role]) -> bool:
    """Whether what grows is a map enlarged: by a resize, or by products of a disparity."""
    return node.op_type == "Resize" or (node.op_type == "MatMul" and above == ["disparity"])


def to_fp16(model: onnx.ModelProto) -> onnx.ModelProto:
    """The graph in fp16 but for `kept_float`; its inputs and outputs keep their types.

    Raises `Rts2Error` for a weight that is too large for fp16.
    """
    kept = {layer for layer, _ in kept_float(model)}
    given = _values(model)
    weights = {tensor.name: tensor for tensor in model.graph.initializer}
    kinds = {value.name: FLOAT for value in model.graph.input}
    graph = _Graph()
    for node in _copies(model):
        wanted = FLOAT if node.name in kept else HALF
        for index, name in enumerate(node.input):
            if name in weights:
                fixed = wanted == FLOAT or index in ALWAYS_FLOAT.get(node.op_type, ())
                node.input[index] = graph.add(weights[name] if fixed else _half(weights[name]))
            elif kinds.get(name, wanted) != wanted:
                node.input[index] = graph.cast(name, wanted)
        kinds |= {name: wanted for name in node.output if given[name][0] == FLOAT}
        if node.op_type == "Cast" and given[node.output[0]][0] == FLOAT:
            node.attribute[0].i = wanted
        graph.nodes.append(node)
    return graph.instead_of(model)


def emulated(model: onnx.ModelProto) -> onnx.ModelProto:
    """An fp16 graph for runtimes without fp16 units, rounding as a target with them rounds.

    Every fp16 operator becomes an fp32 one whose result is rounded to fp16: sums accumulate in
    fp32, as they do in a GPU. ONNX Runtime itself drops the roundings between two operators, and
    so is more accurate than any target.
    """
    kinds = {name: kind for name, (kind, _) in _values(model).items()}
    kinds |= {tensor.name: tensor.data_type for tensor in model.graph.initializer}
    graph = _Graph({tensor.name: tensor for tensor in model.graph.initializer})
    for node in _copies(model):
        if node.op_type == "Cast":
            if graph.known.isdisjoint(node.output):  # else one of ours came before, and is the same
                graph.known.update(node.output)
                graph.nodes.append(node)
            continue
        node.input[:] = [graph.cast(x, FLOAT) if kinds.get(x) == HALF else x for x in node.input]
        rounded = [name for name in node.output if kinds[name] == HALF]
        node.output[:] = [f"{name}:wide" if name in rounded else name for name in node.output]
        graph.nodes.append(node)
        for name in rounded:
            graph.cast(f"{name}:wide", HALF, name)
    return graph.instead_of(model)


class _Graph:
    """Nodes and weights of a graph in the making; a value is cast to one type once."""

    def __init__(self, weights: dict[str, onnx.TensorProto] | None = None) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.weights = dict(weights or {})
        self.known: set[str] = set()

    def add(self, weight: onnx.TensorProto) -> str:
        """Adds a weight; returns its name."""
        self.weights[weight.name] = weight
        return str(weight.name)

    def cast(self, name: str, kind: int, output: str | None = None) -> str:
        """Adds a cast of a value, unless there is one; returns its output's name."""
        output = output or f"{name}:{'fp16' if kind == HALF else 'fp32'}"
        if output not in self.known:
            self.known.add(output)
            self.nodes.append(helper.make_node("Cast", [name], [output], name=output, to=kind))
        return output

    def instead_of(self, model: onnx.ModelProto) -> onnx.ModelProto:
        """`model` with these nodes and weights in place of its own."""
        made = onnx.ModelProto()
        made.CopyFrom(model)
        for field, items in (
            (made.graph.node, self.nodes),
            (made.graph.initializer, self.weights.values()),
            (made.graph.value_info, ()),
        ):
            del field[:]
            field.extend(items)
        return _inferred(made)


def _copies(model: onnx.ModelProto) -> Iterator[onnx.NodeProto]:
    for node in model.graph.node:
        copy = onnx.NodeProto()
        copy.CopyFrom(node)
        yield copy


def _values(model: onnx.ModelProto) -> dict[str, tuple[int, tuple[int, ...]]]:
    """Element type and shape of every value that is no weight.

    Raises `Rts2Error` where the graph contradicts itself, or has an operator that ONNX does not.
    """
    graph = _inferred(model).graph
    values = {
        value.name: (
            value.type.tensor_type.elem_type,
            tuple(side.dim_value for side in value.type.tensor_type.shape.dim),
        )
        for value in (*graph.input, *graph.value_info, *graph.output)
    }
    for node in graph.node:
        if values.keys().isdisjoint(node.output):
            raise Rts2Error(f"{node.name} is no operator of ONNX; export the checkpoint again")
    return values


def _inferred(model: onnx.ModelProto) -> onnx.ModelProto:
    """The model with the types and shapes of all its values."""
    try:
        return shape_inference.infer_shapes(model, strict_mode=True)
    except shape_inference.InferenceError as error:
        raise Rts2Error(f"the graph is broken, export the checkpoint again: {error}") from error


def _half(tensor: onnx.TensorProto) -> onnx.TensorProto:
    """A weight in fp16 under its own name; what is no fp32 stays as it is."""
    if tensor.data_type != FLOAT:
        return tensor
    values = numpy_helper.to_array(tensor)
    with np.errstate(over="ignore"):
        half = values.astype(np.float16)
    if not np.isfinite(half).all():
        largest = float(np.abs(values).max())
        raise Rts2Error(f"{tensor.name} holds {largest:g}; fp16 ends at 65504: keep fp32")
    return numpy_helper.from_array(half, f"{tensor.name}:fp16")
