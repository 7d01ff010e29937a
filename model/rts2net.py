"""RTS²Net: disparity and semantics, coarse to fine (paper, section III)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from .arch import FACTORS, RADIUS, STRIDES, Arch
from .layers import conv_block, conv_pair, enlarge
from .volume import first_volume, residual_volume, soft_argmin


class Stage(NamedTuple):
    """What one stage says. Disparities are (B, 1, h, w), in pixels of the full resolution."""

    disparity: Tensor
    refined: Tensor | None = None
    scores: Tensor | None = None
    """(B, classes, h, w), before the softmax."""

    @property
    def best(self) -> Tensor:
        """The refined disparity where there is one, else the coarse one."""
        return self.disparity if self.refined is None else self.refined


class Encoder(nn.Module):
    """Shared features at 1/4, 1/8, 1/16 and 1/32: 2c, 4c, 8c, 16c (paper, section III-B)."""

    def __init__(self, c: int, context: bool) -> None:
        super().__init__()
        self.stem = nn.Sequential(conv_block(3, c), conv_block(c, c, stride=2))
        self.quarter = nn.Sequential(nn.MaxPool2d(2), conv_pair(c, 2 * c))
        self.eighth = nn.Sequential(nn.MaxPool2d(2), conv_pair(2 * c, 4 * c))
        self.sixteenth = nn.Sequential(nn.MaxPool2d(2), conv_pair(4 * c, 8 * c))
        self.context = nn.Sequential(nn.MaxPool2d(2), conv_pair(8 * c, 16 * c)) if context else None

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(B, 3, H, W) → features at 1/16, 1/8, 1/4: the order of the stages."""
        quarter = self.quarter(self.stem(images))
        eighth = self.eighth(quarter)
        return self.sixteenth(eighth), eighth, quarter


class Embedding(nn.Module):
    """Task features, coarse to fine: each level joins the enlarged level below with the encoder's.

    `deeper` is how many channels join at the first level (the semantic branch's 1/32 features).
    """

    def __init__(self, c: int, stages: int, deeper: int = 0) -> None:
        super().__init__()
        below = [deeper, *(factor * c for factor in FACTORS)]
        self.levels = nn.ModuleList(
            conv_pair(below[stage] + FACTORS[stage] * c, FACTORS[stage] * c)
            for stage in range(stages)
        )

    def forward(self, stage: int, features: Tensor, below: Tensor | None) -> Tensor:
        """(B, f·c, h, w) and the level below at half that size → (B, f·c, h, w)."""
        if below is not None:
            features = torch.cat([enlarge(below, 2), features], 1)
        embedded: Tensor = self.levels[stage](features)
        return embedded


class Regularization(nn.Module):
    """Three 3D convs over a volume, 1 → width → width → 1; the last without ReLU."""

    def __init__(self, width: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for inputs, outputs in ((1, width), (width, width), (width, 1)):
            conv = nn.Conv3d(inputs, outputs, 3, padding=1, bias=False)
            layers += [conv, nn.BatchNorm3d(outputs), nn.ReLU(inplace=True)]
        self.layers = nn.Sequential(*layers[:-1])

    def forward(self, volume: Tensor) -> Tensor:
        """(B, planes, h, w) → (B, planes, h, w)."""
        regular: Tensor = self.layers(volume.unsqueeze(1)).squeeze(1)
        return regular


class Refinement(nn.Module):
    """The synergy module of one stage: class scores correct the volume (paper, section III-E).

    The hybrid volume holds the planes, as many channels of compressed scores and, from the second
    stage on, the refined disparity so far; three convs of its width turn it into a residual.
    """

    def __init__(self, planes: int, classes: int, first: bool) -> None:
        super().__init__()
        hybrid = 2 * planes + (0 if first else 1)
        self.compress = nn.Conv2d(classes, planes, 1)
        self.residual = nn.Sequential(
            conv_pair(hybrid, hybrid), nn.Conv2d(hybrid, planes, 3, padding=1)
        )

    def forward(self, volume: Tensor, scores: Tensor, refined: Tensor | None) -> Tensor:
        """(B, planes, h, w), (B, classes, h, w), (B, 1, h, w) in stage pixels → a volume."""
        parts = [volume, self.compress(scores)] + ([] if refined is None else [refined])
        corrected: Tensor = volume + self.residual(torch.cat(parts, 1))
        return corrected


class RTS2Net(nn.Module):
    """The network of an `Arch` of family `rts2net`.

    Takes RGB images normalised by the ImageNet mean and deviation, with sides that are multiples
    of 32.
    """

    def __init__(self, arch: Arch) -> None:
        super().__init__()
        self.arch = arch
        c, stages = arch.c, range(arch.stages)
        self.encoder = Encoder(c, context=arch.semantic)
        self.disparity = Embedding(c, arch.stages)
        self.regularize = nn.ModuleList(Regularization(width) for width in arch.conv3d)
        if arch.semantic:
            self.semantic = Embedding(c, arch.stages, deeper=16 * c)
            self.classify = nn.ModuleList(
                nn.Conv2d(FACTORS[stage] * c, arch.classes, 3, padding=1) for stage in stages
            )
        if arch.refinement:
            self.refine = nn.ModuleList(
                Refinement(arch.planes(stage), arch.classes, first=stage == 0) for stage in stages
            )

    def forward(self, left: Tensor, right: Tensor, stages: int | None = None) -> list[Stage]:
        """(B, 3, H, W) twice → one `Stage` for each stage run, at 1/16, 1/8, 1/4.

        `stages` stops early: nothing of a later stage is computed. Raises `UsageError` for more
        stages than the arch has.
        """
        depth = self.arch.up_to(stages).stages
        batch = left.shape[0]
        features = self.encoder(torch.cat([left, right]))
        embedded: Tensor | None = None
        meaning = self._context(features[0][:batch])
        found: list[Stage] = []
        for stage in range(depth):
            embedded = self.disparity(stage, features[stage], embedded)
            before = found[-1] if found else None
            scores = None
            if self.arch.semantic:
                meaning = self.semantic(stage, features[stage][:batch], meaning)
                scores = self.classify[stage](meaning)
                if before is not None and before.scores is not None:
                    scores = scores + enlarge(before.scores, 2)
            found.append(self._match(stage, embedded[:batch], embedded[batch:], scores, before))
        return found

    def _context(self, sixteenth: Tensor) -> Tensor | None:
        return None if self.encoder.context is None else self.encoder.context(sixteenth)

    def _match(
        self, stage: int, left: Tensor, right: Tensor, scores: Tensor | None, before: Stage | None
    ) -> Stage:
        """The disparities of one stage from its embeddings and the stage before."""
        stride = STRIDES[stage]
        if before is None:
            first, around = 0, None
            volume = first_volume(left, right, self.arch.d_max)
        else:
            first, around = -RADIUS, enlarge(before.disparity, 2)
            volume = residual_volume(left, right, around / stride)
        volume = self.regularize[stage](volume)

        def disparity(cost: Tensor) -> Tensor:
            found = soft_argmin(cost, first) * stride
            return found if around is None else found + around

        if not self.arch.refinement or scores is None:
            return Stage(disparity(volume), None, scores)
        known = None if before is None or before.refined is None else before.refined
        known = None if known is None else enlarge(known, 2) / stride
        return Stage(
            disparity(volume), disparity(self.refine[stage](volume, scores, known)), scores
        )
