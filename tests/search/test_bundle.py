"""The deployment bundle: what is in it runs there, and notices when it does not."""

import ast
import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch

from rts2.model.arch import Arch, Precision
from rts2.model.checkpoint import build
from rts2.model.errors import Rts2Error, UsageError
from rts2.model.graph import read_header
from rts2.profiles import opset
from rts2.profiles.opset import load_opset, operators, refuse_operators
from rts2.profiles.profile import Profile, Runtime, RuntimeSupport, load
from rts2.search.deploy.bundle import next_step, runtime_of, trtexec, write
from rts2.search.deploy.configuration import Deployment, of_point, read
from rts2.search.result import Coverage, Found, Point, PointEvidence

SIZE = (90, 60)
SHAPE = (1, 3, 64, 96)
SMALL = Arch(c=1, stages=2, d_max=6, conv3d=(4, 2))
SCRIPTS = resources.files("rts2.search.deploy") / "scripts"
ALWAYS = {
    *("README.md", "check.py", "measured.py", "model.onnx"),
    *("sample_disparity.bin", "sample_left.bin", "sample_right.bin"),
}
DEVICES: dict[str, tuple[Runtime, Precision]] = {
    "tx2": ("tensorrt", "fp16"),
    "rtx2080ti": ("pytorch", "fp32"),
    "cpu": ("onnxruntime", "fp32"),
}
"""What the front's pick runs on, by device."""


def asked(profile: Profile, runtime: Runtime, precision: Precision) -> Deployment:
    """What a front would ask for; the numbers are made up."""
    point = Point(
        arch=SMALL,
        precision=precision,
        runtime=runtime,
        latency_ms=40,
        fps=25,
        fps_low=21.5,
        fps_high=29,
        d1_all=5.5,
        epe=None,
        miou=None,
        pacc=None,
        params=1,
        size_bytes=4,
        macs=1,
        evidence=PointEvidence(latency="extrapolated", accuracy="published"),
    )
    found = Found(
        device=profile.name,
        target_fps=20,
        resolution=SIZE,
        task="semantic-stereo",
        objective="d1_all",
        confidence=0.9,
        space=Coverage(size=1, evaluated=1, exhaustive=True),
        front=(point,),
        selected=point,
        prospect=point,
        nearest=None,
        left_out=(),
        elapsed_s=0,
    )
    return of_point(point, found, profile)


def written(device: str, folder: Path) -> Path:
    """The bundle of a device, of random weights that are always the same."""
    folder.mkdir()
    profile = load(device)
    torch.manual_seed(0)
    write(build(SMALL), asked(profile, *DEVICES[device]), profile, "untrained", folder)
    return folder


@pytest.fixture(scope="module")
def bundles(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("bundles")
    return {device: written(device, folder / device) for device in DEVICES}


@pytest.fixture
def copied(bundles: dict[str, Path], tmp_path: Path) -> dict[str, Path]:
    """The same, to be spoiled."""
    for device, folder in bundles.items():
        shutil.copytree(folder, tmp_path / device)
    return {device: tmp_path / device for device in bundles}


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def checked(
    folder: Path, instead: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """check.py as the target runs it: from elsewhere, and without rts2 on the path.

    `instead` has the text of modules that stand in for those which are installed.
    """
    modules = folder.parent / "instead"
    modules.mkdir(exist_ok=True)
    for name, text in (instead or {}).items():
        (modules / f"{name}.py").write_text(text)
    ended = subprocess.run(
        [sys.executable, str(folder / "check.py")],
        capture_output=True,
        text=True,
        cwd=folder.parent,
        env=os.environ | {"PYTHONPATH": str(modules)},
        check=False,
    )
    assert "Traceback" not in ended.stderr, ended.stderr
    return ended


@pytest.mark.parametrize("device", DEVICES)
def test_the_files_are_those_listed_with_their_sizes_and_hashes(
    bundles: dict[str, Path], device: str
) -> None:
    folder = bundles[device]
    deployment = read(folder / "deployment.json")
    listed = {file.name: file for file in deployment.files}
    assert names(folder) == listed.keys() | {"deployment.json"}
    assert listed.keys() == ALWAYS | ({"build.sh"} if device != "cpu" else set())
    for name, file in listed.items():
        data = (folder / name).read_bytes()
        assert file.size_bytes == len(data)
        assert file.sha256 == hashlib.sha256(data).hexdigest()


@pytest.mark.parametrize("device", DEVICES)
def test_the_configuration_promises_with_an_interval_and_its_evidence(
    bundles: dict[str, Path], device: str
) -> None:
    deployment = read(bundles[device] / "deployment.json")
    assert (deployment.device, deployment.arch) == (device, SMALL)
    assert deployment.runtime == runtime_of(load(device)).runtime
    assert deployment.precision == DEVICES[device][1]
    assert deployment.weights == "untrained"
    assert deployment.target_fps == 20
    expected = deployment.expected
    assert expected is not None
    assert expected.runtime == DEVICES[device][0]
    assert (expected.fps_low, expected.fps, expected.fps_high) == (21.5, 25, 29)
    assert (expected.evidence.latency, expected.evidence.accuracy) == ("extrapolated", "published")
    assert expected.confidence == 0.9
    readme = (bundles[device] / "README.md").read_text(encoding="utf-8")
    assert "25.0 FPS (21.5 to 29.0 at 90%), extrapolated" in readme
    assert next_step(deployment.runtime) in readme
    assert "random" in readme
    # The speed of PyTorch is promised, and TensorRT is what runs: said, not hidden.
    assert ("for pytorch; what is built here runs on tensorrt" in readme) == (device == "rtx2080ti")


@pytest.mark.parametrize("device", DEVICES)
def test_the_graph_is_one_that_the_runtime_reads(bundles: dict[str, Path], device: str) -> None:
    path = bundles[device] / "model.onnx"
    model = onnx.load(path)
    onnx.checker.check_model(model, full_check=True)
    support = runtime_of(load(device))
    version, used = operators(path)
    assert support.opset is not None
    assert version <= support.opset
    assert all(entry.domain in ("", "ai.onnx") for entry in model.opset_import)
    if device != "cpu":
        table = load_opset("tensorrt-8.2")
        assert version <= 13
        assert {node.op_type for node in model.graph.node} <= table.operators.keys()
        assert used
    deployment = read(bundles[device] / "deployment.json")
    dims = {
        value.name: tuple(d.dim_value for d in value.type.tensor_type.shape.dim)
        for value in (*model.graph.input, *model.graph.output)
    }
    assert dims == {
        **dict.fromkeys(deployment.input.names, deployment.input.shape),
        **{output.name: output.shape for output in deployment.outputs},
    }
    assert deployment.input.shape == SHAPE
    header = read_header(path)
    assert (header.arch, header.resolution, header.origin) == (SMALL, SIZE, "untrained")


@pytest.mark.parametrize("device", DEVICES)
def test_the_sample_is_a_pair_and_the_graphs_own_answer(
    bundles: dict[str, Path], device: str
) -> None:
    import onnxruntime

    folder = bundles[device]
    left, right, disparity = (
        np.fromfile(folder / f"sample_{name}.bin", "<f4") for name in ("left", "right", "disparity")
    )
    left, right = left.reshape(SHAPE), right.reshape(SHAPE)
    assert np.array_equal(left[..., 16:], right[..., :-16])
    assert not np.array_equal(left, right)
    session = onnxruntime.InferenceSession(
        folder / "model.onnx", providers=["CPUExecutionProvider"]
    )
    found = session.run(["disparity"], {"left": left, "right": right})[0]
    assert np.abs(found.ravel() - disparity).max() < 1e-3


def test_equal_arguments_give_equal_bytes(bundles: dict[str, Path], tmp_path: Path) -> None:
    for device in ("tx2", "cpu"):
        again = written(device, tmp_path / device)
        assert names(again) == names(bundles[device])
        for name in names(again):
            assert (again / name).read_bytes() == (bundles[device] / name).read_bytes(), name


@pytest.mark.parametrize("device", ["tx2", "rtx2080ti"])
def test_the_build_script_is_a_shell_script_that_may_run(
    bundles: dict[str, Path], device: str
) -> None:
    script = bundles[device] / "build.sh"
    assert os.access(script, os.X_OK)
    text = script.read_text()
    assert text.startswith("#!/bin/sh\n")
    subprocess.run(["sh", "-n", str(script)], check=True)
    assert ("--fp16" in text) == (device == "tx2")


@pytest.mark.parametrize("precision", ["fp32", "fp16", "int8"])
def test_half_precision_is_built_exactly_where_it_was_asked_for(precision: Precision) -> None:
    text = trtexec(asked(load("tx2"), "tensorrt", precision))
    calls = [call for call in text.replace("\\\n", " ").splitlines() if "--" in call]
    calls = [call for call in calls if not call.startswith("#")]
    assert len(calls) == 2
    assert ["--fp16" in call.split() for call in calls] == [precision == "fp16"] * 2


@pytest.mark.parametrize(
    ("device", "precision"), [("cpu", "bf16"), ("cpu", "fp16"), ("tx2", "int8")]
)
def test_a_precision_that_the_bundle_cannot_run_is_refused(
    tmp_path: Path, device: str, precision: Precision
) -> None:
    """The graph holds floats: a bundle that calls itself INT8 would promise another's speed."""
    profile = load(device)
    runtime = runtime_of(profile).runtime
    with pytest.raises(UsageError, match=precision):
        write(build(SMALL), asked(profile, runtime, precision), profile, "untrained", tmp_path)
    assert names(tmp_path) == set()


def test_the_check_passes_and_prints_both_frame_rates(copied: dict[str, Path]) -> None:
    ended = checked(copied["cpu"])
    assert (ended.returncode, ended.stderr) == (0, "")
    lines = [line.split() for line in ended.stdout.splitlines()]
    told = {line[0]: line[1:] for line in lines}
    assert float(told["measured"][0]) > 0
    assert told["expected"] == ["25.0", "FPS", "(21.5", "to", "29.0)", "on", "onnxruntime"]
    assert float(told["disparity"][0]) < 1e-3
    assert lines[-1] == ["ok"]


def beside(profile: Profile, *runtimes: Runtime) -> Profile:
    """The profile with more runtimes, as a fit writes them."""
    more = [
        RuntimeSupport(runtime=name, version="2026.3", source="rts2-profile") for name in runtimes
    ]
    return profile.model_copy(update={"runtimes": (*profile.runtimes, *more)})


def test_a_bundle_is_made_for_the_runtime_that_was_asked_for_where_one_can_be() -> None:
    both = beside(load("cpu"), "openvino")
    assert runtime_of(both).runtime == "onnxruntime"
    for runtime in ("onnxruntime", "openvino"):
        assert runtime_of(both, runtime).runtime == runtime
    assert runtime_of(load("cpu"), "openvino").runtime == "onnxruntime"
    assert runtime_of(load("tx2"), "pytorch").runtime == "tensorrt"


def for_openvino(folder: Path, precision: Precision) -> Path:
    profile = beside(load("cpu"), "openvino")
    torch.manual_seed(0)
    write(build(SMALL), asked(profile, "openvino", precision), profile, "untrained", folder)
    return folder


@pytest.mark.parametrize("precision", ["fp32", "bf16", "fp16"])
def test_a_bundle_for_openvino_names_its_precision(tmp_path: Path, precision: Precision) -> None:
    deployment = read(for_openvino(tmp_path, precision) / "deployment.json")
    assert (deployment.runtime, deployment.precision) == ("openvino", precision)
    assert names(tmp_path) == ALWAYS | {"deployment.json"}
    assert "what is built here runs on" not in (tmp_path / "README.md").read_text()


def test_openvino_answers_and_is_timed_in_every_precision_of_the_processor(tmp_path: Path) -> None:
    pytest.importorskip("openvino", reason="needs OpenVINO: pip install 'rts2[openvino]' brings it")
    from rts2.profiles.runtimes import ov

    for precision in ov.precisions("fp32"):
        folder = tmp_path / precision
        folder.mkdir()
        ended = checked(for_openvino(folder, precision))
        assert (ended.returncode, ended.stderr) == (0, "")
        told = {line.split()[0]: line.split()[1:] for line in ended.stdout.splitlines()}
        assert told["runtime"][::2] == ["openvino", ov.HINTS[precision]]
        assert float(told["measured"][0]) > 0
        assert told["expected"][-1] == "openvino"
        assert float(told["disparity"][0]) < (1e-3 if precision == "fp32" else 1)


@pytest.mark.parametrize("missing", ["openvino", "fp16"])
def test_what_openvino_needs_on_the_target_is_one_line(tmp_path: Path, missing: str) -> None:
    """No OpenVINO, or one that computes in another precision than was asked for."""
    folder = tmp_path / "bundle"
    folder.mkdir()
    for_openvino(folder, "fp16")
    standin = "raise ImportError" if missing == "openvino" else OTHER_PRECISION
    ended = checked(folder, instead={"openvino": standin})
    said = {
        "openvino": "openvino is missing: python3 -m pip install openvino brings it\n",
        "fp16": "OpenVINO computes in bf16 on this processor, not in f16\n",
    }
    assert (ended.returncode, ended.stdout, ended.stderr) == (1, "", said[missing])


OTHER_PRECISION = """
class Core:
    def compile_model(self, path, device, settings):
        assert settings["INFERENCE_PRECISION_HINT"] == "f16"
        return self

    def get_property(self, name):
        assert name == "INFERENCE_PRECISION_HINT"
        return self

    def get_type_name(self):
        return "bf16"
"""
"""An OpenVINO that takes bf16 whatever it was told."""


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", ["model.onnx", "sample_disparity.bin", "README.md"])
def test_a_changed_file_is_named(copied: dict[str, Path], device: str, name: str) -> None:
    path = copied[device] / name
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    ended = checked(copied[device])
    assert ended.returncode == 1
    assert ended.stderr == f"{name} has changed since it was written\n"
    assert ended.stdout == ""


@pytest.mark.parametrize("name", ["model.onnx", "deployment.json"])
def test_a_missing_file_is_named(copied: dict[str, Path], name: str) -> None:
    (copied["cpu"] / name).unlink()
    ended = checked(copied["cpu"])
    assert ended.returncode == 1
    assert name in ended.stderr
    assert ended.stderr.count("\n") == 1


def engine_wrote(folder: Path, disparity: Any, times: Any = (8.0, 10.0, 30.0)) -> None:
    """output.json and times.json in the format of `trtexec`."""
    shape = "1x64x96"
    outputs = [
        {"name": "semantic", "dimensions": shape, "values": [0] * len(disparity)},
        {"name": "disparity", "dimensions": shape, "values": [float(v) for v in disparity]},
    ]
    rows = [
        {"startComputeMs": 1.0, "computeMs": ms, "latencyMs": ms + 1, "h2dMs": 0.5} for ms in times
    ]
    (folder / "output.json").write_text(json.dumps(outputs))
    (folder / "times.json").write_text(json.dumps(rows))


def test_tensorrts_answer_is_compared_and_timed(copied: dict[str, Path]) -> None:
    """Half precision moves the disparity a little: 0.05 px on average, and 0.1 are allowed."""
    folder = copied["tx2"]
    wanted = np.fromfile(folder / "sample_disparity.bin", "<f4")
    engine_wrote(folder, wanted + 0.05)
    ended = checked(folder)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "measured  100.0 FPS" in ended.stdout
    assert "expected  25.0 FPS (21.5 to 29.0)" in ended.stdout
    assert ended.stdout.endswith("ok\n")


@pytest.mark.parametrize("change", ["off", "one pixel far off", "nan", "short", "long", "unnamed"])
def test_tensorrts_wrong_answer_fails(copied: dict[str, Path], change: str) -> None:
    folder = copied["tx2"]
    found = np.fromfile(folder / "sample_disparity.bin", "<f4")
    if change == "off":
        found = found + 0.2
    elif change == "one pixel far off":
        found[7] += 0.2 * len(found)
    elif change == "nan":
        found[7] = np.nan
    elif change in ("short", "long"):
        found = found[:-1] if change == "short" else np.append(found, 0)
    engine_wrote(folder, found)
    if change == "unnamed":
        text = (folder / "output.json").read_text().replace('"disparity"', '"depth"')
        (folder / "output.json").write_text(text)
    ended = checked(folder)
    assert ended.returncode == 1
    assert ended.stderr.count("\n") == 1
    assert "disparity" in ended.stderr
    assert "ok" not in ended.stdout.split()


@pytest.mark.parametrize("missing", ["output.json", "times.json"])
def test_without_a_build_the_check_says_so(copied: dict[str, Path], missing: str) -> None:
    folder = copied["tx2"]
    engine_wrote(folder, np.fromfile(folder / "sample_disparity.bin", "<f4"))
    (folder / missing).unlink()
    ended = checked(folder)
    assert ended.returncode == 1
    assert ended.stderr == f"{missing} is missing: run build.sh first\n"


TRTEXEC = """#!{python}
import json, sys, pathlib
import numpy as np
options = dict(word.lstrip("-").partition("=")[::2] for word in sys.argv[1:])
with open("calls.txt", "a") as log:
    print(*sys.argv[1:], file=log)
if "onnx" in options:
    assert pathlib.Path(options["onnx"]).read_bytes()
    pathlib.Path(options["saveEngine"]).write_bytes(b"engine")
else:
    assert pathlib.Path(options["loadEngine"]).read_bytes() == b"engine"
    for pair in options["loadInputs"].split(","):
        name, _, file = pair.partition(":")
        assert name in ("left", "right") and len(np.fromfile(file, "<f4")) == 3 * 64 * 96
    values = np.fromfile("sample_disparity.bin", "<f4").tolist()
    pathlib.Path(options["exportOutput"]).write_text(
        json.dumps([{{"name": "disparity", "dimensions": "1x64x96", "values": values}}])
    )
    pathlib.Path(options["exportTimes"]).write_text(json.dumps([{{"computeMs": 20.0}}] * 3))
"""


def run_build(folder: Path, body: str) -> subprocess.CompletedProcess[str]:
    fake = folder.parent / "trtexec"
    fake.write_text(body)
    fake.chmod(0o755)
    return subprocess.run(
        ["sh", str(folder / "build.sh")],
        capture_output=True,
        text=True,
        cwd=folder.parent,
        env=os.environ | {"TRTEXEC": str(fake)},
        check=False,
    )


def test_the_build_script_builds_runs_and_checks(copied: dict[str, Path]) -> None:
    """From another folder, with a `trtexec` that insists on the files which it is given."""
    folder = copied["tx2"]
    ended = run_build(folder, TRTEXEC.format(python=sys.executable))
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "measured  50.0 FPS" in ended.stdout
    assert (folder / "model.plan").exists()
    assert len((folder / "calls.txt").read_text().splitlines()) == 2


def test_a_failed_build_is_a_failure(copied: dict[str, Path]) -> None:
    folder = copied["tx2"]
    engine_wrote(folder, np.fromfile(folder / "sample_disparity.bin", "<f4"))
    assert run_build(folder, "#!/bin/sh\nexit 3\n").returncode == 3


@pytest.mark.parametrize(
    "script", sorted(p.name for p in SCRIPTS.iterdir() if p.name.endswith(".py"))
)
def test_the_scripts_are_python_3_6(script: str) -> None:
    """JetPack 4.6 has no other; and they import nothing of rts2."""
    tree = ast.parse((SCRIPTS / script).read_text("utf-8"), feature_version=(3, 6))
    imported = {
        name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names
    }
    assert not [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    runtime = script.removeprefix("measured_").removesuffix(".py")
    extra = {"numpy", runtime} if runtime in ("onnxruntime", "openvino") else set()
    assert imported <= set(sys.stdlib_module_names) | {"measured"} | extra


def test_operators_that_the_runtime_lacks_are_all_named(
    bundles: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    support = runtime_of(load("tx2"))
    path = bundles["tx2"] / "model.onnx"
    refuse_operators(path, support)
    table = load_opset("tensorrt-8.2")
    few = {name: op for name, op in table.operators.items() if name not in ("Conv", "Exp")}
    monkeypatch.setattr(opset, "load_opset", lambda _: table.model_copy(update={"operators": few}))
    with pytest.raises(Rts2Error, match="the graph needs Conv, Exp") as error:
        refuse_operators(path, support)
    assert error.value.exit_code == 1
    monkeypatch.setattr(opset, "load_opset", lambda _: table.model_copy(update={"max_opset": 12}))
    with pytest.raises(Rts2Error, match=r"opset 12 at most .* needs opset 13"):
        refuse_operators(path, support)


def test_a_device_without_a_runtime_of_ours_is_refused() -> None:
    profile = load("tx2")
    only = tuple(support for support in profile.runtimes if support.runtime == "pytorch")
    with pytest.raises(UsageError, match="no runtime that a bundle can be made for"):
        runtime_of(profile.model_copy(update={"runtimes": only}))


@pytest.mark.parametrize("difference_px", [2e-3, float("nan")])
def test_a_graph_that_is_not_its_network_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, difference_px: float
) -> None:
    from rts2.model import export

    monkeypatch.setattr(export, "parity", lambda *_: export.Parity(difference_px, None))
    profile = load("cpu")
    with pytest.raises(Rts2Error, match="differs from its network") as error:
        write(build(SMALL), asked(profile, "onnxruntime", "fp32"), profile, "trained", tmp_path)
    assert error.value.exit_code == 1


def test_a_bundle_in_integers_runs_and_says_what_it_was_asked_to(tmp_path: Path) -> None:
    """Its usual layers in 8 bits, checked against its own answer; the float network is near."""
    profile = load("cpu")
    folders = [tmp_path / name for name in ("int8", "again", "fp32")]
    for folder in folders:
        folder.mkdir()
        torch.manual_seed(0)
        precision: Precision = "fp32" if folder.name == "fp32" else "int8"
        write(build(SMALL), asked(profile, "onnxruntime", precision), profile, "untrained", folder)
    assert read_header(folders[0] / "model.onnx").precision == "int8"
    _, kinds = operators(folders[0] / "model.onnx")
    assert {"QuantizeLinear", "DequantizeLinear"} <= set(kinds)
    for name in names(folders[0]):
        assert (folders[0] / name).read_bytes() == (folders[1] / name).read_bytes()
    ended = checked(folders[0])
    assert ended.returncode == 0, ended.stdout + ended.stderr
    integers, floats = (
        np.fromfile(folder / "sample_disparity.bin", "<f4") for folder in (folders[0], folders[2])
    )
    assert 0 < np.abs(integers - floats).mean() < 5
