"""Two runtimes in one profile: what of each is kept, in which order, and at which speed."""

import json
from itertools import islice
from pathlib import Path
from typing import Any

import pytest

from rts2.model.arch import Precision
from rts2.profiles.measure import journal_path, profile_of
from rts2.profiles.plan import jobs
from rts2.profiles.profile import Machine, Profile, Runtime, load
from rts2.profiles.several import apart, blank, joined, others


@pytest.fixture(scope="module")
def fitted(planted: Any) -> Any:
    """The made-up machine's profile of one runtime, on a day when all takes `drift` times as long,
    at a reference speed of its own or of another profile.
    """

    def fit(
        runtime: Runtime,
        *precisions: Precision,
        beside: Profile | None = None,
        drift: float = 1.0,
        **told: Any,
    ) -> Profile:
        bench = planted(runtime)
        bench.precisions, bench.factor = precisions, 0.5 if runtime == "openvino" else 1.0
        journal = bench.journal(24 * len(precisions), [drift] * 96)
        machine = journal.machine.model_copy(update=told)
        if runtime == "openvino":
            versions = {**machine.versions, "openvino": "2026.3"}
            machine = machine.model_copy(update={"versions": versions})
        journal = journal.model_copy(update={"machine": machine})
        if beside is None or beside.machine is None:
            return profile_of(journal, load("cpu"), "x")
        own = profile_of(journal, beside, "x", beside.machine.reference_ms)
        return joined(own, beside)

    return fit


def executors(profile: Profile) -> list[tuple[str, str]]:
    return [(known.runtime, known.precision) for known in profile.calibrations]


@pytest.fixture(scope="module")
def first(fitted: Any) -> Profile:
    """Of ONNX Runtime alone."""
    found: Profile = fitted("onnxruntime", "fp32", date="2026-01-02")
    return found


@pytest.fixture(scope="module")
def both(fitted: Any, first: Profile) -> Profile:
    """Of OpenVINO too, fitted on a day when everything took twice as long."""
    told = {"beside": first, "drift": 2.0, "date": "2026-03-04"}
    found: Profile = fitted("openvino", "fp32", "bf16", **told)
    return found


BOTH = [("onnxruntime", "fp32"), ("openvino", "fp32"), ("openvino", "bf16")]


def test_a_second_runtime_stands_beside_the_first_which_stays_as_it_is(
    first: Profile, both: Profile
) -> None:
    assert executors(both) == BOTH
    assert both.calibrations[0] == first.calibrations[0]
    assert both.points_of("onnxruntime", "fp32") == first.points
    assert others(both, "openvino") == ("onnxruntime",)
    assert {known.runtime for known in both.runtimes} == {"onnxruntime", "openvino"}


def test_the_order_does_not_depend_on_what_was_fitted_first(fitted: Any) -> None:
    both = fitted("onnxruntime", "fp32", beside=fitted("openvino", "fp32"))
    assert executors(both) == BOTH[:2]
    assert [known.runtime for known in both.runtimes] == ["onnxruntime", "openvino"]
    told = [point.runtime for point in both.points]
    assert told == sorted(told, key=["onnxruntime", "openvino"].index)


def test_all_times_are_at_one_speed_of_the_reference(
    first: Profile, both: Profile, planted: Any
) -> None:
    assert both.machine is not None
    assert first.machine is not None
    assert both.machine.reference_ms == first.machine.reference_ms == 10.0
    bench = planted("openvino")
    for runtime, factor in (("onnxruntime", 1.0), ("openvino", 0.5)):
        for job, point in zip(
            islice(jobs(0, ("fp32",)), 24), both.points_of(runtime, "fp32"), strict=False
        ):
            assert point.latency_ms == pytest.approx(factor * bench.latency_ms(job))


def test_the_same_timings_at_twice_the_reference_are_twice_the_times(planted: Any) -> None:
    """Also those of a busy machine, whose drift is against the usual speed of their own day."""
    bench = planted()
    journal = bench.journal(48)
    bench.spread, bench.drift = 0.2, 3.0
    busy = [bench.harvest(job) for job in islice(jobs(0, ("fp32",)), 48)]
    assert not any(sample.reliable for sample in busy)
    samples = (*journal.samples[:40], *busy[40:])
    journal = journal.model_copy(update={"samples": samples})
    once, twice = (profile_of(journal, load("cpu"), "x", ms) for ms in (10.0, 20.0))
    assert once == profile_of(journal, load("cpu"), "x")
    assert [p.latency_ms for p in twice.points] == pytest.approx(
        [2 * p.latency_ms for p in once.points]
    )
    (one,), (two,) = once.calibrations, twice.calibrations
    assert two.residuals == pytest.approx(one.residuals, abs=1e-6)


def test_a_runtime_that_is_fitted_again_is_replaced_with_all_its_precisions(
    fitted: Any, both: Profile
) -> None:
    again = fitted("openvino", "fp32", beside=both, drift=1.25)
    assert executors(again) == BOTH[:2]
    assert "bf16" not in {support.precision for support in again.precisions}
    assert again.calibrations[0] == both.calibrations[0]
    assert len(again.points) == 48


def test_a_precision_is_told_of_all_runtimes_that_were_timed_in_it(both: Profile) -> None:
    """What ONNX Runtime is refused for stands against no runtime that was timed in it."""
    before = {support.precision: support for support in load("cpu").precisions}
    told = {support.precision: support for support in both.precisions}
    assert told["fp32"].reason == "timed in ONNX Runtime and OpenVINO"
    assert told["bf16"].reason == "timed in OpenVINO"
    assert [both.refusal(precision) for precision in ("fp32", "bf16")] == [None, None]
    assert both.refusal("fp16") == told["fp16"] == before["fp16"]


def test_a_refused_precision_that_another_runtime_was_timed_in_is_supported(
    fitted: Any, first: Profile
) -> None:
    assert first.refusal("fp16") is not None
    both = fitted("openvino", "fp32", "fp16", beside=first)
    assert both.refusal("fp16") is None
    assert [support.precision for support in both.precisions] == ["fp32", "fp16"]


def test_what_was_found_on_another_machine_is_no_fact_of_a_template(
    both: Profile, planted: Any
) -> None:
    assert [support.precision for support in blank(both).precisions] == ["fp16"]
    assert [known.runtime for known in blank(both).runtimes] == ["onnxruntime"]
    afresh = profile_of(planted().journal(24), both, "x")
    assert executors(afresh) == [("onnxruntime", "fp32")]
    assert afresh.refusal("fp32") is None
    assert afresh.refusal("bf16") is not None
    assert [known.runtime for known in afresh.runtimes] == ["onnxruntime"]


def test_versions_are_those_of_each_runtime_and_the_date_is_the_references(both: Profile) -> None:
    assert both.machine is not None
    assert both.machine.versions.keys() >= {"rts2", "python", "onnxruntime", "openvino"}
    assert both.machine.date == "2026-01-02"
    assert [known.source[-10:] for known in both.calibrations] == [
        "2026-01-02",
        *("2026-03-04", "2026-03-04"),
    ]


def test_the_profile_of_both_passes_through_its_file(both: Profile, tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    path.write_text(json.dumps(both.model_dump(mode="json", by_alias=True, exclude_none=True)))
    assert load(str(path)) == both


def test_this_machine_is_not_apart(exact: Profile) -> None:
    assert apart(exact, 2) is None


@pytest.mark.parametrize(
    ("told", "said"),
    [
        ({"processor": "Pentium"}, "the profile is of Pentium; this is"),
        ({"threads": 3}, "the profile is for 3 threads, not 2"),
        ({"versions": {"onnxruntime": "0.1"}}, "fitted with onnxruntime 0.1, not"),
        ({"reference_ms": None}, "does not tell how fast its reference ran"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_another_reference_speed_is_told(exact: Profile, told: dict[str, Any], said: str) -> None:
    machine = exact.machine
    assert isinstance(machine, Machine)
    other = exact.model_copy(update={"machine": machine.model_copy(update=told)})
    assert said in str(apart(other, 2))


@pytest.mark.parametrize("told", [{"openvino": "0.1"}, {"python": "3.0"}, {}])
def test_the_references_speed_depends_on_no_other_version(
    exact: Profile, told: dict[str, str]
) -> None:
    """Nor is a profile apart that does not name the reference's."""
    assert exact.machine is not None
    machine = exact.machine.model_copy(update={"versions": told})
    assert apart(exact.model_copy(update={"machine": machine}), 2) is None


def test_each_runtime_has_a_journal_of_its_own() -> None:
    path = Path("out/my-cpu.json")
    assert journal_path(path, "onnxruntime") == Path("out/my-cpu.timings.json")
    assert journal_path(path, "openvino") == Path("out/my-cpu.openvino.timings.json")
