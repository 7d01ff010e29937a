"""RTS²Net: disparity and semantics, coarse to fine (paper, section III)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from .arch import FACTORS, RADIUS, STRIDES, Arch
from .layers import conv_block, conv_pair, enlarge
from .volume import PLAIN, Matching


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

    def forward(self, left: Tensor, right: Tensor) -> tuple[tuple[Tensor, ...], Tensor | None]:
        """(B, 3, H, W) twice → features of both images at 1/16, 1/8, 1/4, the order of the stages,
        and the left one's at 1/32.
        """
        quarter = self.quarter(self.stem(torch.cat([left, right])))
        eighth = self.eighth(quarter)
        sixteenth = self.sixteenth(eighth)
        context = None if self.context is None else self.context(sixteenth.chunk(2)[0])
        return (sixteenth, eighth, quarter), context


class Level(nn.Sequential):
    """One level of an embedding: a pair of conv blocks over what is below and the encoder's."""

    def __init__(self, below: int, channels: int, left_alone: bool) -> None:
        super().__init__(*conv_pair(below + channels, channels))
        self.left_alone = left_alone

    def forward(self, features: Tensor, below: Tensor | None = None) -> Tensor:
        """Both images' features (2B, f·c, h, w), the level below at half that size → the same."""
        if self.left_alone:
            features = features.chunk(2)[0]
        if below is not None:
            features = torch.cat([enlarge(below, 2), features], 1)
        for block in self:
            features = block(features)
        return features


class Embedding(nn.Module):
    """Task features, coarse to fine: each level joins the enlarged level below with the encoder's.

    `deeper` is how many channels join at the first level (the semantic branch's 1/32 features).
    """

    def __init__(self, c: int, stages: int, deeper: int = 0, left_alone: bool = False) -> None:
        super().__init__()
        below = [deeper, *(factor * c for factor in FACTORS)]
        self.levels = nn.ModuleList(
            Level(below[stage], FACTORS[stage] * c, left_alone) for stage in range(stages)
        )

    def forward(self, stage: int, features: Tensor, below: Tensor | None) -> Tensor:
        """One level, as `Level` has it."""
        embedded: Tensor = self.levels[stage](features, below)
        return embedded


class Volume(nn.Module):
    """The cost volume of one stage: the first over `planes`, later ones around what is known."""

    def __init__(self, stage: int, planes: int) -> None:
        super().__init__()
        self.stage, self.planes = stage, planes
        self.matching: Matching = PLAIN

    def forward(self, embedded: Tensor, before: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """Both images' features and the disparity of the stage before → the volume, and around
        which disparity its planes lie.
        """
        left, right = embedded.chunk(2)
        if before is None:
            return self.matching.first_volume(left, right, self.planes), None
        around = self.matching.enlarge(before, 2)
        at = around / STRIDES[self.stage]
        return self.matching.residual_volume(left, right, at), around


class Regression(nn.Module):
    """From a cost volume of one stage to its disparity."""

    def __init__(self, stage: int) -> None:
        super().__init__()
        self.first, self.stride = -RADIUS if stage else 0, STRIDES[stage]
        self.matching: Matching = PLAIN

    def forward(self, cost: Tensor, around: Tensor | None) -> Tensor:
        """(B, planes, h, w) → (B, 1, h, w), in pixels of the full resolution."""
        found = self.matching.soft_argmin(cost, self.first) * self.stride
        return found if around is None else found + around


class Regularization(nn.Module):
    """Three 3D convs over a volume, 1 → width → width → 1, the last without ReLU; a disparity."""

    def __init__(self, width: int, stage: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for inputs, outputs in ((1, width), (width, width), (width, 1)):
            conv = nn.Conv3d(inputs, outputs, 3, padding=1, bias=False)
            layers += [conv, nn.BatchNorm3d(outputs), nn.ReLU(inplace=True)]
        self.layers = nn.Sequential(*layers[:-1])
        self.regression = Regression(stage)

    def forward(self, volume: Tensor, around: Tensor | None) -> tuple[Tensor, Tensor]:
        """(B, planes, h, w) → (B, planes, h, w), (B, 1, h, w)."""
        regular = self.layers(volume.unsqueeze(1)).squeeze(1)
        return regular, self.regression(regular, around)


class Classifier(nn.Conv2d):
    """Class scores of one stage, corrected on top of those of the stage before."""

    def forward(self, embedded: Tensor, before: Tensor | None = None) -> Tensor:
        """(B, f·c, h, w) and scores at half that size → (B, classes, h, w)."""
        scores = super().forward(embedded)
        return scores if before is None else scores + enlarge(before, 2)


class Refinement(nn.Module):
    """The synergy module of one stage: class scores correct the volume (paper, section III-E).

    The hybrid volume holds the planes, as many channels of compressed scores and, from the second
    stage on, the refined disparity so far; three convs of its width turn it into a residual.
    """

    def __init__(self, planes: int, classes: int, stage: int) -> None:
        super().__init__()
        hybrid = 2 * planes + (1 if stage else 0)
        self.stride = STRIDES[stage]
        self.compress = nn.Conv2d(classes, planes, 1)
        self.residual = nn.Sequential(
            conv_pair(hybrid, hybrid), nn.Conv2d(hybrid, planes, 3, padding=1)
        )
        self.regression = Regression(stage)

    def forward(
        self, volume: Tensor, scores: Tensor, before: Tensor | None, around: Tensor | None
    ) -> Tensor:
        """(B, planes, h, w), (B, classes, h, w), the refined disparity before → (B, 1, h, w)."""
        parts = [volume, self.compress(scores)]
        if before is not None:
            parts.append(enlarge(before, 2) / self.stride)
        corrected = volume + self.residual(torch.cat(parts, 1))
        refined: Tensor = self.regression(corrected, around)
        return refined


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
        self.volume = nn.ModuleList(Volume(stage, arch.planes(stage)) for stage in stages)
        self.regularize = nn.ModuleList(
            Regularization(arch.conv3d[stage], stage) for stage in stages
        )
        if arch.semantic:
            self.semantic = Embedding(c, arch.stages, deeper=16 * c, left_alone=True)
            self.classify = nn.ModuleList(
                Classifier(FACTORS[stage] * c, arch.classes, 3, padding=1) for stage in stages
            )
        if arch.refinement:
            self.refine = nn.ModuleList(
                Refinement(arch.planes(stage), arch.classes, stage) for stage in stages
            )

    def forward(self, left: Tensor, right: Tensor, stages: int | None = None) -> list[Stage]:
        """(B, 3, H, W) twice → one `Stage` for each stage run, at 1/16, 1/8, 1/4.

        `stages` stops early: nothing of a later stage is computed. Raises `UsageError` for more
        stages than the arch has.
        """
        depth = self.arch.up_to(stages).stages
        features, meaning = self.encoder(left, right)
        embedded: Tensor | None = None
        found: list[Stage] = []
        for stage in range(depth):
            embedded = self.disparity(stage, features[stage], embedded)
            before = found[-1] if found else None
            scores = None
            if self.arch.semantic:
                meaning = self.semantic(stage, features[stage], meaning)
                scores = self.classify[stage](meaning, before and before.scores)
            found.append(self._match(stage, embedded, scores, before))
        return found

    def _match(
        self, stage: int, embedded: Tensor, scores: Tensor | None, before: Stage | None
    ) -> Stage:
        """The disparities of one stage from its embeddings and the stage before."""
        volume, around = self.volume[stage](embedded, before and before.disparity)
        volume, disparity = self.regularize[stage](volume, around)
        if not self.arch.refinement or scores is None:
            return Stage(disparity, None, scores)
        refined = self.refine[stage](volume, scores, before and before.refined, around)
        return Stage(disparity, refined, scores)
