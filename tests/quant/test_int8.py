"""int8 as a user meets it: chosen on this machine, or by rules for one out of reach."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rts2.model.graph import load_graph, read_header, save_graph
from rts2.model.predictor import open_model
from rts2.model.qdq import layers
from rts2.profiles.timing import Timing
from rts2.quant import ptq
from rts2.quant import run as running
from rts2.quant.cli import quantize
from rts2.quant.parity import synthetic_scene
from rts2.quant.race import Duel, Runner

SIZE = (96, 64)
SMALL = ("--pairs", 3, "--resolution", "96x64")
LENIENT = ("--max-d1-drop", 100, "--max-miou-drop", 100)


def run(*arguments: object) -> int:
    return quantize([str(argument) for argument in arguments])


def reported(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    value = json.loads(capsys.readouterr().out)
    assert isinstance(value, dict)
    return value


def won(ratio: float) -> Duel:
    """A duel that came out so."""
    return Duel(Timing((10 * ratio,) * 12, (10.0,) * 13, 10.0))


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twenty streets would be judged in every test; three tell as much here."""
    monkeypatch.setattr(running, "JUDGED", 3)


@pytest.fixture
def faster(monkeypatch: pytest.MonkeyPatch, quick: None) -> list[float]:
    """Duels come out at the ratio that stands in the list, whatever this machine is busy with."""
    ratio = [0.8]
    monkeypatch.setattr(ptq, "duel", lambda own, parent, threads: won(ratio[0]))
    return ratio


def test_a_checkpoint_in_integers(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], faster: list[float]
) -> None:
    out = tmp_path / "out"
    assert run(checkpoint, "--precision", "int8", *SMALL, *LENIENT, "--out", out, "--json") == 0
    report = reported(capsys)
    assert report == json.loads((out / "quantize.json").read_text())
    assert (report["outcome"], report["evidence"], report["device"]) == ("int8", "measured", "cpu")
    assert report["speedup"] == pytest.approx(1.25)
    assert report["quantized"]["latency_ms"] == pytest.approx(8)
    assert report["float"]["latency_ms"] == pytest.approx(10)
    assert sorted(p.name for p in out.iterdir()) == sorted([*report["files"], "calibration.npz"])
    before, after = (read_header(out / name) for name in ("fp32.onnx", "int8.onnx"))
    assert (before.precision, after.precision) == ("fp32", "int8")
    model = load_graph(out / "int8.onnx")
    names = {layer.name for layer in layers(load_graph(out / "fp32.onnx"))}
    told = {row["layer"]: row for row in report["layers"]}
    assert set(told) == names
    kept = {row["layer"] for row in report["kept_float"]}
    assert kept == {name for name, row in told.items() if row["precision"] == "fp32"}
    assert all(row["reason"] for row in report["kept_float"])
    pairs = {n.input[0] for n in model.graph.node if n.op_type == "QuantizeLinear"}
    assert bool(pairs) == (kept != names)
    assert {"d1_change", "epe_change", "sqnr_db", "float_ms", "quantized_ms"} < set(
        report["layers"][0]
    )
    assert report["calibration"]["pairs"] == 3
    scene = synthetic_scene(SIZE)
    assert np.isfinite(
        open_model(out / "int8.onnx").predict(scene.left, scene.right).disparity
    ).all()


@pytest.mark.parametrize("ratio", [1.0, 1.3])
def test_what_is_not_faster_is_not_delivered(
    graph: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    faster: list[float],
    ratio: float,
) -> None:
    faster[0] = ratio
    out = tmp_path / "out"
    before = graph.read_bytes()
    (out).mkdir()
    (out / "int8.onnx").write_text("of an earlier run")
    options = ("--pairs", 3, *LENIENT, "--out", out, "--json")
    assert run(graph, "--precision", "int8", *options) == 0
    report = reported(capsys)
    assert report["outcome"] == "fp32"
    assert "not surely faster: fp32 is delivered" in report["why"]
    assert not (out / "int8.onnx").exists()
    assert graph.read_bytes() == before


def test_what_is_outside_of_the_budget_is_not_delivered(
    graph: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    faster: list[float],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nobody holds a budget that no network holds."""
    honest = ptq.Audit.of

    def planted(self: ptq.Audit, model: Any, ranges: Any) -> ptq.Audited:
        """Every layer is twice as fast in integers, however busy this machine is."""
        found = honest(self, model, ranges)
        costs = tuple(replace(cost, float_ms=2.0, integer_ms=1.0) for cost in found.costs)
        return replace(found, costs=costs, ms_per_element=0.0)

    monkeypatch.setattr(ptq.Audit, "of", planted)
    monkeypatch.setattr(ptq, "race", lambda runners, threads: [1.0, *[0.5] * (len(runners) - 1)])
    monkeypatch.setattr(ptq.Budget, "holds", lambda self, found: False)
    out = tmp_path / "out"
    assert run(graph, "--precision", "int8", "--pairs", 3, "--out", out, "--json") == 0
    report = reported(capsys)
    assert report["outcome"] == "fp32"
    assert "int8 does not keep the accuracy budget" in report["why"]
    judged = [trial for trial in report["trials"] if trial["what"] == "judged"]
    counts = [trial["layers"] for trial in judged]
    assert len(counts) > 1
    assert counts == sorted(counts, reverse=True)


def test_people_see_the_audit(
    graph: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], faster: list[float]
) -> None:
    options = ("--pairs", 3, *LENIENT, "--out", tmp_path / "out")
    assert run(graph, "--precision", "int8", *options) == 0
    shown = capsys.readouterr().out
    assert "encoder.stem.0.0/Conv" in shown
    assert "outcome     int8: int8 is 1.25 times as fast as fp32" in shown
    assert "timed on" in shown


def test_a_calibration_is_used_again(
    graph: Path, tmp_path: Path, faster: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    options = (graph, "--precision", "int8", "--pairs", 3, *LENIENT, "--out", tmp_path / "out")
    assert run(*options) == 0
    monkeypatch.setattr("rts2.quant.calibration._gather", None)  # called, it would fail
    assert run(*options) == 0


def test_an_interrupted_run_leaves_the_float_model_and_goes_on(
    graph: Path,
    tmp_path: Path,
    faster: list[float],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "out"
    options = (graph, "--precision", "int8", "--pairs", 3, *LENIENT, "--out", out)

    def stopped(*_: object) -> Iterator[None]:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(ptq, "alone", stopped)
        assert run(*options) == 130
    assert capsys.readouterr().err == "interrupted\n"
    assert [path.name for path in out.iterdir()] == ["calibration.npz"]
    monkeypatch.setattr("rts2.quant.calibration._gather", None)
    assert run(*options) == 0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--precision", "int8", "--device", "tx2"), "Jetson TX2 does not run int8: sm_62 has no"),
        (("--precision", "int8", "--device", "nowhere"), "unknown device 'nowhere'"),
        (("--precision", "int8", "--calib", "nowhere"), "nowhere: there is no such folder"),
        (("--precision", "int8", "--pairs", "0"), "must be a whole number from 1"),
        (("--precision", "int8", "--pairs", "1"), "calibration needs 2 pairs"),
        (("--precision", "int8", "--max-d1-drop", "-1"), "must be from 0 to 100 points"),
        (("--precision", "bf16", "--device", "rtx2080ti"), "does not run bf16"),
    ],
)
def test_wrong_use(
    graph: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    said: str,
) -> None:
    assert run(graph, *arguments, "--out", tmp_path / "out") == 2
    found = capsys.readouterr()
    assert said in found.err
    assert found.err.count("\n") == 1


def test_frames_without_a_truth_cannot_judge(
    graph: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], faster: list[float]
) -> None:
    from PIL import Image

    scene = synthetic_scene(SIZE)
    for side, pixels in (("left", scene.left), ("right", scene.right)):
        (tmp_path / "data" / side).mkdir(parents=True)
        Image.fromarray(pixels).save(tmp_path / "data" / side / "a.png")
    options = ("--pairs", 3, "--eval", tmp_path / "data", "--out", tmp_path / "out")
    assert run(graph, "--precision", "int8", *options) == 2
    assert "what judges needs a disparity truth" in capsys.readouterr().err


def test_weights_that_are_no_numbers(
    graph: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import onnx

    model = load_graph(graph)
    weight = next(t for t in model.graph.initializer if t.dims and t.data_type == 1)
    values = onnx.numpy_helper.to_array(weight).copy()
    values.reshape(-1)[0] = np.nan
    weight.CopyFrom(onnx.numpy_helper.from_array(values, weight.name))
    save_graph(model, read_header(graph), tmp_path / "a.onnx")
    assert run(tmp_path / "a.onnx", "--precision", "int8", "--out", tmp_path / "out") == 1
    assert "holds values that are not finite; train it again" in capsys.readouterr().err


def test_what_is_in_integers_already(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], faster: list[float]
) -> None:
    out = tmp_path / "out"
    assert run(checkpoint, "--precision", "int8", *SMALL, *LENIENT, "--out", out) == 0
    capsys.readouterr()
    assert run(out / "int8.onnx", "--precision", "int8", "--out", tmp_path / "again") == 2
    assert "is int8 already" in capsys.readouterr().err


def test_rules_decide_for_a_device_out_of_reach(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], quick: None
) -> None:
    out = tmp_path / "out"
    options = ("--device", "rtx2080ti", *SMALL, *LENIENT, "--out", out, "--json")
    assert run(checkpoint, "--precision", "int8", *options) == 0
    report = reported(capsys)
    assert (report["evidence"], report["outcome"]) == ("rules", "int8")
    assert report["quantized"]["latency_ms"] is None
    reasons = {row["layer"]: row["reason"] for row in report["kept_float"]}
    assert reasons["regularize.0.layers.3/Conv"].startswith("3D convs: TensorRT 8.2")
    assert reasons["classify.2/Conv"].startswith("a head")
    assert "disparity.levels.2.0.0/Conv" not in reasons
    opsets = [entry.version for entry in load_graph(out / "int8.onnx").opset_import]
    assert opsets == [13]


def test_a_race_ranks_by_time(checkpoint: Path, tmp_path: Path) -> None:
    """A network of three stages takes longer than its first one, on however busy a machine."""
    from rts2.model.checkpoint import load
    from rts2.model.export import export
    from rts2.quant.race import race

    network, header = load(checkpoint)
    paths = [tmp_path / f"{stages}.onnx" for stages in (3, 1)]
    for stages, path in zip((3, 1), paths, strict=True):
        export(network, path, (320, 192), header.origin, stages=stages)
    ratios = race([Runner(path, "fp32") for path in paths], 1)
    assert ratios[0] == 1
    assert ratios[1] < 1


def test_a_duel_is_won_beyond_the_error_of_its_timing() -> None:
    assert won(0.9).faster
    assert not won(1.0).faster
    noisy = Timing((9.0, 11.0) * 10, (10.0,) * 21, 10.0)
    assert noisy.ratio == pytest.approx(1.0)
    assert not Duel(noisy).faster


def test_the_trained_anynet_keeps_its_accuracy_in_integers(
    real_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """On real frames; calibrated on generated ones. How fast it is, this test does not ask."""
    model, data = real_data / "anynet_official" / "kitti2015.tar", real_data / "kitti2015"
    options = ("--eval", data, "--pairs", 8, "--out", tmp_path, "--json")
    assert run(model, "--precision", "int8", *options) == 0
    report = reported(capsys)
    assert report["float"]["d1_all"] == pytest.approx(7.57, abs=0.01)
    assert report["quantized"]["d1_all"] - report["float"]["d1_all"] <= 0.3
    shutil.rmtree(tmp_path)
