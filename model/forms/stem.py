"""The stem with several neighbouring pixels in the channels, so that they fill a vector.

Runtimes lay channels out in blocks of 16, and half of a block of c = 8 channels is zeros. Two
neighbours in x (for the narrowest networks 2 × 2 of them) make one pixel of more channels: the
first conv computes them from the image with a stride and a kernel that is larger by as much, and
the second one, of stride 2, finds its nine pixels among 3 × 2 (2 × 2) of the new ones. A tap that
no old kernel had is zero; beyond the borders both have zeros, as the old ones had.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..phases import Phases, phases
from ..rts2net import Encoder


class Overlapping(nn.Conv2d):
    """A conv that has a row or column of zeros before the map and, where it needs it, behind.

    `padding` counts both ends of both axes: top, left, bottom, right, in ONNX's order.
    """

    def __init__(self, weight: Tensor, stride: tuple[int, int], pads: tuple[int, ...]) -> None:
        outputs, inputs, height, width = weight.shape
        # On no device, as weights that are replaced anyway should draw no random numbers.
        super().__init__(inputs, outputs, (height, width), stride, bias=False, device="meta")
        self.weight = nn.Parameter(weight)
        self.pads = pads
        self.eval()

    def forward(self, maps: Tensor) -> Tensor:
        found: Tensor = _Conv.apply(maps, self.weight, self.stride, self.pads)  # type: ignore[no-untyped-call]
        return found


class _Conv(torch.autograd.Function):
    """A conv with zeros on some sides alone; PyTorch would export it as two steps."""

    @staticmethod
    def forward(
        _: Any, maps: Tensor, weight: Tensor, stride: tuple[int, int], pads: tuple[int, ...]
    ) -> Tensor:
        top, left, bottom, right = pads
        return F.conv2d(F.pad(maps, (left, right, top, bottom)), weight, stride=stride)

    @staticmethod
    def symbolic(g: Any, maps: Any, weight: Any, stride: tuple[int, int], pads: Any) -> Any:
        batch, _, *sides = maps.type().sizes()
        outputs, _, *kernel = weight.type().sizes()
        found = g.op(
            "Conv",
            maps,
            weight,
            dilations_i=(1, 1),
            group_i=1,
            kernel_shape_i=kernel,
            pads_i=pads,
            strides_i=stride,
        )
        ends = zip(sides, pads[:2], pads[2:], kernel, stride, strict=True)
        reached = [(side + a + b - size) // step + 1 for side, a, b, size, step in ends]
        return found.setType(maps.type().with_sizes([batch, outputs, *reached]))


def widen_stem(encoder: Encoder) -> None:
    """Puts the stem of an encoder in eval mode into the form that `phases` tells."""
    blocks: Any = encoder.stem
    first, second = blocks
    group = phases(first[0].out_channels)
    if group.pixels > 1:
        first[0] = _first(first[0], group)
        first[1] = _repeated(first[1], group.pixels)
        second[0] = _second(second[0], group)


def _first(conv: nn.Conv2d, group: Phases) -> nn.Conv2d:
    """Stride 1 and 3×3 → stride (y, x) and (2 + y)×(2 + x), the phase at the fore of channels."""
    weight = conv.weight.detach()
    shifted = [
        F.pad(weight, (x, group.x - 1 - x, y, group.y - 1 - y))
        for y in range(group.y)
        for x in range(group.x)
    ]
    return Overlapping(torch.cat(shifted), (group.y, group.x), (1, 1, 1, 1))


def _second(conv: nn.Conv2d, group: Phases) -> nn.Conv2d:
    """Stride 2 and 3×3 over pixels → stride 2 / phases over groups of them.

    Where two pixels make a group, the three at 2i − 1, 2i, 2i + 1 are the second of group i − 1
    and both of group i.
    """
    weight = conv.weight.detach()
    outputs, inputs = weight.shape[:2]
    spread = weight.new_zeros(outputs, group.y, group.x, inputs, *group.sides)
    for v in range(3):
        for u in range(3):
            (y, top), (x, left) = _place(v, group.y), _place(u, group.x)
            spread[:, y, x, :, top, left] = weight[:, :, v, u]
    stride = (2 // group.y, 2 // group.x)
    behind = (2 - group.y, 2 - group.x)
    return Overlapping(spread.flatten(1, 3), stride, (1, 1, *behind))


def _place(tap: int, count: int) -> tuple[int, int]:
    """The phase and the new tap of a tap of the old kernel."""
    return (0, tap) if count == 1 else ((tap + 1) % 2, (tap + 1) // 2)


def _repeated(norm: nn.BatchNorm2d, count: int) -> nn.BatchNorm2d:
    found = nn.BatchNorm2d(norm.num_features * count, norm.eps).to(norm.weight).eval()
    found.load_state_dict(
        {
            name: value.repeat(count) if value.dim() else value
            for name, value in norm.state_dict().items()
        }
    )
    return found
