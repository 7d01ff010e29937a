"""What each layer in integers does to the network's answer, alone: its error, told in five ways."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import onnx

from ..model.console import progress
from ..model.data.scene import Scene
from ..model.evaluation import score
from ..model.graph import GraphHeader
from ..model.metrics import Score
from ..model.predictor import Estimate, OnnxPredictor
from ..model.qdq import Ranges, integers
from .parity import decibels, powers

AUDITED_PAIRS: Final = 2
"""Of the calibration, on which each layer's effect alone is judged."""

MOVED_PX: Final = 1.0
"""A disparity that moves so far, or farther, is all wrong to `harm`."""


@dataclass(frozen=True)
class Effect:
    """What one change of a graph does to its answers; None where no truth is known."""

    sqnr_db: float
    """Of the disparity: signal over what changed, in dB."""
    harm: float
    """Points: the share of pixels that moved, by as much of `MOVED_PX` as they did, and of those
    whose class changed, both in percent."""
    d1_change: float | None
    """In points; so is `miou_change`. Above 0 where it got worse, as `epe_change` is."""
    epe_change: float | None
    """In pixels."""
    miou_change: float | None


class Reference:
    """The float graph's answers on a few pairs, beside which changes of it are judged."""

    def __init__(
        self, model: onnx.ModelProto, header: GraphHeader, scenes: Sequence[Scene]
    ) -> None:
        self._header, self._scenes = header, scenes
        self._answers = self._run(model)
        self._score = self._scored(self._answers)

    def effect(self, changed: onnx.ModelProto) -> Effect:
        """What a graph with the same inputs and outputs answers differently."""
        answers = self._run(changed)
        pairs = list(zip(self._answers, answers, strict=True))
        total = np.sum([powers(a.disparity, b.disparity) for a, b in pairs], axis=0)
        own = self._scored(answers)
        return Effect(
            sqnr_db=decibels(*total),
            harm=float(np.mean([harm(a, b) for a, b in pairs])),
            d1_change=_difference(own.d1_all, self._score.d1_all),
            epe_change=_difference(own.epe, self._score.epe),
            miou_change=_difference(self._score.miou, own.miou),
        )

    def _run(self, model: onnx.ModelProto) -> list[Estimate]:
        predictor = OnnxPredictor.of(model)
        return [predictor.predict(scene.left, scene.right) for scene in self._scenes]

    def _scored(self, answers: Iterable[Estimate]) -> Score:
        pairs = zip(answers, self._scenes, strict=True)
        return sum((score(a, s, self._header.arch) for a, s in pairs), Score())


def alone(
    model: onnx.ModelProto, names: Sequence[str], ranges: Ranges, reference: Reference
) -> dict[str, Effect]:
    """The effect of each layer, when it alone is in integers."""
    shown = progress(names, "auditing layers", len(names))
    return {name: reference.effect(integers(model, [name], ranges)) for name in shown}


def harm(reference: Estimate, other: Estimate) -> float:
    """How much of an answer has changed, in points (see `Effect`)."""
    moved = np.abs(reference.disparity - other.disparity)
    points = 100 * float(np.minimum(moved / MOVED_PX, 1).mean())
    if reference.semantic is None or other.semantic is None:
        return points
    return points + 100 * float(np.mean(reference.semantic != other.semantic))


def _difference(worse: float | None, better: float | None) -> float | None:
    return None if worse is None or better is None else worse - better
