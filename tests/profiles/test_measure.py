"""Which networks are timed, what is kept of the timings, and the profile that comes of them."""

import json
import random
from collections.abc import Iterable
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rts2.model.arch import SPACE_C, SPACE_CONV3D, SPACE_D_MAX, Arch, Precision
from rts2.model.errors import Rts2Error
from rts2.model.files import read_json
from rts2.model.ops import ops
from rts2.profiles import measure, timing
from rts2.profiles.here import this_machine
from rts2.profiles.latency import predict_ms
from rts2.profiles.measure import (
    NEEDED,
    Bench,
    Journal,
    extend,
    in_hindsight,
    open_journal,
    profile_of,
)
from rts2.profiles.parts import PartModel, parts
from rts2.profiles.plan import RESOLUTIONS, Job, jobs, random_candidate
from rts2.profiles.profile import Profile, load
from rts2.profiles.several import OURS
from rts2.profiles.timing import BUSY_ERROR
from rts2.search.space import Space

FIRST = 64
"""Networks at the start of every plan: 12 heads, and each c at both sizes."""

SMALL = Arch(c=1, stages=1, d_max=6, conv3d=(4,), semantic=False)


def planned(count: int, seed: int = 0, precisions: tuple[Precision, ...] = ("fp32",)) -> list[Job]:
    return list(islice(jobs(seed, precisions), count))


def opened(path: Path, seed: int = 0) -> Journal:
    return open_journal(path, "onnxruntime", 2, seed)


def numbers(job: Job) -> tuple[float, ...]:
    arch, (width, height) = job.arch, job.resolution
    return (arch.stages, arch.c, arch.semantic + arch.refinement, width, height)


def test_the_first_networks_hold_both_ends_of_every_dimension() -> None:
    """Sixteen are enough: every head, and the whole network at both ends of c."""
    for seed in range(5):
        table = np.array([numbers(job) for job in planned(16, seed)])
        assert tuple(table.min(0)) == (1, SPACE_C[0], 0, 640, 192)
        assert tuple(table.max(0)) == (3, SPACE_C[-1], 2, 1242, 375)
        assert set(table[:, 0]) == {1, 2, 3}


def test_every_network_of_the_plan_lies_in_the_searched_space() -> None:
    for job in planned(200):
        assert Space().position(job.arch) is not None
        assert job.resolution in RESOLUTIONS


@given(st.integers(0, 2**32))
def test_a_random_candidate_lies_in_the_searched_space(seed: int) -> None:
    arch, resolution = random_candidate(random.Random(seed))
    assert Space().position(arch) is not None
    assert resolution in RESOLUTIONS


def reached(drawn: Iterable[tuple[Arch, tuple[int, int]]]) -> dict[str, set[Any]]:
    known = list(drawn)
    return {
        "c": {arch.c for arch, _ in known},
        "d_max": {arch.d_max for arch, _ in known},
        "branches": {arch.branches for arch, _ in known},
        "resolution": {resolution for _, resolution in known},
        **{
            f"width.{stage}": {arch.conv3d[stage] for arch, _ in known if arch.stages > stage}
            for stage in range(3)
        },
    }


@pytest.mark.parametrize("stream", ["candidates", "plan"])
def test_every_value_of_every_dimension_is_reached(stream: str) -> None:
    """By chance alone one of 2000 draws misses one of 32 values once in 10²⁶ runs."""
    chance = random.Random(0)
    drawn = {
        "candidates": [random_candidate(chance) for _ in range(2000)],
        "plan": [(job.arch, job.resolution) for job in planned(2000)],
    }
    assert reached(drawn[stream]) == {
        "c": set(SPACE_C),
        "d_max": set(SPACE_D_MAX),
        "branches": {"disparity", "disparity+semantic", "full"},
        "resolution": set(RESOLUTIONS),
        **{f"width.{stage}": set(values) for stage, values in enumerate(SPACE_CONV3D)},
    }


def test_after_the_first_networks_every_c_comes_once_a_round() -> None:
    count = len(SPACE_C)
    rest = planned(FIRST + 3 * count)[FIRST:]
    for start in range(0, 3 * count, count):
        assert sorted(job.arch.c for job in rest[start : start + count]) == list(SPACE_C)


def test_the_same_seed_plans_the_same_networks_and_another_others() -> None:
    assert planned(120) == planned(120)
    streams = [tuple(planned(FIRST + 50, seed)) for seed in range(6)]
    assert len({stream[:FIRST] for stream in streams}) == 6
    assert len({stream[FIRST:] for stream in streams}) == 6


def test_the_first_precision_is_timed_throughout_the_others_with_every_other_pair() -> None:
    """All corners and heads in both; then half of the networks, both resolutions alike."""
    both = planned(200, precisions=("fp32", "bf16"))
    alone = [(job.arch, job.resolution, job.forms) for job in planned(200)]
    told = {
        precision: [(j.arch, j.resolution, j.forms) for j in both if j.precision == precision]
        for precision in ("fp32", "bf16")
    }
    assert told["fp32"] == alone[: len(told["fp32"])]
    assert (
        told["bf16"]
        == [job for index, job in enumerate(told["fp32"]) if index < 16 or index // 2 % 2 == 0][
            : len(told["bf16"])
        ]
    )
    sizes = [resolution for _, resolution, _ in told["bf16"][16:40]]
    assert sizes.count((1242, 375)) == sizes.count((640, 192))


def test_a_journal_grows_by_one_sample_a_time_and_is_found_again(
    tmp_path: Path, planted: Any
) -> None:
    path = tmp_path / "x.timings.json"
    journal = opened(path)
    assert journal.samples == ()
    assert not path.exists()
    bench = planted()
    for count, job in enumerate(planned(3), 1):
        journal = extend(journal, path, bench.harvest(job))
        assert opened(path) == journal
        assert len(journal.samples) == count
        last = journal.samples[-1]
        assert Job(last.arch, last.resolution, last.precision, last.forms) == job
        assert last.latency_ms == pytest.approx(bench.latency_ms(job))
        assert sum(last.parts_ms.values()) == pytest.approx(last.latency_ms)
    assert json.loads(path.read_text())["schema"] == "rts2.timings/4"


@pytest.fixture
def stored(tmp_path: Path, planted: Any) -> Path:
    """A journal of one sample, of this machine, seed 0."""
    path = tmp_path / "x.timings.json"
    extend(opened(path), path, planted().harvest(planned(1)[0]))
    return path


@pytest.mark.parametrize(
    "change",
    [
        {"processor": "another one"},
        {"threads": 3},
        {"system": "Plan 9"},
        {"versions": {"onnxruntime": "0.1"}},
        {"seed": 1},
        {"runtime": "openvino"},
    ],
    ids=lambda change: next(iter(change)),
)
def test_a_journal_of_another_machine_runtime_or_seed_is_refused_and_kept(
    stored: Path, change: dict[str, object]
) -> None:
    held = json.loads(stored.read_text())
    (held if change.keys() & held.keys() else held["machine"]).update(change)
    stored.write_text(json.dumps(held))
    said = "another machine, version, runtime or seed; delete it"
    with pytest.raises(Rts2Error, match=said) as error:
        opened(stored)
    assert str(stored) in str(error.value)
    assert json.loads(stored.read_text()) == held


def test_a_journal_of_another_day_goes_on(stored: Path) -> None:
    held = json.loads(stored.read_text())
    held["machine"]["date"] = "2001-01-01"
    stored.write_text(json.dumps(held))
    assert len(opened(stored).samples) == 1


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("latency_ms", 0),
        ("latency_ms", -1),
        ("ratio", 0),
        ("arch", {"c": 0}),
        ("parts_ms", {"encoder": -1}),
        ("precision", "fp8"),
    ],
)
def test_a_broken_journal_is_named_in_one_line(stored: Path, field: str, value: object) -> None:
    held = json.loads(stored.read_text())
    held["samples"][0][field] = value
    stored.write_text(json.dumps(held))
    with pytest.raises(Rts2Error, match=rf"a journal of timings .*samples\.0\.{field}") as error:
        opened(stored)
    assert "\n" not in str(error.value)


def test_a_journal_of_before_is_refused_by_its_schema(stored: Path) -> None:
    stored.write_text(json.dumps(json.loads(stored.read_text()) | {"schema": "rts2.timings/2"}))
    with pytest.raises(Rts2Error, match=r"a journal of timings .*schema"):
        opened(stored)


def fps(profile: Profile) -> list[float]:
    return [point.fps for point in profile.points]


def test_a_drift_of_the_machine_cancels(planted: Any) -> None:
    """Twice as slow in 11 of 24 samples: the reference's median, and so each point, stays."""
    bench, template = planted(), load("cpu")
    steady = profile_of(bench.journal(24), template, "x")
    drifting = profile_of(bench.journal(24, [1.0] * 13 + [2.0] * 11), template, "x")
    assert fps(drifting) == pytest.approx(fps(steady), rel=1e-12)
    for job, point in zip(planned(24), drifting.points, strict=True):
        assert point.latency_ms == pytest.approx(bench.latency_ms(job))
        assert point.parts_ms is not None
        assert sum(point.parts_ms.values()) == pytest.approx(point.latency_ms, rel=1e-4)


def test_a_drift_in_half_of_the_samples_leaves_every_ratio(planted: Any) -> None:
    """Which half was the usual one nobody can tell; that moves all points alike."""
    bench, template = planted(), load("cpu")
    steady = fps(profile_of(bench.journal(24), template, "x"))
    drifting = fps(profile_of(bench.journal(24, [1.0, 2.0] * 12), template, "x"))
    ratios = np.array(drifting) / np.array(steady)
    assert ratios == pytest.approx(np.full(24, ratios[0]), rel=1e-12)
    assert 0.5 <= ratios[0] <= 1


def test_the_fit_of_planted_timings_predicts_networks_that_it_never_saw(planted: Any) -> None:
    bench = planted()
    journal = bench.journal(FIRST, [1.0, 1.3, 0.8] * 25)
    fitted = profile_of(journal, load("cpu"), "x")
    model = fitted.calibration("onnxruntime", "fp32").model
    chance = random.Random(5)
    for _ in range(60):
        unseen = Job(*random_candidate(chance), "fp32")
        truth = bench.truth.fastest_ms(parts(ops(unseen.arch, unseen.resolution)))
        predicted = predict_ms(model, unseen.arch, unseen.resolution)
        assert predicted == pytest.approx(truth, rel=0.02)


def test_the_profile_passes_through_its_file(tmp_path: Path, planted: Any) -> None:
    fitted = profile_of(planted().journal(24), load("cpu"), "my-pc")
    path = tmp_path / "my-pc.json"
    path.write_text(json.dumps(fitted.model_dump(mode="json", by_alias=True, exclude_none=True)))
    assert load(str(path)) == fitted
    assert fitted.name == "my-pc"
    assert fitted.machine == this_machine("onnxruntime", 2).model_copy(
        update={"reference_ms": 10.0}
    )
    assert {(p.evidence, p.runtime, p.precision) for p in fitted.points} == {
        ("measured", "onnxruntime", "fp32")
    }
    (known,) = fitted.calibrations
    assert isinstance(known.model, PartModel)
    assert len(known.residuals) == len(fitted.points) == 24
    assert fitted.derivations == ()
    assert {fact.name: fact.value for fact in fitted.hardware}["threads"] == "2"


def test_unreliable_timings_are_left_out(planted: Any) -> None:
    """Every tenth sample took three times as long, and its runs disagreed: nothing of it stays."""
    bench = planted()
    good = bench.journal(30)
    bench.spread, bench.factor = 0.5, 3.0
    spoiled = [bench.harvest(job) for job in planned(30)]
    samples = [
        bad if index % 10 == 9 else sample
        for index, (sample, bad) in enumerate(zip(good.samples, spoiled, strict=True))
    ]
    assert [index for index, sample in enumerate(samples) if not sample.reliable] == [9, 19, 29]
    mixed = good.model_copy(update={"samples": tuple(samples)})
    kept = good.model_copy(update={"samples": tuple(s for s in samples if s.reliable)})
    found, expected = (profile_of(known, load("cpu"), "x") for known in (mixed, kept))
    assert found.points == expected.points
    assert found.calibrations[0].model == expected.calibrations[0].model
    assert found.calibrations[0].residuals == expected.calibrations[0].residuals
    assert len(found.points) == 27
    assert "27 whole networks, 3 more were worth nothing" in found.calibrations[0].source
    assert "more" not in expected.calibrations[0].source


def test_timings_beside_a_reference_that_was_slow_are_doubted_in_hindsight(
    planted: Any, tmp_path: Path
) -> None:
    """Those of this run: what another day's reference took tells nothing of today."""
    bench = planted()
    journal, path = bench.journal(30, drifts=[1.33, 1.33, 1.33, 1.1]), tmp_path / "journal.json"
    assert all(sample.reliable for sample in journal.samples)
    seen = in_hindsight(journal, path, 1, bench.own_ms)
    assert [index for index, s in enumerate(seen.samples) if not s.reliable] == [1, 2]
    errors = [sample.error for sample in seen.samples[:4]]
    assert errors == pytest.approx([0.0, BUSY_ERROR, BUSY_ERROR, 0.0])
    assert read_json(path, Journal, "a journal") == seen
    assert in_hindsight(seen, path, 3, bench.own_ms) is seen


def test_too_few_reliable_timings_name_the_remedy(planted: Any) -> None:
    bench = planted()
    journal = bench.journal(NEEDED)
    spoiled = journal.samples[3].model_copy(update={"reliable": False})
    samples = (*journal.samples[:3], spoiled, *journal.samples[4:])
    for held, count in ((samples, 23), (samples[:3], 3), (samples[3:4], 0), ((), 0)):
        with pytest.raises(Rts2Error, match=f"^{count} reliable timings are too few") as error:
            profile_of(journal.model_copy(update={"samples": held}), load("cpu"), "x")
        assert "a longer --budget" in str(error.value)
        assert "\n" not in str(error.value)


def test_each_precision_has_its_own_tables_and_is_told_as_supported(planted: Any) -> None:
    bench = planted("openvino")
    bench.precisions = ("fp32", "bf16")
    template = load("cpu")
    found = profile_of(bench.journal(2 * 40), template, "x")
    assert [(c.runtime, c.precision) for c in found.calibrations] == [
        ("openvino", "fp32"),
        ("openvino", "bf16"),
    ]
    for known, count in zip(found.calibrations, (48, 32), strict=True):
        points = found.points_of("openvino", known.precision)
        assert len(known.residuals) == len(points) == count
    single, half = (known.model for known in found.calibrations)
    for job in planned(10, seed=4):
        assert predict_ms(half, job.arch, job.resolution) == pytest.approx(
            0.6 * predict_ms(single, job.arch, job.resolution), rel=0.03
        )
    told = {support.precision: support for support in found.precisions}
    assert len(told) == len(found.precisions)
    for precision in ("fp32", "bf16"):
        assert told[precision].supported
        assert "OpenVINO" in told[precision].reason
    before = {s.precision: s for s in template.precisions if s.source != OURS}
    assert {name: s for name, s in told.items() if name in before} == before


def test_a_profile_of_a_runtime_says_that_it_has_it(planted: Any) -> None:
    """Whoever reads the profile, a bundle too, finds the runtime that was timed."""
    found = profile_of(planted("openvino").journal(24), load("cpu"), "x")
    assert "openvino" in {known.runtime for known in found.runtimes}


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> Bench:
    """A real bench on one thread whose reference is small, and that counts no more than needed."""
    monkeypatch.setattr(measure, "REFERENCE", (Arch(c=1, stages=1, d_max=6), (64, 64)))
    monkeypatch.setattr(timing, "WARM_UP_S", 0.01)
    monkeypatch.setattr(timing, "MIN_SECONDS", 0.01)
    monkeypatch.setattr(timing, "OWN_SECONDS", 0.01)
    return Bench("onnxruntime", 1)


def test_a_bench_times_real_networks_as_a_whole_and_by_part(quick: Bench) -> None:
    job = Job(SMALL, (96, 64), "fp32")
    whole = quick.time(job)
    assert whole.runs >= 10
    assert 0 < whole.median_ms <= whole.p95_ms
    assert whole.reference_ms > 0
    sample = quick.harvest(job)
    assert (sample.arch, sample.resolution, sample.precision) == (SMALL, (96, 64), "fp32")
    assert sample.parts_ms.keys() == {part.name for part in parts(ops(SMALL, (96, 64)))}
    assert sum(sample.parts_ms.values()) == pytest.approx(sample.latency_ms)
    assert min(sample.latency_ms, sample.reference_ms, sample.ratio) > 0


def test_memory_is_given_back_after_each_network(
    quick: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once for each that is exported, not again for its other precisions or timings."""
    released: list[None] = []
    monkeypatch.setattr(measure, "release_memory", lambda: released.append(None))
    for arch in (SMALL, SMALL, Arch(c=2, stages=1), SMALL):
        quick._graph(Job(arch, (96, 64), "fp32"))
    assert len(released) == 3


def test_more_work_takes_longer(quick: Bench) -> None:
    """About 200 times the multiply-adds: no load of the machine turns that around."""
    small = quick.time(Job(SMALL, (96, 64), "fp32"))
    large = quick.time(Job(Arch(c=16, stages=3), (320, 192), "fp32"))
    assert large.ratio > 3 * small.ratio
