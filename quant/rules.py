"""8 bits for a device that is not at hand: rules decide, and accuracy alone is measured.

Nobody times the target from here, so what is left in float is what experience says: the 3D convs,
which TensorRT 8.2 does not build in integers, the heads, whose results are disparities and scores,
and the first layer, which sees three channels. The pairs are symmetric, as TensorRT takes them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from re import compile as pattern
from typing import Final

import onnx

from ..model.data.scene import Sample
from ..model.graph import GraphHeader
from ..model.predictor import OnnxPredictor
from ..model.qdq import integers, layers
from .budget import Budget, dearer, first_within
from .calibration import Calibration, Method, calibrate
from .parity import Measured, judge
from .selection import Cost
from .sensitivity import AUDITED_PAIRS, Effect, Reference, alone
from .source import Source, opened

KEPT: Final = (
    (pattern(r"regularize\."), "3D convs: TensorRT 8.2 does not build them in integers"),
    (pattern(r"classify\.|refine\.\d\.residual\.1/"), "a head: its result is scores or disparity"),
    (pattern(r"encoder\.stem\.0|features\.stem\.0"), "the first layer sees three channels"),
)
"""What stays float whatever is measured, and why."""

UNKNOWN_MS: Final = 1.0
"""What every layer is taken to save alike, where nobody timed any."""


@dataclass(frozen=True)
class ByRules:
    """What the rules made of a network."""

    parent: Path
    model: onnx.ModelProto
    header: GraphHeader
    chosen: frozenset[str]
    layers: tuple[str, ...]
    """All of them, in the order of the graph."""
    kept: Mapping[str, str]
    """Layers that stay float, and why."""
    effects: Mapping[str, Effect]
    calibration: Calibration
    measured: Measured
    within: bool


def quantize(
    source: Source,
    pairs: Sequence[Sample],
    frames: Sequence[Sample],
    budget: Budget,
    method: Method,
    cache: Path,
) -> ByRules:
    """The network in symmetric 8 bits but for `KEPT`, and for what the budget wants restored.

    Raises as `ptq.quantize` does.
    """
    parent = source.graph(next(iter(source.forms), None))
    model, header = opened(parent)
    known = calibrate(model, header, pairs, cache)
    ranges = known.ranges(method)
    names = [layer.name for layer in layers(model)]
    kept = {name: why for name in names if (why := rule(name)) is not None}
    free = frozenset(name for name in names if name not in kept)
    reference = Reference(model, header, known.first(pairs, AUDITED_PAIRS))
    effects = alone(model, sorted(free), ranges, reference)

    def judged(chosen: frozenset[str]) -> Measured:
        made = integers(model, chosen, ranges, symmetric=True)
        return judge(OnnxPredictor(parent), OnnxPredictor.of(made), frames)

    costs = [Cost(name, UNKNOWN_MS, 0.0) for name in names if name in free]
    errors = {name: effect.harm for name, effect in effects.items()}
    choices = chain([free], dearer(costs, (), 0.0, errors, free))
    chosen, measured, within = first_within(budget, choices, judged)
    kept |= dict.fromkeys(free - chosen, "restored for the accuracy budget")
    return ByRules(
        parent,
        integers(model, chosen, ranges, symmetric=True),
        header.model_copy(update={"precision": "int8"}),
        chosen,
        tuple(names),
        kept,
        effects,
        known,
        measured,
        within,
    )


def rule(layer: str) -> str | None:
    """Why a layer stays float whatever is measured; None where it need not."""
    return next((why for known, why in KEPT if known.match(layer)), None)
