"""rts2-profile as a person or a script meets it: what it prints, what it keeps, how it refuses."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from itertools import islice
from math import prod
from pathlib import Path
from typing import Any

import onnx
import pytest
from onnx import TensorProto, helper
from PIL import Image

from rts2.model.arch import UNTRAINED, Arch
from rts2.model.checkpoint import build
from rts2.model.export import export
from rts2.model.files import write_json
from rts2.profiles import cli, here, measure, timing
from rts2.profiles.calibrate import leave_one_out
from rts2.profiles.cli import profile
from rts2.profiles.parts import AXES, PartModel
from rts2.profiles.plan import Job, jobs
from rts2.profiles.profile import Profile, load, names
from rts2.profiles.runtimes import RUNTIMES, ov
from rts2.profiles.timing import Timing


class Clock:
    """A clock that only timed networks move on: a budget is spent exactly."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


CLOCK = Clock()


@pytest.fixture
def made_up(planted: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """No network runs, and no second passes: the made-up machine, one second a network."""

    class Seconds(planted):  # type: ignore[misc]
        factor = 1.0

        def time(self, job: Job) -> Timing:
            CLOCK.now += 1
            found: Timing = super().time(job)
            return found

    monkeypatch.setattr(measure, "Bench", Seconds)
    monkeypatch.setattr(cli, "monotonic", CLOCK)
    monkeypatch.setattr(cli, "RESERVE_S", 0.0)
    monkeypatch.setattr(cli, "FITTING_S", 0.0)
    return Seconds


@pytest.fixture
def device(exact: Profile, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A profile's file, of this machine and right about the made-up one."""
    return written(exact, tmp_path_factory.mktemp("devices") / "made-up.json")


def written(known: Profile, path: Path) -> Path:
    write_json(path, known.model_dump(mode="json", by_alias=True, exclude_none=True))
    return path


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Real networks, timed no longer than needed beside a small reference."""
    monkeypatch.setattr(measure, "REFERENCE", (Arch(c=1, stages=1, d_max=6), (64, 64)))
    monkeypatch.setattr(timing, "WARM_UP_S", 0.01)
    monkeypatch.setattr(timing, "MIN_SECONDS", 0.01)
    monkeypatch.setattr(timing, "OWN_SECONDS", 0.01)


class Run:
    def __init__(self, code: int, out: str, err: str) -> None:
        self.code, self.out, self.err = code, out, err

    @property
    def json(self) -> dict[str, Any]:
        assert (self.code, self.err) == (0, "")
        assert self.out.count("\n") == 1
        found: dict[str, Any] = json.loads(self.out)
        return found


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Any:
    def command(*arguments: object) -> Run:
        code = profile([str(argument) for argument in arguments])
        printed = capsys.readouterr()
        return Run(code, printed.out, printed.err)

    return command


def refused(found: Run, code: int, *said: str) -> None:
    assert (found.code, found.out) == (code, "")
    assert found.err.count("\n") == 1
    assert "Traceback" not in found.err
    for text in said:
        assert text in found.err


def as_list(text: str) -> list[str]:
    return [line.split()[0] for line in text.splitlines() if line.strip()]


@pytest.fixture
def device_alone(ort_alone: Profile, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A device's file of which ONNX Runtime alone was timed."""
    return written(ort_alone, tmp_path_factory.mktemp("device") / "cpu.json")


def test_list_names_every_device_with_what_it_can(run: Any) -> None:
    found = run("list", "--json").json
    assert found["schema"] == "rts2.profiles/1"
    assert [device["name"] for device in found["devices"]] == names()
    by_name = {device["name"]: device for device in found["devices"]}
    assert by_name["tx2"]["evidence"] == ["published"]
    assert by_name["cpu"]["evidence"] == ["measured"]
    assert by_name["cpu"]["runtimes"] == ["onnxruntime", "openvino"]
    assert "int8" not in by_name["tx2"]["precisions"]
    shown = run("list")
    assert (shown.code, shown.err) == (0, "")
    assert as_list(shown.out) == ["name", *names()]


@pytest.mark.parametrize("device", ["cpu", "rtx2080ti", "tx2"])
def test_show_gives_the_profile_or_each_number_with_its_source(run: Any, device: str) -> None:
    known = load(device)
    assert run("show", device, "--json").json == known.model_dump(mode="json", by_alias=True)
    shown = run("show", device)
    assert (shown.code, shown.err) == (0, "")
    printed = set(shown.out.split())
    for text in (known.title, "held-out error", *(fact.value for fact in known.hardware)):
        assert set(text.split()) <= printed


def test_show_prints_the_text_of_a_profile_as_it_is(run: Any, tmp_path: Path) -> None:
    """Square brackets are no markup."""
    path = tmp_path / "box.json"
    stored = load("tx2").model_dump(mode="json", by_alias=True, exclude_none=True)
    stored["title"] = stored["hardware"][0]["value"] = "[/bold] [red]"
    path.write_text(json.dumps(stored))
    shown = run("show", path)
    assert (shown.code, shown.err) == (0, "")
    assert shown.out.count("[/bold] [red]") == 2


def test_show_takes_a_file_too(run: Any, tmp_path: Path) -> None:
    path = tmp_path / "box.json"
    path.write_text(json.dumps(load("tx2").model_dump(mode="json", by_alias=True)))
    assert run("show", path, "--json").json == run("show", "tx2", "--json").json


def test_check_tells_the_held_out_error(run: Any) -> None:
    found = run("check", "--device", "tx2", "--json").json
    known = load("tx2").calibrations[0]
    points = load("tx2").points_of(known.runtime, known.precision)
    assert (found["schema"], found["device"]) == ("rts2.profile-check/1", "tx2")
    assert found["n"] == len(found["points"]) == len(points)
    true = [point["fps_true"] for point in found["points"]]
    predicted = [point["fps_predicted"] for point in found["points"]]
    expected = [
        point.fps * 2.718281828459045**r
        for point, r in zip(points, leave_one_out(points, known.model), strict=True)
    ]
    assert true == [point.fps for point in points]
    assert predicted == pytest.approx(expected)
    errors = [abs(p / t - 1) for t, p in zip(true, predicted, strict=True)]
    assert found["mape"] == pytest.approx(sum(errors) / len(errors))
    assert found["max_ape"] == pytest.approx(max(errors))
    assert found["within_5"] == sum(e <= 0.05 for e in errors) / len(errors)
    assert found["within_10"] == sum(e <= 0.10 for e in errors) / len(errors)


def test_check_for_people_says_what_its_json_says(run: Any) -> None:
    found = run("check", "--device", "rtx2080ti", "--json").json
    shown = run("check", "--device", "rtx2080ti")
    assert (shown.code, shown.err) == (0, "")
    *_, summed, family, stages = shown.out.strip().splitlines()
    assert summed.startswith(f"{found['n']} networks left out in turn: ")
    assert f"mean error {found['mape']:.1%}, worst {found['max_ape']:.1%}" in summed
    assert len(shown.out.strip().splitlines()) == found["n"] + 5
    (groups,) = found["held_out"]
    assert family == (
        f"fp32 on pytorch, a family left out: {groups['family']['mean']:.1%} mean, "
        f"{groups['family']['worst']:.1%} worst of 11"
    )
    assert stages == "fp32 on pytorch, a stage count left out: too few points remain without 3"


def test_check_gives_null_where_too_few_points_remain(run: Any) -> None:
    (groups,) = run("check", "--device", "tx2", "--json").json["held_out"]
    assert (groups["runtime"], groups["precision"]) == ("pytorch", "fp32")
    assert groups["stages"]["groups"]["3"] == {"n": 0, "mean": None, "worst": None}
    assert groups["stages"]["n"] == 4
    assert 0 < groups["stages"]["mean"] <= groups["stages"]["worst"] < 0.03
    assert 0 < groups["family"]["mean"] <= groups["family"]["worst"] < 0.17


def test_show_tells_what_whole_groups_left_out_cost(run: Any) -> None:
    words = " ".join(run("show", "tx2").out.split())
    found = load("tx2").calibrations[0].held_out
    assert found is not None
    assert run("show", "tx2", "--json").json["calibrations"][0]["held_out"] == found.model_dump()
    for part in ("a family left out", "a stage count left out", "remain without 3"):
        assert all(word in words for word in part.split())


def test_show_tells_the_size_of_tables_of_parts(run: Any, device: Path, exact: Profile) -> None:
    known = exact.calibrations[0].model
    assert isinstance(known, PartModel)
    places = sum(prod(len(axis) for axis in table.axes) for table in known.tables.values())
    shown = run("show", device)
    assert (shown.code, shown.err) == (0, "")
    told = f"{len(AXES)} parts, {2 * places} places in their tables, at 0.12, 0.48 megapixels"
    assert set(told.split()) <= set(shown.out.split())
    assert "±12.0%" in shown.out  # the 23rd smallest of 24 residuals
    assert run("show", device, "--json").json["calibrations"][0]["model"]["form"] == "parts"


@pytest.mark.usefixtures("made_up")
def test_check_with_samples_times_networks_now(run: Any, device: Path) -> None:
    asked = ("check", "--device", device, "--samples", 4, "--threads", 2)
    told = run(*asked, "--json")
    assert (told.code, told.err) == (0, "")
    found = json.loads(told.out)
    assert (found["n"], found["unreliable"], found["coverage"]) == (4, 0, 1)
    assert found["mape"] == pytest.approx(0, abs=1e-9)
    assert json.loads(run(*asked, "--seed", 1, "--json").out)["points"] != found["points"]
    shown = run(*asked).out
    assert "4 networks timed now" in shown
    assert "100% of them within the 90% interval" in shown
    assert "unreliable" not in shown


def test_check_counts_no_unreliable_timing_and_tells_them(
    run: Any, device: Path, made_up: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every other network takes twice as long, and its runs disagree whenever it is timed."""
    plain = made_up.time
    first: list[Job] = []

    def time(bench: Any, job: Job) -> Timing:
        if job not in first:
            first.append(job)
        spoiled = first.index(job) % 2 == 1
        bench.spread, bench.factor = (0.5, 2.0) if spoiled else (0.0, 1.0)
        found: Timing = plain(bench, job)
        return found

    monkeypatch.setattr(made_up, "time", time)
    asked = ("check", "--device", device, "--samples", 6, "--threads", 2)
    found = run(*asked, "--json").json
    assert (found["n"], found["unreliable"], found["coverage"]) == (3, 3, 1)
    assert found["max_ape"] == pytest.approx(0, abs=1e-9)
    shown = run(*asked).out
    assert "3 networks timed now" in shown
    assert "! 3 unreliable: the machine was busy; not counted" in shown
    assert sum(line.rstrip().endswith("% !") for line in shown.splitlines()) == 3


@pytest.mark.usefixtures("made_up")
def test_check_writes_its_numbers_and_a_picture(run: Any, device: Path, tmp_path: Path) -> None:
    out = tmp_path / "new" / "check"
    asked = ("check", "--device", device, "--samples", 4, "--threads", 2, "--out", out)
    found = run(*asked, "--json").json
    assert json.loads((out / "check.json").read_text()) == found
    with Image.open(out / "check.png") as image:
        assert image.format == "PNG"
    assert {path.name for path in out.iterdir()} == {"check.json", "check.png"}
    assert f"written   {out}/  check.json  check.png" in run(*asked).out


def test_check_of_a_published_device_is_drawn_too(run: Any, tmp_path: Path) -> None:
    found = run("check", "--device", "tx2", "--out", tmp_path, "--json").json
    assert json.loads((tmp_path / "check.json").read_text()) == found
    assert {path.name for path in tmp_path.iterdir()} == {"check.json", "check.png"}


@pytest.mark.usefixtures("made_up")
def test_a_check_that_cannot_be_written_is_refused_before_it_is_timed(
    run: Any, device: Path, tmp_path: Path
) -> None:
    (tmp_path / "taken").write_text("x")
    before = CLOCK.now
    asked = ("check", "--device", device, "--samples", 3, "--threads", 2)
    refused(run(*asked, "--out", tmp_path / "taken"), 1, str(tmp_path / "taken"))
    assert CLOCK.now == before


@pytest.mark.usefixtures("made_up")
def test_another_machine_is_told_on_stderr_alone(run: Any, exact: Profile, tmp_path: Path) -> None:
    assert exact.machine is not None
    other = exact.machine.model_copy(update={"processor": "[red] Pentium"})
    path = written(exact.model_copy(update={"machine": other}), tmp_path / "box.json")
    found = run("check", "--device", path, "--samples", 2, "--json")
    assert found.code == 0
    assert json.loads(found.out)["n"] == 2
    assert "note: the profile is of [red] Pentium; this is" in found.err


@pytest.mark.usefixtures("made_up")
def test_fit_spends_its_budget_and_writes_a_profile_that_loads(
    run: Any, device_alone: Path, tmp_path: Path
) -> None:
    path = tmp_path / "new" / "my-cpu.json"
    asked = ("fit", "--device", device_alone, "--threads", 1, "--out", path)
    found = run(*asked, "--budget", 40, "--json").json
    assert (found["schema"], found["file"]) == ("rts2.profile-fit/1", str(path))
    assert found["n"] == 40
    assert found["mape"] < 0.1
    told = [(row["runtime"], row["precision"], row["n"]) for row in found["calibrations"]]
    assert told == [("onnxruntime", "fp32", 40)]
    fitted = load(str(path))
    assert (fitted.name, len(fitted.points)) == ("my-cpu", 40)
    assert isinstance(fitted.calibrations[0].model, PartModel)
    assert fitted.machine is not None
    assert fitted.machine.threads == 1
    assert sorted(p.name for p in path.parent.iterdir()) == ["my-cpu.json", "my-cpu.timings.json"]
    longer = run(*asked, "--budget", 2)
    assert (longer.code, longer.err) == (0, "")
    assert "42 timings" in longer.out
    assert load(str(path)).points[:40] == fitted.points


@pytest.mark.usefixtures("made_up")
def test_a_budget_that_is_too_small_keeps_its_timings_and_goes_on(
    run: Any, device_alone: Path, tmp_path: Path
) -> None:
    path = tmp_path / "x.json"
    asked = ("fit", "--device", device_alone, "--threads", 1, "--out", path)
    said = "reliable timings are too few for tables of parts, which need 24"
    refused(run(*asked, "--budget", 12), 1, f"12 {said}", "longer --budget")
    assert not path.exists()
    assert run(*asked, "--budget", 12, "--json").json["n"] == 24


@pytest.mark.usefixtures("made_up")
def test_a_budget_leaves_time_for_the_tables(
    run: Any, device_alone: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 60 s: 10 in any case, and half a second a network, one second each to time: 34 or 33."""
    monkeypatch.setattr(cli, "RESERVE_S", 10.0)
    monkeypatch.setattr(cli, "FITTING_S", 0.5)
    asked = ("fit", "--device", device_alone, "--threads", 1, "--out", tmp_path / "x.json")
    assert run(*asked, "--budget", 60, "--json").json["n"] == 33


def test_a_fit_on_a_busy_machine_is_told_to_be_one(
    run: Any, device_alone: Path, made_up: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every second network of 60, and every fourth: more and less than a third."""
    plain = made_up.time
    for each, told in ((2, True), (4, False)):

        def time(bench: Any, job: Job, each: int = each) -> Timing:
            bench.busy = len(bench.timed) % each == 1
            found: Timing = plain(bench, job)
            return found

        monkeypatch.setattr(made_up, "time", time)
        asked = ("fit", "--device", device_alone, "--threads", 1, "--budget", 60)
        found = run(*asked, "--out", tmp_path / f"{each}.json")
        assert found.code == 0
        assert ("of 60 networks were timed while the machine was busy" in found.err) == told
        assert found.err.count("\n") == told


def test_a_budget_without_a_single_timing_is_one_line(
    run: Any, made_up: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Opening the bench alone may take longer than a small budget."""

    class Late(made_up):  # type: ignore[misc]
        def __init__(self, runtime: str, threads: int) -> None:
            super().__init__(runtime, threads)
            CLOCK.now += 5

    monkeypatch.setattr(measure, "Bench", Late)
    asked = ("fit", "--device", "cpu", "--out", tmp_path / "x.json", "--budget", 3)
    refused(run(*asked), 1, "0 reliable timings are too few", "longer --budget")


@pytest.mark.usefixtures("made_up")
def test_fit_refuses_timings_of_another_seed_or_threads_and_keeps_them(
    run: Any, tmp_path: Path
) -> None:
    path = tmp_path / "x.json"
    asked = ("fit", "--device", "cpu", "--threads", 1, "--out", path, "--budget", 3)
    run(*asked)
    journal = (tmp_path / "x.timings.json").read_bytes()
    for other in (("--seed", 1), ("--threads", 2)):
        refused(run(*asked, *other), 1, "another machine, version, runtime or seed")
    assert (tmp_path / "x.timings.json").read_bytes() == journal


@pytest.fixture
def openvino_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if OpenVINO were installed, whether it is or not; the made-up machine needs none."""
    told = {"openvino": here.installed("openvino") or "none"}
    row = replace(RUNTIMES["openvino"], missing=lambda: None, versions=lambda: told)
    monkeypatch.setitem(RUNTIMES, "openvino", row)


@pytest.fixture
def both(device: Path, run: Any, made_up: Any, openvino_here: None, tmp_path: Path) -> Path:
    """The made-up machine's profile in ONNX Runtime, and fitted in OpenVINO beside it."""
    path = tmp_path / "both.json"
    asked = ("fit", "--device", device, "--threads", 2, "--runtime", "openvino", "--budget", 24)
    assert run(*asked, "--out", path).code == 0
    return path


def test_a_second_runtime_is_fitted_beside_the_first(run: Any, both: Path, device: Path) -> None:
    first, found = load(str(device)), load(str(both))
    assert [c.runtime for c in found.calibrations] == ["onnxruntime", "openvino"]
    assert found.calibrations[0] == first.calibrations[0]
    assert (both.parent / "both.openvino.timings.json").exists()
    asked = ("fit", "--device", both, "--out", both, "--threads", 2, "--runtime", "openvino")
    told = run(*asked, "--budget", 1, "--json").json
    assert (told["n"], [row["n"] for row in told["calibrations"]]) == (25, [24, 25])
    shown = run(*asked, "--budget", 1)
    assert (shown.code, shown.err) == (0, "")
    assert "fp32 on openvino: 26 timings" in shown.out
    assert "kept      what both tells of ONNX Runtime" in shown.out
    assert "on onnxruntime" not in shown.out
    assert load(str(both)).calibrations[0] == first.calibrations[0]


@pytest.mark.usefixtures("made_up", "openvino_here")
def test_what_is_of_other_threads_is_not_kept_and_told(
    run: Any, device: Path, tmp_path: Path
) -> None:
    path = tmp_path / "x.json"
    asked = ("fit", "--device", device, "--threads", 1, "--runtime", "openvino", "--budget", 24)
    found = run(*asked, "--out", path)
    assert found.code == 0
    assert found.err == (
        "note: what made-up tells of ONNX Runtime is not kept: "
        "the profile is for 2 threads, not 1\n"
    )
    assert [c.runtime for c in load(str(path)).calibrations] == ["openvino"]
    again = run("fit", "--device", path, "--threads", 2, "--budget", 24, "--out", path)
    assert "note: what x tells of OpenVINO is not kept: the profile is for 1 threads" in again.err
    assert [c.runtime for c in load(str(path)).calibrations] == ["onnxruntime"]
    assert load(str(path)).refusal("fp16") is not None


@pytest.mark.usefixtures("made_up")
def test_two_runtimes_are_checked_side_by_side(run: Any, both: Path, tmp_path: Path) -> None:
    out = tmp_path / "check"
    asked = ("check", "--device", both, "--samples", 12, "--threads", 2)
    found = run(*asked, "--json", "--out", out)
    told = json.loads(found.out)
    assert {point["runtime"] for point in told["points"]} == {"onnxruntime", "openvino"}
    assert told == json.loads((out / "check.json").read_text())
    assert (out / "check.png").stat().st_size > 10_000


def test_a_runtime_that_is_missing_is_skipped_with_a_note(
    run: Any, both: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = replace(RUNTIMES["openvino"], missing=lambda: "OpenVINO is not installed; pip brings it")
    monkeypatch.setitem(RUNTIMES, "openvino", row)
    found = run("check", "--device", both, "--samples", 6, "--threads", 2, "--json")
    assert "note: not timed: OpenVINO is not installed; pip brings it\n" in found.err
    points = json.loads(found.out)["points"]
    assert [point["runtime"] for point in points] == ["onnxruntime"] * 6


def test_fit_in_a_runtime_that_is_missing_names_its_extra(
    run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ov, "find_spec", lambda _: None)
    path = tmp_path / "x.json"
    found = run("fit", "--device", "cpu", "--runtime", "openvino", "--out", path)
    refused(found, 1, "OpenVINO is not installed", "pip install 'rts2[openvino]'")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("made_up")
@pytest.mark.parametrize("name", ["My CPU.json", "_x.json", "größe.json"])
def test_a_file_name_gives_a_profile_that_loads_or_is_refused_at_once(
    run: Any, tmp_path: Path, name: str
) -> None:
    """Five minutes of timing must not end in a profile that no command reads."""
    before = CLOCK.now
    found = run("fit", "--device", "cpu", "--out", tmp_path / name, "--budget", 24)
    if found.code == 0:
        assert load(str(tmp_path / name)).points
    else:
        refused(found, 2, name)
        assert CLOCK.now == before
        assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("made_up")
def test_an_out_that_is_a_folder_is_refused_before_the_budget_is_spent(
    run: Any, tmp_path: Path
) -> None:
    before = CLOCK.now
    found = run("fit", "--device", "cpu", "--out", tmp_path, "--budget", 12)
    assert found.code in (1, 2)
    refused(found, found.code, str(tmp_path))
    assert CLOCK.now == before


def test_fit_of_a_published_device_fits_its_own_points_again(run: Any, tmp_path: Path) -> None:
    path = tmp_path / "again.json"
    found = run("fit", "--device", "tx2", "--out", path, "--json").json
    shipped = load("tx2")
    assert found["n"] == len(shipped.calibrations[0].residuals)
    again = load(str(path))
    assert again.points == shipped.points
    for new, old in zip(again.calibrations, shipped.calibrations, strict=True):
        assert new.residuals == pytest.approx(old.residuals, abs=1e-6)
    assert [p.name for p in tmp_path.iterdir()] == ["again.json"]


SLOW = """
import sys, time
from rts2.model.ops import ops
from rts2.profiles import measure
from rts2.profiles.cli import profile
from rts2.profiles.parts import PartModel, parts

class Slow:
    precisions = ("fp32",)
    def __init__(self, runtime, threads):
        with open(sys.argv[1]) as file:
            self.model = PartModel.model_validate_json(file.read())
    def harvest(self, job):
        time.sleep(0.02)
        found = parts(ops(job.arch, job.resolution), job.forms)
        parts_ms = {part.name: self.model.cost_ms(part) for part in found}
        latency_ms = sum(parts_ms.values())
        return measure.Sample(
            arch=job.arch, resolution=job.resolution, precision=job.precision, reliable=True,
            forms=job.forms,
            error=0.01, latency_ms=latency_ms, reference_ms=10, ratio=latency_ms / 10,
            parts_ms=parts_ms,
        )

measure.Bench = Slow
sys.exit(profile(sys.argv[2:]))
"""


def test_a_killed_fit_goes_on_from_its_samples_and_repeats_none(
    run: Any, device_alone: Path, made_up: Any, tmp_path: Path
) -> None:
    path, journal = tmp_path / "x.json", tmp_path / "x.timings.json"
    truth = tmp_path / "truth.json"
    truth.write_text(made_up.truth.model_dump_json())
    asked = [
        "fit",
        "--device",
        str(device_alone),
        "--threads",
        "1",
        "--budget",
        "24",
        "--out",
        str(path),
    ]
    started = subprocess.Popen([sys.executable, "-c", SLOW, str(truth), *asked])
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and started.poll() is None:
        if journal.exists() and len(json.loads(journal.read_text())["samples"]) >= 3:
            break
        time.sleep(0.01)
    os.kill(started.pid, signal.SIGKILL)
    assert started.wait() == -signal.SIGKILL
    assert not path.exists()
    before = json.loads(journal.read_text())["samples"]
    assert len(before) >= 3
    assert run(*asked, "--json").json["n"] == len(before) + 24
    after = json.loads(journal.read_text())["samples"]
    assert after[: len(before)] == before
    timed = [
        Job(
            Arch.model_validate(s["arch"]),
            tuple(s["resolution"]),
            s["precision"],
            tuple(s["forms"]),
        )
        for s in after
    ]
    assert timed == list(islice(jobs(0, ("fp32",)), len(after)))


@pytest.fixture(scope="module")
def graph(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("graphs") / "small.onnx"
    small = Arch(c=1, stages=1, d_max=6, conv3d=(4,), semantic=False)
    export(build(small), path, (96, 64), UNTRAINED)
    return path


@pytest.mark.usefixtures("quick")
def test_measure_tells_each_file_beside_the_reference(run: Any, graph: Path) -> None:
    found = run("measure", graph, graph, "--threads", 1, "--json").json
    assert found["schema"] == "rts2.profile-measure/1"
    assert found["machine"]["threads"] == 1
    assert [row["model"] for row in found["models"]] == [str(graph)] * 2
    for row in found["models"]:
        assert row["fps"] == pytest.approx(1000 / row["latency_ms"])
        assert row["latency_ms"] <= row["p95_ms"]
        assert row["runs"] >= 10
        assert row["reference_ms"] > 0
    shown = run("measure", graph, "--threads", 1)
    assert (shown.code, shown.err) == (0, "")
    assert "FPS" in shown.out
    assert "ONNX Runtime (onnxruntime" in shown.out
    assert "1 thread," in shown.out


def odd_graph(path: Path, kind: str) -> Path:
    """Files that are none, or whose inputs cannot be made up."""
    if kind in ("text", "empty"):
        path.write_text("junk" if kind == "text" else "")
        return path
    shape = ["N", 3] if kind == "open shape" else [2, 3]
    of = TensorProto.INT32 if kind == "integers" else TensorProto.FLOAT
    operator = "Nonsense" if kind == "unknown operator" else "Neg"
    values = [helper.make_tensor_value_info(name, of, shape) for name in ("x", "y")]
    body = helper.make_graph(
        [helper.make_node(operator, ["x"], ["y"])], "g", *[[v] for v in values]
    )
    model = helper.make_model(body, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.save(model, path)
    return path


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("kind", ["text", "empty", "open shape", "integers", "unknown operator"])
def test_measure_refuses_what_it_cannot_run_by_name(run: Any, tmp_path: Path, kind: str) -> None:
    path = odd_graph(tmp_path / "odd.onnx", kind)
    refused(run("measure", path, "--threads", 1), 1, str(path))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "ACTION"),
        (["dance"], "dance"),
        (["show", "toaster"], "unknown device 'toaster'; known are cpu, rtx2080ti, tx2"),
        (["check", "--device", "toaster"], "unknown device"),
        (["show", "no/such.json"], "there is no such file"),
        (["check", "--device", "no-such.json"], "there is no such file"),
        (["fit", "--device", "no-such.json", "--out", "x.json"], "there is no such file"),
        (["check"], "--device"),
        (["fit", "--device", "cpu"], "--out"),
        (["check", "--device", "cpu", "--samples", "0"], "whole number above 0, not '0'"),
        (["check", "--device", "cpu", "--samples", "-3"], "whole number above 0, not '-3'"),
        (["check", "--device", "cpu", "--samples", "1.5"], "whole number above 0, not '1.5'"),
        (["check", "--device", "tx2", "--samples", "3"], "Jetson TX2 is not this machine"),
        (["fit", "--device", "cpu", "--out", "x.json", "--budget", "0"], "not '0'"),
        (["fit", "--device", "cpu", "--out", "x.json", "--budget", "nan"], "not 'nan'"),
        (["fit", "--device", "cpu", "--out", "x.json", "--threads", "0"], "above 0, not '0'"),
        (["fit", "--device", "cpu", "--out", "x.json", "--seed", "a"], "--seed"),
        (["measure"], "MODEL"),
        (["measure", "no-such.onnx"], "there is no such file"),
        (["measure", "."], "it is a folder"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_wrong_use_is_one_line_and_writes_nothing(
    run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    refused(run(*arguments), 2, said)
    refused(run(*arguments, "--json"), 2)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("text", ["", "{", "[]", '{"schema": "rts2.search/1"}', "\x00"])
def test_a_file_that_is_no_profile_is_one_line(run: Any, tmp_path: Path, text: str) -> None:
    path = tmp_path / "x.json"
    path.write_text(text)
    for arguments in (["show", path], ["check", "--device", path]):
        refused(run(*arguments), 1, str(path))


@pytest.mark.parametrize("action", ["list", "show", "check", "fit", "measure"])
def test_every_action_has_help(capsys: pytest.CaptureFixture[str], action: str) -> None:
    assert profile([action, "--help"]) == 0
    assert "--json" in capsys.readouterr().out
