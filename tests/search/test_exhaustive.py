"""The whole search against a loop that takes candidates one by one, and what it promises."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise, product
from math import exp, log
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from rts2.model.arch import Arch
from rts2.model.errors import UsageError
from rts2.model.files import write_json
from rts2.model.ops import ops, padded
from rts2.profiles.conformal import half_width
from rts2.profiles.latency import LatencyModel, predict_ms
from rts2.profiles.profile import Profile, load
from rts2.search.accuracy import LOWER_IS_BETTER, METRICS, AccuracySource
from rts2.search.exhaustive import (
    EVIDENCE,
    Question,
    _Block,
    _Totals,
    executors_of,
    search,
)
from rts2.search.lowered import Lowered, LoweredRows, Row
from rts2.search.result import Found
from rts2.search.sources import source
from rts2.search.space import Space

BRANCHES = ("disparity", "disparity+semantic", "full")
PUBLISHED = source("published")
SMALL = Space(c=(1, 8, 9), d_max=(11, 12, 13), conv3d=((8, 16), (4, 8), (2, 4)))
"""378 archs; 27 of each stage count have the paper's 3D widths."""
USUAL = Space(conv3d=((16,), (4,), (4,)))
"""Every arch of the paper's 3D widths: what the published tables can say anything of."""


NOTHING = Lowered(LoweredRows(schema="rts2.lowered/1", protocol="a test", rows=()))
"""Nobody has judged anything but fp32 and fp16."""


def loss(c: int, stages: int, level: int) -> float:
    """Points of D1 that a made-up int8 costs where it was judged."""
    return 0.1 * stages + 0.2 * level + (0.3 if c == 1 else 0.0)


LOSSES = Lowered(
    LoweredRows(
        schema="rts2.lowered/1",
        protocol="made up",
        rows=tuple(
            Row(
                arch=Arch(c=c, stages=stages, semantic=True, refinement=level == 2),
                precision="int8",
                d1_all=loss(c, stages, level),
                epe=-0.01,
                miou=-0.5,
                pacc=0.25,
            )
            for c, stages, level in product((1, 8), (1, 2, 3), (1, 2))
        ),
    )
)
"""int8 judged with semantics, at c = 1 and 8: EPE and pixel accuracy got better by chance."""


def question(device: str = "tx2", target_fps: float = 10.0, **others: Any) -> Question:
    return Question(profile=load(device), target_fps=target_fps, **others)


class Executor(NamedTuple):
    runtime: str
    precision: str
    model: LatencyModel
    derived: bool


class Candidate(NamedTuple):
    """What the loop knows of one candidate."""

    arch: Arch
    runtime: str
    precision: str
    latency_ms: float
    half_width: float
    accuracy: tuple[float | None, ...]
    latency_evidence: str
    accuracy_evidence: str

    @property
    def key(self) -> tuple[Arch, str, str]:
        return self.arch, self.runtime, self.precision


def executors(profile: Profile) -> list[Executor]:
    """What the device offers, the refused precisions taken away."""
    (base,) = profile.calibrations
    refused = {s.precision for s in profile.precisions if not s.supported}
    derived = [
        Executor(d.runtime, d.precision, d.scale(base.model), True) for d in profile.derivations
    ]
    every = [Executor(base.runtime, base.precision, base.model, False), *derived]
    return [executor for executor in every if executor.precision not in refused]


def archs(space: Space) -> Iterator[Arch]:
    for stages in space.stages:
        for level, c, d_max, *widths in product(
            range(3), space.c, space.d_max, *space.conv3d[:stages]
        ):
            yield Arch(
                c=c,
                stages=stages,
                d_max=d_max,
                conv3d=tuple(widths),
                semantic=level > 0,
                refinement=level > 1,
            )


def dimensions(arch: Arch) -> tuple[int, ...]:
    return (arch.c, BRANCHES.index(arch.branches), arch.d_max, *arch.conv3d)


@cache
def weights(arch: Arch) -> int:
    return sum(op.weights for op in ops(arch, (64, 64)))


@cache
def accuracy(arch: Arch, known: AccuracySource) -> tuple[tuple[float | None, ...], bool, bool]:
    """Metrics, exact, extrapolated: the columns for a space of this one arch."""
    alone = around(arch)
    columns = known.columns(alone, arch.stages)
    at = (BRANCHES.index(arch.branches),) + (0,) * (len(alone.shape(arch.stages)) - 1)

    def value(array: Any) -> Any:
        return np.broadcast_to(array, alone.shape(arch.stages))[at]

    numbers = (float(value(columns.metrics[metric])) for metric in METRICS)
    found = tuple(None if np.isnan(number) else number for number in numbers)
    return found, bool(value(columns.exact)), bool(value(columns.extrapolated))


def around(arch: Arch) -> Space:
    """The three variants of `arch` and nothing else."""
    widths = (*arch.conv3d, 16, 4, 4)[:3]
    return Space((arch.c,), (arch.stages,), (arch.d_max,), tuple((width,) for width in widths))


@dataclass(frozen=True)
class Loop:
    """The search written down again, one candidate after the other."""

    asked: Question
    source: AccuracySource = PUBLISHED
    space: Space = SMALL

    def candidates(self) -> tuple[list[Candidate], Counter[str]]:
        """Those that may enter the front, and how many were left out for which reason."""
        eligible, left_out = [], Counter[str]()
        for arch in archs(self.space):
            for executor in executors(self.asked.profile):
                known, exact, extrapolated = accuracy(arch, self.source)
                if executor.precision == "int8":
                    known, extrapolated = self.in_integers(arch, known, extrapolated)
                reason = self.reason(arch, executor, known)
                if reason:
                    left_out[reason] += 1
                    continue
                evidence = "extrapolated" if extrapolated else "interpolated"
                if exact and not extrapolated and executor.precision == "fp32":
                    evidence = self.source.exact_evidence
                latency, half, timed = self.latency(arch, executor)
                names = (executor.runtime, executor.precision)
                eligible.append(Candidate(arch, *names, latency, half, known, timed, evidence))
        return eligible, left_out

    def in_integers(
        self, arch: Arch, known: tuple[float | None, ...], extrapolated: bool
    ) -> tuple[tuple[float | None, ...], bool]:
        """What was known in fp32, and what int8 costs: between c = 1 and 8, linear in log2(c)."""
        level = BRANCHES.index(arch.branches)
        if not level:
            return (None,) * len(known), True
        low, high = (loss(c, arch.stages, level) for c in (1, 8))
        share = min(log(arch.c) / log(8), 1.0)
        changes = {"d1_all": low + share * (high - low), "epe": 0.0, "miou": -0.5, "pacc": 0.0}
        found = tuple(
            None if value is None else value + changes[metric]
            for metric, value in zip(METRICS, known, strict=True)
        )
        return found, extrapolated or not 1 <= arch.c <= 8

    def reason(self, arch: Arch, executor: Executor, known: tuple[float | None, ...]) -> str | None:
        asked = self.asked
        size = weights(arch) * {"fp32": 4, "fp16": 2, "int8": 1}[executor.precision]
        if asked.task == "semantic-stereo" and not arch.semantic:
            return "no semantic branch"
        if 16 * arch.d_max < asked.min_disparity:
            return "d_max"
        if size > asked.max_size_bytes:
            return "--max-size-mb"
        if known[METRICS.index(asked.objective)] is None:
            usual = arch.conv3d == (16, 4, 4)[: arch.stages]
            return "stages and branches" if usual else "3D widths"
        return None

    def latency(self, arch: Arch, executor: Executor) -> tuple[float, float, str]:
        """Milliseconds, half width of the interval, evidence."""
        asked, points = self.asked, self.asked.profile.points
        size = padded(asked.resolution, 32)
        predicted = predict_ms(executor.model, arch, asked.resolution)
        sure = half_width(asked.profile.calibrations[0].residuals, asked.confidence)
        known = [dimensions(point.arch) for point in points if point.arch.stages == arch.stages]
        same_size = all(padded(point.resolution, 32) == size for point in points)
        bounded = predicted
        if not executor.derived and same_size and known:
            for point in points:
                if point.arch == arch:
                    return point.latency_ms, sure, point.evidence
            bounded = self.in_order(arch, predicted)
            columns = list(zip(*known, strict=True))
            if all(min(c) <= v <= max(c) for v, c in zip(dimensions(arch), columns, strict=True)):
                return bounded, sure, "interpolated"
        (base,) = asked.profile.calibrations
        way = [
            self.anchor_ms(arch),
            predict_ms(base.model, arch, points[0].resolution),
            predict_ms(base.model, arch, asked.resolution),
            predicted,
        ]
        doubt = 0.5 * sum(abs(log(after / before)) for before, after in pairwise(way))
        held_out = asked.profile.calibrations[0].held_out
        assert held_out is not None
        worst = held_out.family.worst or 0.0
        return bounded, sure + max(doubt, sure, -log(1 - worst) - sure), "extrapolated"

    def in_order(self, arch: Arch, predicted: float) -> float:
        """Between the published networks that `arch` holds and those that hold it."""
        for point in self.asked.profile.points:
            if point.arch.stages != arch.stages:
                continue
            pairs = list(zip(dimensions(arch), dimensions(point.arch), strict=True))
            if all(own >= known for own, known in pairs):
                predicted = max(predicted, point.latency_ms)
            if all(own <= known for own, known in pairs):
                predicted = min(predicted, point.latency_ms)
        return predicted

    def anchor_ms(self, arch: Arch) -> float:
        """The prediction for the nearest arch among those that the points span, where they are."""
        points = self.asked.profile.points
        counts = sorted({point.arch.stages for point in points}, reverse=True)
        stages = min(counts, key=lambda count: abs(count - arch.stages))
        known = [dimensions(point.arch) for point in points if point.arch.stages == stages]
        wanted = (*dimensions(arch), *(widths[0] for widths in self.space.conv3d[arch.stages :]))
        c, level, d_max, *widths = (
            min(max(value, min(column)), max(column))
            for value, column in zip(wanted, zip(*known, strict=True), strict=False)
        )
        nearest = Arch(
            c=c,
            stages=stages,
            d_max=d_max,
            conv3d=tuple(widths),
            semantic=level > 0,
            refinement=level > 1,
        )
        (base,) = self.asked.profile.calibrations
        return predict_ms(base.model, nearest, points[0].resolution)

    def front(self, candidates: list[Candidate]) -> list[Candidate]:
        """Those that no other beats in speed, accuracy and both evidences; of equals the first."""
        at, sign = METRICS.index(self.asked.objective), 1
        if not LOWER_IS_BETTER[self.asked.objective]:
            sign = -1

        def costs(one: Candidate) -> tuple[float, ...]:
            accuracy = one.accuracy[at]
            assert accuracy is not None
            told = (one.latency_evidence, one.accuracy_evidence)
            return (one.latency_ms, sign * accuracy, *(1.0 * (e == "extrapolated") for e in told))

        rows = np.array([costs(one) for one in candidates])
        kept = []
        for index, row in enumerate(rows):
            no_worse = (rows <= row).all(1)
            better = no_worse & (rows < row).any(1)
            equal = no_worse & ~better
            if not better.any() and np.flatnonzero(equal)[0] == index:
                kept.append(candidates[index])
        return kept


QUESTIONS = {
    "tx2": question(),
    "tx2, stereo": question(task="stereo"),
    "tx2, sized and blind": question(task="stereo", max_size_bytes=4e5, min_disparity=190),
    "tx2, epe": question(objective="epe", target_fps=6),
    "tx2, miou": question(objective="miou", target_fps=6),
    "tx2, another resolution": question(resolution=(640, 480), confidence=0.7),
    "tx2, fp16": question(precisions=("fp16",)),
    "rtx2080ti": question("rtx2080ti", 60),
    "rtx2080ti, stereo on tensorrt": question(
        "rtx2080ti", 60, task="stereo", runtimes=("tensorrt",)
    ),
}


@cache
def found_by_loop(name: str) -> tuple[list[Candidate], Counter[str]]:
    return Loop(QUESTIONS[name]).candidates()


@pytest.mark.parametrize("name", QUESTIONS)
def test_the_search_is_the_loop(name: str) -> None:
    asked = QUESTIONS[name]
    candidates, left_out = found_by_loop(name)
    chosen = [
        one
        for one in candidates
        if (not asked.precisions or one.precision in asked.precisions)
        and (not asked.runtimes or one.runtime in asked.runtimes)
    ]
    expected = {one.key: one for one in Loop(asked).front(chosen)}
    found = search(asked, PUBLISHED, SMALL, LOSSES)
    assert {(p.arch, p.runtime, p.precision) for p in found.front} == expected.keys()
    assert len(found.front) == len(expected)
    for point in found.front:
        same = expected[point.arch, point.runtime, point.precision]
        assert point.evidence.latency == same.latency_evidence
        assert point.evidence.accuracy == same.accuracy_evidence
        assert point.latency_ms == pytest.approx(same.latency_ms, rel=1e-9)
        assert point.fps == pytest.approx(1000 / same.latency_ms, rel=1e-9)
        assert point.fps_low == pytest.approx(point.fps * exp(-same.half_width), rel=1e-9)
        assert point.fps_high == pytest.approx(point.fps * exp(same.half_width), rel=1e-9)
        assert tuple(point.metric(metric) for metric in METRICS) == pytest.approx(same.accuracy)
    if not asked.precisions and not asked.runtimes:
        assert_counted(found, len(candidates), left_out)


def assert_counted(found: Found, eligible: int, left_out: Counter[str]) -> None:
    """Every candidate is eligible or left out, once, under the loop's reason."""
    assert sum(left_out.values()) + eligible == found.space.size == found.space.evaluated
    assert found.space.exhaustive
    counted = Counter[str]()
    for entry in found.left_out:
        (key,) = (reason for reason in left_out if reason in entry.reason)
        counted[key] += entry.count
    assert counted == left_out
    counts = [entry.count for entry in found.left_out]
    assert counts == sorted(counts, reverse=True)


@pytest.mark.parametrize("name", QUESTIONS)
def test_the_front_falls_in_frames_per_second(name: str) -> None:
    found = search(QUESTIONS[name], PUBLISHED, SMALL)
    assert all(a.fps >= b.fps for a, b in pairwise(found.front))


@pytest.mark.parametrize("name", QUESTIONS)
def test_sizes_and_multiply_adds_of_the_front_are_those_of_its_networks(name: str) -> None:
    asked = QUESTIONS[name]
    for point in search(asked, PUBLISHED, SMALL).front[::5]:
        steps = ops(point.arch, asked.resolution)
        assert point.params == sum(op.weights for op in steps)
        assert point.macs == sum(op.macs for op in steps)
        assert point.size_bytes == point.params * {"fp32": 4, "fp16": 2}[point.precision]


@pytest.mark.parametrize("at_lower_bound", [False, True])
@pytest.mark.parametrize("name", ["tx2, stereo", "tx2, epe", "tx2, miou", "rtx2080ti"])
def test_pick_and_prospect_are_the_best_of_all_candidates(name: str, at_lower_bound: bool) -> None:
    """Not of the front alone: what the front dropped could not have been chosen either."""
    asked = replace(QUESTIONS[name], at_lower_bound=at_lower_bound)
    candidates = found_by_loop(name)[0]
    at, sign = METRICS.index(asked.objective), -1 if asked.objective == "miou" else 1
    rates = [1000 / one.latency_ms for one in candidates]
    for target in np.geomspace(min(rates), max(rates), 12) * (1 - 1e-6):
        meeting = [
            one
            for one in candidates
            if 1000 / one.latency_ms * exp(-one.half_width * at_lower_bound) >= target
        ]
        known = [one for one in meeting if one.accuracy_evidence != "extrapolated"]
        proven = [one for one in known if one.latency_evidence != "extrapolated"]
        found = search(replace(asked, target_fps=target), PUBLISHED, SMALL)
        for point, admitted in ((found.selected, proven), (found.prospect, known or meeting)):
            value = None if point is None else sign * (point.metric(asked.objective) or 0.0)
            best = min((sign * (one.accuracy[at] or 0.0) for one in admitted), default=None)
            assert value == pytest.approx(best)


@pytest.fixture(scope="module")
def tx2() -> Found:
    """The whole search that the README shows."""
    return search(question(), PUBLISHED)


def test_ten_frames_a_second_on_a_tx2(tx2: Found) -> None:
    assert tx2.selected is not None
    assert tx2.selected.arch.semantic
    assert tx2.selected.fps >= 10
    assert tx2.selected.d1_all is not None
    assert tx2.selected.d1_all <= 4.70
    assert "extrapolated" not in tx2.selected.evidence.model_dump().values()
    assert tx2.selected.precision == "fp32"
    assert tx2.nearest is None


def test_the_prospect_on_a_tx2_is_half_precision_with_an_interval(tx2: Found) -> None:
    assert tx2.prospect is not None
    assert tx2.selected is not None
    assert tx2.prospect.precision == "fp16"
    assert tx2.prospect.evidence.latency == "extrapolated"
    assert tx2.prospect.evidence.accuracy != "extrapolated"
    assert tx2.prospect.fps >= 10
    assert tx2.prospect.fps_low < tx2.prospect.fps < tx2.prospect.fps_high
    assert tx2.prospect.d1_all is not None
    assert tx2.prospect.d1_all < (tx2.selected.d1_all or 0)


def test_a_network_without_semantics_may_answer_stereo_alone(tx2: Found) -> None:
    stereo = search(question(task="stereo"), PUBLISHED, USUAL)
    assert any(point.arch.branches == "disparity" for point in stereo.front)
    assert not any(point.arch.branches == "disparity" for point in tx2.front)
    for target in (5, 8, 10, 15, 20, 27):
        plain, semantic = (
            search(question(target_fps=target, task=task), PUBLISHED, USUAL).selected
            for task in ("stereo", "semantic-stereo")
        )
        assert plain is not None
        assert semantic is not None
        assert (plain.d1_all or 0) <= (semantic.d1_all or 0)


def test_nothing_of_the_whole_space_beats_the_front(tx2: Found) -> None:
    """Two hundred random candidates: each is matched by a point no worse in any objective."""
    random = np.random.default_rng(5)
    loop = Loop(question(), space=Space())
    offered = executors(loop.asked.profile)
    for _ in range(200):
        stages = int(random.integers(1, 4))
        arch = Arch(
            c=int(random.integers(1, 33)),
            stages=stages,
            d_max=int(random.choice([6, 8, 11, 12, 12, 12, 13, 24])),
            refinement=bool(random.integers(2)),
        )
        executor = offered[int(random.integers(len(offered)))]
        known, _, guessed = accuracy(arch, PUBLISHED)
        latency, _, timed = loop.latency(arch, executor)
        assert any(
            point.latency_ms <= latency * (1 + 1e-9)
            and (point.d1_all or 0) <= (known[0] or 0) + 1e-9
            and (point.evidence.latency == "extrapolated") <= (timed == "extrapolated")
            and (point.evidence.accuracy == "extrapolated") <= guessed
            for point in tx2.front
        )


@pytest.mark.parametrize(("device", "least"), [("tx2", 10), ("rtx2080ti", 5)])
def test_published_networks_are_published_and_carry_their_frame_rates(
    device: str, least: int
) -> None:
    rates = {timing.arch: timing.fps for timing in load(device).points}
    seen = set()
    for asked in (question(device), question(device, task="stereo")):
        for point in search(asked, PUBLISHED, USUAL).front:
            if (point.runtime, point.precision) != ("pytorch", "fp32"):
                assert point.evidence.latency == "extrapolated"
            elif point.arch in rates:
                assert point.fps == rates[point.arch]
                assert set(point.evidence.model_dump().values()) == {"published"}
                seen.add(point.arch)
            else:
                assert point.evidence.latency != "published"
    assert len(seen) >= least


@pytest.mark.parametrize("device", ["tx2", "rtx2080ti"])
def test_a_published_frame_rate_as_the_target_is_met_by_its_network(device: str) -> None:
    """No rounding on the way from frames to milliseconds and back loses it."""
    profile = load(device)
    for timing in profile.points:
        asked = Question(profile, timing.fps, task="stereo", runtimes=("pytorch",))
        found = search(asked, PUBLISHED, around(timing.arch)).selected
        assert found is not None, f"{timing.fps} FPS of {timing.arch.label()}"
        assert found.fps >= timing.fps
        (published, *_), _, _ = accuracy(timing.arch, PUBLISHED)
        assert (found.d1_all or 0) <= (published or 0)


@pytest.mark.parametrize("device", ["tx2", "rtx2080ti"])
def test_intervals_hold_the_nominal_and_are_wider_where_extrapolated(device: str) -> None:
    found = search(question(device, task="stereo"), PUBLISHED, USUAL)
    sure = half_width(load(device).calibrations[0].residuals, 0.9)
    kinds = set()
    for point in found.front:
        assert point.fps_low < point.fps < point.fps_high
        assert point.fps_high / point.fps == pytest.approx(point.fps / point.fps_low)
        width = log(point.fps_high / point.fps)
        if point.evidence.latency == "extrapolated":
            assert width > sure * (1 + 1e-9)
        else:
            assert width == pytest.approx(sure)
        kinds.add(point.evidence.latency)
    assert kinds == {"published", "interpolated", "extrapolated"}


@pytest.mark.parametrize("device", ["tx2", "rtx2080ti"])
def test_a_runtime_that_nobody_timed_is_never_as_sure_as_one_that_was(device: str) -> None:
    """Even where the promise is the very latency of the runtime that it derives from."""
    asked = question(device, precisions=("fp16",))
    sure = half_width(load(device).calibrations[0].residuals, 0.9)
    for point in search(asked, PUBLISHED, SMALL).front:
        assert log(point.fps_high / point.fps) > sure * (1 + 1e-9)


def test_a_higher_confidence_asks_for_wider_intervals() -> None:
    ends = []
    for confidence in (0.5, 0.7, 0.9):
        (first, *_) = search(question(confidence=confidence), PUBLISHED, SMALL).front
        ends.append(first.fps_low / first.fps)
    assert ends[0] > ends[1] > ends[2]


def test_at_the_lower_bound_the_pick_holds_the_target_there() -> None:
    sure = search(question(target_fps=10.5, at_lower_bound=True), PUBLISHED, USUAL).selected
    bold = search(question(target_fps=10.5), PUBLISHED, USUAL).selected
    assert sure is not None
    assert bold is not None
    assert bold.fps >= 10.5 > bold.fps_low
    assert sure.fps_low >= 10.5
    assert (sure.d1_all or 0) > (bold.d1_all or 0)


def test_a_confidence_that_cannot_be_given_is_refused() -> None:
    """Fifteen points bound nothing above 15/16, eleven nothing above 11/12."""
    assert search(question(confidence=15 / 16), PUBLISHED, SMALL).front
    with pytest.raises(UsageError, match="15 calibration points"):
        search(question(confidence=0.94), PUBLISHED, SMALL)
    with pytest.raises(UsageError, match="11 calibration points"):
        search(question("rtx2080ti", confidence=0.92), PUBLISHED, SMALL)


def test_a_resolution_padded_to_the_same_size_is_the_same_work(tx2: Found) -> None:
    for resolution in ((1248, 384), (1217, 353)):
        same = search(question(resolution=resolution), PUBLISHED)
        assert same.resolution == resolution
        assert (same.front, same.selected, same.prospect) == (tx2.front, tx2.selected, tx2.prospect)


@pytest.mark.parametrize("resolution", [(1249, 384), (1216, 384), (640, 480), (1242, 385)])
def test_another_resolution_is_extrapolated(resolution: tuple[int, int]) -> None:
    found = search(question(resolution=resolution, target_fps=5), PUBLISHED, USUAL)
    assert {point.evidence.latency for point in found.front} == {"extrapolated"}
    assert found.selected is None
    assert found.prospect is not None
    assert found.nearest is not None
    allowed = search(
        question(resolution=resolution, target_fps=5, allow_extrapolated=True), PUBLISHED, USUAL
    )
    assert allowed.selected is not None
    assert allowed.selected.fps >= 5
    assert allowed.nearest is None


def test_timings_at_two_resolutions_span_what_lies_between() -> None:
    """A timing is carried to its own size alone; between the two sizes the model interpolates."""
    profile = load("tx2")
    (base,) = profile.calibrations
    timed = profile.points[-1]
    smaller = timed.model_copy(
        update={"resolution": (640, 320), "fps": 21.5, "evidence": "measured"}
    )
    both = profile.model_copy(
        update={
            "points": (*profile.points, smaller),
            "calibrations": (base.model_copy(update={"residuals": (*base.residuals, 0.01)}),),
        }
    )

    def told(resolution: tuple[int, int]) -> tuple[float, str]:
        asked = Question(both, 1, resolution, precisions=("fp32",), runtimes=("pytorch",))
        (found,) = (
            point
            for point in search(asked, PUBLISHED, around(timed.arch)).front
            if point.arch == timed.arch
        )
        return found.fps, found.evidence.latency

    assert timed.arch == Arch(c=8, stages=2)
    assert told((1242, 375)) == (10.9, "published")
    assert told((640, 320)) == (21.5, "measured")
    between, outside = (960, 352), (320, 320)
    for resolution, evidence in ((between, "interpolated"), (outside, "extrapolated")):
        fps, found = told(resolution)
        assert found == evidence
        assert fps == pytest.approx(1000 / predict_ms(base.model, timed.arch, resolution))


@pytest.mark.parametrize("resolution", [(1242, 375), (960, 288)])
def test_a_profile_by_parts_gives_every_network_of_a_block_its_latency(
    by_parts: Profile, resolution: tuple[int, int]
) -> None:
    """At a size that was timed, and between the two: one by one as the tables say, and the ends
    of the space as they were timed.
    """
    space = Space(c=(1, 8, 32), d_max=(6, 12, 24), conv3d=((4, 16, 32), (2, 4, 16), (2, 4, 16)))
    timed = {(p.arch, p.resolution): p.latency_ms for p in by_parts.points}
    assert {arch for arch, _ in timed} <= set(archs(space))
    model = by_parts.calibrations[0].model
    asked = Question(by_parts, 1, resolution, task="stereo")
    (executor,) = executors_of(asked)
    totals = _Totals(space)
    for stages in space.stages:
        block = _Block(
            space, asked, executor, PUBLISHED.columns(space, stages), True, totals, stages
        )
        latency, evidence = block._latency()
        for arch in (arch for arch in archs(space) if arch.stages == stages):
            position = space.position(arch)
            assert position is not None
            expected = timed.get((arch, resolution), predict_ms(model, arch, resolution))
            assert latency[position] == pytest.approx(expected, rel=1e-9)
            told = "measured" if (arch, resolution) in timed else "interpolated"
            assert EVIDENCE[evidence[position]] == told


def test_a_search_by_parts_is_as_sure_as_its_residuals(by_parts: Profile) -> None:
    """Of 26 residuals the 90% interval is the 25th smallest: 23%."""
    known = by_parts.calibrations[0].residuals
    assert len(known) == 26
    found = search(Question(by_parts, 1), PUBLISHED, USUAL)
    assert {point.evidence.latency for point in found.front} == {"measured", "interpolated"}
    for point in found.front:
        assert log(point.fps_high / point.fps) == pytest.approx(0.23)
        assert log(point.fps / point.fps_low) == pytest.approx(0.23)


def test_runtimes_and_precisions_of_one_profile_compete(two_runtimes: Profile) -> None:
    """All are candidates; of bf16 no accuracy is known. The front of both is what remains of the
    fronts of each.
    """
    found = search(Question(two_runtimes, 1), PUBLISHED, USUAL, NOTHING)
    assert found.space.size == 3 * USUAL.size()
    assert {(p.runtime, p.precision) for p in found.front} == {
        ("onnxruntime", "fp32"),
        ("openvino", "fp32"),
    }
    left_out = {entry.reason: entry.count for entry in found.left_out}
    assert left_out["no d1_all is known in bf16"] == 2 / 3 * USUAL.size()  # the third is semantic
    asked = [Question(two_runtimes, 1, runtimes=(r,)) for r in ("onnxruntime", "openvino")]
    alone = [point for one in asked for point in search(one, PUBLISHED, USUAL, NOTHING).front]
    assert set(map(repr, found.front)) <= set(map(repr, alone))
    for point in alone:
        beaten = [p for p in found.front if p.fps >= point.fps and p.d1_all <= point.d1_all]
        assert beaten, point


def test_each_runtime_predicts_with_its_own_tables(two_runtimes: Profile) -> None:
    models = {(c.runtime, c.precision): c.model for c in two_runtimes.calibrations}
    for point in search(Question(two_runtimes, 1, (960, 288)), PUBLISHED, USUAL).front:
        expected = predict_ms(models[point.runtime, point.precision], point.arch, (960, 288))
        assert point.latency_ms == pytest.approx(expected)


def test_a_precision_of_one_runtime_alone_is_asked_for(two_runtimes: Profile) -> None:
    only = executors_of(Question(two_runtimes, 1, precisions=("bf16",)))
    assert [(e.runtime, e.precision) for e in only] == [("openvino", "bf16")]
    with pytest.raises(UsageError, match="has no latency for that choice; it has fp32 on onnx"):
        search(
            Question(two_runtimes, 1, precisions=("bf16",), runtimes=("onnxruntime",)),
            PUBLISHED,
            USUAL,
        )
    with pytest.raises(UsageError, match="does not run fp16: ONNX Runtime computes FP16 through"):
        search(Question(two_runtimes, 1, precisions=("fp16",)), PUBLISHED, USUAL)


def test_int8_is_refused_on_the_tx2_and_says_why() -> None:
    with pytest.raises(UsageError, match=r"Jetson TX2 does not run int8: .*DP4A.*fp16"):
        search(question(precisions=("int8",)), PUBLISHED, SMALL)
    with pytest.raises(UsageError, match="int8"):
        search(question(precisions=("fp16", "int8")), PUBLISHED, SMALL)


def test_a_runtime_that_the_device_lacks_is_refused_with_what_it_has() -> None:
    with pytest.raises(UsageError, match=r"Jetson TX2 .* it has fp32 on pytorch") as refusal:
        search(question(runtimes=("openvino",)), PUBLISHED, SMALL)
    assert "int8" not in str(refusal.value)


def test_a_precision_that_nobody_judged_is_left_out() -> None:
    found = search(question("rtx2080ti", precisions=("int8",)), PUBLISHED, SMALL, NOTHING)
    assert found.front == ()
    assert (found.selected, found.prospect, found.nearest) == (None, None, None)
    assert sum(entry.count for entry in found.left_out) == found.space.size == 378
    assert any("in int8" in entry.reason for entry in found.left_out)


@pytest.mark.parametrize("choice", [{"precisions": ("fp16",)}, {"runtimes": ("tensorrt",)}])
def test_a_choice_narrows_the_space(choice: dict[str, Any]) -> None:
    found = search(question(**choice), PUBLISHED, SMALL)
    assert found.space.size == 2 * SMALL.size()
    assert found.selected is None
    assert found.prospect is not None
    assert {point.precision for point in found.front} <= {"fp16", "fp32"}


def test_geometry_removes_volumes_that_are_too_small() -> None:
    """A first volume of n planes sees 16·n pixels."""
    for least, smallest in ((176, 11), (176.1, 12), (192, 12), (192.5, 13)):
        found = search(question(min_disparity=least, task="stereo"), PUBLISHED, SMALL)
        assert {point.arch.d_max for point in found.front} <= set(range(smallest, 14))
        blind = [entry for entry in found.left_out if "d_max" in entry.reason]
        removed = sum(16 * d_max < least for d_max in SMALL.d_max) / len(SMALL.d_max)
        assert sum(entry.count for entry in blind) == removed * found.space.size
    none = search(question(min_disparity=1000), PUBLISHED, SMALL)
    assert none.front == ()
    assert none.nearest is None


def test_a_bound_on_the_size_removes_what_is_larger() -> None:
    bound = 300_000
    found = search(question(max_size_bytes=bound, task="stereo"), PUBLISHED, SMALL)
    assert max(point.size_bytes for point in found.front) <= bound
    unbound = search(question(task="stereo"), PUBLISHED, SMALL)
    assert max(point.size_bytes for point in unbound.front) > bound
    exact = max(point.size_bytes for point in found.front)
    again = search(question(max_size_bytes=exact, task="stereo"), PUBLISHED, SMALL)
    assert max(point.size_bytes for point in again.front) == exact


@pytest.mark.parametrize(("objective", "target"), [("miou", 4.5), ("epe", 4.5)])
def test_other_objectives_pick_by_their_own_direction(objective: str, target: float) -> None:
    """At 4.5 frames a second the paper's c=16 is the best that is known in either."""
    found = search(question(objective=objective, target_fps=target), PUBLISHED, USUAL)
    assert found.selected is not None
    assert found.selected.arch == Arch(c=16)
    assert (found.selected.miou, found.selected.epe) == (67.41, 0.78)
    values = [point.metric(found.objective) for point in found.front if point.proven]
    assert None not in values
    assert values == sorted(values, reverse=objective == "epe")


def test_an_impossible_target_names_the_fastest() -> None:
    found = search(question(target_fps=1000), PUBLISHED, USUAL)
    proven = [point for point in found.front if point.proven]
    assert (found.selected, found.prospect) == (None, None)
    assert found.nearest == max(proven, key=lambda point: point.fps)


def test_with_extrapolation_allowed_the_fastest_is_the_fastest_of_all() -> None:
    found = search(question(target_fps=1000, allow_extrapolated=True), PUBLISHED, USUAL)
    assert found.selected is None
    assert found.nearest == max(found.front, key=lambda point: point.fps)


@pytest.mark.parametrize("target", [5.0, 10.0, 25.0, 45.0, 55.0])
def test_with_extrapolation_allowed_the_prospect_becomes_the_pick(target: float) -> None:
    """That is what the table and the error promise of --allow-extrapolated."""
    careful = search(question(target_fps=target), PUBLISHED, USUAL)
    allowed = search(question(target_fps=target, allow_extrapolated=True), PUBLISHED, USUAL)
    assert careful.prospect is not None
    assert allowed.selected == allowed.prospect == careful.prospect


def measurements(folder: Path, *rows: dict[str, Any]) -> AccuracySource:
    write_json(folder / "accuracy.json", {"schema": "rts2.accuracy/1", "rows": rows})
    return source(str(folder / "accuracy.json"))


def test_measured_accuracies_bring_other_3d_widths(tmp_path: Path) -> None:
    """A narrow network that was measured is known; its latency stays a promise there."""
    narrow = {"c": 8, "stages": 2, "conv3d": [8, 4]}
    usual = {"c": 8, "stages": 2}
    known = measurements(tmp_path, {"arch": narrow, "d1_all": 4.6}, {"arch": usual, "d1_all": 4.7})
    found = search(question(), known, SMALL)
    assert found.selected is not None
    assert found.selected.arch == Arch(**usual)
    assert found.selected.evidence.accuracy == "measured"
    assert found.selected.fps == 10.9
    assert found.prospect is not None
    assert found.prospect.arch == Arch(**narrow)
    assert found.prospect.evidence.latency == "extrapolated"
    eligible = found.space.size - sum(entry.count for entry in found.left_out)
    assert eligible == 2 * 4
    candidates, left_out = Loop(question(), known).candidates()
    assert_counted(found, len(candidates), left_out)


def test_a_measured_network_outside_of_the_space_is_not_dropped_in_silence(tmp_path: Path) -> None:
    """The user named it; the search must take it or say that it does not."""
    known = measurements(tmp_path, {"arch": {"c": 40}, "d1_all": 2.5})
    with pytest.raises(UsageError, match="c=40"):
        search(question(), known, SMALL)


def test_timings_of_another_family_do_not_widen_what_is_known() -> None:
    """A wide AnyNet on the board says nothing of RTS²Net at that width."""
    profile = load("tx2")
    (base,) = profile.calibrations
    foreign = profile.points[0].model_copy(update={"arch": Arch(family="anynet", c=32, stages=1)})
    wider = profile.model_copy(
        update={
            "points": (*profile.points, foreign),
            "calibrations": (base.model_copy(update={"residuals": (*base.residuals, 0.0)}),),
        }
    )
    space = Space(c=(16,), stages=(1,), d_max=(12,), conv3d=((16,), (4,), (4,)))
    for known in (profile, wider):
        asked = Question(known, 1, task="stereo", runtimes=("pytorch",), precisions=("fp32",))
        found = search(asked, PUBLISHED, space)
        assert {point.evidence.latency for point in found.front} == {"extrapolated"}
