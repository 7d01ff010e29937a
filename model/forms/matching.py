"""Volumes and the soft-argmin as rows: one row a pixel, its channels side by side.

A pixel's channels are what is compared, moved and added up together. As rows, a warp copies whole
pixels instead of numbers, one index serves all channels, and sums run along memory. Runtimes keep
what a 2D conv gives in blocks of channels, so rows are as near to it as planes of numbers are.
"""

from __future__ import annotations

from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor

from ..arch import RADIUS
from ..layers import enlarge
from ..volume import Matching

NARROW = 32
"""Up to here rows are too short to be multiplied by one number each: it is repeated beforehand."""


def first_volume(left: Tensor, right: Tensor, planes: int) -> Tensor:
    """`rts2.model.volume.first_volume`: all planes at once, from a constant index along x."""
    width = left.shape[-1]
    reach = planes - 1
    padded = F.pad(_rows(right), (0, 0, reach, 0))
    shift = torch.arange(planes, device=left.device).view(-1, 1)
    columns = torch.arange(width, device=left.device) + reach - shift  # (planes, W)
    rows = _rows(left).unsqueeze(2)
    batch, height, _, _, channels = rows.shape
    shifted = padded.index_select(2, columns.flatten())
    shifted = shifted.view(batch, height, planes, width, channels)
    return (rows - shifted).abs().sum(-1).transpose(1, 2)


def residual_volume(left: Tensor, right: Tensor, disparity: Tensor) -> Tensor:
    """`rts2.model.volume.residual_volume`: six gathers of whole pixels.

    From x − disparity ≤ −RADIUS − 2 or ≥ W + RADIUS on every plane is out of view. Clamped to
    these bounds, and between margins of 2·RADIUS + 2 zeros, no offset leaves its row: one clamp
    and one cast serve all six.
    """
    batch, channels, height, width = left.shape
    margin = 2 * RADIUS + 2
    table = F.pad(_rows(right), (0, 0, margin, margin)).reshape(-1, channels)
    x = torch.arange(width, dtype=disparity.dtype, device=left.device) - disparity
    whole = x.floor()
    starts = torch.arange(batch * height, device=left.device) * (width + 2 * margin) + margin
    index = whole.clamp(-RADIUS - 2, width + RADIUS).long() + starts.view(batch, 1, height, 1)
    index = index.flatten()
    fraction = (x - whole).reshape(-1, 1)
    if channels <= NARROW:
        fraction = fraction @ fraction.new_ones(1, channels)
    pixels = _rows(left).reshape(-1, channels)
    columns = [table.index_select(0, index + k) for k in range(-RADIUS, RADIUS + 2)]
    planes = [
        (pixels - (near + fraction * (far - near))).abs().sum(-1).view(batch, 1, height, width)
        for near, far in pairwise(columns)
    ]
    return torch.cat(planes[::-1], 1)


def soft_argmin(cost: Tensor, first: int) -> Tensor:
    """`rts2.model.volume.soft_argmin` as a quotient: Σ k·w / Σ w, with w = exp(min − cost).

    No weight exceeds one, and that of the least cost is one. Both sums are one product with the
    rows (first, first + 1, …) and (1, 1, …). Runtimes take a softmax over a middle axis by laying
    everything out anew, twice.
    """
    if cost.dtype in (torch.bfloat16, torch.float16):
        cost = cost.float()
    weights = (cost.amin(1, keepdim=True) - cost).exp().flatten(2)
    planes = torch.arange(first, first + cost.shape[1], dtype=cost.dtype, device=cost.device)
    sums = torch.stack([planes, torch.ones_like(planes)]) @ weights
    above, below = torch.split(sums.view(cost.shape[0], 2, *cost.shape[2:]), 1, 1)
    return above / below


def enlarge_by_products(maps: Tensor, factor: int) -> Tensor:
    """`rts2.model.layers.enlarge` as two matrix products: (B, C, h, w) → (B, C, f·h, f·w).

    A bilinear map is linear along each axis by itself: R_y · maps · R_xᵀ, where row i of an R has
    the shares of the two old places around the new place i. Both are constants.
    """
    height, width = maps.shape[-2:]
    return _shares(height, factor, maps) @ (maps @ _shares(width, factor, maps).T)


def _shares(size: int, factor: int, like: Tensor) -> Tensor:
    """(factor·size, size): a unit vector at each old place, enlarged along y alone."""
    units = torch.eye(size, dtype=like.dtype, device=like.device).view(1, 1, size, size)
    target = (factor * size, size)
    return F.interpolate(units, size=target, mode="bilinear", align_corners=False)[0, 0]


ROWS = Matching(first_volume, residual_volume, soft_argmin, enlarge)


def _rows(maps: Tensor) -> Tensor:
    """(B, C, H, W) → (B, H, W, C)."""
    return maps.permute(0, 2, 3, 1)
