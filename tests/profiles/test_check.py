"""How well a profile predicts: against points left out, and against a machine that is made up."""

import warnings
from dataclasses import replace
from itertools import islice
from math import exp, log
from typing import Any

import numpy as np
import pytest

from rts2.model.arch import Arch
from rts2.model.errors import Rts2Error
from rts2.profiles.calibrate import fit, leave_one_out, recalibrated
from rts2.profiles.check import (
    Comparison,
    coverage,
    executors_here,
    fresh,
    half_widths,
    held_out,
    report,
)
from rts2.profiles.latency import predict_ms
from rts2.profiles.plan import Job, jobs
from rts2.profiles.profile import Profile, load
from rts2.profiles.runtimes import RUNTIMES
from rts2.profiles.timing import Timing
from rts2.search.space import Space

KEYS = [
    *("schema", "device", "n", "unreliable"),
    *("mape", "max_ape", "within_5", "within_10", "spearman", "points"),
]


def compared(true: float, predicted: float, reliable: bool = True) -> Comparison:
    return Comparison(Arch(c=1), "fp32", "pytorch", (1242, 375), true, predicted, reliable=reliable)


def test_a_residual_is_of_latency() -> None:
    """A network that is slower than predicted (10 FPS, not 20) has a positive one."""
    assert compared(10, 20).residual == pytest.approx(log(2))


@pytest.mark.parametrize("device", ["tx2", "rtx2080ti"])
def test_each_point_is_predicted_by_a_fit_on_all_the_others(device: str) -> None:
    profile = load(device)
    found = held_out(recalibrated(profile))
    assert len(found) == sum(
        len(profile.points_of(known.runtime, known.precision)) for known in profile.calibrations
    )
    known = profile.calibrations[0]
    points = profile.points_of(known.runtime, known.precision)
    residuals = leave_one_out(points, known.model)
    for comparison, point, residual in zip(found, points, residuals, strict=False):
        assert (comparison.arch, comparison.resolution) == (point.arch, point.resolution)
        assert (comparison.runtime, comparison.precision) == (point.runtime, point.precision)
        assert comparison.fps_true == point.fps
        assert comparison.residual == pytest.approx(residual, abs=1e-12)
    for index in (0, len(points) // 2, len(points) - 1):
        others = [point for at, point in enumerate(points) if at != index]
        left_out = points[index]
        predicted = predict_ms(fit(others, known.model), left_out.arch, left_out.resolution)
        assert found[index].fps_predicted == pytest.approx(1000 / predicted)


def test_what_the_profile_stores_is_what_the_check_finds() -> None:
    profile = load("tx2")
    stored = [residual for known in profile.calibrations for residual in known.residuals]
    assert [c.residual for c in held_out(recalibrated(profile))] == pytest.approx(stored, abs=1e-6)


def test_a_report_has_the_keys_of_the_contract_and_its_points() -> None:
    profile = load("tx2")
    comparisons = [compared(10, 11), compared(20, 19)]
    found = report(profile, comparisons)
    assert list(found) == KEYS
    assert (found["schema"], found["device"], found["n"]) == ("rts2.profile-check/1", "tx2", 2)
    for point, comparison in zip(found["points"], comparisons, strict=True):
        assert point.keys() >= {
            *("arch", "precision", "runtime", "fps_true", "fps_predicted"),
        }
        assert Arch.model_validate(point["arch"]) == comparison.arch
        assert point["fps_true"] == comparison.fps_true
        assert point["fps_predicted"] == comparison.fps_predicted


def test_a_report_by_hand() -> None:
    """Predicted frame rates that are 0, +4, −8 and +20% off."""
    true = (10.0, 20.0, 30.0, 40.0)
    ratios = (1.0, 1.04, 0.92, 1.2)
    found = report(load("tx2"), [compared(t, t * r) for t, r in zip(true, ratios, strict=True)])
    assert found["mape"] == pytest.approx(0.08)
    assert found["max_ape"] == pytest.approx(0.2)
    assert found["within_5"] == 0.5
    assert found["within_10"] == 0.75
    assert found["spearman"] == pytest.approx(1)


def test_the_rank_by_hand() -> None:
    """Ranks 1 2 3 4 against 2 1 4 3: 1 − 6·4 / (4·15) = 0.6."""
    pairs = ((10, 12), (11, 10), (12, 14), (13, 13))
    assert report(load("tx2"), [compared(*p) for p in pairs])["spearman"] == pytest.approx(0.6)


@pytest.mark.parametrize("pairs", [[(10, 10)], [(10, 11), (10, 12)], [(10, 12), (11, 12)]])
def test_a_rank_that_does_not_exist_is_unknown(pairs: list[tuple[float, float]]) -> None:
    """One point has no order, equal ones neither; JSON has no NaN."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert report(load("tx2"), [compared(*pair) for pair in pairs])["spearman"] is None


def test_an_unreliable_timing_is_told_and_not_counted() -> None:
    """Two that are 0 and +10% off, and a third, twice off, whose runs disagree."""
    pairs = [compared(10, 10), compared(30, 60, reliable=False), compared(20, 22)]
    found = report(load("tx2"), pairs)
    assert (found["n"], found["unreliable"]) == (2, 1)
    assert found["mape"] == pytest.approx(0.05)
    assert found["max_ape"] == pytest.approx(0.1)
    assert [point["fps_true"] for point in found["points"]] == [10, 20]


def test_no_reliable_timing_is_one_line_with_a_remedy() -> None:
    pairs = [compared(10, 10, reliable=False)] * 3
    with pytest.raises(Rts2Error, match=r"^none of 3 timings was reliable: close") as error:
        report(load("tx2"), pairs)
    assert "\n" not in str(error.value)


def with_residuals(profile: Profile, *residuals: float) -> Profile:
    (known,) = profile.calibrations
    told = known.model_copy(update={"residuals": residuals})
    return profile.model_copy(update={"calibrations": (told,)})


def test_the_coverage_by_hand() -> None:
    """Of nine residuals of 1% to 9% the 80% interval is the 8th, ±8%: it holds 0 and ±7%, and
    neither ±8.5% nor what is unreliable."""
    profile = with_residuals(load("tx2"), *(k / 100 for k in (-1, 2, -3, 4, -5, 6, -7, 8, -9)))
    misses = (0.0, 0.07, -0.07, 0.085, -0.085)
    pairs = [compared(10, 10 * exp(miss)) for miss in misses]
    assert coverage(profile, pairs, 0.8) == pytest.approx(3 / 5)
    assert coverage(profile, pairs, 0.9) == 1
    unsure = [*pairs, compared(10, 20, reliable=False)]
    assert coverage(profile, unsure, 0.8) == pytest.approx(3 / 5)


def test_each_precision_is_covered_by_its_own_interval(exact: Profile) -> None:
    (known,) = exact.calibrations
    half = known.model_copy(
        update={"precision": "bf16", "residuals": tuple(10 * r for r in known.residuals)}
    )
    both = exact.model_copy(update={"calibrations": (known, half)})
    arch, size = Arch(c=1), (1242, 375)
    pairs = [
        Comparison(arch, precision, "onnxruntime", size, 10, 10 * exp(0.5))
        for precision in ("fp32", "bf16")
    ]
    assert [coverage(both, [pair], 0.9) for pair in pairs] == [0, 1]
    # The 23rd smallest of 24.
    assert half_widths(both, 0.9) == {
        ("onnxruntime", "fp32"): pytest.approx(0.12),
        ("onnxruntime", "bf16"): pytest.approx(1.2),
    }


def checked(profile: Profile, *benches: Any, samples: int = 5, seed: int = 0) -> list[Comparison]:
    """In all that the benches run of the profile."""
    by_runtime = {bench.runtime: bench for bench in benches}
    executors = [
        (known.runtime, known.precision)
        for known in profile.calibrations
        if known.runtime in by_runtime and known.precision in by_runtime[known.runtime].precisions
    ]
    return list(fresh(profile, by_runtime.__getitem__, executors, samples, seed))


def test_fresh_networks_are_judged_by_the_profile_that_claims_them(
    exact: Profile, planted: Any
) -> None:
    bench = planted()
    bench.factor = exp(0.07)
    found = checked(exact, bench)
    assert [c.residual for c in found] == pytest.approx([0.07] * 5)
    timed = [(job.arch, job.resolution, job.precision) for job in bench.timed]
    assert [(c.arch, c.resolution, c.precision) for c in found] == timed
    told = report(exact, found)
    assert (told["n"], told["within_5"], told["within_10"]) == (5, 0.0, 1.0)
    assert (coverage(exact, found, 0.5), coverage(exact, found, 0.9)) == (0, 1)


def test_what_the_reference_drifted_is_divided_out_and_told(exact: Profile, planted: Any) -> None:
    bench = planted()
    bench.factor, bench.drift = exp(0.07), 1.5
    found = checked(exact, bench)
    assert [c.residual for c in found] == pytest.approx([0.07] * 5)
    assert [c.drift for c in found] == pytest.approx([1.5] * 5)


def test_what_turns_out_to_be_of_a_busy_machine_is_timed_again(
    exact: Profile, planted: Any
) -> None:
    """The first two timings know of no faster reference than their own; the others do."""
    bench = planted()
    steady = bench.time

    def time(job: Job) -> Timing:
        bench.drift = 1.33 if len(bench.timed) < 2 else 1.0
        found: Timing = steady(job)
        return found

    bench.time = time
    found = checked(exact, bench)
    assert [job.arch for job in bench.timed[5:]] == [job.arch for job in bench.timed[:2]]
    assert [c.drift for c in found] == pytest.approx([1.0] * 5)
    assert all(c.reliable for c in found)


def test_runs_that_disagree_are_marked(exact: Profile, planted: Any) -> None:
    bench = planted()
    bench.spread = 0.09
    assert all(c.reliable for c in checked(exact, bench))
    bench.spread = 0.11
    assert not any(c.reliable for c in checked(exact, bench))


def several(exact: Profile) -> Profile:
    """In three precisions on two runtimes; all as fast as the first, so the others' are wrong."""
    (known,) = exact.calibrations
    more = [
        known.model_copy(update={"runtime": "openvino"}),
        known.model_copy(update={"precision": "bf16", "runtime": "openvino"}),
    ]
    return exact.model_copy(update={"calibrations": (known, *more)})


def test_fresh_networks_come_in_every_precision_of_every_runtime(
    exact: Profile, planted: Any
) -> None:
    """Each is timed on the bench of its runtime; of 60 draws none of three is missed by chance."""
    one, other = planted(), planted("openvino")
    other.precisions, other.factor = ("fp32", "bf16"), 0.5
    found = checked(several(exact), one, other, samples=60)
    wanted = {
        ("onnxruntime", "fp32"): 0.0,
        ("openvino", "fp32"): log(0.5),
        ("openvino", "bf16"): log(0.5 * 0.6),
    }
    assert {c.executor for c in found} == wanted.keys()
    for comparison in found:
        assert comparison.residual == pytest.approx(wanted[comparison.executor])
    assert len(one.timed) == sum(c.runtime == "onnxruntime" for c in found)
    assert {job.precision for job in one.timed} == {"fp32"}


def test_fresh_networks_come_in_what_was_asked_for_alone(exact: Profile, planted: Any) -> None:
    found = checked(several(exact), planted(), samples=20)
    assert {c.executor for c in found} == {("onnxruntime", "fp32")}


def runtimes_here(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    """As if these runtimes, and no others, were installed."""
    for name, row in RUNTIMES.items():
        missing = None if name in names else f"{row.title} is not installed"
        able = replace(row, missing=lambda missing=missing: missing)
        monkeypatch.setitem(RUNTIMES, name, able)


def test_what_cannot_be_timed_here_is_told_once_and_no_bench_of_it_opened(
    exact: Profile, planted: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    runtimes_here(monkeypatch, "onnxruntime")
    able, told = executors_here(several(exact), {"onnxruntime": planted()}.__getitem__)
    assert able == [("onnxruntime", "fp32")]
    assert told == ["OpenVINO is not installed"]


def test_a_precision_that_the_processor_lacks_is_told(
    exact: Profile, planted: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    runtimes_here(monkeypatch, "onnxruntime", "openvino")
    able, told = executors_here(several(exact), planted)
    assert able == [("onnxruntime", "fp32"), ("openvino", "fp32")]
    assert told == ["OpenVINO does not run bf16 on this machine"]


def test_where_nothing_can_be_timed_the_error_says_why(
    exact: Profile, planted: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    runtimes_here(monkeypatch)
    with pytest.raises(Rts2Error, match=r"can be timed here: ONNX Runtime is not") as error:
        executors_here(several(exact), planted)
    assert "\n" not in str(error.value)


def test_fresh_networks_are_none_that_a_fit_was_made_of(exact: Profile, planted: Any) -> None:
    bench = planted()
    checked(exact, bench, samples=40)
    assert all(Space().position(job.arch) is not None for job in bench.timed)
    for seed in (0, 1):
        assert not set(bench.timed) & set(islice(jobs(seed, ("fp32",)), 12, 400))


def test_fresh_networks_depend_on_the_seed_alone(exact: Profile, planted: Any) -> None:
    benches = [planted() for _ in range(3)]
    for bench, seed in zip(benches, (0, 0, 1), strict=True):
        checked(exact, bench, samples=10, seed=seed)
    same, again, other = (bench.timed for bench in benches)
    assert same == again
    assert not set(same) & set(other)


def test_errors_are_finite_fractions() -> None:
    for device in ("tx2", "rtx2080ti"):
        profile = load(device)
        told = report(profile, held_out(recalibrated(profile)))
        assert 0 < told["mape"] <= told["max_ape"] < 1
        assert 0 <= told["within_5"] <= told["within_10"] <= 1
        assert np.isfinite(told["spearman"])


def test_fresh_networks_run_in_the_forms_that_the_profile_takes_for_the_fastest(
    exact: Profile, planted: Any
) -> None:
    """On the made-up machine that is banded up to seven planes: always from the second stage on."""
    bench = planted()
    found = checked(exact, bench, samples=40)
    for job in bench.timed:
        expected = ("banded" if job.arch.d_max <= 7 else "3d", "banded", "banded")
        assert job.forms == expected[: job.arch.stages]
    assert [c.residual for c in found] == pytest.approx([0.0] * 40, abs=0.02)
