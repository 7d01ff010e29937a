"""What `rts2-profile measure` takes as a model, and what it says of each."""

import json
import re
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest

from rts2.model.arch import UNTRAINED, Arch
from rts2.model.box import named_model
from rts2.model.checkpoint import build, save
from rts2.model.console import KITTI
from rts2.model.export import export
from rts2.profiles import measure, timed, timing
from rts2.profiles.cli import profile
from rts2.profiles.runtimes import RUNTIMES, Sized
from rts2.profiles.timed import BOUNDARY, given
from rts2.profiles.timing import Timing

SMALL = Arch(c=1, stages=2, d_max=3, conv3d=(2, 2))


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The same network as a checkpoint, a graph and a bundle."""
    folder = tmp_path_factory.mktemp("models")
    network = build(SMALL)
    known = {
        "checkpoint": folder / "small.safetensors",
        "graph": folder / "small.onnx",
        "bundle": folder / "bundle",
    }
    save(network, known["checkpoint"], UNTRAINED)
    export(network, known["graph"], (96, 64), UNTRAINED)
    known["bundle"].mkdir()
    content = known["graph"].read_bytes()
    (known["bundle"] / "model.onnx").write_bytes(content)
    described = {"name": "model.onnx", "sha256": sha256(content).hexdigest()}
    (known["bundle"] / "deployment.json").write_text(
        json.dumps({"schema": "rts2.deployment/1", "files": [described]})
    )
    return known


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measure, "REFERENCE", (Arch(c=1, stages=1, d_max=6), (64, 64)))
    monkeypatch.setattr(timing, "WARM_UP_S", 0.01)
    monkeypatch.setattr(timing, "MIN_SECONDS", 0.01)
    monkeypatch.setattr(timing, "OWN_SECONDS", 0.01)
    monkeypatch.setattr(timing, "CAREFUL", 1e6)
    monkeypatch.setattr(timing, "MAX_ERROR", 1e6)


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Any:
    def command(*arguments: object) -> tuple[int, str, str]:
        code = profile(["measure", *map(str, arguments)])
        printed = capsys.readouterr()
        return code, printed.out, printed.err

    return command


def test_every_kind_of_model_is_taken(models: dict[str, Path]) -> None:
    checkpoint = given(models["checkpoint"], None, None)
    assert isinstance(checkpoint.model, Sized)
    assert (checkpoint.resolution, checkpoint.stages) == (KITTI, 2)
    for kind in ("graph", "bundle"):
        found = given(models[kind], None, None)
        assert found.name == str(models[kind])
        assert (found.resolution, found.stages) == ((96, 64), 2)
    boxed = given(named_model("c1"), (96, 64), 1)
    assert (boxed.name, boxed.resolution, boxed.stages) == ("c1", (96, 64), 1)


def test_the_json_says_what_a_timing_depends_on(run: Any, models: dict[str, Path]) -> None:
    asked = ("--resolution", "96x64", "--threads", 1, "--json")
    code, out, err = run(models["checkpoint"], models["graph"], models["bundle"], *asked)
    assert (code, err) == (0, "")
    found = json.loads(out)
    assert found["schema"] == "rts2.profile-measure/1"
    assert (found["runtime"], found["boundary"]) == ("onnxruntime", BOUNDARY)
    assert "c=1, 1 stage, full, at 64×64, in ONNX Runtime fp32" in found["reference"]
    assert found["machine"]["threads"] == 1
    assert len(found["models"]) == 3
    for row in found["models"]:
        assert row["versions"].keys() == {"onnxruntime"}
        assert (row["runtime"], row["precision"], row["threads"]) == ("onnxruntime", "fp32", 1)
        assert (row["resolution"], row["stages"]) == ([96, 64], 2)
        assert row["runs"] >= 10
        assert 0 < row["latency_ms"] <= row["p95_ms"]
        assert row["fps"] == pytest.approx(1000 / row["latency_ms"])
        assert row["ratio"] > 0
        assert row["spread"] >= 0
        assert row["reliable"] is True


def test_the_table_says_it_too(run: Any, models: dict[str, Path]) -> None:
    code, out, err = run(models["checkpoint"], "--resolution", "96x64", "--threads", 1)
    assert (code, err) == (0, "")
    lines = out.splitlines()
    for title in ("model", "size", "precision", "median ms", "p95 ms", "spread", "FPS", "runs"):
        assert title in lines[0]
    assert re.search(r"ONNX Runtime \(onnxruntime [\d.]+\), 1 thread, \S", out)
    assert BOUNDARY in lines
    assert "unreliable" not in out


def test_an_unreliable_timing_is_marked(
    run: Any, models: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    wide = Timing((5.0, 5.0, 10.0, 15.0, 15.0), (5.0,) * 6, 5.0)
    monkeypatch.setattr(timing, "MAX_ERROR", 0.03)
    monkeypatch.setattr(timing, "measure", lambda *_: wide)
    asked = (models["graph"], "--threads", 1)
    code, out, _ = run(*asked)
    assert code == 0
    assert "2.000 ±41.6% !" in out
    assert "! unreliable: the machine was busy, or the ratio is not known to 3%" in out
    (row,) = json.loads(run(*asked, "--json")[1])["models"]
    assert (row["reliable"], row["spread"], row["ratio"]) == (False, 1.0, 2.0)


def test_pytorch_times_checkpoints(run: Any, models: dict[str, Path]) -> None:
    asked = ("--runtime", "pytorch", "--resolution", "96x64", "--stages", 1, "--threads", 1)
    code, out, err = run(models["checkpoint"], *asked, "--json")
    assert (code, err) == (0, "")
    (row,) = json.loads(out)["models"]
    assert (row["runtime"], row["stages"], row["versions"].keys()) == ("pytorch", 1, {"torch"})


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_openvino_times_what_the_processor_has(
    run: Any, models: dict[str, Path], precision: str
) -> None:
    pytest.importorskip("openvino", reason="needs OpenVINO: pip install 'rts2[openvino]'")
    from rts2.profiles.runtimes import precisions

    if precision not in precisions("openvino"):
        pytest.skip(f"this processor has no {precision}")
    asked = ("--runtime", "openvino", "--precision", precision, "--threads", 1, "--json")
    code, out, err = run(models["graph"], *asked)
    assert (code, err) == (0, "")
    assert json.loads(out)["models"][0]["precision"] == precision


@pytest.mark.parametrize(
    ("kind", "asked", "code", "said"),
    [
        ("graph", ("--resolution", "640x192"), 2, "is a graph made for 96x64; leave --resolution"),
        ("graph", ("--stages", "1"), 2, "always runs 2 stages, not 1; leave --stages out"),
        ("bundle", ("--stages", "3"), 2, "always runs 2 stages, not 3"),
        ("checkpoint", ("--stages", "3"), 2, "stages must be 1 to 2 for this network, not 3"),
        ("graph", ("--runtime", "pytorch"), 2, "is a graph; give the checkpoint"),
        ("checkpoint", ("--precision", "fp16"), 2, "not in fp16; choose another --precision"),
        ("graph", ("--precision", "int8"), 2, "not in int8; choose another --precision"),
        ("graph", ("--runtime", "toaster"), 2, "toaster"),
        ("graph", ("--precision", "fp8"), 2, "fp8"),
        ("graph", ("--threads", "0"), 2, "whole number above 0"),
    ],
)
def test_wrong_use_is_one_line(
    run: Any, models: dict[str, Path], kind: str, asked: tuple[str, ...], code: int, said: str
) -> None:
    found = run(models[kind], *asked)
    assert found[:2] == (code, "")
    assert said in found[2]
    assert found[2].count("\n") == 1


@pytest.mark.parametrize(
    ("runtime", "beside"),
    [
        ("pytorch", "onnxruntime"),
        ("openvino", "onnxruntime"),
        ("pytorch-cuda-graphs", "pytorch-cuda"),
    ],
)
def test_the_reference_runs_where_the_model_does(
    monkeypatch: pytest.MonkeyPatch, runtime: str, beside: str
) -> None:
    monkeypatch.setattr(timed, "usable", RUNTIMES.__getitem__)
    assert timed.Clock(runtime, 1).beside == beside
    assert RUNTIMES[beside].title in timed.Clock(runtime, 1).reference
