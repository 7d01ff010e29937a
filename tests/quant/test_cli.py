"""rts2-quantize as a user meets it: its files, its JSON, its errors in one line."""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from PIL import Image

from rts2.model.graph import load_graph, read_header, save_graph
from rts2.model.predictor import open_model
from rts2.quant.cli import quantize
from rts2.quant.parity import SHIFT_PX, synthetic_scene

SIZE = (96, 64)
LENIENT = ("--max-d1-drop", 100, "--max-miou-drop", 100)
"""For networks of random weights, whose answers hang in the balance everywhere."""

METRICS = ["latency_ms", "d1_all", "epe", "miou", "size_bytes", "sqnr_db"]


def run(*arguments: object) -> int:
    return quantize([str(argument) for argument in arguments])


def reported(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """The one JSON object on stdout, with nothing on stderr."""
    found = capsys.readouterr()
    assert found.err == ""
    value = json.loads(found.out)
    assert isinstance(value, dict)
    return value


def refused(capsys: pytest.CaptureFixture[str], code: int, said: str, *arguments: object) -> None:
    """The command ends with `code` and one line, and writes no file."""
    out = Path(str(arguments[arguments.index("--out") + 1]))
    before = sorted(out.iterdir()) if out.is_dir() else []
    assert run(*arguments) == code
    found = capsys.readouterr()
    assert found.out == ""
    assert said in found.err
    assert found.err.count("\n") == 1
    assert (sorted(out.iterdir()) if out.is_dir() else []) == before


def test_a_checkpoint_becomes_two_graphs_and_a_report(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new" / "out"
    size = ("--resolution", "90x50")
    assert run(checkpoint, "--precision", "fp16", "--out", out, *size, *LENIENT, "--json") == 0
    report = reported(capsys)
    assert report == json.loads((out / "quantize.json").read_text())
    assert report["schema"] == "rts2.quantize/1"
    assert report["measured_on"] == "20 frames of streets"
    assert (report["outcome"], report["evidence"]) == ("fp16", "rules")
    assert list(report["float"]) == list(report["quantized"]) == METRICS
    for name, file in (("float", "fp32.onnx"), ("quantized", "fp16.onnx")):
        metrics = report[name]
        assert metrics.pop("size_bytes") == (out / file).stat().st_size
        assert (metrics.pop("sqnr_db") or 99) > 40
        assert metrics.pop("latency_ms") is None
        assert None not in metrics.values()
    assert report["float"].get("sqnr_db") is None
    reason = report["kept_float"][0]["reason"]
    assert {"layer": "refine.0.regression/Exp", "reason": reason} in report["kept_float"]
    told = {row["layer"]: (row["precision"], row["reason"]) for row in report["layers"]}
    assert told["encoder.stem.0.0/Conv"] == ("fp16", None)
    assert told["refine.0.regression/Exp"] == ("fp32", reason)
    assert sorted(path.name for path in out.iterdir()) == sorted(report["files"])
    before, after = (read_header(out / name) for name in ("fp32.onnx", "fp16.onnx"))
    assert (before.precision, after.precision) == ("fp32", "fp16")
    assert before.model_copy(update={"precision": "fp16"}) == after
    assert (after.resolution, after.size, after.origin) == (
        (90, 50),
        (96, 64),
        "made up for a test",
    )


def test_an_onnx_file_gives_the_same_and_is_left_alone(
    checkpoint: Path, graph: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = graph.read_bytes()
    size = ("--resolution", "96x64", *LENIENT)
    assert run(checkpoint, "--precision", "fp16", "--out", tmp_path / "a", *size) == 0
    assert run(graph, "--precision", "fp16", "--out", tmp_path / "b", *LENIENT) == 0
    assert graph.read_bytes() == before
    files = [tmp_path / name / "fp16.onnx" for name in "ab"]
    assert files[0].read_bytes() == files[1].read_bytes()
    assert not (tmp_path / "b" / "fp32.onnx").exists()


def test_stages_and_opset_shape_the_export(checkpoint: Path, tmp_path: Path) -> None:
    export = ("--resolution", "96x64", "--stages", 1, "--opset", 13, *LENIENT)
    assert run(checkpoint, "--precision", "fp16", "--out", tmp_path, *export) == 0
    assert read_header(tmp_path / "fp16.onnx").stages == 1
    assert [entry.version for entry in load_graph(tmp_path / "fp16.onnx").opset_import] == [13]


def test_the_result_runs(graph: Path, tmp_path: Path) -> None:
    assert run(graph, "--precision", "fp16", "--out", tmp_path, *LENIENT) == 0
    scene = synthetic_scene(SIZE)
    wanted, found = (
        open_model(path).predict(scene.left, scene.right)
        for path in (graph, tmp_path / "fp16.onnx")
    )
    assert np.abs(wanted.disparity - found.disparity).max() < 0.5
    assert wanted.semantic is not None
    assert np.mean(wanted.semantic != found.semantic) < 0.01


def test_people_get_a_table(
    graph: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(graph, "--precision", "fp16", "--out", tmp_path, *LENIENT) == 0
    shown = capsys.readouterr().out
    assert "c=1, 3 stages, full · 96×64 · made up for a test" in shown
    assert "SQNR dB" in shown
    assert "judged on   20 frames of streets" in shown
    assert "outcome     fp16: rounded to fp16 after every operator" in shown
    assert "ONNX Runtime on a CPU runs it through casts, no faster" in shown
    assert "10 layers, warp coordinate" in shown


def kitti(folder: Path, size: tuple[int, int] = SIZE) -> Path:
    """Two frames in KITTI 2015's layout, alike, with the truth that they were made with."""
    scene = synthetic_scene(size)
    truth = np.full(scene.truth.shape, SHIFT_PX * 256, np.uint16)
    for name in ("000000_10", "000001_10"):
        for part, pixels in (
            ("image_2", scene.left),
            ("image_3", scene.right),
            ("disp_occ_0", truth),
        ):
            path = folder / "training" / part / f"{name}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(pixels).save(path)
    return folder


def test_evaluation_is_that_of_the_networks(
    graph: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = kitti(tmp_path / "data")
    out = tmp_path / "out"
    assert run(graph, "--precision", "fp16", "--eval", data, "--out", out, *LENIENT, "--json") == 0
    report = reported(capsys)
    scene = synthetic_scene(SIZE)
    error = np.abs(open_model(graph).predict(scene.left, scene.right).disparity - SHIFT_PX)
    assert report["float"]["epe"] == pytest.approx(error.mean(), rel=1e-5)
    assert report["float"]["d1_all"] == pytest.approx(100 * np.mean(error > 3), abs=0.02)
    assert report["quantized"]["epe"] == pytest.approx(report["float"]["epe"], rel=1e-2)
    assert report["quantized"]["epe"] != report["float"]["epe"]
    assert report["measured_on"] == f"2 frames of {data}"


def test_evaluation_takes_plain_pairs(
    graph: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same frames in two layouts have the same figures."""
    official, plain = kitti(tmp_path / "kitti"), tmp_path / "plain"
    plain.mkdir()
    for ours, theirs in (("left", "image_2"), ("right", "image_3"), ("disparity", "disp_occ_0")):
        shutil.copytree(official / "training" / theirs, plain / ours)
    told = []
    for data in (official, plain):
        out = ("--out", tmp_path / f"out of {data.name}")
        assert run(graph, "--precision", "fp16", "--eval", data, *out, "--json") == 0
        told.append(reported(capsys))
    assert told[0]["float"] == told[1]["float"]
    assert told[1]["measured_on"] == f"2 frames of {plain}"


def test_evaluation_takes_streets(
    checkpoint: Path, graph: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """They come at the network's size: a graph's own, or the one that a checkpoint is given."""
    told = []
    for model, size in ((graph, ()), (checkpoint, ("--resolution", "96x64"))):
        command = (model, "--precision", "fp16", "--eval", "streets", *size)
        assert run(*command, "--out", tmp_path / model.name, "--json") == 0
        told.append(reported(capsys))
    assert told[0]["measured_on"] == "20 frames of streets"
    assert told[0]["float"]["miou"] is not None
    assert told[0]["float"]["epe"] == pytest.approx(told[1]["float"]["epe"])


def test_a_model_in_the_box_goes_by_its_name(
    graph: Path, checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "small.safetensors").write_bytes(checkpoint.read_bytes())
    monkeypatch.setattr("rts2.model.box._folder", lambda: tmp_path)
    size = ("--resolution", "96x64", *LENIENT)
    assert run("small", "--precision", "fp16", "--out", tmp_path / "a", *size) == 0
    assert run(graph, "--precision", "fp16", "--out", tmp_path / "b", *LENIENT) == 0
    files = [tmp_path / name / "fp16.onnx" for name in "ab"]
    assert files[0].read_bytes() == files[1].read_bytes()


def test_an_onnx_file_needs_no_torch(graph: Path, tmp_path: Path) -> None:
    code = (
        "import sys; from rts2.quant.cli import quantize;"
        "code = quantize(sys.argv[1:]);"
        "sys.exit(code or 10 * ('torch' in sys.modules))"
    )
    command = [
        sys.executable,
        "-c",
        code,
        str(graph),
        "--precision",
        "fp16",
        "--out",
        str(tmp_path),
    ]
    ran = subprocess.run(command, capture_output=True, text=True)
    assert (ran.returncode, ran.stderr) == (0, "")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--precision", "fp8"], "argument --precision: invalid choice: 'fp8'"),
        ([], "the following arguments are required: --precision"),
        (["--precision", "fp16", "--eval", "nowhere"], "nowhere: there is no such folder"),
        (["--precision", "fp16", "--stages", "2"], "--stages is for checkpoints"),
        (["--precision", "fp16", "--resolution", "96x64"], "--resolution is for checkpoints"),
        (["--precision", "fp16", "--resolution", "96"], "must be WxH"),
    ],
)
def test_wrong_options(
    graph: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    said: str,
) -> None:
    refused(capsys, 2, said, graph, *arguments, "--out", tmp_path / "out")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--stages", "4"], "stages must be 1 to 3 for this network, not 4"),
        (["--opset", "11"], "opset must be 13 to 20, not 11"),
    ],
)
def test_wrong_exports(
    checkpoint: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    said: str,
) -> None:
    command = [checkpoint, "--precision", "fp16", "--resolution", "96x64", *arguments]
    refused(capsys, 2, said, *command, "--out", tmp_path / "out")


def test_a_model_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for path in (tmp_path / "a.onnx", tmp_path / "a.safetensors", tmp_path):
        said = "a model must be a file or a bundle" if path == tmp_path else "must be a file"
        refused(capsys, 2, said, path, "--precision", "fp16", "--out", tmp_path / "out")


@pytest.mark.parametrize("name", ["a.onnx", "a.safetensors"])
@pytest.mark.parametrize("length", [0, 3, 2000])
def test_a_truncated_model(
    checkpoint: Path,
    graph: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    name: str,
    length: int,
) -> None:
    whole = (graph if name == "a.onnx" else checkpoint).read_bytes()
    (tmp_path / name).write_bytes(whole[:length])
    said = "holds no arch" if (name, length) == ("a.onnx", 0) else "is truncated or no"
    refused(capsys, 1, said, tmp_path / name, "--precision", "fp16", "--out", tmp_path / "out")


def test_a_graph_that_is_fp16_already(
    graph: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(graph, "--precision", "fp16", "--out", tmp_path, *LENIENT) == 0
    capsys.readouterr()
    lowered = tmp_path / "fp16.onnx"
    said = f"a float graph is needed: {lowered} is fp16 already"
    refused(capsys, 2, said, lowered, "--precision", "fp16", "--out", tmp_path / "out")


def test_a_network_that_fp16_cannot_hold(
    graph: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Weights fit, and what they compute does not."""
    model = load_graph(graph)
    [stem] = [node for node in model.graph.node if node.name == "encoder.stem.0.0/Conv"]
    [weight] = [tensor for tensor in model.graph.initializer if tensor.name == stem.input[1]]
    large = 3e4 * np.sign(onnx.numpy_helper.to_array(weight))
    weight.CopyFrom(onnx.numpy_helper.from_array(large.astype(np.float32), weight.name))
    save_graph(model, read_header(graph), tmp_path / "a.onnx")
    said = "val-000000: in this precision the network leaves the range of its numbers; keep"
    refused(capsys, 1, said, tmp_path / "a.onnx", "--precision", "fp16", "--out", tmp_path / "out")


def test_images_that_do_not_fit_the_graph(
    graph: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = kitti(tmp_path / "data", (128, 64))
    command = (graph, "--precision", "fp16", "--eval", data, "--out", tmp_path / "out")
    refused(capsys, 2, "takes images that pad to 96x64, and 128x64 pads to 128x64", *command)


def test_an_output_folder_that_cannot_be(
    graph: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("mine")
    out = tmp_path / "file" / "out"
    refused(capsys, 1, "choose another --out", graph, "--precision", "fp16", "--out", out)


def test_the_trained_anynet_keeps_its_accuracy(
    real_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, data = real_data / "anynet_official" / "kitti2015.tar", real_data / "kitti2015"
    assert run(model, "--precision", "fp16", "--eval", data, "--out", tmp_path, "--json") == 0
    report = reported(capsys)
    before, after = report["float"], report["quantized"]
    assert before["d1_all"] == pytest.approx(7.57, abs=0.01)
    assert before["epe"] == pytest.approx(1.232, abs=0.001)
    assert abs(after["d1_all"] - before["d1_all"]) <= 0.05
    assert abs(after["epe"] - before["epe"]) <= 0.005
    assert after["sqnr_db"] > 50
