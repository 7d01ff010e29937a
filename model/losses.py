"""The paper's objective (section III-F), as sums and counts.

A loss of the paper is a mean over pixels. Here a batch gives sums, and the counts that divide them
may come from more batches: so micro-batches and several processes add up to exactly the objective
of the whole step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from .errors import Rts2Error
from .layers import enlarge
from .metrics import IGNORED
from .rts2net import Stage

STAGE_WEIGHTS: Final = (1 / 4, 1 / 2, 1.0)
"""The weights of stages 1, 2, 3."""

TASK_WEIGHTS: Final = {"disparity": 1.0, "semantic": 2.0, "refined": 2.0}
"""The weights of the coarse disparity, the semantics and the refined disparity."""

Sums = dict[str, Tensor]
"""Losses summed over pixels, by term: `disparity_1`, `semantic_1`, `refined_1`, `disparity_2` …"""


class Truth(NamedTuple):
    """What a batch is compared with."""

    disparity: Tensor
    """(B, H, W) in pixels, NaN where it is unknown."""
    labels: Tensor | None = None
    """(B, H, W) whole numbers, train ids; 255 is unlabelled."""


@dataclass(frozen=True)
class Counts:
    """How many pixels the terms of a step were summed over; counts add."""

    known: int
    """Pixels of known disparity; every disparity term counts these."""
    labelled: tuple[int, ...] = ()
    """Labelled pixels at the resolution of each stage; empty without semantics."""
    compared: tuple[int, ...] = ()
    """All pixels at the resolution of each stage."""

    def __add__(self, other: Counts) -> Counts:
        return Counts(
            self.known + other.known,
            tuple(a + b for a, b in zip(self.labelled, other.labelled, strict=True)),
            tuple(a + b for a, b in zip(self.compared, other.compared, strict=True)),
        )

    def numbers(self) -> list[int]:
        """All counts in a row; `Counts.of` takes them back."""
        return [self.known, *self.labelled, *self.compared]

    @staticmethod
    def of(numbers: Sequence[int]) -> Counts:
        stages = len(numbers) // 2
        return Counts(numbers[0], tuple(numbers[1 : 1 + stages]), tuple(numbers[1 + stages :]))


def count(truth: Truth, strides: Sequence[int]) -> Counts:
    """The counts of a batch; `strides` are those of the stages that have scores."""
    known = int(truth.disparity.isfinite().sum())
    if truth.labels is None:
        return Counts(known)
    seen = [at_stage(truth.labels, stride) for stride in strides]
    return Counts(
        known,
        tuple(int((labels != IGNORED).sum()) for labels in seen),
        tuple(labels.numel() for labels in seen),
    )


def at_stage(labels: Tensor, stride: int) -> Tensor:
    """(B, H, W) → (B, H/stride, W/stride): the labels at the centres of a stage's pixels."""
    return labels[:, stride // 2 :: stride, stride // 2 :: stride]


def sums(stages: Sequence[Stage], truth: Truth, class_weights: Tensor | None = None) -> Sums:
    """Every term of the objective, summed over the pixels of a batch, in fp32.

    H and W of the truth must be multiples of the network's. `class_weights`: (classes,). A stage
    without scores or refinement, or a truth without labels, has no such term.
    """
    terms: Sums = {}
    for number, stage in enumerate(stages, 1):
        terms[f"disparity_{number}"] = smooth_l1(stage.disparity, truth.disparity)
        if stage.scores is not None and truth.labels is not None:
            terms[f"semantic_{number}"] = cross_entropy(stage.scores, truth.labels, class_weights)
        if stage.refined is not None:
            terms[f"refined_{number}"] = smooth_l1(stage.refined, truth.disparity)
    return terms


def smooth_l1(disparity: Tensor, truth: Tensor) -> Tensor:
    """Equation 1, summed where the truth is known.

    `disparity`, (B, 1, h, w), is enlarged to the size of `truth`, (B, H, W); both are in pixels of
    that size.
    """
    full = enlarge(disparity.float(), truth.shape[-2] // disparity.shape[-2])[:, 0]
    known = truth.isfinite()
    wanted = torch.where(known, truth, 0.0)
    return F.smooth_l1_loss(full * known, wanted, reduction="sum", beta=1.0)


def cross_entropy(scores: Tensor, labels: Tensor, class_weights: Tensor | None = None) -> Tensor:
    """The weighted cross entropy, summed over the labelled pixels at the resolution of the scores.

    `scores`: (B, classes, h, w), before the softmax; `labels`: (B, H, W) train ids.
    """
    seen = at_stage(labels, labels.shape[-2] // scores.shape[-2]).long()
    return F.cross_entropy(
        scores.float(), seen, class_weights, ignore_index=IGNORED, reduction="sum"
    )


def imitation(stages: Sequence[Stage], largest: Sequence[Stage]) -> Sums:
    """How far a network's maps are from a larger one's, term by term, as means over all pixels of a
    stage: smooth L1 of disparities in pixels, Kullback-Leibler divergence of class scores.

    The larger network's maps are taken as they are: no gradient reaches them. Stages have the terms
    that both networks have.
    """
    terms: Sums = {}
    for number, (own, its) in enumerate(zip(stages, largest, strict=False), 1):
        terms[f"disparity_{number}"] = _mean_smooth_l1(own.disparity, its.disparity)
        if own.scores is not None and its.scores is not None:
            said, aim = (F.log_softmax(scores.float(), 1) for scores in (own.scores, its.scores))
            apart = F.kl_div(said, aim.detach(), reduction="none", log_target=True)
            terms[f"semantic_{number}"] = apart.sum(1).mean()
        if own.refined is not None and its.refined is not None:
            terms[f"refined_{number}"] = _mean_smooth_l1(own.refined, its.refined)
    return terms


def means(terms: Mapping[str, Tensor], counts: Counts, gamma: float = 0.0) -> Sums:
    """The terms as means over pixels; a term that no pixel speaks for is 0.

    `gamma` above 0 is for coarse annotations: the semantic terms grow with the unlabelled area.
    """
    return {name: value * _scale(name, counts, gamma) for name, value in terms.items()}


def total(terms: Mapping[str, Tensor]) -> Tensor:
    """Equation 2: the mean terms, weighted by stage and by task."""
    weighted = [value * _weight(name) for name, value in terms.items()]
    return torch.stack(weighted).sum()


def coarse_factor(labelled: int, compared: int, gamma: float) -> float:
    """1 + γ · A_unlab / (A_tot − A_unlab); 1 where nothing is labelled."""
    return 1 + gamma * (compared - labelled) / labelled if labelled else 1.0


def class_weights(shares: NDArray[np.float64], k: float) -> NDArray[np.float64]:
    """Equation 3: the weight of each class from its share of the labelled pixels.

    The weights have mean 1; a smaller `k`, above 1, spreads them more (1.12 for Cityscapes, 2 for
    KITTI). Raises `Rts2Error` for a `k` that gives no weights.
    """
    if not k > 1:
        raise Rts2Error(f"k must be above 1, as log(P + k) must be above 0 for P = 0; not {k}")
    inverse = 1 / np.log(np.asarray(shares, np.float64) + k)
    weights: NDArray[np.float64] = len(inverse) * inverse / inverse.sum()
    return weights


def _mean_smooth_l1(disparity: Tensor, aim: Tensor) -> Tensor:
    return F.smooth_l1_loss(disparity.float(), aim.detach().float(), beta=1.0)


def _scale(name: str, counts: Counts, gamma: float) -> float:
    """What turns a sum into the mean that the objective weighs."""
    task, stage = _parts(name)
    if task != "semantic":
        return 1 / max(counts.known, 1)
    labelled, compared = counts.labelled[stage], counts.compared[stage]
    return coarse_factor(labelled, compared, gamma) / max(labelled, 1)


def _weight(name: str) -> float:
    task, stage = _parts(name)
    return STAGE_WEIGHTS[stage] * TASK_WEIGHTS[task]


def _parts(name: str) -> tuple[str, int]:
    """`refined_3` → `refined`, 2."""
    task, number = name.split("_")
    return task, int(number) - 1
