"""From a dozen timings to a latency model: what was known before, moved as far as they ask for.

Each coefficient is the prior's times exp(g + s·z): g ~ N(0, COMMON²) is how much slower the whole
device is than the prior says, z ~ N(0, 1) how much this coefficient strays from the others. The
posterior's mode weighs both against the relative errors of the timings, and no coefficient can
become negative. `s`, the strength of the prior, is what predicts best when each timing is left out.
A coefficient that is 0 in the prior is one of which it knows nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ...model.ops import ops
from ..heldout import hold_outs
from ..latency import Floats, LatencyModel, Steps, step_costs_ms
from ..profile import Calibration, Point

Combine = Literal["sum", "max"]

COMMON = 2.0
"""How far, in natural logarithm, a whole device may be from its prior: a factor of 7."""

NOISE = 0.03
"""The relative error of a timing, and of the model's form."""

STRENGTHS = (0.1, 0.3, 0.9)
"""How far a coefficient may stray from the others, in natural logarithm: what is tried."""

FAINT = 0.02
"""The share of the latency that a coefficient of which the prior knows nothing starts with."""

UNKNOWN = 1.5
"""How far such a coefficient may stray."""


def calibrated(points: Sequence[Point], prior: LatencyModel, source: str) -> Calibration:
    """The posterior of the points of one runtime and precision, with the errors of each left out,
    of each family left out, and of each stage count.

    What is left out is left out of everything, the choice of the strength too.
    """
    return Calibration(
        runtime=points[0].runtime,
        precision=points[0].precision,
        model=posterior(points, prior),
        residuals=tuple(float(residual) for residual in leave_one_out(points, prior)),
        source=source,
        prior=prior,
        held_out=hold_outs(points, lambda others: posterior(others, prior)),
    )


def posterior(points: Sequence[Point], prior: LatencyModel) -> LatencyModel:
    """The likeliest model once the points are known; every coefficient of it is positive."""
    table = _Table.of(points, prior)
    everything = np.ones(len(points))
    return _with(prior, table.fitted(table.strength(everything), everything))


def leave_one_out(points: Sequence[Point], prior: LatencyModel) -> Floats:
    """ln(true / predicted) of each point, predicted from the prior and all the others."""
    table = _Table.of(points, prior)
    everything = np.ones(len(points))
    residuals = []
    for index in range(len(points)):
        keep = _without(everything, index)
        residuals.append(-table.misses(table.fitted(table.strength(keep), keep))[index])
    return np.array(residuals)


def shares(model: LatencyModel, steps: Steps) -> Floats:
    """What each coefficient has in each latency, the cost of starting first: (lists, 1 + k)."""
    design = _design(model, steps)
    parts = _parts(design, steps.firsts, model.combine, _values(model))
    found: Floats = parts / parts.sum(1, keepdims=True)
    return found


@dataclass
class _Table:
    """The timings as arrays, and what was fitted to them so far."""

    design: Floats
    """What each step takes of each coefficient: (n, 1 + k)."""
    firsts: NDArray[np.int64]
    combine: Combine
    truth: Floats
    prior: Floats
    unknown: NDArray[np.bool_]
    """Of which coefficients the prior knows nothing."""
    known: dict[tuple[float, bytes], Floats] = field(default_factory=dict)

    @classmethod
    def of(cls, points: Sequence[Point], prior: LatencyModel) -> _Table:
        steps = Steps.of([ops(point.arch, point.resolution) for point in points])
        design, firsts = _design(prior, steps), steps.firsts
        if prior.combine == "sum":  # a sum over steps is the same for all coefficients
            design, firsts = np.add.reduceat(design, firsts), np.arange(len(points))
        truth = np.array([point.latency_ms for point in points])
        values = _values(prior)
        filled = _filled(values, design, firsts, prior.combine)
        return cls(design, firsts, prior.combine, truth, filled, values == 0)

    def strength(self, keep: Floats) -> float:
        """How far the coefficients may stray, by leaving out each timing of `keep` in turn."""
        return min(STRENGTHS, key=lambda strength: self._held_out(strength, keep))

    def _held_out(self, strength: float, keep: Floats) -> float:
        left = [
            self.misses(self.fitted(strength, _without(keep, index)))[index]
            for index in np.flatnonzero(keep).tolist()
        ]
        return float(np.mean(np.square(left)))

    def fitted(self, strength: float, keep: Floats) -> Floats:
        """The coefficients that the timings of `keep` ask for: (1 + k,)."""
        key = (strength, keep.tobytes())
        if key not in self.known:
            self.known[key] = self._fitted(strength, keep)
        return self.known[key]

    def _fitted(self, strength: float, keep: Floats) -> Floats:
        count = len(self.prior)
        spread = np.where(self.unknown, UNKNOWN, strength)

        def values(found: Floats) -> Floats:
            strayed: Floats = self.prior * np.exp(np.clip(found[0] + spread * found[1:], -30, 30))
            return strayed

        def misses(found: Floats) -> Floats:
            missed = keep * self.misses(values(found)) / NOISE
            return np.concatenate([missed, [found[0] / COMMON], found[1:]])

        def slopes(found: Floats) -> Floats:
            parts = _parts(self.design, self.firsts, self.combine, values(found))
            of_each = spread * parts / parts.sum(1, keepdims=True)
            rows = np.column_stack([np.ones(len(parts)), of_each]) * keep[:, None] / NOISE
            return np.vstack([rows, np.diag([1 / COMMON, *np.ones(count)])])

        start = np.zeros(1 + count)
        start[0] = -float(np.median(self.misses(self.prior)[keep > 0]))
        return values(least_squares(misses, start, slopes, method="lm").x)

    def misses(self, values: Floats) -> Floats:
        """ln(predicted / true) of each timing."""
        parts = _parts(self.design, self.firsts, self.combine, values)
        missed: Floats = np.log(parts.sum(1) / self.truth)
        return missed


def _filled(values: Floats, design: Floats, firsts: NDArray[np.int64], combine: Combine) -> Floats:
    """`values` with a faint one for each 0, if any timing exercises it."""
    latency = _parts(design, firsts, combine, values).sum(1)
    alone = np.add.reduceat(design, firsts) / latency[:, None]
    share = alone.mean(0)
    faint = np.divide(FAINT, share, out=np.zeros_like(share), where=share > 0)
    found: Floats = np.where(values == 0, faint, values)
    return found


def _without(keep: Floats, index: int) -> Floats:
    fewer = keep.copy()
    fewer[index] = 0
    return fewer


def _parts(design: Floats, firsts: NDArray[np.int64], combine: Combine, values: Floats) -> Floats:
    """What each coefficient adds to each latency, in milliseconds: (lists, 1 + k)."""
    terms = design * values
    if combine == "max":
        hidden = terms[:, 0] >= terms[:, 1:].sum(1)
        terms[hidden, 1:] = 0
        terms[~hidden, 0] = 0
    found: Floats = np.add.reduceat(terms, firsts)
    return found


def _design(model: LatencyModel, steps: Steps) -> Floats:
    """The cost of each step at each coefficient alone, that coefficient 1: (n, 1 + k)."""
    rows = np.eye(1 + len(model.ms_per))
    units = [_with(model, row).model_copy(update={"combine": "sum"}) for row in rows]
    return np.stack([step_costs_ms(unit, steps) for unit in units], 1)


def _values(model: LatencyModel) -> Floats:
    return np.array([model.start_ms, *model.ms_per.values()])


def _with(form: LatencyModel, values: Floats) -> LatencyModel:
    start, *rest = (float(value) for value in values)
    per = dict(zip(form.ms_per, rest, strict=True))
    return form.model_copy(update={"start_ms": start, "ms_per": per})
