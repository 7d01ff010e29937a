"""Which chain to judge next: the one whose networks promise to move the front the furthest.

A surrogate is refitted on everything judged so far and predicts every network of the space, not a
sample of them. What counts is the area that a network would add below the front of latency and
accuracy, taken at an optimistic end of its prediction, so that what is unsure is tried too.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from optuna.distributions import BaseDistribution, CategoricalDistribution
from optuna.samplers import BaseSampler
from optuna.study import Study
from optuna.trial import FrozenTrial, TrialState

from ..profiles.latency import Floats
from .accuracy import LOWER_IS_BETTER, Metric, Row
from .landscape import Chains, Course, Landscape

ROWS: Final = "rows"
"""The attribute of a trial that holds what was judged."""

REASON: Final = "reason"
"""The attribute of a trial that tells why its evaluation failed."""

OPTIMISM: Final = 2.0
"""Standard deviations by which a prediction is taken for better than it is expected to be."""

RIDGES: Final = np.geomspace(1e-4, 1e2, 13)
"""Ratios of noise to prior variance among which the evidence decides."""

BLOCK: Final = 65_536
"""Networks predicted at a time."""

MARGIN: Final = 0.1
"""The worst loss that counts lies above the worst known one by this share of their range."""

Chosen = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Surrogate:
    """Bayesian linear regression of one metric on smooth features of a network's dimensions."""

    mean: float
    weights: Floats
    root: Floats
    """(features, features); the variance of features f is |f root|²."""

    @classmethod
    def fitted(cls, features: Floats, values: Floats) -> Surrogate:
        """From (n, features) and (n,), with the ridge of the greatest marginal likelihood."""
        mean, n = float(values.mean()), len(values)
        left, scales, right = np.linalg.svd(features, full_matrices=False)
        along = left.T @ (values - mean)
        rest = max(float(((values - mean) ** 2).sum() - (along**2).sum()), 0.0)

        def prior(ridge: float) -> float:
            """The variance of a weight, before anything is known, that fits a ridge best."""
            spread = (along**2 / (scales**2 + ridge)).sum() + rest / ridge
            return float(max(spread / n, 1e-12))

        def evidence(ridge: float) -> float:
            volume = np.log(scales**2 + ridge).sum() + (n - len(scales)) * np.log(ridge)
            return float(-n * np.log(prior(ridge)) - volume)

        ridge = float(max(RIDGES, key=evidence))
        weights = right.T @ (scales / (scales**2 + ridge) * along)
        learned = right.T * (1 - np.sqrt(ridge / (scales**2 + ridge)))
        root = np.eye(features.shape[1]) - learned @ right
        return cls(mean, weights, np.sqrt(prior(ridge)) * root)

    def predicted(self, features: Floats) -> tuple[Floats, Floats]:
        """Mean and standard deviation of (n, features)."""
        deviation = np.linalg.norm(features @ self.root, axis=1)
        return self.mean + features @ self.weights, deviation


def features(chains: Chains, stages: int) -> Floats:
    """Of every beginning of a chain: powers and products of the logarithms of its dimensions."""
    axes = [np.log2(axis) for axis in list(chains.axes.values())[: 2 + stages]]
    scaled = [2 * (axis - axis[0]) / (axis[-1] - axis[0]) - 1 for axis in axes if len(axis) > 1]
    columns = [values.reshape(-1) for values in np.meshgrid(*scaled, indexing="ij")]
    products = [columns[i] * columns[j] for i in range(len(columns)) for j in range(i)]
    powers = [values**2 for values in columns] + [values**3 for values in columns[:2]]
    return np.stack([np.ones(chains.count(stages)), *columns, *products, *powers], 1)


@dataclass(frozen=True, eq=False)
class Staircase:
    """The best known loss at every latency up to a limit."""

    latency_ms: Floats
    """Where the steps begin, rising from zero; the last is the limit."""
    loss: Floats
    """Of each step, falling; the first is the worst that counts, before any network."""

    @classmethod
    def of(cls, latency_ms: Floats, loss: Floats, limit_ms: float, worst: float) -> Staircase:
        """Of networks in any order; what is not better than `worst` does not count."""
        order = np.lexsort((loss, latency_ms))
        order = order[loss[order] < worst]
        latency_ms, loss = latency_ms[order], loss[order]
        falls = loss < np.minimum.accumulate(np.r_[worst, loss])[:-1]
        return cls(np.r_[0.0, latency_ms[falls], limit_ms], np.r_[worst, loss[falls]])

    @cached_property
    def widths(self) -> Floats:
        """How long each step is."""
        return np.diff(self.latency_ms)

    @property
    def area(self) -> float:
        """Between the worst loss and the steps: the hypervolume."""
        return float((self.widths * (self.loss[0] - self.loss)).sum())

    def gains(self, latency_ms: Floats, loss: Floats) -> Floats:
        """What each network alone would add to the area: (n,) and (n,) → (n,)."""
        width = np.r_[0.0, np.cumsum(self.widths)]
        below = np.r_[0.0, np.cumsum(self.widths * self.loss)]
        first = np.searchsorted(self.latency_ms[:-1], latency_ms, side="right") - 1
        last = np.maximum(np.searchsorted(-self.loss, -loss, side="left"), first)
        into = latency_ms - self.latency_ms[first]
        wide = width[last] - width[first] - into
        high = below[last] - below[first] - into * self.loss[first]
        better = last > first
        return np.where(better, high - np.where(better, loss, 0.0) * wide, 0.0)


class FrontSampler(BaseSampler):
    """Chooses among all chains that hold a network which meets the target, none twice."""

    def __init__(
        self,
        landscape: Landscape,
        metrics: Sequence[Metric],
        first: Sequence[int] = (),
        optimism: float = OPTIMISM,
    ) -> None:
        """`first`: the chains to begin with."""
        self.landscape, self.chains = landscape, landscape.chains
        self.metrics, self.optimism = tuple(metrics), optimism
        admitted = set(landscape.admitted.tolist())
        self.first = [chain for chain in dict.fromkeys(first) if chain in admitted]
        self._stages = self.chains.space.stages
        self._features = {stages: features(self.chains, stages) for stages in self._stages}
        self._beginning = {stages: self.chains.beginning(stages) for stages in self._stages}
        self._rows: dict[int, tuple[Row, ...]] = {}

    def infer_relative_search_space(
        self,
        study: Study,  # noqa: ARG002  # Optuna's interface
        trial: FrozenTrial,  # noqa: ARG002
    ) -> dict[str, BaseDistribution]:
        return self.dimensions()

    def sample_relative(
        self,
        study: Study,
        trial: FrozenTrial,  # noqa: ARG002
        search_space: dict[str, BaseDistribution],  # noqa: ARG002
    ) -> dict[str, Any]:
        return self.proposed(study)

    def sample_independent(
        self,
        study: Study,  # noqa: ARG002
        trial: FrozenTrial,  # noqa: ARG002
        param_name: str,
        param_distribution: BaseDistribution,  # noqa: ARG002
    ) -> Any:
        """What is left where every chain is taken: the first value."""
        return self.chains.axes[param_name][0]

    def dimensions(self) -> dict[str, BaseDistribution]:
        """What Optuna is told of a chain."""
        return {name: CategoricalDistribution(axis) for name, axis in self.chains.axes.items()}

    def proposed(self, study: Study) -> dict[str, int]:
        """The next chain as one value a dimension; empty where every one is judged or running."""
        trials = study.get_trials(deepcopy=False)
        taken = {chain for trial in trials if (chain := self.taken(trial)) is not None}
        for chain in self.first:
            if chain not in taken:
                return self.chains.values(chain)
        free = np.setdiff1d(self.landscape.admitted, np.array(sorted(taken), np.int64))
        if not len(free):
            return {}
        finished = [trial for trial in trials if trial.state == TrialState.COMPLETE]
        rows = [row for trial in finished for row in self.rows(trial)]
        if not rows:
            return self.chains.values(int(free[len(free) // 2]))
        done = {self.taken(trial) for trial in finished}
        gains = self._gains(rows, np.array(sorted(taken - done), np.int64))
        return self.chains.values(int(free[np.argmax(gains[free])]))

    def taken(self, trial: FrozenTrial) -> int | None:
        """The chain of a trial, unless it is free because its worker was lost or came second."""
        # First what was chosen as a whole: parameters are stored one after the other.
        values = trial.system_attrs.get("fixed_params") or trial.params
        lost = trial.state == TrialState.FAIL and REASON not in trial.user_attrs
        if lost or trial.state == TrialState.PRUNED or len(values) < len(self.chains.axes):
            return None
        return self.chains.number(values)

    def rows(self, trial: FrozenTrial) -> tuple[Row, ...]:
        """What a finished trial judged; each is parsed once."""
        if trial.number not in self._rows:
            stored = json.loads(trial.user_attrs[ROWS])
            self._rows[trial.number] = tuple(Row.model_validate(row) for row in stored)
        return self._rows[trial.number]

    def _gains(self, rows: Sequence[Row], running: Chosen) -> Floats:
        """What each chain promises to add to the fronts, as shares of what they have.

        With several metrics there is a front for each, and for mixtures of them, as a network may
        be the best in none and a good one in all.
        """
        judged = [self._judged(metric, rows, running) for metric in self.metrics]
        gains = np.zeros(self.chains.size)
        for proven in (True, False):
            courses = [each for each in self.landscape.courses if each.proven == proven]
            if courses:
                known, hoped = (
                    self._losses(courses, losses) for losses in zip(*judged, strict=True)
                )
                for weights in _mixtures(known):
                    gains += self._promised(courses, _mixed(weights, known), _mixed(weights, hoped))
        return gains

    def _losses(self, courses: Sequence[Course], losses: Sequence[Mapping[int, Floats]]) -> Floats:
        """The losses of all courses' networks, each in its precision: (metrics, networks)."""
        pairs = list(zip(self.metrics, losses, strict=True))
        return np.stack(
            [np.concatenate([_changed(c, metric, own) for c in courses]) for metric, own in pairs]
        )

    def _promised(self, courses: Sequence[Course], known: Floats, hoped: Floats) -> Floats:
        """What the best network of each chain promises to add to one front."""
        told = ~np.isnan(known)
        if not told.any():
            return np.zeros(self.chains.size)
        latency = np.concatenate([course.latency_ms for course in courses])
        worst = float(known[told].max() + MARGIN * max(float(np.ptp(known[told])), 1e-9))
        front = Staircase.of(latency[told], known[told], self.landscape.target_ms, worst)
        gains = front.gains(latency, hoped)
        best = {stages: np.zeros(self.chains.count(stages)) for stages in self._stages}
        start = 0
        for course in courses:
            own, stop = best[course.stages], start + len(course.at)
            np.maximum.at(own, course.at % len(own), gains[start:stop])
            start = stop
        each = [own[self._beginning[stages]] for stages, own in best.items()]
        found: Floats = np.max(each, axis=0) / max(front.area, 1e-12)
        return found

    def _judged(
        self, metric: Metric, rows: Iterable[Row], running: Chosen
    ) -> tuple[dict[int, Floats], dict[int, Floats]]:
        """Losses by stages, flattened as the block is: what is known (or else NaN), and the
        optimistic end of what is predicted of the rest (infinite for what is known).

        Of a chain that another worker is judging the prediction counts as known, so that no two
        workers look in the same place.
        """
        known = self._known(metric, rows)
        hoped = {stages: np.full(len(losses), np.inf) for stages, losses in known.items()}
        for stages in self._stages:
            waiting = self._beginning[stages][running]
            count = self.chains.count(stages)
            for start in range(0, self.chains.levels * count, count):
                own = known[stages][start : start + count]
                if np.isnan(own).all():
                    continue
                mean, hope = self._predicted(metric, stages, own)
                own[waiting] = np.where(np.isnan(own[waiting]), mean[waiting], own[waiting])
                hoped[stages][start : start + count] = np.where(np.isnan(own), hope, np.inf)
        return known, hoped

    def _known(self, metric: Metric, rows: Iterable[Row]) -> dict[int, Floats]:
        """Judged losses by stages; NaN elsewhere."""
        sizes = {stages: 3 * self.chains.count(stages) for stages in self._stages}
        known = {stages: np.full(size, np.nan) for stages, size in sizes.items()}
        for row in rows:
            value, flat = row.value(metric), self.chains.flat(row.arch)
            if value is not None and flat is not None:
                known[row.arch.stages][flat] = value if LOWER_IS_BETTER[metric] else -value
        return known

    def _predicted(self, metric: Metric, stages: int, losses: Floats) -> tuple[Floats, Floats]:
        """The expected loss of every beginning of a chain, and its optimistic end.

        Errors are predicted as logarithms: what improves them improves them by a share.
        """
        every, told, errors = self._features[stages], ~np.isnan(losses), LOWER_IS_BETTER[metric]
        values = np.log(np.maximum(losses[told], 1e-6)) if errors else losses[told]
        surrogate = Surrogate.fitted(every[told], values)
        mean, hope = np.empty(len(every)), np.empty(len(every))
        for start in range(0, len(every), BLOCK):
            part = slice(start, start + BLOCK)
            mean[part], deviation = surrogate.predicted(every[part])
            hope[part] = mean[part] - self.optimism * deviation
        return (np.exp(mean), np.exp(hope)) if errors else (mean, hope)


def as_stored(rows: Iterable[Row]) -> str:
    """Rows as a trial keeps them."""
    return json.dumps([row.model_dump(mode="json") for row in rows])


def _changed(course: Course, metric: Metric, losses: Mapping[int, Floats]) -> Floats:
    """The losses of a course's networks in its precision."""
    direction = 1 if LOWER_IS_BETTER[metric] else -1
    found: Floats = losses[course.stages][course.at] + direction * course.changes[metric]
    return found


def _mixtures(known: Floats) -> Floats:
    """Weights that bring metrics to one scale, each alone and all together: (mixtures, metrics)."""
    told = known[:, ~np.isnan(known).any(axis=0)]
    if not told.size or len(known) == 1:
        return np.eye(len(known))
    scales = 1 / np.maximum(np.ptp(told, axis=1), 1e-9)
    weights: Floats = np.concatenate([np.eye(len(known)), np.ones((1, len(known)))]) * scales
    return weights


def _mixed(weights: Floats, losses: Floats) -> Floats:
    """The weighted sum; what weighs nothing may be unknown."""
    own = weights > 0
    found: Floats = weights[own] @ losses[own]
    return found
