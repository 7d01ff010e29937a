"""rts2-profile as a person or a script meets it: what it prints, what it keeps, how it refuses."""

import json
import os
import signal
import subprocess
import sys
import time
from itertools import islice
from pathlib import Path
from typing import Any

import onnx
import pytest
from onnx import TensorProto, helper

from rts2.model.arch import UNTRAINED, Arch
from rts2.model.checkpoint import build
from rts2.model.export import export
from rts2.profiles import cli, measure, timing
from rts2.profiles.calibrate import leave_one_out
from rts2.profiles.cli import profile
from rts2.profiles.latency import predict_ms
from rts2.profiles.profile import Resolution, load, names
from rts2.profiles.timing import Timing


class Clock:
    """A clock that only `Planted` moves on: a budget is spent exactly."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


class Planted:
    """In the place of the bench: the cpu profile's own latencies, one second a network."""

    def __init__(self, threads: int) -> None:
        self.threads = threads

    def time(self, arch: Arch, resolution: Resolution) -> Timing:
        CLOCK.now += 1
        latency_ms = predict_ms(load("cpu").calibrations[0].model, arch, resolution)
        machine = load("cpu").machine
        assert machine is not None
        return Timing(latency_ms, 1.1 * latency_ms, 10, machine.reference_ms or 10.0)


CLOCK = Clock()


@pytest.fixture
def planted(monkeypatch: pytest.MonkeyPatch) -> None:
    """No network runs, and no second passes."""
    monkeypatch.setattr(measure, "Bench", Planted)
    monkeypatch.setattr(cli, "monotonic", CLOCK)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Real networks, timed no longer than needed beside a small reference."""
    monkeypatch.setattr(measure, "REFERENCE", (Arch(c=1, stages=1, d_max=6), (64, 64)))
    monkeypatch.setattr(timing, "WARM_UP_S", 0.01)
    monkeypatch.setattr(timing, "MIN_SECONDS", 0.01)


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


def test_list_names_every_device_with_what_it_can(run: Any) -> None:
    found = run("list", "--json").json
    assert found["schema"] == "rts2.profiles/1"
    assert [device["name"] for device in found["devices"]] == names()
    by_name = {device["name"]: device for device in found["devices"]}
    assert by_name["tx2"]["evidence"] == ["published"]
    assert by_name["cpu"]["evidence"] == ["measured"]
    assert by_name["cpu"]["runtimes"] == ["onnxruntime"]
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
    last = shown.out.strip().splitlines()[-1]
    assert last.startswith(f"{found['n']} networks left out in turn: ")
    assert f"mean error {found['mape']:.1%}, worst {found['max_ape']:.1%}" in last
    assert len(shown.out.strip().splitlines()) == found["n"] + 3


@pytest.mark.usefixtures("planted")
def test_check_with_samples_times_networks_now(run: Any) -> None:
    asked = ("check", "--device", "cpu", "--samples", 4, "--threads", 1)
    told = run(*asked, "--json")
    assert told.code == 0
    found = json.loads(told.out)
    assert found["n"] == 4
    assert found["mape"] == pytest.approx(0, abs=1e-9)
    assert json.loads(run(*asked, "--seed", 1, "--json").out)["points"] != found["points"]
    assert "4 networks timed now" in run(*asked).out


@pytest.mark.usefixtures("planted")
def test_another_machine_is_told_on_stderr_alone(run: Any, tmp_path: Path) -> None:
    path = tmp_path / "box.json"
    stored = load("cpu").model_dump(mode="json", by_alias=True, exclude_none=True)
    stored["machine"]["processor"] = "[red] Pentium"
    path.write_text(json.dumps(stored))
    found = run("check", "--device", path, "--samples", 2, "--json")
    assert found.code == 0
    assert json.loads(found.out)["n"] == 2
    assert "note: the profile is of [red] Pentium; this is" in found.err


@pytest.mark.usefixtures("planted")
def test_fit_spends_its_budget_and_writes_a_profile_that_loads(run: Any, tmp_path: Path) -> None:
    path = tmp_path / "new" / "my-cpu.json"
    asked = ("fit", "--device", "cpu", "--threads", 1, "--out", path)
    found = run(*asked, "--budget", 12, "--json").json
    assert (found["schema"], found["file"]) == ("rts2.profile-fit/1", str(path))
    assert found["n"] == 12
    assert found["max_ape"] < 1e-3
    fitted = load(str(path))
    assert (fitted.name, len(fitted.points)) == ("my-cpu", 12)
    assert fitted.machine is not None
    assert fitted.machine.threads == 1
    assert sorted(p.name for p in path.parent.iterdir()) == ["my-cpu.json", "my-cpu.timings.json"]
    longer = run(*asked, "--budget", 2)
    assert (longer.code, longer.err) == (0, "")
    assert "14 timings" in longer.out
    assert load(str(path)).points[:12] == fitted.points


@pytest.mark.usefixtures("planted")
def test_a_budget_that_is_too_small_keeps_its_timings_and_goes_on(run: Any, tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    asked = ("fit", "--device", "cpu", "--threads", 1, "--out", path, "--budget", 6)
    refused(run(*asked), 1, "6 networks were timed and a fit needs 10", "longer --budget")
    assert not path.exists()
    assert run(*asked, "--json").json["n"] == 12


@pytest.mark.usefixtures("planted")
def test_fit_refuses_timings_of_another_seed_and_keeps_them(run: Any, tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    asked = ("fit", "--device", "cpu", "--threads", 1, "--out", path, "--budget", 3)
    run(*asked)
    journal = (tmp_path / "x.timings.json").read_bytes()
    refused(run(*asked, "--seed", 1), 1, "another machine, version or seed")
    refused(run(*asked, "--threads", 2), 1, "another machine, version or seed")
    assert (tmp_path / "x.timings.json").read_bytes() == journal


@pytest.mark.usefixtures("planted")
@pytest.mark.parametrize("name", ["My CPU.json", "_x.json", "größe.json"])
def test_a_file_name_gives_a_profile_that_loads_or_is_refused_at_once(
    run: Any, tmp_path: Path, name: str
) -> None:
    """Five minutes of timing must not end in a profile that no command reads."""
    before = CLOCK.now
    found = run("fit", "--device", "cpu", "--out", tmp_path / name, "--budget", 12)
    if found.code == 0:
        assert load(str(tmp_path / name)).points
    else:
        refused(found, 2, name)
        assert CLOCK.now == before
        assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("planted")
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
from rts2.profiles import measure
from rts2.profiles.cli import profile
from rts2.profiles.latency import predict_ms
from rts2.profiles.profile import load
from rts2.profiles.timing import Timing

class Slow:
    def __init__(self, threads):
        self.model = load("cpu").calibrations[0].model
    def time(self, arch, resolution):
        time.sleep(0.02)
        latency_ms = predict_ms(self.model, arch, resolution)
        return Timing(latency_ms, latency_ms, 10, 10.0)

measure.Bench = Slow
sys.exit(profile(sys.argv[1:]))
"""


@pytest.mark.usefixtures("planted")
def test_a_killed_fit_goes_on_from_its_samples_and_repeats_none(run: Any, tmp_path: Path) -> None:
    path, journal = tmp_path / "x.json", tmp_path / "x.timings.json"
    asked = ["fit", "--device", "cpu", "--threads", "1", "--budget", "20", "--out", str(path)]
    started = subprocess.Popen([sys.executable, "-c", SLOW, *asked])
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
    assert run(*asked, "--json").json["n"] == len(before) + 20
    after = json.loads(journal.read_text())["samples"]
    assert after[: len(before)] == before
    timed = [(Arch.model_validate(s["arch"]), tuple(s["resolution"])) for s in after]
    assert timed == list(islice(measure.candidates(0), len(after)))


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
    assert "ONNX Runtime, 1 threads" in shown.out


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
