"""rts2-deploy as a person or a script meets it: what it writes, what it keeps, how it refuses."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import onnx
import onnxruntime
import pytest
import torch
from torch import nn

from rts2.model.arch import Arch
from rts2.model.checkpoint import build, cut, load, save
from rts2.model.export import Deployed, parity
from rts2.model.files import sha256, write_json
from rts2.model.graph import read_header
from rts2.profiles.profile import Profile
from rts2.profiles.profile import load as load_profile
from rts2.search.cli import deploy, search
from rts2.search.deploy.configuration import of_point, read
from rts2.search.result import Coverage, Found, Point, PointEvidence

SIZE = (96, 64)
PICK = Arch(c=1, stages=2, d_max=6, conv3d=(4, 2))
PROSPECT = Arch(c=1, stages=1, d_max=6, conv3d=(4,), semantic=False)
WHOLE = Arch(c=1, stages=3, d_max=6, conv3d=(4, 2, 2))
"""Both are parts of it."""


def point(arch: Arch, **changes: Any) -> Point:
    known = {
        "arch": arch,
        "precision": "fp32",
        "runtime": "pytorch",
        "latency_ms": 40,
        "fps": 25,
        "fps_low": 21.5,
        "fps_high": 29,
        "d1_all": 5.5,
        "epe": None,
        "miou": None,
        "pacc": None,
        "params": 1,
        "size_bytes": 4,
        "macs": 1,
        "evidence": PointEvidence(latency="interpolated", accuracy="published"),
    }
    return Point.model_validate(known | changes)


def found(device: str, **changes: Any) -> Found:
    pick = point(PICK, runtime="onnxruntime" if device == "cpu" else "pytorch")
    known = {
        "device": device,
        "target_fps": 20,
        "resolution": SIZE,
        "task": "semantic-stereo",
        "objective": "d1_all",
        "confidence": 0.9,
        "space": Coverage(size=1, evaluated=1, exhaustive=True),
        "front": (pick,),
        "selected": pick,
        "prospect": pick.model_copy(update={"arch": PROSPECT}),
        "nearest": None,
        "left_out": (),
        "elapsed_s": 0,
    }
    return Found.model_validate(known | changes)


@pytest.fixture
def front(tmp_path: Path) -> Callable[..., Path]:
    """A front.json of a device, with changes."""

    def write(device: str, **changes: Any) -> Path:
        path = tmp_path / f"front-{device}.json"
        path.write_text(found(device, **changes).model_dump_json(by_alias=True))
        return path

    return write


@pytest.fixture
def checkpoint(tmp_path: Path) -> Callable[..., Path]:
    """A checkpoint whose norms know their inputs: no layer is dead."""

    def write(arch: Arch = WHOLE, origin: str = "made up for a test") -> Path:
        network = build(arch)
        for module in network.modules():
            if isinstance(module, nn.BatchNorm2d | nn.BatchNorm3d):
                module.momentum = None
        with torch.no_grad():
            network.train()(*torch.randn(2, 4, 3, SIZE[1], SIZE[0]))
        path = tmp_path / "model.safetensors"
        save(network.eval(), path, origin)
        return path

    return write


class Run:
    def __init__(self, code: int, out: str, err: str, folder: Path) -> None:
        self.code, self.out, self.err, self.folder = code, out, err, folder

    @property
    def json(self) -> dict[str, Any]:
        assert (self.code, self.err) == (0, "")
        assert self.out.count("\n") == 1
        value: dict[str, Any] = json.loads(self.out)
        return value


@pytest.fixture
def run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Any:
    def command(*arguments: object, out: Path | None = None) -> Run:
        folder = out or tmp_path / "results" / "bundle"
        code = deploy([*map(str, arguments), "--out", str(folder)])
        printed = capsys.readouterr()
        return Run(code, printed.out, printed.err, folder)

    return command


def refused(ended: Run, code: int, *said: str) -> None:
    assert (ended.code, ended.out) == (code, "")
    assert ended.err.count("\n") == 1
    assert "Traceback" not in ended.err
    for text in said:
        assert text in ended.err


def entries(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


@pytest.mark.parametrize("device", ["tx2", "rtx2080ti", "cpu"])
def test_the_pick_becomes_a_folder(run: Any, front: Callable[..., Path], device: str) -> None:
    ended = run("--device", device, "--front", front(device), "--untrained")
    assert (ended.code, ended.err) == (0, "")
    deployment = read(ended.folder / "deployment.json")
    assert (deployment.device, deployment.arch, deployment.weights) == (device, PICK, "untrained")
    listed = {file.name for file in deployment.files}
    assert entries(ended.folder).keys() == listed | {"deployment.json"}
    for name in ("deployment.json", *(file.name for file in deployment.files)):
        assert name in ended.out
    assert ("sh build.sh" in ended.out) == (device != "cpu")
    assert [path.name for path in ended.folder.parent.iterdir()] == ["bundle"]


def test_the_json_is_the_configuration(run: Any, front: Callable[..., Path]) -> None:
    ended = run("--device", "cpu", "--front", front("cpu"), "--untrained", "--json")
    assert ended.json == json.loads((ended.folder / "deployment.json").read_text())
    assert ended.json["expected"]["fps_low"] == 21.5
    assert ended.json["expected"]["evidence"]["latency"] == "interpolated"


@pytest.mark.parametrize("runtime", ["onnxruntime", "openvino"])
def test_the_front_of_a_real_search_is_deployed(
    run: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], runtime: str
) -> None:
    if runtime == "openvino":
        pytest.importorskip("openvino", reason="needs OpenVINO: pip install 'rts2[openvino]'")
    asked = ("--device", "cpu", "--target-fps", "30", "--resolution", "640x192", "--task", "stereo")
    limit = ("--max-size-mb", "0.1", "--runtime", runtime, "--json")
    assert search([*asked, *limit, "--out", str(tmp_path / "found")]) == 0
    selected = json.loads(capsys.readouterr().out)["selected"]
    path = tmp_path / "found" / "front.json"
    configured = json.loads((tmp_path / "found" / "deployment.json").read_text())
    told = run("--device", "cpu", "--front", path, "--untrained", "--json").json
    assert told["arch"] == selected["arch"]
    assert told["expected"]["fps"] == selected["fps"]
    for key in ("weights", "files", "check", "execution", "layers"):
        assert told.pop(key)
        assert not configured.pop(key)
    assert bool(told.pop("calibration")["images"]) == (selected["precision"] == "int8")
    assert configured.pop("calibration")["images"] == []
    assert told.pop("versions").items() > configured.pop("versions").items()
    assert told == configured


def test_the_prospect_is_deployed_on_request(run: Any, front: Callable[..., Path]) -> None:
    asked = ("--device", "cpu", "--front", front("cpu"), "--untrained", "--json")
    assert run(*asked, "--prospect").json["arch"] == PROSPECT.model_dump(mode="json")


def test_the_seed_decides_random_weights(run: Any, front: Callable[..., Path]) -> None:
    asked = ("--device", "cpu", "--front", front("cpu"), "--untrained", "--json")
    hashes = []
    for seed in (0, 0, 1):
        told = run(*asked, "--seed", seed).json
        hashes.append({file["name"]: file["sha256"] for file in told["files"]})
    assert hashes[0] == hashes[1]
    changed = {name for name in hashes[0] if hashes[0][name] != hashes[2][name]}
    samples = ("samples/val-000000", "samples/val-000001")
    maps = {f"{sample}/{name}.bin" for sample in samples for name in ("disparity", "semantic")}
    assert changed == {"model.onnx", *maps}


def test_a_checkpoint_is_cut_to_the_pick_and_answers_the_same(
    run: Any, front: Callable[..., Path], checkpoint: Callable[..., Path]
) -> None:
    path = checkpoint()
    ended = run("--device", "tx2", "--front", front("tx2"), "--model", path)
    assert ended.code == 0
    graph = ended.folder / "model.onnx"
    assert read_header(graph).arch == PICK
    assert read_header(graph).origin == "made up for a test"
    assert read(ended.folder / "deployment.json").weights == "made up for a test"
    whole, _ = load(path)
    left, right = torch.randn(2, 1, 3, SIZE[1], SIZE[0])
    assert parity(graph, cut(whole, PICK), left, right).disparity_px < 1e-3
    # The whole network stopped after two stages says the same: the weights are its own.
    with torch.inference_mode():
        expected = Deployed(whole, stages=2).eval()(left, right)[0].numpy()
    session = onnxruntime.InferenceSession(graph, providers=["CPUExecutionProvider"])
    answer = session.run(["disparity"], {"left": left.numpy(), "right": right.numpy()})[0]
    assert abs(answer - expected).max() < 1e-3
    assert answer.std() > 0.01


def test_a_checkpoint_alone_promises_nothing(run: Any, checkpoint: Callable[..., Path]) -> None:
    asked = ("--device", "cpu", "--model", checkpoint(PROSPECT), "--resolution", "90x60")
    told = run(*asked, "--json").json
    assert (told["expected"], told["target_fps"]) == (None, None)
    assert told["arch"] == PROSPECT.model_dump(mode="json")
    assert (told["input"]["resolution"], told["input"]["shape"]) == ([90, 60], [1, 3, 64, 96])
    assert "No search promised" in (run(*asked).folder / "README.md").read_text()


@pytest.mark.parametrize(
    ("device", "options", "runtime"),
    [
        ("cpu", ("--precision", "int8"), "onnxruntime"),
        ("rtx2080ti", ("--precision", "fp16", "--tensorrt", "10"), "tensorrt"),
        ("rtx2080ti", ("--runtime", "tensorrt"), "tensorrt"),
    ],
)
def test_without_a_front_precision_runtime_and_generation_can_be_said(
    run: Any,
    checkpoint: Callable[..., Path],
    device: str,
    options: tuple[str, ...],
    runtime: str,
) -> None:
    asked = ("--device", device, "--model", checkpoint(PROSPECT), "--resolution", "96x64")
    told = run(*asked, *options, "--json").json
    given = dict(zip(options[::2], options[1::2], strict=True))
    assert told["precision"] == given.get("--precision", "fp32")
    assert told["runtime"] == told["execution"]["runtime"] == runtime
    if runtime == "tensorrt":
        assert told["execution"]["generation"] == given.get("--tensorrt", "8.2")


def test_what_a_device_does_not_have_without_a_front_is_refused(
    run: Any, checkpoint: Callable[..., Path], ort_alone: Profile, tmp_path: Path
) -> None:
    device = tmp_path / "box.json"
    write_json(device, ort_alone.model_dump(mode="json", by_alias=True, exclude_none=True))
    asked = ("--device", device, "--model", checkpoint(PROSPECT), "--resolution", "96x64")
    refused(run(*asked, "--runtime", "openvino"), 2, "rts2-profile fit --runtime openvino adds it")
    refused(run(*asked, "--precision", "bf16"), 2, "runs fp32 or int8 on onnxruntime, not bf16")
    refused(run(*asked, "--tensorrt", "10"), 2, "--tensorrt is for TensorRT")
    tx2 = ("--device", "tx2", *asked[2:])
    refused(run(*tx2, "--tensorrt", "11"), 2, "runs TensorRT 8.2, not 11")
    refused(run(*tx2, "--precision", "int8"), 2, "sm_62 has no DP4A", "use fp16")


def test_a_network_in_the_box_goes_by_its_name(
    run: Any, checkpoint: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = checkpoint(PROSPECT)
    monkeypatch.setattr("rts2.model.box._folder", lambda: path.parent)
    size = ("--resolution", "90x60")
    named = run("--device", "cpu", "--model", path.stem, *size, "--json")
    assert named.code == 0
    assert named.json["arch"] == PROSPECT.model_dump(mode="json")


def test_a_pick_takes_its_weights_from_the_box(
    run: Any,
    front: Callable[..., Path],
    checkpoint: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    path = checkpoint(WHOLE)
    monkeypatch.setattr("rts2.model.box._folder", lambda: path.parent)
    ended = run("--device", "cpu", "--front", front("cpu"), "--json")
    assert ended.json["arch"] == PICK.model_dump(mode="json")
    assert ended.json["weights"].startswith(f"{path.stem} of the box, ")
    assert "the accuracy that the search promises needs the training" in caplog.text


FIGURES = {"d1_all": 40.5, "epe": 3.5, "miou": 12.25, "pacc": 60.0}
"""Of the second stage, as a record tells them."""


@pytest.fixture
def box(
    checkpoint: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Path]:
    """A box of one network, judged after each stage on frames that nobody trained on."""

    def fill(dataset: str = "kitti2015") -> Path:
        path = tmp_path / "box" / "mine.safetensors"
        path.parent.mkdir()
        checkpoint(WHOLE).rename(path)
        stages = [FIGURES | {"stage": stage, "d1_all": 38.5 + stage} for stage in (1, 2, 3)]
        judged = {"dataset": dataset, "split": "all", "samples": 3, "stages": stages}
        other = judged | {"dataset": "streets", "stages": [FIGURES | {"stage": 2, "epe": 9.0}]}
        path.with_suffix(".json").write_text(json.dumps({"judged": [other, judged]}))
        monkeypatch.setattr("rts2.model.box._folder", lambda: path.parent)
        return path

    return fill


@pytest.mark.parametrize("named", [False, True])
def test_weights_of_the_box_promise_what_they_were_judged_to_reach(
    run: Any, front: Callable[..., Path], box: Callable[..., Path], named: bool
) -> None:
    path = box()
    more = ("--model", path) if named else ()
    ended = run("--device", "cpu", "--front", front("cpu"), *more, "--json")
    told = json.loads(ended.out)["expected"]
    assert {name: told[name] for name in ("d1_all", "epe", "miou")} == {
        name: FIGURES[name] for name in ("d1_all", "epe", "miou")
    }
    assert told["evidence"] == {"latency": "interpolated", "accuracy": "measured"}
    assert told["judged_on"] == "kitti2015 all, 3 frames, in fp32"
    assert (told["fps"], told["latency_ms"]) == (25, 40)
    text = " ".join((ended.folder / "README.md").read_text().split())
    assert "theirs, judged on kitti2015 all, 3 frames" in text


@pytest.mark.parametrize("why", ["no record", "another data set", "a branch was cut"])
def test_what_nobody_judged_of_the_box_is_not_promised(
    run: Any, front: Callable[..., Path], box: Callable[..., Path], why: str
) -> None:
    path = box("kitti2012" if why == "another data set" else "kitti2015")
    if why == "no record":
        path.with_suffix(".json").unlink()
    cut_off = ("--prospect",) if why == "a branch was cut" else ()
    ended = run("--device", "cpu", "--front", front("cpu"), *cut_off, "--json")
    told = json.loads(ended.out)["expected"]
    assert [told[name] for name in ("d1_all", "epe", "miou", "judged_on")] == [None] * 4
    assert told["evidence"] == {"latency": "interpolated", "accuracy": None}
    assert told["fps"] == 25
    assert "accuracy they reach is not known" in (ended.folder / "README.md").read_text()


def test_weights_of_others_keep_the_promise_of_the_search(
    run: Any, front: Callable[..., Path], checkpoint: Callable[..., Path]
) -> None:
    asked = ("--device", "cpu", "--front", front("cpu"), "--model", checkpoint())
    told = run(*asked, "--json").json["expected"]
    assert (told["d1_all"], told["evidence"]["accuracy"]) == (5.5, "published")
    text = " ".join((run(*asked).folder / "README.md").read_text().split())
    assert "those of the search's source, not of these weights" in text


def test_a_checkpoint_that_does_not_hold_the_pick_is_refused_with_each_difference(
    run: Any, front: Callable[..., Path], checkpoint: Callable[..., Path]
) -> None:
    other = Arch(c=2, stages=1, d_max=8, conv3d=(4,), semantic=False)
    ended = run("--device", "tx2", "--front", front("tx2"), "--model", checkpoint(other))
    refused(
        ended,
        2,
        "c is 2, 1 was asked for",
        "stages is 1, 2 was asked for",
        "d_max is 8, 6 was asked for",
        "it has no semantic branch",
        "it has no refinement branch",
    )
    assert not ended.folder.parent.exists()


def test_random_weights_are_deployed_only_on_request(
    run: Any, front: Callable[..., Path], checkpoint: Callable[..., Path]
) -> None:
    path = checkpoint(PICK, "untrained")
    asked = ("--device", "cpu", "--front", front("cpu"))
    for arguments in (asked, (*asked, "--model", path), ("--device", "cpu", "--model", path)):
        ended = run(*arguments)
        refused(ended, 2, "--untrained")
        assert not ended.folder.parent.exists()
    assert run(*asked, "--model", path, "--untrained", "--json").json["weights"] == "untrained"


def test_a_front_without_a_pick_names_its_prospect(run: Any, front: Callable[..., Path]) -> None:
    asked = ("--device", "cpu", "--front", front("cpu", selected=None), "--untrained")
    refused(run(*asked), 3, "has no pick; --prospect deploys")
    assert run(*asked, "--prospect").code == 0


@pytest.mark.parametrize("text", ["", "{", "[]", '{"schema": "rts2.profile/1"}'])
def test_a_file_that_is_no_front_is_one_line(run: Any, tmp_path: Path, text: str) -> None:
    path = tmp_path / "front.json"
    path.write_text(text)
    ended = run("--device", "tx2", "--front", path, "--untrained")
    refused(ended, 1, str(path))
    assert not ended.folder.parent.exists()


def test_a_front_that_does_not_fit_is_refused_and_nothing_is_written(
    run: Any, front: Callable[..., Path], tmp_path: Path
) -> None:
    tx2 = front("tx2")
    asked = ("--device", "tx2", "--front", tx2)
    without = front("cpu", selected=None, prospect=None)
    cases: list[tuple[int, str, tuple[object, ...]]] = [
        (2, "searched for tx2, not for cpu", ("--device", "cpu", "--front", tx2)),
        (2, "searched at 96x64", ("--device", "tx2", "--front", tx2, "--resolution", "640x192")),
        (3, "has no pick; search with", ("--device", "cpu", "--front", without)),
        (3, "has no prospect", ("--device", "cpu", "--front", without, "--prospect")),
        (2, "no such file", ("--device", "cpu", "--front", tmp_path / "none.json")),
        (2, "no such file", ("--device", "cpu", "--model", tmp_path / "none.safetensors")),
        (2, "unknown device", ("--device", "toaster", "--front", tx2)),
        (2, "--device", ("--front", tx2)),
        (2, "--precision is the front's", (*asked, "--precision", "fp16")),
        (2, "--runtime is the front's", (*asked, "--runtime", "tensorrt")),
        (2, "--tensorrt", (*asked, "--tensorrt", "7")),
        (2, "--target", (*asked, "--target", "toaster")),
        (2, "--front front.json, --model CHECKPOINT", ("--device", "cpu")),
        (2, "must be WxH", ("--device", "cpu", "--front", tx2, "--resolution", "96")),
        (2, "--seed", ("--device", "tx2", "--front", tx2, "--seed", "x")),
        (2, "--seed", ("--device", "tx2", "--front", tx2, "--seed", "9" * 30)),
    ]
    for code, said, arguments in cases:
        ended = run(*arguments, "--untrained")
        refused(ended, code, said)
        assert not ended.folder.parent.exists()


def test_a_broken_checkpoint_leaves_nothing(
    run: Any, front: Callable[..., Path], tmp_path: Path
) -> None:
    path = tmp_path / "broken.safetensors"
    path.write_bytes(b"\x10" * 40)
    ended = run("--device", "cpu", "--front", front("cpu"), "--model", path)
    refused(ended, 1, str(path))
    assert not ended.folder.parent.exists()


def test_a_device_without_a_runtime_of_ours_is_refused(
    run: Any, front: Callable[..., Path], tmp_path: Path
) -> None:
    path = tmp_path / "box.json"
    stored = load_profile("tx2").model_dump(mode="json", by_alias=True, exclude_none=True)
    stored["runtimes"] = [r for r in stored["runtimes"] if r["runtime"] == "pytorch"]
    path.write_text(json.dumps(stored))
    ended = run("--device", path, "--front", front("tx2"), "--untrained")
    refused(ended, 2, "no runtime that a bundle can be made for")
    assert not ended.folder.exists() or list(ended.folder.iterdir()) == []


def test_an_earlier_bundle_is_replaced_file_by_file(run: Any, front: Callable[..., Path]) -> None:
    first = run("--device", "tx2", "--front", front("tx2"), "--untrained", "--seed", 1)
    before = entries(first.folder)
    again = run("--device", "tx2", "--front", front("tx2"), "--untrained", "--seed", 2)
    after = entries(again.folder)
    assert after.keys() == before.keys()
    changed = {name for name in after if after[name] != before[name]}
    assert {"deployment.json", "model.onnx", "samples/val-000001/disparity.bin"} <= changed
    assert not changed & {"build.sh", "verify.py", "samples/val-000000/left.ppm"}


def test_deploying_into_the_searchs_folder_keeps_the_front(
    run: Any, front: Callable[..., Path], tmp_path: Path
) -> None:
    """Both write a deployment.json; `--out` of the search given again must not cost the front."""
    folder = tmp_path / "rts2-out"
    folder.mkdir()
    for name in ("front.json", "front.csv", "front.png"):
        (folder / name).write_bytes(front("cpu").read_bytes())
    of_pick = of_point(point(PICK), found("cpu"), load_profile("cpu"))
    (folder / "deployment.json").write_text(of_pick.model_dump_json(by_alias=True))
    before = entries(folder)
    run("--device", "cpu", "--front", folder / "front.json", "--untrained", out=folder)
    after = entries(folder)
    for name in ("front.json", "front.csv", "front.png"):
        assert after[name] == before[name]


def test_a_file_that_somebody_put_into_a_bundle_is_not_lost(
    run: Any, front: Callable[..., Path], checkpoint: Callable[..., Path]
) -> None:
    """The trained weights beside the bundle that was made of them, say."""
    first = run("--device", "cpu", "--front", front("cpu"), "--untrained")
    mine = first.folder / "trained.safetensors"
    checkpoint(PICK).rename(mine)
    before = mine.read_bytes()
    run("--device", "cpu", "--front", front("cpu"), "--model", mine)
    assert mine.read_bytes() == before


def test_a_folder_of_somebody_else_keeps_its_files(
    run: Any, front: Callable[..., Path], tmp_path: Path
) -> None:
    folder = tmp_path / "thesis"
    folder.mkdir()
    file = folder / "chapter.tex"
    file.write_text("mine")
    run("--device", "cpu", "--front", front("cpu"), "--untrained", out=folder)
    assert file.read_text() == "mine"
    refused(run("--device", "cpu", "--front", front("cpu"), "--untrained", out=file), 1, str(file))
    assert file.read_text() == "mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["front-cpu.json", "thesis"]


def test_only_what_an_earlier_bundle_left_is_cleared(
    run: Any, front: Callable[..., Path], tmp_path: Path
) -> None:
    """A TX2's engine and its build script go with its bundle; the user's own files stay."""
    folder = tmp_path / "bundle"
    folder.mkdir()
    (folder / "layers.json").write_text("mine")
    tx2 = ("--device", "tx2", "--front", front("tx2"), "--untrained")
    run(*tx2, "--target", "triton", out=folder)
    assert (folder / "layers.json").read_text() == "mine"
    assert (folder / "triton").is_dir()
    engines = [folder / "model.plan", folder / "triton" / "rts2net" / "1" / "model.plan"]
    for engine in engines:
        engine.parent.mkdir(exist_ok=True)
        engine.write_text("an engine")
    (folder / "notes.txt").write_text("mine")
    run("--device", "cpu", "--front", front("cpu"), "--untrained", out=folder)
    left = {path.name for path in folder.iterdir()}
    assert "notes.txt" in left
    assert not left & {"model.plan", "build.sh", "layers.json", "triton"}


@pytest.fixture
def verify(capsys: pytest.CaptureFixture[str]) -> Any:
    def command(folder: Path, *options: str) -> Run:
        code = deploy(["verify", str(folder), *options])
        printed = capsys.readouterr()
        return Run(code, printed.out, printed.err, folder)

    return command


def rehash(folder: Path, known: dict[str, Any]) -> None:
    """Makes a configuration agree with what a test has done to the files."""
    for file in known["files"]:
        file["sha256"] = sha256(folder / file["name"])
    (folder / "deployment.json").write_text(json.dumps(known))


@pytest.fixture
def made(run: Any, front: Callable[..., Path]) -> Path:
    folder: Path = run("--device", "cpu", "--front", front("cpu"), "--untrained").folder
    return folder


def test_a_bundle_is_verified_here(verify: Any, made: Path) -> None:
    ended = verify(made)
    assert (ended.code, ended.err) == (0, "")
    assert ended.out.endswith("ok\n")
    assert "expected  25.0 FPS" in ended.out
    told = verify(made, "--json").json
    assert (told["schema"], told["ok"]) == ("rts2.verification/1", True)


def test_a_bundle_that_was_changed_is_not_run(verify: Any, made: Path) -> None:
    script = made / "verify.py"
    script.write_text("raise SystemExit('was run')")
    refused(verify(made), 1, "verify.py is not the file that deployment.json tells the hash of")
    script.unlink()
    refused(verify(made), 1, "holds no verify.py; make the bundle again")


def test_verify_refuses_a_configuration_that_its_schema_does_not_know(
    made: Path, verify: Any
) -> None:
    path = made / "deployment.json"
    known = json.loads(path.read_text())
    path.write_text(json.dumps(known | {"layers": [{"layer": "*", "precision": "fp8"}]}))
    refused(verify(made), 1, "deployment.json", "layers.0.precision")


def test_what_verify_py_finds_fails_the_command(verify: Any, made: Path) -> None:
    known = json.loads((made / "deployment.json").read_text())
    known["versions"]["onnxruntime"] = "1.2.3"
    expected = made / "samples" / "val-000001" / "disparity.bin"
    expected.write_bytes(bytes(expected.stat().st_size))
    rehash(made, known)
    ended = verify(made)
    assert ended.code == 1
    assert "written with onnxruntime 1.2.3" in ended.out
    assert "FAILED: the answers are too far off" in ended.err
    assert ended.err.count("\n") == 1
    ended = verify(made, "--json")
    assert (ended.code, json.loads(ended.out)["ok"]) == (1, False)


def test_a_bundle_for_another_device_is_one_line(
    run: Any, verify: Any, front: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = run("--device", "tx2", "--front", front("tx2"), "--untrained").folder
    monkeypatch.setenv("TRTEXEC", "/none/trtexec")
    said = "trtexec is not at /none/trtexec: this bundle runs on tx2 with TensorRT 8.2"
    for options in ((), ("--json",)):
        refused(verify(folder, *options), 1, said)


def test_weights_in_another_file_that_is_missing_are_named(verify: Any, made: Path) -> None:
    graph = made / "model.onnx"
    model = onnx.load(graph)
    options = {"save_as_external_data": True, "location": "weights.bin", "size_threshold": 1000}
    onnx.save_model(model, graph, **options)
    rehash(made, json.loads((made / "deployment.json").read_text()))
    assert verify(made).code == 0
    (made / "weights.bin").unlink()
    refused(verify(made), 1, "keeps weights in weights.bin, which is missing; copy the whole")


def test_what_is_no_bundle_is_not_verified(verify: Any, tmp_path: Path) -> None:
    refused(verify(tmp_path), 2, "it is a folder without deployment.json")
    refused(verify(tmp_path / "none"), 2, "it is no folder")
    (tmp_path / "deployment.json").write_text("{}")
    refused(verify(tmp_path), 1, "a deployment configuration")
