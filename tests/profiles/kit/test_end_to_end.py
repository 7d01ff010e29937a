"""Kit, run.sh, collect.py, import: all of it, with a stand-in for `trtexec`."""

import ast
import hashlib
import json
import shutil
import subprocess
import sys
from importlib import resources
from pathlib import Path
from typing import Any

import pytest

from rts2.model.errors import Rts2Error
from rts2.model.graph import read_header
from rts2.profiles import opset
from rts2.profiles.cli import profile
from rts2.profiles.kit import folder
from rts2.profiles.kit.folder import write
from rts2.profiles.kit.manifest import Manifest
from rts2.profiles.latency import predict_ms
from rts2.profiles.opset import load_opset, operators
from rts2.profiles.profile import load

from .conftest import Device, small, truth

SCRIPTS = resources.files("rts2.profiles.kit") / "scripts"
ALWAYS = {"README.md", "collect.py", "manifest.json", "run.sh"}


def told(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    code = profile([str(word) for word in words])
    printed = capsys.readouterr()
    return code, printed.out, printed.err


def test_a_kit_is_what_its_manifest_says_and_equal_arguments_give_the_same(
    tmp_path: Path,
) -> None:
    chosen = [small()[0], small()[8]]  # one stage, disparity; three stages, full
    manifest = write(load("tx2"), ("fp32", "fp16"), tmp_path / "kit", chosen)
    found = {file.name for file in (tmp_path / "kit").iterdir()}
    assert found == ALWAYS | {n.file for n in manifest.networks}
    assert manifest.kit == manifest.identity()
    table = load_opset("tensorrt-8.2")
    for network, (arch, resolution) in zip(manifest.networks, chosen, strict=True):
        path = tmp_path / "kit" / network.file
        header = read_header(path)
        assert (header.arch, header.resolution) == (arch, resolution)
        assert (network.arch, network.resolution) == (arch, resolution)
        assert hashlib.sha256(path.read_bytes()).hexdigest() == network.sha256
        version, used = operators(path)
        assert version <= table.max_opset
        assert set(used) <= table.operators.keys()
    assert write(load("tx2"), ("fp32", "fp16"), tmp_path / "again", chosen) == manifest
    for name in found:
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "kit" / name).read_bytes()


def test_a_kit_leaves_other_files_alone_and_replaces_an_older_kit(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    first = write(load("tx2"), ("fp32",), tmp_path, small()[:1])
    second = write(load("tx2"), ("fp16",), tmp_path, small()[:1])
    assert first.kit != second.kit
    assert (tmp_path / "notes.txt").read_text() == "mine"
    stored = Manifest.model_validate_json((tmp_path / "manifest.json").read_text())
    assert stored == second


def test_an_operator_that_the_device_lacks_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = load_opset("tensorrt-8.2")
    few = {name: op for name, op in table.operators.items() if name != "Conv"}
    monkeypatch.setattr(opset, "load_opset", lambda _: table.model_copy(update={"operators": few}))
    with pytest.raises(Rts2Error, match="the graph needs Conv"):
        write(load("tx2"), ("fp32",), tmp_path / "kit", small()[:1])
    assert list((tmp_path / "kit").iterdir()) == []


def test_the_script_is_posix_and_has_the_flags_of_that_tensorrt(device: Device) -> None:
    script = device.folder / "run.sh"
    subprocess.run(["sh", "-n", str(script)], check=True)
    assert "@" not in script.read_text().replace('"$@"', "")
    device.keep(2)
    device.run()
    timed = {"network-01", "network-02", device.manifest.reference}
    calls = device.called()
    built = [call for call in calls if "--onnx=" in call]
    assert len(built) == len(set(built)) == 2 * len(timed)
    assert all("--workspace=1024" in call and "--memPoolSize" not in call for call in built)
    assert sum("--fp16" in call for call in built) == len(timed)
    beside = [call for call in calls if "--loadEngine=" in call]
    assert len(beside) == len(built)  # the reference, after each


def test_every_network_is_timed_and_the_truth_comes_back(ran: Device) -> None:
    found = ran.results()
    assert found["manifest"] == json.loads((ran.folder / "manifest.json").read_text())
    assert len(found["rows"]) == 24
    reference = ran.manifest.network(ran.manifest.reference)
    assert reference is not None
    for row in found["rows"]:
        network = ran.manifest.network(row["network"])
        assert network is not None
        assert row["status"] == "timed"
        assert row["version"] == "8.2.1"
        expected = predict_ms(truth(), network.arch, network.resolution)
        assert row["latency_ms"] == pytest.approx(expected, rel=1e-4)  # six digits are printed
        assert row["p95_ms"] == pytest.approx(1.02 * expected, rel=1e-4)
        beside = predict_ms(truth(), reference.arch, reference.resolution)
        assert row["reference_ms"] == pytest.approx(beside, rel=1e-4)
        assert row["state"]["date"].startswith("20")
        assert row["state"]["system"]


def test_import_gives_a_profile_that_every_command_takes(
    ran: Device, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = ran.results()
    found["rows"] = [row for row in found["rows"] if row["precision"] == "fp32"]
    (ran.folder / "kit-results.json").write_text(json.dumps(found))
    path = tmp_path / "tx2-mine.json"
    words = ("import", ran.folder / "kit-results.json", "--device", "tx2", "--out", path)
    code, out, err = told(capsys, *words, "--json")
    assert code == 0
    assert err == ("note: nothing was timed in fp16: its latency stays what the profile derives\n")
    result = json.loads(out)
    assert result["schema"] == "rts2.profile-import/1"
    assert [row["n"] for row in result["calibrations"]] == [12]
    made = load(str(path))
    assert made.name == "tx2-mine"
    before = {(d.runtime, d.precision) for d in load("tx2").derivations}
    assert {(d.runtime, d.precision) for d in made.derivations} == before - {("tensorrt", "fp32")}
    points = made.points_of("tensorrt", "fp32")
    assert len(points) == 12
    assert {point.evidence for point in points} == {"measured"}
    assert all("TensorRT 8.2.1" in point.source for point in points)
    known = made.calibration("tensorrt", "fp32")
    for arch, resolution in small():
        predicted = predict_ms(known.model, arch, resolution)
        assert predicted == pytest.approx(predict_ms(truth(), arch, resolution), rel=0.03)
    assert any(fact.name == "date when timed" for fact in made.hardware)
    # The published points, and what was fitted to them, stay as they were.
    published = load("tx2").calibration("pytorch", "fp32")
    assert made.calibration("pytorch", "fp32") == published

    code, out, err = told(capsys, "check", "--device", path, "--json")
    assert (code, err) == (0, "")
    checked = json.loads(out)
    assert checked["n"] == 12 + len(published.residuals)
    mine = [p for p in checked["points"] if (p["runtime"], p["precision"]) == ("tensorrt", "fp32")]
    errors = [abs(p["fps_predicted"] / p["fps_true"] - 1) for p in mine]
    assert sum(errors) / 12 == pytest.approx(result["calibrations"][0]["mape"], rel=1e-6)
    for action in ("show", "list"):
        code, out, err = told(capsys, action, *([path] if action == "show" else []))
        assert (code, err) == (0, "")


def test_what_was_timed_before_is_not_timed_again(ran: Device) -> None:
    ended = ran.run()
    assert ended.returncode == 0
    assert ended.stdout.count("was timed before") == 24
    assert ran.called() == []


def test_an_interrupted_run_goes_on_with_what_is_missing(ran: Device) -> None:
    (ran.logs / "network-05.fp16.log").unlink()
    (ran.logs / "network-07.fp32.log").rename(ran.logs / "network-07.fp32.log.part")
    assert ran.run().returncode == 0
    built = [call for call in ran.called() if "--onnx=" in call]
    assert sorted(call.split()[0] for call in built) == [
        "--onnx=network-05.onnx",
        "--onnx=network-07.onnx",
    ]
    assert len(ran.results()["rows"]) == 24


def test_a_failing_network_is_recorded_and_tried_again_later(
    ran: Device, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for path in ran.logs.glob("network-03.*"):
        path.unlink()
    ended = ran.run(KIT_FAILS="network-03.onnx")
    assert ended.returncode == 0
    assert ended.stdout.count("FAILED") == 2
    rows = {(row["network"], row["precision"]): row for row in ran.results()["rows"]}
    assert len(rows) == 24
    failed = rows["network-03", "fp16"]
    assert failed["status"] == "failed"
    assert "Error[10]: no implementation for a node" in failed["reason"]
    path = tmp_path / "mine.json"
    words = ("import", ran.folder / "kit-results.json", "--device", "tx2", "--out", path)
    code, out, err = told(capsys, *words)
    assert code == 0
    assert err.count("network-03 fp16 failed on the device: ") == 1
    assert "tensorrt fp16: 11 timings" in out
    ran.run()
    assert all(row["status"] == "timed" for row in ran.results()["rows"])


def test_times_that_are_far_apart_are_repeated_then_told(device: Device) -> None:
    device.keep(1)
    device.run(KIT_SPREAD="0.5")
    built = [call for call in device.called() if "--onnx=network-01.onnx" in call]
    assert len(built) == 6  # three attempts in each precision
    ended = device.collect()
    assert ended.returncode == 0
    assert ended.stdout.count("not steady") == 4  # the reference is timed too


@pytest.mark.parametrize(
    ("release", "version"), [("8201", "8.2.1"), ("8503", "8.5.3"), ("100300", "10.3.0")]
)
def test_the_version_is_read_from_the_log(device: Device, release: str, version: str) -> None:
    device.keep(1)
    if version == "10.3.0":  # has no --workspace any more
        script = device.folder / "run.sh"
        pools = script.read_text().replace("--workspace=", "--memPoolSize=workspace:")
        script.write_text(pools)
    device.run(KIT_RELEASE=release)
    assert {row["version"] for row in device.results()["rows"]} == {version}


@pytest.mark.parametrize("cut", ["before the summary", "before the end"])
def test_a_truncated_log_is_a_failure(ran: Device, cut: str) -> None:
    path = ran.logs / "network-04.fp32.log"
    mark = "GPU Compute Time: min" if cut == "before the summary" else "&&&& PASSED"
    path.write_text(path.read_text().partition(mark)[0])
    rows = {(row["network"], row["precision"]): row for row in ran.results()["rows"]}
    assert rows["network-04", "fp32"]["status"] == "failed"
    assert rows["network-04", "fp32"]["reason"] == "the log ends before trtexec passed"


def test_a_log_of_another_network_is_a_failure(ran: Device) -> None:
    shutil.copy(ran.logs / "network-04.fp32.log", ran.logs / "network-05.fp32.log")
    rows = {(row["network"], row["precision"]): row for row in ran.results()["rows"]}
    assert rows["network-05", "fp32"]["reason"] == "the log is of another network"


@pytest.mark.parametrize("kind", ["changed", "missing", "nothing"])
def test_the_collector_refuses_in_one_line(ran: Device, kind: str) -> None:
    path = ran.folder / "network-04.onnx"
    if kind == "changed":
        path.write_bytes(path.read_bytes()[:-1] + b"\x00")
    elif kind == "missing":
        path.unlink()
    else:
        shutil.rmtree(ran.logs)
    ended = ran.collect()
    assert ended.returncode == 1
    assert ended.stderr.count("\n") == 1
    assert ("network-04.onnx" in ended.stderr) == (kind != "nothing")
    assert not (ran.folder / "kit-results.json").exists()


def test_without_trtexec_the_script_says_so(device: Device) -> None:
    ended = device.run(TRTEXEC="/no/such/trtexec", PATH="/usr/bin:/bin")
    assert ended.returncode == 1
    assert "set TRTEXEC" in ended.stderr


def test_the_collector_is_python_3_6() -> None:
    """JetPack 4.6 has no other; and it imports the standard library alone."""
    tree = ast.parse((SCRIPTS / "collect.py").read_text("utf-8"), feature_version=(3, 6))
    imported = {
        name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names
    }
    assert not [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    assert imported <= set(sys.stdlib_module_names)


def test_the_command_writes_a_kit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(folder, "networks", lambda _: small()[:1])
    words: tuple[Any, ...] = ("kit", "--device", "tx2", "--out", tmp_path / "kit")
    code, out, err = told(capsys, *words, "--json")
    assert (code, err) == (0, "")
    found = json.loads(out)
    assert (found["schema"], found["networks"]) == ("rts2.profile-kit/1", 1)
    assert found["precisions"] == ["fp32", "fp16"]
    code, out, err = told(capsys, *words, "--precision", "fp16")
    assert (code, err) == (0, "")
    assert "sh run.sh" in out
    stored = json.loads((tmp_path / "kit" / "manifest.json").read_text())
    assert stored["precisions"] == ["fp16"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["kit"], "--device"),
        (["kit", "--device", "toaster"], "unknown device 'toaster'"),
        (["kit", "--device", "cpu"], "has no TensorRT"),
        (["kit", "--device", "tx2", "--precision", "int8"], "no int8 engine of a float graph"),
        (["kit", "--device", "tx2", "--precision", "fp8"], "fp8"),
        (["kit", "--device", "tx2", "--precision", "fp32,fp32"], "each once"),
        (["import", "x.json", "--out", "y.json"], "--device"),
        (["import", "x.json", "--device", "tx2"], "--out"),
        (["import", "no-such.json", "--device", "tx2", "--out", "y.json"], "no such file"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_wrong_use_is_one_line_and_writes_nothing(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = told(capsys, *words)
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert said in err
    assert list(tmp_path.iterdir()) == []
