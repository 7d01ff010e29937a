"""The search itself: every candidate of the space, none sampled.

One block of the space (a runtime, a precision, a stage count) is laid out at a time: its
latencies by broadcasting, its accuracies from the source, then what cannot be chosen is left out
and counted, and only the rest is carried on to the front.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from math import exp, log1p
from statistics import NormalDist
from typing import NamedTuple, TypedDict

import numpy as np
from numpy.typing import NDArray

from ..model.arch import CONV3D, STRIDES, Arch, Precision
from ..model.console import KITTI
from ..model.errors import UsageError
from ..model.ops import Size, padded
from ..profiles.conformal import half_width
from ..profiles.evidence import Box, Evidence, boxes, part_boxes
from ..profiles.latency import Floats, LatencyModel, latencies_ms
from ..profiles.parts import PartModel
from ..profiles.profile import Calibration, Profile, Resolution, Runtime
from ..profiles.profile import Point as Timing
from .accuracy import LOWER_IS_BETTER, METRICS, Accuracy, AccuracySource, Metric, bounded, unbounded
from .front import fastest, pick, unbeaten
from .lowered import Lowered, measured
from .result import Coverage, Found, LeftOut, Point, PointEvidence, Task
from .space import Parts, Space

Flags = NDArray[np.bool_]

BYTES_PER_WEIGHT: dict[Precision, int] = {"fp32": 4, "bf16": 2, "fp16": 2, "int8": 1}


@dataclass(frozen=True)
class Question:
    """What the user wants to know."""

    profile: Profile
    target_fps: float
    resolution: Resolution = KITTI
    task: Task = "semantic-stereo"
    objective: Metric = "d1_all"
    confidence: float = 0.9
    at_lower_bound: bool = False
    """Whether the interval's lower end must meet the target."""
    allow_extrapolated: bool = False
    precisions: tuple[Precision, ...] = ()
    """Only these; all that the device has when empty."""
    runtimes: tuple[Runtime, ...] = ()
    max_size_bytes: float = float("inf")
    min_disparity: float = 0.0
    """The widest disparity that must fit into the first volume, in pixels."""


class Candidate(NamedTuple):
    """One network in one precision under one runtime."""

    arch: Arch
    precision: Precision
    runtime: Runtime


@dataclass(frozen=True)
class Executor:
    """One runtime and precision of the device, and the latency model that predicts it."""

    runtime: Runtime
    precision: Precision
    model: LatencyModel | PartModel
    base: Calibration
    """What was calibrated: this very executor, or the one that it derives from."""

    @property
    def derived(self) -> bool:
        return (self.runtime, self.precision) != (self.base.runtime, self.base.precision)


@dataclass(frozen=True)
class _Columns:
    """Candidates that may enter the front, one entry each."""

    executor: NDArray[np.int64]
    stages: NDArray[np.int64]
    position: NDArray[np.int64]
    """In the block of their stage count, flattened."""
    latency_ms: Floats
    half_width: Floats
    """Of the interval, in natural logarithm."""
    metrics: Floats
    """(n, metrics)"""
    evidence: NDArray[np.int64]
    """(n, 2): latency's and accuracy's, as positions in `EVIDENCE`."""
    doubt: dict[Metric, Floats]
    """Of each metric over the whole block, as its `Accuracy` has it."""


EVIDENCE: tuple[Evidence, ...] = ("published", "measured", "interpolated", "extrapolated")
EXTRAPOLATED = EVIDENCE.index("extrapolated")


def search(
    question: Question,
    source: AccuracySource,
    space: Space | None = None,
    lowered: Lowered | None = None,
) -> Found:
    """Every candidate of `space`, the front, the pick and the prospect.

    The source tells accuracies in fp32; `lowered` what other precisions make of them, the changes
    that come with rts2 unless given.

    Raises:
        UsageError: a precision or runtime that the device refuses or lacks, a confidence that
            its calibration points cannot give, or a measured network outside of the space.
    """
    started = time.perf_counter()
    space, lowered = space or Space(), lowered or measured()
    for arch in source.named:
        if space.position(arch) is None:
            raise UsageError(f"{arch.label()} was measured, and lies outside of the space")
    executors = executors_of(question)
    totals = _Totals(space)
    found: list[_Columns] = []
    left_out = Counter[str]()
    for index, block in _blocks(question, source, space, lowered, executors, totals):
        left_out.update(block.leave_out())
        found.append(block.columns(index, source.exact_evidence, block.left()))
    front = _front(question, totals, executors, found)
    size = space.size() * len(executors)
    return Found(
        device=question.profile.name,
        target_fps=question.target_fps,
        resolution=question.resolution,
        task=question.task,
        objective=question.objective,
        confidence=question.confidence,
        space=Coverage(size=size, evaluated=size, exhaustive=True),
        front=tuple(front),
        **choices(question, front),
        left_out=tuple(LeftOut(reason=r, count=n) for r, n in left_out.most_common()),
        elapsed_s=time.perf_counter() - started,
    )


def look_up(
    question: Question,
    source: AccuracySource,
    wanted: Iterable[Candidate],
    space: Space | None = None,
    lowered: Lowered | None = None,
) -> dict[Candidate, Point]:
    """What `search` with these arguments knows of some candidates, chosen or left out.

    Those that lie outside of the space or of the question's executors are missing. Raises as
    `search` does.
    """
    space = space or Space()
    executors, totals = executors_of(question), _Totals(space)
    archs: dict[tuple[int, Precision, Runtime], list[tuple[int, ...]]] = {}
    for arch, precision, runtime in wanted:
        if (position := space.position(arch)) is not None:
            archs.setdefault((arch.stages, precision, runtime), []).append(position)
    found: dict[Candidate, Point] = {}
    for index, block in _blocks(question, source, space, lowered or measured(), executors, totals):
        own = block.executor
        if positions := archs.get((block.stages, own.precision, own.runtime)):
            at = np.ravel_multi_index(tuple(np.transpose(positions)), block.shape)
            columns = block.columns(index, source.exact_evidence, at)
            for point in _points(question, totals, executors, columns, np.arange(len(at))):
                found[Candidate(point.arch, point.precision, point.runtime)] = point
    return found


@dataclass(frozen=True)
class Speed:
    """How fast the networks of one stage count are in one executor, before any accuracy is known.

    The arrays have the shape of the block, flattened.
    """

    stages: int
    executor: Executor
    latency_ms: Floats
    """What must meet the target: the nominal value, or the upper bound where the question asks for
    it; infinite for what the question does not admit."""
    proven: Flags
    """Where it is not extrapolated."""


def speeds(question: Question, space: Space) -> Iterator[Speed]:
    """Every executor and stage count of the space; raises as `search` does."""
    totals = _Totals(space)
    for executor in executors_of(question):
        for stages in space.stages:
            none = np.zeros(space.shape(stages), dtype=bool)
            nothing = Accuracy({}, none, none)
            block = _Block(space, question, executor, nothing, True, totals, stages)
            latency, evidence = block._latency()
            latency, proven = latency.reshape(-1), evidence.reshape(-1) != EXTRAPOLATED
            if question.at_lower_bound:
                latency = latency * np.exp(block._half_width(np.arange(len(latency)), ~proven))
            for _, flags in block._unfit():
                refused = np.broadcast_to(flags, block.shape).reshape(-1)
                latency = np.where(refused, np.inf, latency)
            yield Speed(stages, executor, latency, proven)


class Choices(TypedDict):
    """What of a front is told by name."""

    selected: Point | None
    prospect: Point | None
    nearest: Point | None


def choices(question: Question, front: list[Point]) -> Choices:
    """The pick on proven numbers, what extrapolation could win, the fastest where none meets.

    The prospect trusts extrapolated latency, and extrapolated accuracy only where no other is.
    """
    proven = [point for point in front if point.proven]
    timed = [point for point in front if point.evidence.accuracy != "extrapolated"]

    def best(points: list[Point]) -> Point | None:
        return pick(points, question.target_fps, question.objective, question.at_lower_bound)

    allowed = question.allow_extrapolated
    prospect = best(timed) or best(front)
    selected = prospect if allowed else best(proven)
    return {
        "selected": selected,
        "prospect": prospect,
        "nearest": None if selected else next(iter(front), None) if allowed else fastest(front),
    }


def executors_of(question: Question) -> list[Executor]:
    """The device's runtimes and precisions that the question admits."""
    profile = question.profile
    for precision in question.precisions:
        if refusal := profile.refusal(precision):
            raise UsageError(f"{profile.title} does not run {precision}: {refusal.reason}")
    every = [Executor(c.runtime, c.precision, c.model, c) for c in profile.calibrations]
    for derivation in profile.derivations:
        base = profile.calibration(*derivation.base)
        model = derivation.scale(base.by_steps)
        every.append(Executor(derivation.runtime, derivation.precision, model, base))
    chosen = [
        executor
        for executor in every
        if (not question.precisions or executor.precision in question.precisions)
        and (not question.runtimes or executor.runtime in question.runtimes)
        and profile.refusal(executor.precision) is None
    ]
    if not chosen:
        known = ", ".join(f"{e.precision} on {e.runtime}" for e in every)
        raise UsageError(f"{profile.title} has no latency for that choice; it has {known}")
    return chosen


def _blocks(
    question: Question,
    source: AccuracySource,
    space: Space,
    lowered: Lowered,
    executors: list[Executor],
    totals: _Totals,
) -> Iterator[tuple[int, _Block]]:
    """Every stage count and executor, with the executor's number."""
    for stages in space.stages:
        accuracy = source.columns(space, stages)
        for index, executor in enumerate(executors):
            own = lowered.applied(accuracy, space, stages, executor.precision)
            known = lowered.knows(executor.precision)
            yield index, _Block(space, question, executor, own, known, totals, stages)


class _Totals:
    """Additive quantities of blocks; each input size is tabulated once."""

    def __init__(self, space: Space) -> None:
        self.space = space
        self._parts: dict[Size, Parts] = {}
        self._latencies: dict[tuple[int, Size], Floats] = {}
        """Of each part, by model and size."""

    def latency_ms(
        self, model: LatencyModel | PartModel, resolution: Resolution, stages: int
    ) -> Floats:
        """The predicted latency of every arch of a block."""
        parts = self._at(resolution)
        key = (id(model), padded(resolution, Arch().multiple))
        if key not in self._latencies:
            self._latencies[key] = latencies_ms(model, parts.steps)
        return parts.totals(stages, self._latencies[key])

    def weights(self, resolution: Resolution, stages: int) -> Floats:
        """The trained numbers of every arch of a block."""
        parts = self._at(resolution)
        return parts.totals(stages, parts.steps.summed(parts.steps.weights))

    def macs(self, resolution: Resolution, stages: int) -> Floats:
        """The multiply-adds of every arch of a block."""
        parts = self._at(resolution)
        return parts.totals(stages, parts.steps.summed(parts.steps.macs))

    def _at(self, resolution: Resolution) -> Parts:
        size = padded(resolution, Arch().multiple)
        if size not in self._parts:
            self._parts[size] = Parts.of(self.space, resolution)
        return self._parts[size]


class _Block:
    """One executor and stage count: its candidates, and which of them are left out."""

    def __init__(
        self,
        space: Space,
        question: Question,
        executor: Executor,
        accuracy: Accuracy,
        known: bool,
        totals: _Totals,
        stages: int,
    ) -> None:
        """`known`: whether anything is known of accuracies in the executor's precision."""
        self.space, self.question, self.executor = space, question, executor
        self.accuracy, self.known, self.totals, self.stages = accuracy, known, totals, stages
        self.shape = space.shape(stages)
        self._free = np.ones(self.shape, dtype=bool)

    @cached_property
    def latency_ms(self) -> Floats:
        """As the executor's model predicts it."""
        return self.totals.latency_ms(self.executor.model, self.question.resolution, self.stages)

    def leave_out(self) -> dict[str, int]:
        """Removes what cannot be chosen; counts it by reason, each candidate once."""
        counts: Counter[str] = Counter()
        for reason, excluded in self._exclusions():
            removed = self._free & excluded
            counts[reason] += int(np.count_nonzero(removed))
            self._free &= ~removed
        return {reason: count for reason, count in counts.items() if count}

    def _exclusions(self) -> Iterator[tuple[str, Flags]]:
        yield from self._unfit()
        yield from self._unknown()

    def _unfit(self) -> Iterator[tuple[str, Flags]]:
        """Candidates that the question does not admit, whatever their accuracy."""
        question, space, stages = self.question, self.space, self.stages
        if question.task == "semantic-stereo":
            without = space.along(stages, 0) == 0
            yield "they have no semantic branch (--task stereo admits them)", without
        if question.min_disparity:
            blind = STRIDES[0] * space.along(stages, 2) < question.min_disparity
            yield f"their d_max cannot see {question.min_disparity:.0f} px of disparity", blind
        if question.max_size_bytes < float("inf"):
            weights = self.totals.weights(question.resolution, stages)
            size = BYTES_PER_WEIGHT[self.executor.precision] * weights
            yield "their weights exceed --max-size-mb", size > question.max_size_bytes

    def _unknown(self) -> Iterator[tuple[str, Flags]]:
        """Candidates whose accuracy nobody knows, with what is missing."""
        name = self.question.objective
        precision = self.executor.precision
        if not self.known:
            yield f"no {name} is known in {precision}", np.array(True)
        unknown = np.isnan(self.accuracy.metrics[name])
        for stage in range(self.stages):
            unusual = self.space.along(self.stages, 3 + stage) != CONV3D[stage]
            reason = f"no {name} is known for their 3D widths (--accuracy FILE brings it)"
            yield reason, unknown & unusual
        yield f"no {name} is known for their stages and branches", unknown

    def left(self) -> NDArray[np.int64]:
        """The positions of what is not left out, in the flattened block."""
        return np.flatnonzero(self._free)

    def columns(self, executor: int, exact: Evidence, at: NDArray[np.int64]) -> _Columns:
        """The candidates at `at`. `exact` is what a row of the accuracy source counts as."""
        latency, timing = self._latency()
        latency, timing = latency.reshape(-1)[at], timing.reshape(-1)[at]
        metrics = [self.accuracy.metrics[metric].reshape(-1)[at] for metric in METRICS]
        evidence = np.stack([timing, self._accuracy_evidence(exact).reshape(-1)[at]], 1)
        return _Columns(
            executor=np.full(len(at), executor),
            stages=np.full(len(at), self.stages),
            position=at,
            latency_ms=latency,
            half_width=self._half_width(at, timing == EXTRAPOLATED),
            metrics=np.stack(metrics, 1),
            evidence=evidence,
            doubt=self.accuracy.doubt,
        )

    def _accuracy_evidence(self, exact: Evidence) -> NDArray[np.int64]:
        between = EVIDENCE.index("interpolated")
        # Rows were taken in single precision and, if published, at KITTI's size: what is carried
        # over to another is not a row.
        here = exact == "measured" or _size(self.question.resolution) == _size(KITTI)
        told = EVIDENCE.index(exact) if here and self.executor.precision == "fp32" else between
        known = np.where(self.accuracy.exact, told, between)
        return np.where(self.accuracy.extrapolated, EXTRAPOLATED, known)

    def _latency(self) -> tuple[Floats, NDArray[np.int64]]:
        """Latencies, timings put in where there are any, and the evidence of each."""
        box = self._boxes().get(self.stages)
        if self.executor.derived or box is None or not self._resolution_known():
            return self.latency_ms, np.full(self.shape, EXTRAPOLATED)
        latency = self.latency_ms.copy()
        inside = self.space.inside(self.stages, box)
        evidence = np.where(inside, EVIDENCE.index("interpolated"), EXTRAPOLATED)
        known = [
            (position, timing)
            for timing in self._timings()
            if timing.arch.stages == self.stages
            and _size(timing.resolution) == _size(self.question.resolution)
            and (position := self.space.position(timing.arch)) is not None
        ]
        for position, timing in known:
            if timing.evidence == "published":
                _bound(latency, position, timing.latency_ms)
        for position, timing in known:
            latency[position] = timing.latency_ms
            evidence[position] = EVIDENCE.index(timing.evidence)
        return latency, evidence

    def _half_width(self, at: NDArray[np.int64], extrapolated: Flags) -> Floats:
        """The interval's half width in natural logarithm, for the positions `at`.

        Where the model extrapolates, each step away from what was calibrated (to this executor,
        to this resolution, to this arch) changes the latency by a factor, and half of its
        logarithm is in doubt on top: a promised speed-up of two could be 1.4 or 2.8. What nobody
        timed is at least twice as unsure as what somebody did, and as unsure as what the model
        said of a family that it was not fitted to.
        """
        sure = half_width(self.executor.base.residuals, self.question.confidence)
        if not extrapolated.any():
            return np.full(len(at), sure)
        steps = np.abs(np.diff(np.log(self._way_from_calibrated(at)), axis=0))
        doubt = np.maximum(0.5 * steps.sum(0), max(sure, self._worst_held_out() - sure))
        return np.where(extrapolated, sure + doubt, sure)

    def _worst_held_out(self) -> float:
        """How far the model missed, in natural logarithm, where a whole family was left out."""
        held_out = self.executor.base.held_out
        worst = held_out and held_out.family.worst
        return -log1p(-min(worst, 0.9)) if worst else 0.0

    def _way_from_calibrated(self, at: NDArray[np.int64]) -> Floats:
        """Latencies of the archs at `at`, one step after the other, (4, n).

        From the nearest arch that the calibration spans to the arch itself, to its resolution, to
        its executor. Widths of stages that only the calibrated block has are moved into its box.
        """
        known = self._boxes()
        stages = min(known, key=lambda count: (abs(count - self.stages), -count))
        resolution = min(
            {timing.resolution for timing in self._timings()},
            key=lambda size: abs(np.log(_pixels(size) / _pixels(self.question.resolution))),
        )
        base = self.executor.base.model
        own = np.unravel_index(at, self.shape)
        nearest = self.space.nearest(stages, known[stages])
        absent = (np.zeros_like(at),) * max(len(nearest) - len(own), 0)
        moved = zip(nearest, (*own, *absent), strict=False)
        inside = tuple(positions[index] for positions, index in moved)
        return np.stack(
            [
                self.totals.latency_ms(base, resolution, stages)[inside],
                self.totals.latency_ms(base, resolution, self.stages)[own],
                self.totals.latency_ms(base, self.question.resolution, self.stages)[own],
                self.latency_ms[own],
            ]
        )

    def _boxes(self) -> dict[int, Box]:
        """What was timed of each stage count."""
        archs = (timing.arch for timing in self._timings())
        by_parts = isinstance(self.executor.base.model, PartModel)
        return part_boxes(archs) if by_parts else boxes(archs)

    def _timings(self) -> tuple[Timing, ...]:
        base = self.executor.base
        points = self.question.profile.points_of(base.runtime, base.precision)
        return tuple(point for point in points if point.arch.family == "rts2net")

    def _resolution_known(self) -> bool:
        sizes = [_pixels(timing.resolution) for timing in self._timings()]
        return min(sizes) <= _pixels(self.question.resolution) <= max(sizes)


def _bound(latency: Floats, position: tuple[int, ...], known_ms: float) -> None:
    """Keeps a block in order with one published network: none that holds it is faster, none that
    it holds is slower. Every axis of a block ascends.
    """
    larger = tuple(slice(at, None) for at in position)
    smaller = tuple(slice(at + 1) for at in position)
    latency[larger] = np.maximum(latency[larger], known_ms)
    latency[smaller] = np.minimum(latency[smaller], known_ms)


def _size(resolution: Resolution) -> Size:
    """The input size: resolutions that are padded to the same one are the same work."""
    return padded(resolution, Arch().multiple)


def _pixels(resolution: Resolution) -> int:
    height, width = _size(resolution)
    return height * width


def _front(
    question: Question, totals: _Totals, executors: list[Executor], found: list[_Columns]
) -> list[Point]:
    """The points that no other beats: not in speed, not in accuracy, and not in evidence.

    Evidence is an objective of its own, so that a promise never hides a measurement.
    """
    latency, metrics, evidence = (
        np.concatenate([getattr(columns, name) for columns in found])
        for name in ("latency_ms", "metrics", "evidence")
    )
    direction = 1 if LOWER_IS_BETTER[question.objective] else -1
    accuracy = direction * metrics[:, METRICS.index(question.objective)]
    if question.at_lower_bound:
        latency = latency * np.exp(np.concatenate([columns.half_width for columns in found]))
    kept = unbeaten(np.column_stack([latency, accuracy]), evidence == EXTRAPOLATED)
    points: list[Point] = []
    start = 0
    for columns in found:
        stop = start + len(columns.position)
        own = np.flatnonzero(kept[start:stop])
        points += _points(question, totals, executors, columns, own)
        start = stop
    return sorted(points, key=lambda point: -point.fps)


def _points(
    question: Question,
    totals: _Totals,
    executors: list[Executor],
    columns: _Columns,
    own: NDArray[np.int64],
) -> Iterator[Point]:
    """The candidates `own` of one block as values."""
    if not len(own):
        return
    stages, space = int(columns.stages[0]), totals.space
    executor = executors[columns.executor[0]]
    weights, macs = (
        quantity(question.resolution, stages).reshape(-1)
        for quantity in (totals.weights, totals.macs)
    )
    for at in own:
        flat = columns.position[at]
        position = np.unravel_index(flat, space.shape(stages))
        latency, half = float(columns.latency_ms[at]), float(columns.half_width[at])
        told = [EVIDENCE[code] for code in columns.evidence[at]]
        known = {
            metric: None if np.isnan(value) else float(value)
            for metric, value in zip(METRICS, columns.metrics[at], strict=True)
        }
        doubt = {metric: float(values[position]) for metric, values in columns.doubt.items()}
        yield Point(
            arch=space.arch(stages, tuple(int(index) for index in position)),
            precision=executor.precision,
            runtime=executor.runtime,
            latency_ms=latency,
            fps=float(f"{1000 / latency:.12g}"),  # a published 60.4 comes back as 60.4
            fps_low=1000 / latency * exp(-half),
            fps_high=1000 / latency * exp(half),
            params=int(weights[flat]),
            size_bytes=int(weights[flat]) * BYTES_PER_WEIGHT[executor.precision],
            macs=int(macs[flat]),
            evidence=PointEvidence(latency=told[0], accuracy=told[1]),
            ranges=_ranges(known, doubt, question.confidence),
            **known,
        )


def _ranges(
    known: dict[Metric, float | None], doubt: dict[Metric, float], confidence: float
) -> dict[Metric, tuple[float, float]] | None:
    """The interval of each metric that is in doubt; None where none is."""
    sure = NormalDist().inv_cdf((1 + confidence) / 2)
    found = {}
    for metric, value in known.items():
        if value is not None and (half := sure * doubt.get(metric, 0.0)):
            ends = unbounded(metric, np.array(value)) + np.array([-half, half])
            low, high = bounded(metric, ends)
            found[metric] = float(low), float(high)
    return found or None
