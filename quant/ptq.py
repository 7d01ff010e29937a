"""Post-training quantization for the machine at hand: 8 bits where they are faster and harm least.

    the forms of the 3D convs, faster in float and faster in integers   (kernels timed)
    → the ranges of all values                                          (calibration)
    → the cheapest layers, raced against near choices                   (selection)
    → layers restored until the accuracy budget holds                   (judged on the frames)
    → a duel with the float parent                                      (paired timing)

What is not faster than its parent, or is outside of the budget, is not delivered.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Final

import onnx

from ..model.arch import Form
from ..model.console import progress
from ..model.data.scene import Sample
from ..model.graph import GraphHeader, save_graph
from ..model.predictor import OnnxPredictor
from ..model.qdq import integers, layers, nominal
from .audit import Audit, Audited
from .bias import corrected
from .budget import Budget, dearer, first_within
from .calibration import Calibration, Method, calibrate
from .parity import Measured, judge
from .race import Duel, Runner, duel, race
from .selection import cheapest, total_ms
from .sensitivity import AUDITED_PAIRS, Effect, Reference, alone
from .source import Source, opened

CONVERSIONS: Final = (0.0, 0.5, 1.0, 2.0, 4.0)
"""What a conversion is taken to cost, in multiples of what it does on average: one cheapest choice
each, and the race decides."""

NEAR: Final = 10
"""Choices that differ in one part of the network, raced against the best."""

GAIN: Final = 0.003
"""What a choice must win by in a race, as a share of the latency, to take another's place."""

PART: Final = re.compile(r"[a-z]+(\.levels)?(\.\w+)?")
"""What of a layer's name tells its part."""


@dataclass(frozen=True)
class Trial:
    """One choice of layers that was looked at."""

    what: str
    layers: int
    """How many are in integers."""
    latency_ratio: float | None = None
    """Over the float parent's; None where the choice was not timed."""
    measured: Measured | None = None
    kept: bool = False


@dataclass(frozen=True)
class Quantized:
    """What came of a quantization: the float parent, the choice, and all that speaks for it."""

    parent: Path
    model: onnx.ModelProto
    header: GraphHeader
    chosen: frozenset[str]
    restored: frozenset[str]
    """Layers that went back to float for the accuracy."""
    audited: Audited
    effects: Mapping[str, Effect]
    calibration: Calibration
    measured: Measured
    duel: Duel
    within: bool
    """Whether the budget holds."""
    float_forms: tuple[Form, ...] | None
    trials: tuple[Trial, ...]

    @property
    def delivered(self) -> bool:
        """Whether the integers are worth having: faster, and within the budget."""
        return bool(self.chosen) and self.within and self.duel.faster


@dataclass(frozen=True)
class Setting:
    """Where and with what a network is quantized."""

    pairs: Sequence[Sample]
    """Of the calibration."""
    frames: Sequence[Sample]
    """What judges."""
    budget: Budget
    method: Method
    threads: int
    cache: Path
    """Where the calibration keeps its state."""
    folder: Path
    """For graphs in between."""


def quantize(source: Source, setting: Setting) -> Quantized:
    """The network in 8 bits, chosen layer by layer for the machine at hand, in ONNX Runtime.

    Raises:
        UsageError: too few pairs fit, or no frame has the truth that judges.
        Rts2Error: a value that is not finite, or a graph that cannot be quantized.
    """
    return _Quantization(source, setting).run()


class _Quantization:
    def __init__(self, source: Source, setting: Setting) -> None:
        self.source, self.setting = source, setting
        self.trials: list[Trial] = []
        header = opened(source.graph(next(iter(source.forms), None)))[1]
        self.audit = Audit(header, setting.folder, setting.threads)

    def run(self) -> Quantized:
        setting = self.setting
        self.parent = self.source.graph(self.forms[0])
        self.model, self.header = opened(self.source.graph(self.forms[1]))
        self.biased = self.model
        known = calibrate(self.model, self.header, setting.pairs, setting.cache)
        self.ranges = known.ranges(setting.method)
        self.audited = self.audit.of(self.model, self.ranges)
        scenes = known.first(setting.pairs, AUDITED_PAIRS)
        self.reference = Reference(self.model, self.header, scenes)
        names = [layer.name for layer in layers(self.model)]
        self.effects = alone(self.model, names, self.ranges, self.reference)
        fastest = self._fastest()
        self.biased = self._biased(fastest, known)
        chosen, measured, within = self._within_budget(fastest)
        made = self._made(chosen)
        return Quantized(
            parent=self.parent,
            model=made,
            header=self._header(),
            chosen=chosen,
            restored=fastest - chosen,
            audited=self.audited,
            effects=self.effects,
            calibration=known,
            measured=measured,
            duel=duel(self._saved(made, "chosen"), self._parent(), setting.threads),
            within=within,
            float_forms=self.forms[0] or None,
            trials=tuple(self.trials),
        )

    @cached_property
    def forms(self) -> tuple[tuple[Form, ...], tuple[Form, ...]]:
        """The forms of the 3D convs, stage by stage: the faster in float, and with integers."""
        known = self.source.forms
        if not known:
            return (), ()
        shown = progress(known, "timing both forms of the 3D convs", len(known))
        audits = {forms[0]: self._nominal(forms) for forms in shown}
        stages = range(len(known[0]))

        def faster(stage: int, integer: bool) -> Form:
            return min(audits, key=lambda form: _stage_ms(audits[form], stage, integer))

        plain, mixed = (tuple(faster(stage, i) for stage in stages) for i in (False, True))
        return plain, mixed

    def _nominal(self, forms: tuple[Form, ...]) -> Audited:
        """The kernels of one form; how long they take does not depend on the ranges."""
        model, _ = opened(self.source.graph(forms))
        return self.audit.of(model, nominal(model))

    def _fastest(self) -> frozenset[str]:
        """The fastest choice of those that should be, by a race."""
        costs, flows = self.audited.costs, self.audited.flows
        cuts = [cheapest(costs, flows, self.audited.ms_per_element * c) for c in CONVERSIONS]
        every = frozenset(cost.layer for cost in costs)
        best, ratio = self._raced("cheapest cut", [*cuts, every])
        near, near_ratio = self._raced("one part differs", self._near(best), best)
        return near if near_ratio < ratio - GAIN else best

    def _near(self, chosen: frozenset[str]) -> list[frozenset[str]]:
        """Choices that differ in one part, those first that cost the least more as predicted."""
        costs, flows = self.audited.costs, self.audited.flows
        parts: dict[str, set[str]] = {}
        for cost in costs:
            parts.setdefault(part_of(cost.layer), set()).add(cost.layer)
        others = {frozenset(chosen - part) for part in parts.values()}
        others |= {frozenset(chosen | part) for part in parts.values()}
        rate = self.audited.ms_per_element
        ranked = sorted(
            others - {chosen}, key=lambda c: (total_ms(costs, flows, rate, c), sorted(c))
        )
        return ranked[:NEAR]

    def _raced(
        self, what: str, choices: Sequence[frozenset[str]], *beside: frozenset[str]
    ) -> tuple[frozenset[str], float]:
        """The fastest of several choices, and its latency over the float parent's."""
        distinct = [c for c in dict.fromkeys((*choices, *beside)) if c]
        if not distinct:
            return frozenset(), 1.0
        made = progress(distinct, f"racing: {what}", len(distinct))
        runners = [self._saved(self._made(c), f"raced-{index}") for index, c in enumerate(made)]
        ratios = race([self._parent(), *runners], self.setting.threads)[1:]
        self.trials += [Trial(what, len(c), r) for c, r in zip(distinct, ratios, strict=True)]
        best = min(range(len(distinct)), key=ratios.__getitem__)
        return distinct[best], ratios[best]

    def _biased(self, chosen: frozenset[str], known: Calibration) -> onnx.ModelProto:
        """The float graph, with corrected biases where they bring the answers nearer to it."""
        other = corrected(self.model, chosen, known)
        plain = self.reference.effect(integers(self.model, chosen, self.ranges))
        better = self.reference.effect(integers(other, chosen, self.ranges))
        return other if better.harm < plain.harm else self.model

    def _within_budget(self, fastest: frozenset[str]) -> tuple[frozenset[str], Measured, bool]:
        errors = {name: effect.harm for name, effect in self.effects.items()}
        audited = self.audited
        choices = dearer(audited.costs, audited.flows, audited.ms_per_element, errors, fastest)
        return first_within(self.setting.budget, chain([fastest], choices), self._judged)

    def _judged(self, chosen: frozenset[str]) -> Measured:
        """The parent and a choice on the frames."""
        pair = OnnxPredictor(self.parent), OnnxPredictor.of(self._made(chosen))
        found = judge(*pair, self.setting.frames)
        self.trials.append(
            Trial("judged", len(chosen), None, found, self.setting.budget.holds(found))
        )
        return found

    def _made(self, chosen: frozenset[str]) -> onnx.ModelProto:
        return integers(self.biased, chosen, self.ranges)

    def _header(self) -> GraphHeader:
        return self.header.model_copy(update={"precision": "int8"})

    def _parent(self) -> Runner:
        return Runner(self.parent, "fp32")

    def _saved(self, made: onnx.ModelProto, name: str) -> Runner:
        path = self.setting.folder / f"{name}.onnx"
        save_graph(made, self._header(), path)
        return Runner(path, "int8")


def part_of(layer: str) -> str:
    """The part of the network that a layer belongs to, from its name."""
    found = PART.match(layer)
    return found.group() if found else layer


def _stage_ms(audited: Audited, stage: int, integer: bool) -> float:
    """What the 3D convs of a stage take, each in its faster kind if integers are allowed."""
    own = (cost for cost in audited.costs if cost.layer.startswith(f"regularize.{stage}."))
    return sum(min(c.float_ms, c.integer_ms) if integer else c.float_ms for c in own)
