"""What a network does, step by step, without building it: the ground of every latency.

`ops` lists the steps of the deployed network: the best disparity of its last stage at full
resolution and, with the semantic branch, the class map. The parts it is chained from are public,
because a search tabulates each part over the few dimensions that it depends on.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass
from itertools import pairwise
from math import prod
from typing import Literal

from .arch import FACTORS, STRIDES, Arch, Branches

Kind = Literal[
    "conv2d", "conv3d", "norm", "relu", "pool", "resize", "concat", "add",
    "volume", "warp_volume", "soft_argmin", "argmax",
]  # fmt: skip
Shape = tuple[int, ...]
Size = tuple[int, int]
"""Height and width in pixels."""

BYTES_PER_ELEMENT = 4
PLANE_KERNELS = 6
"""A plane of the first volume: absolute value, sum and copy at its border, difference, norm and
copy elsewhere."""

WARP_KERNELS = 29
"""A residual volume: planes repeated (8), the sampling grid built and scaled (18), sampled, and
the norm of the difference (3)."""

SOFT_ARGMIN_KERNELS = 6
"""Negate, softmax, planes repeated, weigh, sum, scale by the stride."""


@dataclass(frozen=True)
class Op:
    """One step with the shapes that it reads and writes.

    `weights` are its trained numbers, `macs` its multiply-adds (of convolutions; other steps are
    bound by memory), `launches` the kernels that eager PyTorch starts for it, volumes built the
    way of AnyNet's release: the published frame rates were taken on code of that kind.
    """

    name: str
    kind: Kind
    inputs: tuple[Shape, ...]
    output: Shape
    weights: int = 0
    macs: int = 0
    launches: int = 1

    @property
    def elements(self) -> int:
        """Numbers moved: read, written and weights."""
        return sum(prod(shape) for shape in self.inputs) + prod(self.output) + self.weights

    @property
    def bytes(self) -> int:
        """Bytes moved in single precision."""
        return BYTES_PER_ELEMENT * self.elements


def padded(resolution: tuple[int, int], multiple: int) -> Size:
    """(width, height) of an image → (height, width) of the network's input."""
    width, height = (-(-side // multiple) * multiple for side in resolution)
    return height, width


def ops(arch: Arch, resolution: tuple[int, int]) -> tuple[Op, ...]:
    """Every step of `arch` on one pair of images of `resolution` (width, height)."""
    size = padded(resolution, arch.multiple)
    return tuple(_anynet(arch, size) if arch.family == "anynet" else _rts2net(arch, size))


def _rts2net(arch: Arch, size: Size) -> Iterator[Op]:
    c, branches = arch.c, arch.branches
    yield from encoder(c, branches, size)
    for stage in range(arch.stages):
        planes = arch.planes(stage)
        yield from embedding(c, stage, size)
        yield from volume(c, stage, planes, size)
        yield from regularization(arch.conv3d[stage], stage, planes, size)
        if arch.semantic:
            yield from semantics(c, stage, arch.classes, size)
        if arch.refinement:
            yield from refinement(stage, planes, arch.classes, size)
    yield from head(arch.stages - 1, arch.semantic, arch.classes, size)


def encoder(c: int, branches: Branches, size: Size) -> Iterator[Op]:
    """The shared encoder on both images, and the left image's 1/32 features for semantics."""
    height, width = size
    image = (1, 3, height, width)
    yield Op("encoder.pair", "concat", (image, image), (2, 3, height, width))
    yield from _conv_block("encoder.stem.0", (2, 3, height, width), c)
    yield from _conv_block("encoder.stem.1", (2, c, height, width), c, stride=2)
    below: Shape = (2, c, height // 2, width // 2)
    for name, factor in (("quarter", 2), ("eighth", 4), ("sixteenth", 8)):
        below = yield from _down(f"encoder.{name}", below, factor * c)
    if branches != "disparity":
        yield from _down("encoder.context", (1, *below[1:]), 16 * c)


def embedding(c: int, stage: int, size: Size) -> Iterator[Op]:
    """The disparity embedding of one stage, both images."""
    below = FACTORS[stage - 1] * c if stage else 0
    yield from _embedding(f"disparity.{stage}", 2, c, stage, below, size)


def volume(c: int, stage: int, planes: int, size: Size) -> Iterator[Op]:
    """The cost volume of one stage; from the second on, around the enlarged disparity."""
    if stage:
        yield _enlarge(f"around.{stage}", (1, 1, *_at(stage, size)), 2)
    yield _distances(c, stage, planes, size)


def regularization(width: int, stage: int, planes: int, size: Size) -> Iterator[Op]:
    """Three 3D convs over the volume of one stage, and its disparity."""
    at = (planes, *_at(stage, size))
    for index, (inputs, outputs) in enumerate(pairwise((1, width, width, 1))):
        *block, relu = _conv_block(f"regularize.{stage}.{index}", (1, inputs, *at), outputs)
        yield from block
        if index < 2:
            yield relu
    yield from _regression(f"disparity.{stage}.regression", stage, planes, size)


def semantics(c: int, stage: int, classes: int, size: Size) -> Iterator[Op]:
    """The semantic embedding and class scores of one stage, left image."""
    below = FACTORS[stage - 1] * c if stage else 16 * c
    yield from _embedding(f"semantic.{stage}", 1, c, stage, below, size)
    height, width = _at(stage, size)
    embedded, scores = (1, FACTORS[stage] * c, height, width), (1, classes, height, width)
    yield _conv(f"classify.{stage}", embedded, scores, 3, bias=True)
    if stage:
        yield _enlarge(f"classify.{stage}.before", scores, 2)
        yield Op(f"classify.{stage}.sum", "add", (scores, scores), scores)


def refinement(stage: int, planes: int, classes: int, size: Size) -> Iterator[Op]:
    """The synergy refinement of one stage."""
    height, width = _at(stage, size)
    name = f"refine.{stage}"
    cost, plane = (1, planes, height, width), (1, 1, height, width)
    yield _conv(f"{name}.compress", (1, classes, height, width), cost, 1, bias=True)
    parts: tuple[Shape, ...] = (cost, cost)
    if stage:
        yield _enlarge(f"{name}.before", plane, 2)
        parts = (*parts, plane)
    hybrid = (1, sum(part[1] for part in parts), height, width)
    yield Op(f"{name}.hybrid", "concat", parts, hybrid)
    for index in range(2):
        yield from _conv_block(f"{name}.residual.{index}", hybrid, hybrid[1])
    yield _conv(f"{name}.residual.2", hybrid, cost, 3, bias=True)
    yield Op(f"{name}.sum", "add", (cost, cost), cost)
    yield from _regression(f"{name}.regression", stage, planes, size)


def head(stage: int, semantic: bool, classes: int, size: Size) -> Iterator[Op]:
    """From the last stage to full resolution: the disparity, and the class of each pixel."""
    stride = STRIDES[stage]
    yield _enlarge("head.disparity", (1, 1, *size), stride)
    if semantic:
        scores = (1, classes, *size)
        yield _enlarge("head.scores", scores, stride)
        yield Op("head.semantic", "argmax", (scores,), (1, 1, *size))


def _anynet(arch: Arch, size: Size) -> Iterator[Op]:
    """The official AnyNet: pre-activated blocks, six 3D convs, sums at full resolution."""
    c, full = arch.c, (1, 1, *size)
    image = (1, 3, *size)
    yield Op("features.pair", "concat", (image, image), (2, 3, *size))
    yield _conv("features.stem.0", (2, 3, *size), (2, c, *size), 3, bias=True)
    maps: Shape = (2, c, size[0] // 2, size[1] // 2)
    yield from _preactivated("features.stem.1", (2, c, *size), maps)
    encoded = []
    for index in range(3):
        pooled = (2, maps[1], maps[2] // 2, maps[3] // 2)
        yield Op(f"features.down.{index}.pool", "pool", (maps,), pooled)
        maps = (2, 2 * pooled[1], *pooled[2:])
        yield from _preactivated(f"features.down.{index}.0", pooled, maps)
        yield from _preactivated(f"features.down.{index}.1", maps, maps)
        encoded.append(maps)
    for stage in range(arch.stages):
        if stage:
            yield from _anynet_up(stage, encoded[3 - stage], encoded[2 - stage])
            yield Op(f"around.{stage}", "resize", (full,), (1, 1, *_at(stage, size)))
        planes = arch.planes(stage)
        yield _distances(c, stage, planes, size)
        widths = [1, *[arch.conv3d[stage]] * 5, 1]
        at = (planes, *_at(stage, size))
        for index, (inputs, outputs) in enumerate(pairwise(widths)):
            yield from _preactivated(
                f"regularize.{stage}.{index}", (1, inputs, *at), (1, outputs, *at)
            )
        yield _soft_argmin(f"regression.{stage}", stage, planes, size)
        yield _enlarge(f"disparity.{stage}", full, STRIDES[stage])
        if stage:
            yield Op(f"disparity.{stage}.sum", "add", (full, full), full)


def _anynet_up(stage: int, below: Shape, skip: Shape) -> Iterator[Op]:
    name = f"features.up.{stage - 1}"
    yield _enlarge(f"{name}.enlarge", (2, below[1], *skip[2:]), 2)
    joined = (2, below[1] + skip[1], *skip[2:])
    yield Op(f"{name}.join", "concat", (skip, (2, below[1], *skip[2:])), joined)
    yield from _preactivated(f"{name}.0", joined, skip)
    yield from _preactivated(f"{name}.1", skip, skip)


def _preactivated(name: str, inputs: Shape, output: Shape) -> Iterator[Op]:
    yield Op(f"{name}.norm", "norm", (inputs,), inputs, weights=2 * inputs[1])
    yield Op(f"{name}.relu", "relu", (inputs,), inputs)
    yield _conv(f"{name}.conv", inputs, output, 3)


def _at(stage: int, size: Size) -> Size:
    return size[0] // STRIDES[stage], size[1] // STRIDES[stage]


def _conv(name: str, inputs: Shape, output: Shape, kernel: int, bias: bool = False) -> Op:
    """A convolution over as many dimensions as the shapes have behind batch and channels."""
    taps = int(kernel ** (len(inputs) - 2)) * inputs[1]
    weights = taps * output[1] + (output[1] if bias else 0)
    kind: Kind = "conv3d" if len(inputs) == 5 else "conv2d"
    return Op(name, kind, (inputs,), output, weights=weights, macs=taps * prod(output))


def _conv_block(name: str, inputs: Shape, outputs: int, stride: int = 1) -> Iterator[Op]:
    output = (inputs[0], outputs, *(side // stride for side in inputs[2:]))
    yield _conv(f"{name}.conv", inputs, output, 3)
    yield Op(f"{name}.norm", "norm", (output,), output, weights=2 * outputs)
    yield Op(f"{name}.relu", "relu", (output,), output)


def _down(name: str, below: Shape, outputs: int) -> Generator[Op, None, Shape]:
    """Half the size and a pair of conv blocks; returns the shape that comes out."""
    pooled = (*below[:2], below[2] // 2, below[3] // 2)
    yield Op(f"{name}.pool", "pool", (below,), pooled)
    yield from _conv_block(f"{name}.0", pooled, outputs)
    output = (pooled[0], outputs, *pooled[2:])
    yield from _conv_block(f"{name}.1", output, outputs)
    return output


def _embedding(name: str, batch: int, c: int, stage: int, below: int, size: Size) -> Iterator[Op]:
    outputs = FACTORS[stage] * c
    at = _at(stage, size)
    if below:
        deeper = (batch, below, *at)
        yield _enlarge(f"{name}.enlarge", deeper, 2)
        joined = (batch, below + outputs, *at)
        yield Op(f"{name}.join", "concat", (deeper, (batch, outputs, *at)), joined)
    yield from _conv_block(f"{name}.0", (batch, below + outputs, *at), outputs)
    yield from _conv_block(f"{name}.1", (batch, outputs, *at), outputs)


def _enlarge(name: str, output: Shape, factor: int) -> Op:
    small = (*output[:2], output[2] // factor, output[3] // factor)
    return Op(name, "resize", (small,), output)


def _distances(c: int, stage: int, planes: int, size: Size) -> Op:
    """The L1 distances of one volume."""
    at = _at(stage, size)
    feature, output = (1, FACTORS[stage] * c, *at), (1, planes, *at)
    if stage == 0:
        kernels = PLANE_KERNELS * planes + 2  # fill with zeros, make contiguous
        return Op("volume.0", "volume", (feature, feature), output, launches=kernels)
    inputs = (feature, feature, (1, 1, *at))
    return Op(f"volume.{stage}", "warp_volume", inputs, output, launches=WARP_KERNELS)


def _regression(name: str, stage: int, planes: int, size: Size) -> Iterator[Op]:
    plane = (1, 1, *_at(stage, size))
    yield _soft_argmin(name, stage, planes, size)
    if stage:
        yield Op(f"{name}.sum", "add", (plane, plane), plane)


def _soft_argmin(name: str, stage: int, planes: int, size: Size) -> Op:
    at = _at(stage, size)
    inputs, output = ((1, planes, *at),), (1, 1, *at)
    return Op(name, "soft_argmin", inputs, output, launches=SOFT_ARGMIN_KERNELS)
