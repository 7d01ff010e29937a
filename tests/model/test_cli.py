"""rts2-infer and rts2-eval as a user meets them: results, exit codes, one line for each mistake."""

import json
import pickle
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper
from PIL import Image

from rts2.model.arch import Arch
from rts2.model.checkpoint import build, save
from rts2.model.cli import evaluate, infer
from rts2.model.data.images import read_disparity, read_rgb, read_whole
from rts2.model.pictures import legend
from rts2.model.predictor import Estimate, open_model
from rts2.model.video import Stream, film

Command = Callable[[list[str]], int]

CALIBRATION = "cam0=[100 0 48; 0 100 32; 0 0 1]\nbaseline=500\nwidth=96\nheight=64\n"


def put(path: Path, pixels: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)
    return path


def noise(seed: int, height: int = 64, width: int = 96) -> np.ndarray:
    generator = np.random.default_rng(seed)
    return generator.integers(0, 256, (height, width, 3), dtype=np.uint8)


PAIRS = [(noise(seed), noise(seed + 10)) for seed in range(3)]


def filmed(path: Path, pairs: Sequence[tuple[np.ndarray, ...]]) -> Path:
    """A video of images side by side."""
    frames = [np.concatenate(pair, axis=1) for pair in pairs]
    with film(path, frames[0].shape[1::-1], 8.0) as write:
        for frame in frames:
            write(frame)
    return path


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Checkpoints of two small networks with random weights."""
    folder = tmp_path_factory.mktemp("models")
    save(build(Arch(c=1, d_max=4)), folder / "full.safetensors", "a test")
    save(build(Arch(family="anynet", c=1)), folder / "anynet.safetensors", "a test")
    return folder


@pytest.fixture
def home(tmp_path: Path, models: Path) -> Path:
    """Two folders of two pairs, and a KITTI of one frame."""
    for side, seed in (("left", 0), ("right", 10)):
        for index in range(2):
            put(tmp_path / side / f"{index}.png", noise(seed + index))
    training = tmp_path / "kitti" / "training"
    put(training / "image_2" / "000000_10.png", noise(0))
    put(training / "image_3" / "000000_10.png", noise(1))
    put(training / "disp_occ_0" / "000000_10.png", np.full((64, 96), 2560, np.uint16))
    labels = np.full((64, 96), 7, np.uint8)
    put(training / "semantic" / "000000_10.png", labels)
    return tmp_path


def infer_arguments(home: Path, model: Path, *more: str) -> list[str]:
    sides = [str(home / side / "0.png") for side in ("left", "right")]
    return [*sides, "--model", str(model), "--out", str(home / "out"), *more]


def evaluate_arguments(home: Path, model: Path, *more: str) -> list[str]:
    return [str(model), "--dataset", "kitti2015", "--data", str(home / "kitti"), *more]


def report(run: Command, arguments: list[str], capsys: pytest.CaptureFixture[str]) -> Any:
    """What the command prints with --json; it must succeed and say nothing else."""
    assert run([*arguments, "--json"]) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    return json.loads(printed.out)


def refusal(
    run: Command, arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> tuple[int, str]:
    """The exit code and the one line on stderr of a command that must fail."""
    code = run(arguments)
    printed = capsys.readouterr()
    assert code != 0
    assert printed.out == ""
    assert len(printed.err.splitlines()) == 1, printed.err
    assert "Traceback" not in printed.err
    return code, printed.err


def left_behind(home: Path) -> list[Path]:
    out = home / "out"
    return sorted(out.rglob("*")) if out.is_dir() else []


def test_import_is_light() -> None:
    heavy = "{'torch', 'onnx', 'onnxruntime', 'matplotlib', 'rich'}"
    code = f"import sys, rts2.model.cli; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_pair_gives_every_file(
    home: Path, models: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (home / "calib.txt").write_text(CALIBRATION)
    arguments = infer_arguments(
        home, models / "full.safetensors", "--calib", str(home / "calib.txt")
    )
    told = report(infer, arguments, capsys)
    assert told["schema"] == "rts2.infer/1"
    assert told["arch"]["c"] == 1
    assert told["origin"] == "a test"
    (pair,) = told["pairs"]
    kinds = ("cloud.ply", "color.png", "disparity.png", "overlay.png", "semantic.png")
    assert sorted(pair["files"]) == [f"0_{kind}" for kind in kinds]
    assert told["legend"] == "classes.png"
    assert [path.name for path in left_behind(home)] == [*sorted(pair["files"]), told["legend"]]
    np.testing.assert_array_equal(read_rgb(home / "out" / "classes.png"), legend())

    left, right = (read_rgb(home / side / "0.png") for side in ("left", "right"))
    expected = open_model(models / "full.safetensors").predict(left, right)
    written = read_disparity(home / "out" / "0_disparity.png")
    np.testing.assert_allclose(written, expected.disparity, atol=0.5 / 256 + 1e-4)
    np.testing.assert_array_equal(read_whole(home / "out" / "0_semantic.png"), expected.semantic)
    assert pair["disparity_px"] == [written.min(), written.max()]
    assert pair["size"] == [96, 64]
    assert pair["network_ms"] > 0
    assert b"element vertex 6144\n" in (home / "out" / "0_cloud.ply").read_bytes()


def test_without_a_model_the_box_serves(
    home: Path,
    models: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    box = home / "box"
    box.mkdir()
    (box / "c8.safetensors").write_bytes((models / "full.safetensors").read_bytes())
    monkeypatch.setattr("rts2.model.box._folder", lambda: box)
    images = [str(home / side / "0.png") for side in ("left", "right")]
    told = report(infer, [*images, "--out", str(home / "out")], capsys)
    assert told["model"] == str(box / "c8.safetensors")
    assert told["origin"] == "a test"
    data = ["--dataset", "kitti2015", "--data", str(home / "kitti")]
    assert report(evaluate, ["c8", *data], capsys)["model"] == told["model"]


def test_folders_give_every_pair(
    home: Path, models: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (home / "left" / "notes.txt").write_text("no image")
    folders = [str(home / "left"), str(home / "right")]
    arguments = [
        *folders,
        "--model",
        str(models / "anynet.safetensors"),
        "--out",
        str(home / "out"),
    ]
    told = report(infer, [*arguments, "--stages", "1"], capsys)
    assert [(pair["name"], pair["stage"]) for pair in told["pairs"]] == [("0", 1), ("1", 1)]
    assert told["legend"] is None, "no classes, no colours to explain"
    assert len(left_behind(home)) == 4


def test_a_folder_of_pairs_has_one_legend(
    home: Path, models: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folders = [str(home / "left"), str(home / "right")]
    rest = ["--model", str(models / "full.safetensors"), "--out", str(home / "out")]
    assert infer([*folders, *rest]) == 0
    assert capsys.readouterr().out.rstrip().endswith("NAME_…  classes.png")
    assert len(left_behind(home)) == 2 * 4 + 1


def test_table_tells_what_was_written(
    home: Path, models: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    camera = ("--focal", "100", "--baseline", "0.5")
    assert infer(infer_arguments(home, models / "anynet.safetensors", *camera)) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    for words in ("AnyNet c=1, 3 stages · a test", "96x64", "disparity.png color.png cloud.ply"):
        assert words in printed.out


class Given:
    """A session that stands in for one of a network, and takes a quarter of a second."""

    arch = origin = None

    def fits(self, size: tuple[int, int]) -> bool:
        return True

    def predict(self, left: np.ndarray, right: np.ndarray, budget_ms: float | None) -> Estimate:
        return Estimate(self.estimate(left), None, 0.25, None)

    def estimate(self, left: np.ndarray) -> np.ndarray:
        raise NotImplementedError


def test_network_is_warmed_up_and_timed_in_milliseconds(
    home: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Slow(Given):
        runs = 0

        def estimate(self, left: np.ndarray) -> np.ndarray:
            self.runs += 1
            return left[..., 0].astype(np.float32)

    slow = Slow()
    monkeypatch.setattr("rts2.model.session.StereoSession", lambda *_: slow)
    folders = [str(home / "left"), str(home / "right")]
    told = report(infer, [*folders, "--model", "m.onnx", "--out", str(home / "out")], capsys)
    assert [pair["network_ms"] for pair in told["pairs"]] == [250.0, 250.0]
    assert slow.runs == 3, "two pairs of one size: one warm-up, one run each"


@pytest.mark.parametrize(
    ("values", "wanted"),
    [
        ([-3.25, 7.0, 20.125], [1 / 256, 20.125]),  # residuals may lead below 0
        ([5.001, 300.0, np.nan], [1280 / 256, 65535 / 256]),
        ([np.nan, np.inf, np.nan], None),
    ],
)
def test_the_range_is_that_of_the_written_file(
    home: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    values: list[float],
    wanted: list[float] | None,
) -> None:
    class Known(Given):
        def estimate(self, left: np.ndarray) -> np.ndarray:
            return np.resize(np.array(values, np.float32), left.shape[:2])

    monkeypatch.setattr("rts2.model.session.StereoSession", lambda *_: Known())
    arguments = infer_arguments(home, Path("m.onnx"))
    assert infer([*arguments, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["pairs"][0]["disparity_px"] == wanted
    written = read_disparity(home / "out" / "0_disparity.png")
    assert infer(arguments) == 0
    shown = "– – –" if wanted is None else f"{np.nanmin(written):.1f} – {np.nanmax(written):.1f}"
    assert f" {shown} " in capsys.readouterr().out


def test_disparity_beyond_the_format_is_told(
    home: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    network = build(Arch(c=1, d_max=48, stages=1, semantic=False))
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.zero_()  # equal costs: every pixel is in the middle, 23.5 planes of 16 px
    save(network, tmp_path / "far.safetensors", "a test")
    assert infer(infer_arguments(home, tmp_path / "far.safetensors")) == 0
    assert "6144 pixels exceed 255.996 px" in caplog.text
    assert (read_disparity(home / "out" / "0_disparity.png") == 65535 / 256).all()


def broken_models(home: Path, models: Path) -> dict[str, Path]:
    """Files that are no network, by what is wrong with them."""
    whole = (models / "full.safetensors").read_bytes()
    truncated = home / "truncated.safetensors"
    truncated.write_bytes(whole[: len(whole) // 2])
    text = home / "text.onnx"
    text.write_text("hello")
    value = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, 64, 96])
    out = helper.make_tensor_value_info("out", TensorProto.FLOAT, [1, 3, 64, 96])
    body = helper.make_graph([helper.make_node("Relu", ["image"], ["out"])], "g", [value], [out])
    model = helper.make_model(body, opset_imports=[helper.make_opsetid("", 13)])
    model.ir_version = 8
    onnx.save(model, home / "other.onnx")
    return {"truncated": truncated, "no onnx": text, "other inputs": home / "other.onnx"}


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("truncated", "truncated or no safetensors"),
        ("no onnx", "truncated or no ONNX file"),
        ("other inputs", "it takes image, tensor(float) [1, 3, 64, 96]"),
    ],
)
@pytest.mark.parametrize("command", [infer, evaluate])
def test_broken_model(
    home: Path,
    models: Path,
    capsys: pytest.CaptureFixture[str],
    command: Command,
    fault: str,
    words: str,
) -> None:
    model = broken_models(home, models)[fault]
    arguments = infer_arguments if command is infer else evaluate_arguments
    code, line = refusal(command, arguments(home, model), capsys)
    assert code == 1
    assert words in line
    assert left_behind(home) == []


class Evil:
    """Creates a file when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.mark,)


@pytest.mark.parametrize("container", ["zip", "protocol 2", "protocol 4"])
@pytest.mark.parametrize("command", [infer, evaluate])
def test_malicious_checkpoint_runs_nothing(
    home: Path, capsys: pytest.CaptureFixture[str], command: Command, container: str
) -> None:
    mark, model = home / "mark", home / "model.tar"
    if container == "zip":
        torch.save({"state_dict": Evil(mark)}, model)
    else:
        protocol = int(container.split()[1])
        model.write_bytes(pickle.dumps({"state_dict": Evil(mark)}, protocol=protocol))
        pickle.loads(model.read_bytes())
        assert mark.exists(), "the file is as malicious as it should be"
        mark.unlink()
    arguments = infer_arguments if command is infer else evaluate_arguments
    code, _ = refusal(command, arguments(home, model), capsys)
    assert code == 1
    assert not mark.exists()
    assert left_behind(home) == []


def wrong(home: Path, models: Path) -> dict[str, tuple[list[str], int, str]]:
    """Wrong uses of rts2-infer: arguments, exit code, words of the line."""
    model = models / "full.safetensors"
    good = infer_arguments(home, model)
    left, right = good[:2]
    put(home / "small.png", noise(3, 60, 96))
    put(home / "twins" / "0.png", noise(3))
    put(home / "twins" / "0.jpg", noise(3))
    put(home / "one" / "0.png", noise(3))
    (home / "empty").mkdir()
    (home / "text.png").write_text("hello")
    (home / "half.png").write_bytes((home / "left" / "0.png").read_bytes()[:5000])
    (home / "file").write_text("in the way")
    (home / "calib.txt").write_text(CALIBRATION.replace("96", "97"))
    (home / "broken.mp4").write_text("hello")
    video, film = str(home / "broken.mp4"), str(filmed(home / "both.mp4", PAIRS))
    rest = good[2:]
    folder = str(home / "left")
    return {
        "missing image": ([str(home / "none.png"), right, *rest], 2, "no such file"),
        "no image": ([left, str(home / "text.png"), *rest], 1, "truncated or no image"),
        "half an image": ([str(home / "half.png"), right, *rest], 1, "truncated or no image"),
        "two sizes": ([left, str(home / "small.png"), *rest], 2, "0.png is 96x64, "),
        "folder and image": ([folder, right, *rest], 2, "two images or two folders"),
        "no partner": ([folder, str(home / "one"), *rest], 2, "has no 1 (2 images against 1)"),
        "empty folders": ([str(home / "empty")] * 2 + rest, 2, "must hold images"),
        "twins": ([str(home / "twins")] * 2 + rest, 2, "names must differ"),
        "stages 0": ([*good, "--stages", "0"], 2, "stages must be 1 to 3"),
        "stages 4": ([*good, "--stages", "4"], 2, "stages must be 1 to 3"),
        "stages x": ([*good, "--stages", "x"], 2, "invalid int value"),
        "no model": ([left, right], 2, "c8 is neither; the box of this version is empty"),
        "missing model": ([left, right, "--model", "n.onnx"], 2, "a checkpoint or an ONNX file"),
        "unknown name": ([left, right, "--model", "none"], 2, "none is neither; the box"),
        "file for --out": ([*good[:-1], str(home / "file")], 1, "choose another --out"),
        "folder in a file": ([*good[:-1], str(home / "file" / "x")], 1, "choose another --out"),
        "half a camera": ([*good, "--focal", "700"], 2, "both --focal PX and --baseline M"),
        "focal 0": ([*good, "--focal", "0"], 2, "finite number above 0"),
        "two cameras": (
            [*good, "--focal", "7", "--calib", str(home / "calib.txt")],
            2,
            "leave the others out",
        ),
        "other calibration": (
            [*good, "--calib", str(home / "calib.txt")],
            2,
            "it is for 97x64, they are 96x64",
        ),
        "missing calibration": ([*good, "--calib", "none"], 2, "a calibration must be a file"),
        "small budget": ([*good, "--budget-ms", "0.001"], 2, "a budget must hold the first stage"),
        "budget 0": ([*good, "--budget-ms", "0"], 2, "finite number above 0"),
        "nothing": (rest, 2, "give LEFT and RIGHT, a video of both, or --camera"),
        "left alone": ([left, *rest], 2, "RIGHT is missing: LEFT alone must be a video"),
        "video and image": ([video, right, *rest], 2, "must be of one kind: "),
        "image and video": ([left, video, *rest], 2, "must be of one kind: "),
        "missing video": (["n.mp4", *rest], 2, "a video must be a file: n.mp4"),
        "broken video": ([video, *rest], 1, "broken.mp4 gives no frame"),
        "frames of images": ([*good, "--frames"], 2, "for videos and cameras"),
        "limit of images": ([*good, "--limit", "3"], 2, "for videos and cameras"),
        "limit 0": ([film, *rest, "--limit", "0"], 2, "a whole number from 1 to"),
        "size of images": ([*good, "--camera-size", "64x64"], 2, "--camera-size is for --camera"),
        "camera and images": ([*good, "--camera", "0"], 2, "no LEFT and RIGHT beside it"),
        "three cameras": ([*rest, "--camera", "0", "1", "2"], 2, "takes one index or two"),
        "camera -1": ([*rest, "--camera", "-1"], 2, "--camera"),
        "no camera": (["--camera", "77", *rest], 1, "camera 77 gives no frame"),
        "points of a film": (
            [film, *rest, "--focal", "7", "--baseline", "1"],
            2,
            "add --frames",
        ),
        "other calibration of a film": (
            [film, *rest, "--frames", "--calib", str(home / "calib.txt")],
            2,
            "it is for 97x64, they are 96x64",
        ),
        "stages 4 of a film": ([film, *rest, "--stages", "4"], 2, "stages must be 1 to 3"),
        "small budget of a film": (
            [film, *rest, "--budget-ms", "0.001"],
            2,
            "a budget must hold the first stage",
        ),
    }


WRONG = [
    "missing image",
    "no image",
    "half an image",
    "two sizes",
    "folder and image",
    "no partner",
    "empty folders",
    "twins",
    "stages 0",
    "stages 4",
    "stages x",
    "no model",
    "missing model",
    "unknown name",
    "file for --out",
    "folder in a file",
    "half a camera",
    "focal 0",
    "two cameras",
    "other calibration",
    "missing calibration",
    "small budget",
    "budget 0",
    "nothing",
    "left alone",
    "video and image",
    "image and video",
    "missing video",
    "broken video",
    "frames of images",
    "limit of images",
    "limit 0",
    "size of images",
    "camera and images",
    "three cameras",
    "camera -1",
    "no camera",
    "points of a film",
    "other calibration of a film",
    "stages 4 of a film",
    "small budget of a film",
]


@pytest.mark.parametrize("fault", WRONG)
def test_wrong_use_of_infer(
    home: Path,
    models: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    fault: str,
) -> None:
    monkeypatch.setattr("rts2.model.box._folder", lambda: home / "no box")
    cases = wrong(home, models)
    assert list(cases) == WRONG
    arguments, expected, words = cases[fault]
    code, line = refusal(infer, arguments, capsys)
    assert code == expected
    assert words in line
    assert not (home / "out").exists()
    assert (home / "file").read_text() == "in the way"


def test_broken_image_in_a_folder_keeps_what_was_done(
    home: Path, models: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image = home / "right" / "1.png"
    image.write_bytes(image.read_bytes()[:5000])
    folders = [str(home / "left"), str(home / "right")]
    arguments = [
        *folders,
        "--model",
        str(models / "anynet.safetensors"),
        "--out",
        str(home / "out"),
    ]
    code, line = refusal(infer, arguments, capsys)
    assert code == 1
    assert str(image) in line
    assert [path.name for path in left_behind(home)] == ["0_color.png", "0_disparity.png"]


def test_a_budget_is_kept_in_fewer_stages(
    home: Path,
    models: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    planted = iter((10.0, 20.0, 40.0))

    class Planted:
        """Calls that take as long as was planted, whatever they took."""

        def __init__(self) -> None:
            self.expected_ms = next(planted)

        def add(self, ms: float) -> None: ...

        def forget_slowest(self) -> None: ...

    monkeypatch.setattr("rts2.model.session.Times", Planted)
    arguments = infer_arguments(home, models / "full.safetensors", "--budget-ms", "30")
    (pair,) = report(infer, arguments, capsys)["pairs"]
    assert pair["stage"] == 2
    left, right = (read_rgb(home / side / "0.png") for side in ("left", "right"))
    wanted = open_model(models / "full.safetensors").predict(left, right, 2)
    written = read_disparity(home / "out" / "0_disparity.png")
    np.testing.assert_allclose(written, wanted.disparity, atol=0.5 / 256 + 1e-3)


def test_a_graph_stops_early_too(
    home: Path, models: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from rts2.model.checkpoint import load
    from rts2.model.export import export

    network = load(models / "full.safetensors")[0]
    export(network, home / "a.onnx", (96, 64), "a test")
    told = report(infer, infer_arguments(home, home / "a.onnx", "--stages", "1"), capsys)
    assert [pair["stage"] for pair in told["pairs"]] == [1]
    assert told["arch"]["stages"] == 3, "that of the network"


def test_images_of_several_sizes(
    home: Path, models: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for side in ("left", "right"):
        for index, size in ((2, (70, 90)), (3, (120, 40)), (4, (64, 96))):
            put(home / side / f"{index}.png", noise(index, *size))
    folders = [str(home / "left"), str(home / "right"), "--out", str(home / "out")]
    told = report(infer, [*folders, "--model", str(models / "full.safetensors")], capsys)
    sizes = [[96, 64], [96, 64], [90, 70], [40, 120], [96, 64]]
    assert [pair["size"] for pair in told["pairs"]] == sizes
    assert read_disparity(home / "out" / "3_disparity.png").shape == (120, 40)


@pytest.mark.parametrize("sources", ["side by side", "two videos"])
def test_a_video_gives_films(
    home: Path, models: Path, capsys: pytest.CaptureFixture[str], sources: str
) -> None:
    files = [filmed(home / "both.mp4", PAIRS)]
    if sources == "two videos":
        files = [
            filmed(home / f"{name}.mp4", list(zip(images, strict=True)))
            for name, images in zip(("l", "r"), zip(*PAIRS, strict=True), strict=True)
        ]
    name = files[0].stem
    rest = ["--model", str(models / "full.safetensors"), "--out", str(home / "out")]
    told = report(infer, [*map(str, files), *rest], capsys)
    films = [f"{name}_color.mp4", f"{name}_overlay.mp4"]
    assert [path.name for path in left_behind(home)] == sorted([*films, "classes.png"])
    stream = told.pop("stream")
    assert stream.pop("fps") > 0
    assert stream.pop("network_ms") > 0
    assert stream == {
        "name": name,
        "size": [96, 64],
        "frames": 3,
        "stages": [{"stage": 3, "frames": 3}],
        "files": films,
    }
    assert (told["schema"], told["pairs"], told["legend"]) == ("rts2.infer/1", [], "classes.png")


def test_every_frame_of_a_video_can_have_its_files(
    home: Path, models: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    video = filmed(home / "both.mp4", PAIRS)
    (home / "calib.txt").write_text(CALIBRATION)
    rest = [
        "--model",
        str(models / "anynet.safetensors"),
        "--out",
        str(home / "out"),
        "--stages",
        "1",
    ]
    more = ["--frames", "--limit", "2", "--calib", str(home / "calib.txt")]
    told = report(infer, [str(video), *rest, *more], capsys)
    kinds = ["cloud.ply", "color.png", "disparity.png"]
    assert [sorted(pair["files"]) for pair in told["pairs"]] == [
        [f"both_{index:06}_{kind}" for kind in kinds] for index in range(2)
    ]
    assert told["legend"] is None
    assert len(left_behind(home)) == 2 * 3 + 1
    left, right = next(Stream([video]).pairs())
    wanted = open_model(models / "anynet.safetensors").predict(left, right, 1)
    written = read_disparity(home / "out" / "both_000000_disparity.png")
    np.testing.assert_allclose(written, wanted.disparity.clip(1 / 256), atol=0.5 / 256 + 1e-3)


def test_the_table_of_a_video(home: Path, models: Path, capsys: pytest.CaptureFixture[str]) -> None:
    video = filmed(home / "both.mp4", PAIRS)
    rest = ["--model", str(models / "full.safetensors"), "--out", str(home / "out")]
    assert infer([str(video), *rest]) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    for words in ("full.safetensors · c=1", "96x64", "3: 3", "both_color.mp4  both_overlay.mp4"):
        assert words in printed.out


def test_cameras_are_seen_until_the_limit(
    home: Path,
    models: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import cv2

    opened: list[int | str] = []
    capture = cv2.VideoCapture

    def camera(index: int | str) -> Any:
        opened.append(index)
        return capture(str(home / f"{index}.mp4"))

    for index in range(2):
        filmed(home / f"{index}.mp4", [(pair[index],) for pair in PAIRS])
    monkeypatch.setattr(cv2, "VideoCapture", camera)
    rest = ["--model", str(models / "full.safetensors"), "--out", str(home / "out"), "--limit", "2"]
    told = report(infer, ["--camera", "0", "1", *rest], capsys)
    assert opened == [0, 1]
    assert (told["stream"]["name"], told["stream"]["frames"]) == ("camera0", 2)
    assert (home / "out" / "camera0_color.mp4").is_file()


def test_evaluation_tells_what_is_known(
    home: Path, models: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told = report(evaluate, evaluate_arguments(home, models / "full.safetensors"), capsys)
    assert told["schema"] == "rts2.eval/1"
    assert (told["crop"], told["foreground"]) == (None, None)
    assert [entry["stage"] for entry in told["stages"]] == [1, 2, 3]
    scene = [read_rgb(home / "kitti" / "training" / f"image_{i}" / "000000_10.png") for i in (2, 3)]
    for entry, image in zip(told["stages"], told["images"], strict=True):
        estimate = open_model(models / "full.safetensors").predict(*scene, entry["stage"])
        error = np.abs(estimate.disparity - 10.0)
        assert entry["epe"] == pytest.approx(error.mean(), rel=1e-4)
        assert entry["d1_all"] == pytest.approx(100 * (error > 3).mean(), abs=0.1)
        assert entry["pacc"] == pytest.approx(100 * (estimate.semantic == 0).mean(), abs=0.1)
        assert entry["miou"] is not None
        assert (entry["d1_bg"], entry["d1_fg"], entry["iiou"]) == (None, None, None)
        assert (entry["pixels"], entry["missing"]) == (64 * 96, 0)
        assert image["name"] == "000000_10"
        assert (image["stage"], image["epe"]) == (entry["stage"], entry["epe"])


def test_evaluation_splits_by_the_instances(
    home: Path, models: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    instances = np.full((64, 96), 26 * 256, np.uint16)
    instances[:, :48] += 1
    put(home / "kitti" / "training" / "instance" / "000000_10.png", instances)
    arguments = evaluate_arguments(home, models / "anynet.safetensors", "--stages", "2")
    told = report(evaluate, arguments, capsys)
    assert told["foreground"] == "instance"
    assert len(told["stages"]) == 2
    for entry in told["stages"]:
        assert entry["d1_all"] == pytest.approx((entry["d1_fg"] + entry["d1_bg"]) / 2)
        assert entry["miou"] is None


def test_evaluation_knows_objects(
    home: Path, models: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    training = home / "kitti" / "training"
    put(training / "semantic" / "000000_10.png", np.full((64, 96), 26, np.uint8))
    put(training / "instance" / "000000_10.png", np.full((64, 96), 26 * 256 + 1, np.uint16))
    told = report(evaluate, evaluate_arguments(home, models / "full.safetensors"), capsys)
    assert told["object_sizes"] == "published"
    scene = [read_rgb(training / f"image_{i}" / "000000_10.png") for i in (2, 3)]
    semantic = open_model(models / "full.safetensors").predict(*scene).semantic
    assert semantic is not None
    entry = told["stages"][-1]
    share = 100 * (semantic == 13).mean()  # one car: what is found of it, and nothing false
    assert entry["classes"]["car"]["iou"] == pytest.approx(share)
    assert entry["classes"]["car"]["iiou"] == pytest.approx(share)
    vehicle = 100 * (semantic >= 13).mean()
    human = ((semantic == 11) | (semantic == 12)).any()
    assert entry["iiou_category"] == pytest.approx(vehicle / (2 if human else 1))


def test_crop_judges_the_bottom_right(
    home: Path, models: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = evaluate_arguments(home, models / "anynet.safetensors", "--crop", "48x32")
    told = report(evaluate, arguments, capsys)
    assert told["crop"] == [48, 32]
    assert {entry["pixels"] for entry in told["stages"]} == {48 * 32}


def test_evaluation_table(home: Path, models: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert evaluate(evaluate_arguments(home, models / "anynet.safetensors")) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "anynet.safetensors · AnyNet c=1, 3 stages · a test · kitti2015"
    assert "D1-all %" in lines[1]
    assert sum(line.startswith("000000_10") for line in lines) == 3
    assert sum(line.startswith("all pixels") for line in lines) == 3


def test_columns_that_nobody_knows_are_left_out(
    home: Path, models: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert evaluate(evaluate_arguments(home, models / "full.safetensors")) == 0
    heading = capsys.readouterr().out.splitlines()[1]
    assert "mIoU cat. %" in heading
    assert "D1-fg" not in heading
    assert "iIoU" not in heading


def test_table_of_many_images_has_the_totals_alone(
    home: Path, models: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    training = home / "kitti" / "training"
    for folder in ("image_2", "image_3", "disp_occ_0", "semantic"):
        for index in range(1, 21):
            (training / folder / f"{index:06}_10.png").write_bytes(
                (training / folder / "000000_10.png").read_bytes()
            )
    arguments = evaluate_arguments(home, models / "anynet.safetensors", "--stages", "1")
    assert evaluate(arguments) == 0
    printed = capsys.readouterr().out
    assert "000000_10" not in printed
    assert "all pixels" in printed
    assert "21 images, one by one in --json" in printed
    assert len(report(evaluate, arguments, capsys)["images"]) == 21


def test_streets_need_no_folder(
    home: Path, models: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [str(models / "full.safetensors"), "--dataset", "streets"]
    told = report(evaluate, [*arguments, "--count", "2", "--size", "96x64"], capsys)
    assert (told["dataset"], told["split"]) == ("streets", "val")
    assert told["object_sizes"] in ("data set", None)
    assert len(told["images"]) == 6
    assert all(entry["d1_noc"] is not None for entry in told["stages"])


def test_submission_of_the_test_frames(
    home: Path, models: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for index in range(2):
        for side, seed in (("image_2", 0), ("image_3", 10)):
            put(home / "kitti" / "testing" / side / f"{index:06}_10.png", noise(seed + index))
    arguments = evaluate_arguments(home, models / "full.safetensors", "--split", "test")
    told = report(evaluate, [*arguments, "--submission", str(home / "s")], capsys)
    assert [part["folder"] for part in told["submission"]["parts"]] == ["disp_0", "semantic"]
    assert {part["frames"] for part in told["submission"]["parts"]} == {2}
    assert {entry["pixels"] for entry in told["stages"]} == {0}
    pair = [home / "kitti" / "testing" / f"image_{i}" / "000001_10.png" for i in (2, 3)]
    expected = open_model(models / "full.safetensors").predict(*map(read_rgb, pair))
    written = read_disparity(home / "s" / "disp_0" / "000001_10.png")
    np.testing.assert_allclose(written, expected.disparity, atol=0.5 / 256 + 1e-4)
    assert evaluate([*arguments, "--submission", str(home / "t")]) == 0
    printed = capsys.readouterr().out
    assert "2 images, of which no truth is known: nothing to judge" in printed
    assert "submission: disp_0/ has 2 of 200 frames, incomplete" in printed
    assert "training frames" not in printed


def test_submission_of_training_frames_says_so(
    home: Path, models: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = evaluate_arguments(home, models / "anynet.safetensors")
    assert evaluate([*arguments, "--submission", str(home / "s")]) == 0
    assert "these are training frames; the servers take --split test" in capsys.readouterr().out
    assert [path.name for path in (home / "s").iterdir()] == ["disp_0"]


@pytest.mark.parametrize(
    ("more", "code", "words"),
    [
        (["--crop", "97x64"], 2, "97x64 does not fit in 000000_10 of 96x64"),
        (["--crop", "12"], 2, "must be WxH"),
        (["--stages", "4"], 2, "stages must be 1 to 3"),
        (["--data", "none"], 2, "no such folder"),
        (["--dataset", "kitti2042"], 2, "kitti2015"),
        (["--dataset", "streets"], 2, "leave out --data"),
        (["--split", "none"], 2, "the splits of kitti2015 are all, train, val, test"),
        (["--split", "test"], 2, "testing"),
        (["--count", "3"], 2, "--count is for generated scenes (--dataset streets)"),
        (["--seed", "3"], 2, "--seed is for generated scenes"),
        (["--dataset", "streets", "--seed", "3"], 2, "--seed is for --split train"),
        (["--submission", "s", "--crop", "48x32"], 2, "leave --crop out"),
        (["--submission", "s", "--dataset", "streets"], 2, "leave out --data"),
        (["--submission", "kitti"], 2, "needs a new or an empty folder"),
    ],
)
def test_wrong_use_of_evaluate(
    home: Path,
    models: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    more: list[str],
    code: int,
    words: str,
) -> None:
    monkeypatch.chdir(home)
    arguments = evaluate_arguments(home, models / "anynet.safetensors", *more)
    found, line = refusal(evaluate, arguments, capsys)
    assert found == code
    assert words in line


RELEASED = {
    "kitti2015": {
        "000000_10": ([1.59, 1.46, 1.22], [12.62, 12.38, 8.79]),
        "000001_10": ([1.89, 1.50, 1.22], [12.53, 8.94, 6.29]),
        "000002_10": ([1.99, 1.52, 1.23], [17.14, 9.73, 7.09]),
    },
    "sceneflow": {
        "000000_10": ([3.34, 3.10, 3.12], [40.22, 36.95, 33.31]),
        "000001_10": ([3.19, 2.85, 2.74], [33.18, 27.99, 25.26]),
        "000002_10": ([4.74, 4.88, 5.21], [44.53, 45.29, 46.52]),
    },
}
"""EPE and D1-all of the official AnyNet code, stages 1 to 3, on the 1232x368 crop."""


@pytest.mark.parametrize("weights", sorted(RELEASED))
def test_released_checkpoints_give_the_official_figures(
    real_data: Path, capsys: pytest.CaptureFixture[str], weights: str
) -> None:
    model = real_data / "anynet_official" / f"{weights}.tar"
    data = ["--dataset", "kitti2015", "--data", str(real_data / "kitti2015")]
    told = report(evaluate, [str(model), *data, "--crop", "1232x368"], capsys)
    for name, (epe, d1) in RELEASED[weights].items():
        found = [entry for entry in told["images"] if entry["name"] == name]
        assert [entry["epe"] for entry in found] == pytest.approx(epe, abs=0.01)
        assert [entry["d1_all"] for entry in found] == pytest.approx(d1, abs=0.05)
    assert told["foreground"] == "instance"
    assert all(entry["d1_bg"] is not None for entry in told["stages"])
