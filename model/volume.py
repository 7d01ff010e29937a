"""Cost volumes and the soft-argmin: where two feature maps become a disparity.

Rectified pairs need to be compared along x alone, so the warp is a gather of whole columns and a
linear blend; no two-dimensional sampler is involved, and every operator exports to ONNX opset 13.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from .arch import RADIUS
from .layers import enlarge


def first_volume(left: Tensor, right: Tensor, planes: int) -> Tensor:
    """L1 distances between left features and right features shifted by 0 … planes−1 pixels.

    `left`, `right`: (B, C, H, W). Returns (B, planes, H, W); where the right feature would be out
    of view it counts as zero. Source: paper, section III-C.
    """
    width = left.shape[-1]
    padded = F.pad(right, (planes - 1, 0))
    starts = [planes - 1 - shift for shift in range(planes)]
    return torch.cat([_distance(left, padded[..., start : start + width]) for start in starts], 1)


def residual_volume(left: Tensor, right: Tensor, disparity: Tensor) -> Tensor:
    """L1 distances around a known disparity: plane k = −2 … 2 compares with x − disparity − k.

    `left`, `right`: (B, C, H, W); `disparity`: (B, 1, H, W) in pixels of that size. Returns
    (B, 5, H, W); what is out of view counts as zero. All planes of a pixel share the fraction of
    its disparity, so six gathers along x serve the five of them. Source: paper, section III-C.
    """
    channels, width = left.shape[1], left.shape[-1]
    x = torch.arange(width, dtype=disparity.dtype, device=left.device) - disparity
    whole = x.floor()
    fraction = x - whole
    padded = F.pad(right, (1, 1))

    def column(offset: int) -> Tensor:
        index = (whole + offset).clamp(-1, width).long() + 1
        return padded.gather(3, index.expand(-1, channels, -1, -1))

    columns = {offset: column(offset) for offset in range(-RADIUS, RADIUS + 2)}
    warped = (
        columns[-k] + fraction * (columns[1 - k] - columns[-k]) for k in range(-RADIUS, RADIUS + 1)
    )
    return torch.cat([_distance(left, plane) for plane in warped], 1)


def soft_argmin(cost: Tensor, first: int) -> Tensor:
    """The expected plane under softmax(−cost): (B, P, H, W) → (B, 1, H, W), in planes.

    The planes stand for `first`, `first` + 1, … Costs of half precision are taken in fp32: 8 bits
    hold no disparity. Source: Kendall et al. 2017, equation 1.
    """
    if cost.dtype in (torch.bfloat16, torch.float16):
        cost = cost.float()
    planes = torch.arange(first, first + cost.shape[1], dtype=cost.dtype, device=cost.device)
    weights = torch.softmax(-cost, 1)
    return (weights * planes.view(1, -1, 1, 1)).sum(1, keepdim=True)


def _distance(left: Tensor, right: Tensor) -> Tensor:
    """The L1 distance over the channels: (B, C, H, W) twice → (B, 1, H, W)."""
    return (left - right).abs().sum(1, keepdim=True)


class FirstVolume(Protocol):
    """What `first_volume` is."""

    def __call__(self, left: Tensor, right: Tensor, planes: int) -> Tensor: ...


class ResidualVolume(Protocol):
    """What `residual_volume` is."""

    def __call__(self, left: Tensor, right: Tensor, disparity: Tensor) -> Tensor: ...


class SoftArgmin(Protocol):
    """What `soft_argmin` is."""

    def __call__(self, cost: Tensor, first: int) -> Tensor: ...


class Enlarge(Protocol):
    """What `rts2.model.layers.enlarge` is, of maps of one channel."""

    def __call__(self, maps: Tensor, factor: int) -> Tensor: ...


class Matching(NamedTuple):
    """How a network computes its volumes, what it reads from them, and how that is enlarged.

    The same values can be had in other steps, which other runtimes are faster at; networks are
    trained with `PLAIN`.
    """

    first_volume: FirstVolume
    residual_volume: ResidualVolume
    soft_argmin: SoftArgmin
    enlarge: Enlarge


PLAIN = Matching(first_volume, residual_volume, soft_argmin, enlarge)
