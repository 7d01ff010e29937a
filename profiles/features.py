"""What the work of a step is measured in: counts that a latency is linear in."""

from __future__ import annotations

from collections.abc import Callable
from math import prod
from typing import Final

from ..model.ops import BYTES_PER_ELEMENT, Kind, Op, Shape
from ..model.phases import BLOCK, widened

REORDERED: Final = 4
"""Channels that are copied into blocks at a time: other counts of inputs are not packed."""

IMAGE_CHANNELS: Final = 3


def _macs(op: Op, kind: Kind) -> float:
    return op.macs / 1e9 if op.kind == kind else 0.0


def _gbytes(*shapes: Shape) -> float:
    return sum(BYTES_PER_ELEMENT * prod(shape) for shape in shapes) / 1e9


def _single(op: Op) -> float:
    return _macs(op, "conv2d") if op.inputs[0][0] == 1 else 0.0


def _blocked(op: Op, kind: Kind) -> float:
    """Multiply-adds of a convolution on whole blocks of channels; an image's three stay three."""
    inputs, outputs = op.inputs[0][1], op.output[1]
    filled = _filled(outputs)
    if kind == "conv2d" and inputs > IMAGE_CHANNELS:
        filled *= _filled(inputs)
    return _macs(op, kind) * filled


def _filled(channels: int) -> float:
    """How many times as many channels are computed as there are."""
    return -(-channels // BLOCK) * BLOCK / channels


def _is_packed(op: Op) -> bool:
    """Whether a 2D convolution packs channels in blocks: outputs always, inputs once there is a
    whole block of them.
    """
    inputs = op.inputs[0][1]
    return op.kind == "conv2d" and (inputs < BLOCK or inputs % REORDERED == 0)


def _is_product(op: Op) -> bool:
    """Whether a convolution is a product of matrices, its windows laid out in columns before."""
    return op.kind in ("conv2d", "conv3d") and not _is_packed(op)


def _packed(op: Op) -> float:
    """Multiply-adds of a 2D convolution in blocks, with zeros in the channels that fill them up."""
    own = widened(op)
    if not _is_packed(own):
        return 0.0
    inputs, outputs = own.inputs[0][1], own.output[1]
    filled = _filled(outputs)
    if inputs >= BLOCK:
        filled *= _filled(inputs)
    return own.macs / 1e9 * filled


def _repacked(op: Op) -> float:
    """10⁹ bytes of the maps of a 2D convolution in blocks that fill no whole ones, and are copied
    for it.
    """
    own = widened(op)
    if not _is_packed(own):
        return 0.0
    maps = (own.output, *(shape for shape in own.inputs if shape[1] > BLOCK))
    return _gbytes(*(shape for shape in maps if shape[1] % BLOCK))


def _product(op: Op) -> float:
    own = widened(op)
    return own.macs / 1e9 if _is_product(own) else 0.0


def _columns(op: Op) -> float:
    """10⁹ bytes of the windows of a convolution that is a product: one for each multiply-add of an
    output channel.
    """
    own = widened(op)
    return BYTES_PER_ELEMENT * own.macs / own.output[1] / 1e9 if _is_product(own) else 0.0


def _strided(op: Op) -> float:
    """Those of windows that are several columns apart, and are gathered number by number."""
    own = widened(op)
    return _columns(op) if own.output[-1] < own.inputs[0][-1] else 0.0


def _warped(op: Op) -> float:
    return prod(op.output) / 1e6 if op.kind == "warp_volume" else 0.0


FEATURES: Final[dict[str, Callable[[Op], float]]] = {
    "gmac": lambda op: op.macs / 1e9,
    "gmac_2d": lambda op: _macs(op, "conv2d"),
    "gmac_2d_single": _single,
    "gmac_2d_blocked": lambda op: _blocked(op, "conv2d"),
    "gmac_2d_packed": _packed,
    "gmac_3d": lambda op: _macs(op, "conv3d"),
    "gmac_3d_blocked": lambda op: _blocked(op, "conv3d"),
    "gmac_product": _product,
    "gbyte": lambda op: op.bytes / 1e9,
    "gbyte_resize": lambda op: op.bytes / 1e9 if op.kind == "resize" else 0.0,
    "gbyte_argmax": lambda op: op.bytes / 1e9 if op.kind == "argmax" else 0.0,
    "gbyte_repacked": _repacked,
    "gbyte_columns": _columns,
    "gbyte_strided": _strided,
    "mvoxel_warp": _warped,
    "extra_kernel": lambda op: float(op.launches - 1),
}
"""10⁹ multiply-adds, of 2D convs, of those on one image alone (the semantic and refinement
branches), with channels filled up to blocks (2D: inputs and outputs, 3D: outputs), of 3D convs; 10⁹
bytes moved, of those by resizing and by finding the best class; 10⁶ voxels of residual volumes;
kernels of a step beyond its first.

Of few-shot fits (`kit`), as ONNX Runtime computes the graphs of `rts2.model.export` on a CPU:
`gmac_2d_packed` in blocks of channels, inputs only from a whole block on, `gbyte_repacked` copied
into blocks and out; `gmac_product` as products of matrices, which are 3D convs, and 2D convs whose
inputs cannot be packed; `gbyte_columns` laid out for those, `gbyte_strided` number by number."""
