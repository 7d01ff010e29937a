"""How wide the stem of a graph is, counted without building it (see `rts2.model.forms.stem`)."""

from __future__ import annotations

from dataclasses import replace
from math import prod
from typing import NamedTuple

from .ops import Op, Shape

BLOCK = 16
"""Single-precision channels in one AVX-512 register: CPU kernels compute whole blocks."""

STEM = ("encoder.stem.0.conv", "encoder.stem.1.conv")
"""Its two convs in the op list."""


class Phases(NamedTuple):
    """How many neighbours in y and x become one pixel: 1 or 2."""

    y: int
    x: int

    @property
    def pixels(self) -> int:
        return self.y * self.x

    @property
    def sides(self) -> tuple[int, int]:
        """Of the second kernel: three pixels lie in three groups of one, or in two of two."""
        return 3 if self.y == 1 else 2, 3 if self.x == 1 else 2

    def of(self, maps: Shape) -> Shape:
        """(B, C, H, W) with the pixels of a group side by side in the channels."""
        batch, channels, height, width = maps
        return batch, channels * self.pixels, height // self.y, width // self.x


def phases(c: int) -> Phases:
    """What is fastest for a stem of c channels (measured in ONNX Runtime)."""
    if c % BLOCK == 0 or (c > BLOCK and c % 8):
        return Phases(1, 1)
    return Phases(1, 2) if c >= 8 else Phases(2, 2)


def widened(op: Op) -> Op:
    """A step of RTS²Net's op list as graphs hold it: a conv of the stem with the shapes and the
    multiply-adds of its wider form, any other step as it is.
    """
    if op.name not in STEM:
        return op
    group = phases(op.output[1])
    if op.name == STEM[0]:
        output = group.of(op.output)
        taps = (2 + group.y) * (2 + group.x)
        return replace(op, output=output, macs=taps * op.inputs[0][1] * prod(output))
    inputs = group.of(op.inputs[0])
    height, width = group.sides
    return replace(op, inputs=(inputs,), macs=height * width * inputs[1] * prod(op.output))
