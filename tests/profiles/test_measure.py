"""Which networks are timed, what is kept of the timings, and the profile that comes of them."""

import json
import random
from collections.abc import Iterator
from datetime import date
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rts2.model.arch import SPACE_C, SPACE_CONV3D, SPACE_D_MAX, UNTRAINED, Arch
from rts2.model.checkpoint import build
from rts2.model.errors import Rts2Error
from rts2.model.export import export
from rts2.profiles.latency import predict_ms
from rts2.profiles.measure import (
    RESOLUTIONS,
    Bench,
    Candidate,
    Journal,
    Sample,
    candidates,
    corners,
    extend,
    open_journal,
    profile_of,
    random_candidate,
    this_machine,
)
from rts2.profiles.profile import Profile, Resolution, load
from rts2.profiles.timing import Timing
from rts2.search.space import Space

TRUTH = load("cpu").calibration("onnxruntime", "fp32").model
REFERENCE_MS = 10.0


class Planted(Bench):
    """A machine that takes exactly what a latency model says, times the drift of the moment."""

    def __init__(self) -> None:
        self.drift = 1.0

    def time(self, arch: Arch, resolution: Resolution) -> Timing:
        latency_ms = predict_ms(TRUTH, arch, resolution) * self.drift
        return Timing(latency_ms, 1.1 * latency_ms, 10, REFERENCE_MS * self.drift)


def journal_of(timed: Iterator[Candidate], drifts: list[float]) -> Journal:
    """A journal in which sample k was timed while the machine was `drifts[k]` times slower."""
    samples = [
        Sample(
            arch=arch,
            resolution=resolution,
            latency_ms=predict_ms(TRUTH, arch, resolution) * drift,
            reference_ms=REFERENCE_MS * drift,
        )
        for (arch, resolution), drift in zip(timed, drifts, strict=False)
    ]
    return Journal(machine=this_machine(2), seed=0, samples=tuple(samples))


def numbers(candidate: Candidate) -> tuple[float, ...]:
    arch, (width, height) = candidate
    branches = arch.semantic + arch.refinement
    return (arch.stages, arch.c, arch.d_max, branches, width, height)


def test_corners_hold_both_ends_of_every_dimension() -> None:
    found = corners()
    assert len(found) == len(set(found)) == len(RESOLUTIONS) * 3 * 2 * 2
    low = (1, SPACE_C[0], SPACE_D_MAX[0], 0, 640, 192)
    high = (3, SPACE_C[-1], SPACE_D_MAX[-1], 2, 1242, 375)
    table = np.array([numbers(candidate) for candidate in found])
    assert tuple(table.min(0)) == low
    assert tuple(table.max(0)) == high
    assert set(table[:, 0]) == {1, 2, 3}
    for column in (1, 2, 3, 4, 5):
        assert set(table[:, column]) == {low[column], high[column]}


def test_corners_are_in_the_space_and_have_all_widths_at_one_end() -> None:
    for arch, _ in corners():
        assert Space().position(arch) is not None
        ends = [
            (width == values[0], width == values[-1])
            for width, values in zip(arch.conv3d, SPACE_CONV3D, strict=False)
        ]
        assert len(set(ends)) == 1
        assert any(ends[0])


@given(st.integers(0, 2**32))
def test_a_random_candidate_lies_in_the_searched_space(seed: int) -> None:
    arch, resolution = random_candidate(random.Random(seed))
    assert Space().position(arch) is not None
    assert resolution in RESOLUTIONS


def test_random_candidates_reach_every_value_of_every_dimension() -> None:
    """By chance alone one of 2000 draws misses one of 32 values once in 10²⁶ runs."""
    chance = random.Random(0)
    drawn = [random_candidate(chance) for _ in range(2000)]
    assert {arch.c for arch, _ in drawn} == set(SPACE_C)
    assert {arch.d_max for arch, _ in drawn} == set(SPACE_D_MAX)
    assert {arch.branches for arch, _ in drawn} == {"disparity", "disparity+semantic", "full"}
    assert {resolution for _, resolution in drawn} == set(RESOLUTIONS)
    for stage, values in enumerate(SPACE_CONV3D):
        widths = {arch.conv3d[stage] for arch, _ in drawn if arch.stages > stage}
        assert widths == set(values)


def test_candidates_are_the_corners_first_and_the_same_for_the_same_seed() -> None:
    first = list(islice(candidates(0), 80))
    assert set(first[: len(corners())]) == set(corners())
    assert first == list(islice(candidates(0), 80))


def test_another_seed_draws_another_stream() -> None:
    count = len(corners())
    streams = [tuple(islice(candidates(seed), count + 50)) for seed in range(6)]
    assert len({stream[:count] for stream in streams}) == 6
    assert len({stream[count:] for stream in streams}) == 6


def test_a_journal_grows_by_one_sample_a_time_and_is_found_again(tmp_path: Path) -> None:
    path = tmp_path / "x.timings.json"
    journal = open_journal(path, 2, 0)
    assert journal.samples == ()
    assert not path.exists()
    bench = Planted()
    for count, candidate in enumerate(islice(candidates(0), 3), 1):
        journal = extend(journal, path, bench, candidate)
        assert open_journal(path, 2, 0) == journal
        assert len(journal.samples) == count
        last = journal.samples[-1]
        assert (last.arch, last.resolution) == candidate
        assert last.latency_ms == pytest.approx(predict_ms(TRUTH, *candidate))
        assert last.reference_ms == REFERENCE_MS
    assert json.loads(path.read_text())["schema"] == "rts2.timings/1"


@pytest.mark.parametrize(
    "change",
    [
        {"processor": "another one"},
        {"threads": 3},
        {"system": "Plan 9"},
        {"versions": {"onnxruntime": "0.1"}},
        {"seed": 1},
    ],
    ids=lambda change: next(iter(change)),
)
def test_a_journal_of_another_machine_or_seed_is_refused_and_kept(
    tmp_path: Path, change: dict[str, object]
) -> None:
    path = tmp_path / "x.timings.json"
    extend(open_journal(path, 2, 0), path, Planted(), corners()[0])
    stored = json.loads(path.read_text())
    (stored if "seed" in change else stored["machine"]).update(change)
    path.write_text(json.dumps(stored))
    with pytest.raises(Rts2Error, match="another machine, version or seed; delete it") as error:
        open_journal(path, 2, 0)
    assert str(path) in str(error.value)
    assert json.loads(path.read_text()) == stored


def test_a_journal_of_another_day_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "x.timings.json"
    extend(open_journal(path, 2, 0), path, Planted(), corners()[0])
    stored = json.loads(path.read_text())
    stored["machine"]["date"] = "2001-01-01"
    path.write_text(json.dumps(stored))
    assert len(open_journal(path, 2, 0).samples) == 1


@pytest.mark.parametrize(
    ("field", "value"), [("latency_ms", 0), ("latency_ms", -1), ("arch", {"c": 0})]
)
def test_a_broken_journal_is_named_in_one_line(tmp_path: Path, field: str, value: object) -> None:
    path = tmp_path / "x.timings.json"
    extend(open_journal(path, 2, 0), path, Planted(), corners()[0])
    stored = json.loads(path.read_text())
    stored["samples"][0][field] = value
    path.write_text(json.dumps(stored))
    with pytest.raises(Rts2Error, match=rf"a journal of timings .*samples\.0\.{field}") as error:
        open_journal(path, 2, 0)
    assert "\n" not in str(error.value)


def fps(profile: Profile) -> list[float]:
    return [point.fps for point in profile.points]


def test_a_drift_of_the_machine_cancels() -> None:
    """Twice as slow in 7 of 16 samples: the reference's median, and so each point, stays."""
    template = load("cpu")
    steady = profile_of(journal_of(candidates(0), [1.0] * 16), template, "x")
    drifting = profile_of(journal_of(candidates(0), [1.0] * 9 + [2.0] * 7), template, "x")
    assert fps(drifting) == pytest.approx(fps(steady), rel=1e-12)
    for point in steady.points:
        assert point.latency_ms == pytest.approx(predict_ms(TRUTH, point.arch, point.resolution))


def test_a_drift_in_half_of_the_samples_leaves_every_ratio() -> None:
    """Which half was the usual one nobody can tell; that moves all points alike."""
    template = load("cpu")
    steady = fps(profile_of(journal_of(candidates(0), [1.0] * 16), template, "x"))
    drifting = fps(profile_of(journal_of(candidates(0), [1.0, 2.0] * 8), template, "x"))
    ratios = np.array(drifting) / np.array(steady)
    assert ratios == pytest.approx(np.full(16, ratios[0]), rel=1e-12)
    assert 0.5 <= ratios[0] <= 1


def test_the_fit_of_planted_timings_predicts_networks_that_it_never_saw() -> None:
    fitted = profile_of(journal_of(candidates(0), [1.0, 1.3, 0.8] * 9), load("cpu"), "x")
    known = fitted.calibration("onnxruntime", "fp32")
    unseen = list(islice(candidates(7), 24, 64))
    for arch, resolution in unseen:
        assert predict_ms(known.model, arch, resolution) == pytest.approx(
            predict_ms(TRUTH, arch, resolution), rel=1e-3
        )
    assert np.abs(known.residuals).max() < 1e-3


def test_the_profile_passes_through_its_file(tmp_path: Path) -> None:
    fitted = profile_of(journal_of(candidates(0), [1.0] * 16), load("cpu"), "my-pc")
    path = tmp_path / "my-pc.json"
    path.write_text(json.dumps(fitted.model_dump(mode="json", by_alias=True, exclude_none=True)))
    assert load(str(path)) == fitted
    assert fitted.name == "my-pc"
    assert fitted.machine == this_machine(2).model_copy(update={"reference_ms": REFERENCE_MS})
    assert {(p.evidence, p.runtime, p.precision) for p in fitted.points} == {
        ("measured", "onnxruntime", "fp32")
    }
    assert len(fitted.calibrations[0].residuals) == len(fitted.points) == 16
    assert fitted.derivations == ()
    assert {fact.name: fact.value for fact in fitted.hardware}["threads"] == "2"


def test_the_machine_tells_what_a_timing_depends_on() -> None:
    import onnxruntime

    here = this_machine(3)
    assert here.threads == 3
    assert here.processor
    assert here.versions["onnxruntime"] == onnxruntime.__version__
    assert here.versions.keys() >= {"rts2", "python"}
    assert date.fromisoformat(here.date) <= date.today()


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> Bench:
    """A real bench on one thread whose reference is small, and that counts no more than needed."""
    from rts2.profiles import measure, timing

    monkeypatch.setattr(measure, "REFERENCE", (Arch(c=1, stages=1, d_max=6), (64, 64)))
    monkeypatch.setattr(timing, "WARM_UP_S", 0.01)
    monkeypatch.setattr(timing, "MIN_SECONDS", 0.01)
    return Bench(1)


def test_a_bench_times_real_networks_and_files(quick: Bench, tmp_path: Path) -> None:
    small = Arch(c=1, stages=1, d_max=6, conv3d=(4,), semantic=False)
    path = tmp_path / "small.onnx"
    export(build(small), path, (96, 64), UNTRAINED)
    for timing in (quick.time(small, (96, 64)), quick.time_file(path)):
        assert timing.runs >= 10
        assert 0 < timing.median_ms <= timing.p95_ms
        assert timing.reference_ms > 0


def test_more_work_takes_longer(quick: Bench) -> None:
    """About 200 times the multiply-adds: no load of the machine turns that around."""
    small = quick.time(Arch(c=1, stages=1, d_max=6, conv3d=(4,), semantic=False), (96, 64))
    large = quick.time(Arch(c=16, stages=3), (320, 192))
    assert large.median_ms / large.reference_ms > 3 * small.median_ms / small.reference_ms
