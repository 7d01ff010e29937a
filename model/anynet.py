"""The official AnyNet without its SPN (Wang et al. 2019), for its released checkpoints."""

from __future__ import annotations

from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .arch import RADIUS, STRIDES, Arch
from .layers import preactivated
from .rts2net import Stage
from .volume import PLAIN, Matching


def _conv(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return preactivated(nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False))


class Features(nn.Module):
    """A U-Net of 2c, 4c, 8c features at 1/4, 1/8, 1/16; the way up ends in the same widths."""

    def __init__(self, c: int, stages: int) -> None:
        super().__init__()
        self.stem = nn.Sequential(nn.Conv2d(3, c, 3, padding=1), _conv(c, c, stride=2))
        self.down = nn.ModuleList(
            nn.Sequential(nn.MaxPool2d(2), _conv(width, 2 * width), _conv(2 * width, 2 * width))
            for width in (c, 2 * c, 4 * c)
        )
        self.up = nn.ModuleList(
            nn.Sequential(_conv(3 * width, width), _conv(width, width))
            for width in (4 * c, 2 * c)[: stages - 1]
        )

    def forward(self, images: Tensor, stages: int) -> list[Tensor]:
        """(B, 3, H, W) → features at 1/16, 1/8, 1/4, as many as there are stages."""
        maps = self.stem(images)
        encoded = [maps := block(maps) for block in self.down]
        found = [encoded[2]]
        for block, skip in zip(self.up[: stages - 1], (encoded[1], encoded[0]), strict=False):
            below = F.interpolate(found[-1], scale_factor=2.0, mode="bilinear", align_corners=True)
            found.append(block(torch.cat([skip, below], 1)))
        return found


class SixConvs(nn.Sequential):
    """Six pre-activated 3D convs over a volume, 1 → width → … → 1."""

    def __init__(self, width: int) -> None:
        widths = [1, *[width] * 5, 1]
        super().__init__(
            *(
                preactivated(nn.Conv3d(inputs, outputs, 3, padding=1, bias=False))
                for inputs, outputs in pairwise(widths)
            )
        )

    def forward(self, volume: Tensor) -> Tensor:
        """(B, planes, h, w) → the same."""
        regular = volume.unsqueeze(1)
        for block in self:
            regular = block(regular)
        return regular.squeeze(1)


class AnyNet(nn.Module):
    """The network of an `Arch` of family `anynet`.

    It differs from RTS²Net's disparity branch: six pre-activated 3D convs a stage, sums of the
    stages at full resolution, and residual volumes that run from +2 to −2 while the regression
    runs from −2 to +2, a flip that the released weights have learned.
    """

    def __init__(self, arch: Arch) -> None:
        super().__init__()
        self.arch = arch
        self.features = Features(arch.c, arch.stages)
        self.regularize = nn.ModuleList(SixConvs(width) for width in arch.conv3d)
        self.matching: Matching = PLAIN

    def forward(self, left: Tensor, right: Tensor, stages: int | None = None) -> list[Stage]:
        """(B, 3, H, W) twice, sides multiples of 16 → one `Stage` per stage, at full resolution."""
        depth, matching = self.arch.up_to(stages).stages, self.matching
        batch = left.shape[0]
        found: list[Stage] = []
        for stage, features in enumerate(self.features(torch.cat([left, right]), depth)):
            left_features, right_features = features[:batch], features[batch:]
            stride = STRIDES[stage]
            if stage == 0:
                volume = matching.first_volume(left_features, right_features, self.arch.d_max)
            else:
                around = _resized(found[-1].disparity, features.shape[-2:]) / stride
                volume = matching.residual_volume(left_features, right_features, around).flip(1)
            volume = self.regularize[stage](volume)
            step = matching.soft_argmin(volume, 0 if stage == 0 else -RADIUS) * stride
            disparity = matching.enlarge(step, stride)
            found.append(Stage(disparity + found[-1].disparity if found else disparity))
        return found


def _resized(maps: Tensor, size: torch.Size) -> Tensor:
    return F.interpolate(maps, size=size, mode="bilinear", align_corners=False)
