"""Latency as the sum of a network's steps, predicted for whole tables of networks at once.

A step costs what it takes to start it and what it takes to do its work, either one after the
other (`sum`) or one hidden behind the other (`max`). Both are linear in a few physical features,
so a model is a handful of non-negative coefficients that a person can read in a profile.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import prod
from typing import Annotated, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, field_validator

from ..model.arch import Arch
from ..model.ops import Kind, Op, ops

Floats = NDArray[np.float64]
Milliseconds = Annotated[float, Field(ge=0, le=1e6)]

CHANNEL_BLOCK = 16
"""Single-precision channels in one AVX-512 register: CPU kernels compute whole blocks."""

IMAGE_CHANNELS = 3


def _macs(op: Op, kind: Kind) -> float:
    return op.macs / 1e9 if op.kind == kind else 0.0


def _single(op: Op) -> float:
    return _macs(op, "conv2d") if op.inputs[0][0] == 1 else 0.0


def _blocked(op: Op, kind: Kind) -> float:
    """Multiply-adds of a convolution on whole blocks of channels; an image's three stay three."""
    inputs, outputs = op.inputs[0][1], op.output[1]
    filled = _whole_blocks(outputs) / outputs
    if kind == "conv2d" and inputs > IMAGE_CHANNELS:
        filled *= _whole_blocks(inputs) / inputs
    return _macs(op, kind) * filled


def _whole_blocks(channels: int) -> int:
    return -(-channels // CHANNEL_BLOCK) * CHANNEL_BLOCK


def _warped(op: Op) -> float:
    return prod(op.output) / 1e6 if op.kind == "warp_volume" else 0.0


FEATURES: dict[str, Callable[[Op], float]] = {
    "gmac_2d": lambda op: _macs(op, "conv2d"),
    "gmac_2d_single": _single,
    "gmac_2d_blocked": lambda op: _blocked(op, "conv2d"),
    "gmac_3d": lambda op: _macs(op, "conv3d"),
    "gmac_3d_blocked": lambda op: _blocked(op, "conv3d"),
    "gbyte": lambda op: op.bytes / 1e9,
    "gbyte_resize": lambda op: op.bytes / 1e9 if op.kind == "resize" else 0.0,
    "mvoxel_warp": _warped,
}
"""What work is measured in: 10⁹ multiply-adds of 2D convs, of those on one image alone (the
semantic and refinement branches), with channels filled up to blocks (2D: inputs and outputs, 3D:
outputs), of 3D convs; 10⁹ bytes moved, and of those by resizing; 10⁶ voxels of residual volumes."""

_KINDS: tuple[Kind, ...] = get_args(Kind)


class LatencyModel(BaseModel):
    """Coefficients of one runtime and precision on one device, in milliseconds.

    `starts` says what is started: every kernel that eager execution launches, or every step once.
    Steps of a `folded` kind cost nothing: the runtime merges them into the convolution before.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    combine: Literal["sum", "max"]
    starts: Literal["kernels", "steps"]
    folded: tuple[Kind, ...] = ()
    start_ms: Milliseconds
    ms_per: dict[str, Milliseconds]

    @field_validator("ms_per")
    @classmethod
    def _known(cls, value: dict[str, float]) -> dict[str, float]:
        unknown = sorted(value.keys() - FEATURES.keys())
        if unknown:
            raise ValueError(f"{unknown[0]} is no feature; known are {', '.join(FEATURES)}")
        return value


@dataclass(frozen=True)
class Steps:
    """Op lists as arrays: n steps in all, list i from `firsts[i]` on."""

    kinds: NDArray[np.int64]
    launches: Floats
    weights: Floats
    macs: Floats
    features: Floats
    """(n, len(FEATURES))"""
    firsts: NDArray[np.int64]

    @classmethod
    def of(cls, lists: Iterable[Sequence[Op]]) -> Steps:
        """Lays out op lists; every list needs at least one op."""
        known = list(lists)
        flat = [op for steps in known for op in steps]
        lengths = [len(steps) for steps in known]
        return cls(
            np.array([_KINDS.index(op.kind) for op in flat]),
            np.array([op.launches for op in flat], dtype=np.float64),
            np.array([op.weights for op in flat], dtype=np.float64),
            np.array([op.macs for op in flat], dtype=np.float64),
            np.array([[feature(op) for feature in FEATURES.values()] for op in flat]),
            np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int64),
        )

    def summed(self, per_step: Floats) -> Floats:
        """Sums of a quantity of each step over each list: (n,) → (lists,)."""
        totals: Floats = np.add.reduceat(per_step, self.firsts)
        return totals


def step_costs_ms(model: LatencyModel, steps: Steps) -> Floats:
    """The cost of each step, in milliseconds: (n,)."""
    counts = steps.launches if model.starts == "kernels" else np.ones_like(steps.launches)
    start = model.start_ms * counts
    work = steps.features @ np.array([model.ms_per.get(name, 0.0) for name in FEATURES])
    cost = start + work if model.combine == "sum" else np.maximum(start, work)
    folded = [_KINDS.index(kind) for kind in model.folded]
    return np.where(np.isin(steps.kinds, folded), 0.0, cost)


def latencies_ms(model: LatencyModel, steps: Steps) -> Floats:
    """The latency of each op list, in milliseconds: (lists,)."""
    return steps.summed(step_costs_ms(model, steps))


def predict_ms(model: LatencyModel, arch: Arch, resolution: tuple[int, int]) -> float:
    """The latency of one arch at (width, height), in milliseconds."""
    return float(latencies_ms(model, Steps.of([ops(arch, resolution)]))[0])
