"""The blocks that both families are made of."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn


def conv_block(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    """3×3 conv, batch norm, ReLU (paper, section III-B): (B, inputs, H, W) → (B, outputs, H, W)."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


def conv_pair(inputs: int, outputs: int) -> nn.Sequential:
    """Two conv blocks, the second of equal width."""
    return nn.Sequential(conv_block(inputs, outputs), conv_block(outputs, outputs))


def preactivated(conv: nn.Conv2d | nn.Conv3d) -> nn.Sequential:
    """Batch norm, ReLU, then `conv`: AnyNet's order."""
    norm = nn.BatchNorm2d if isinstance(conv, nn.Conv2d) else nn.BatchNorm3d
    return nn.Sequential(norm(conv.in_channels), nn.ReLU(inplace=True), conv)


def enlarge(maps: Tensor, factor: int) -> Tensor:
    """Bilinear, pixel centres aligned: (B, C, H, W) → (B, C, factor·H, factor·W)."""
    return F.interpolate(maps, scale_factor=float(factor), mode="bilinear", align_corners=False)
