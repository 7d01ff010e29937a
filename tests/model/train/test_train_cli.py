"""rts2-train as a user meets it: runs, resumptions, killed ones, several processes, mistakes."""

import csv
import json
import os
import random
import re
import resource
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file

from rts2.model.arch import Arch
from rts2.model.checkpoint import build, load, save
from rts2.model.data.images import image_size
from rts2.model.errors import Rts2Error
from rts2.model.train import cli, run
from rts2.model.train.cli import train

COMMAND = [
    sys.executable,
    "-c",
    "import sys; from rts2.model.train.cli import train; sys.exit(train())",
]
TIMES = ("images_per_s", "wait_share", "seconds")


def options(data: Path, out: Path, steps: int = 4, *more: str) -> list[str]:
    """A small run; an option in `more` replaces one of the same name."""
    given = {
        "--dataset": "folder",
        "--data": str(data),
        "--out": str(out),
        "--steps": str(steps),
        "--arch": "c=1",
        "--crop": "64x32",
        "--batch": "4",
        "--precision": "fp32",
        "--threads": "1",
        "--workers": "0",
    }
    given |= dict(zip(more[::2], more[1::2], strict=True))
    return [part for pair in given.items() for part in pair]


def rows(out: Path) -> list[dict[str, str]]:
    with (out / "log.csv").open() as file:
        return list(csv.DictReader(file))


def untimed(out: Path) -> list[dict[str, str]]:
    return [{k: v for k, v in row.items() if k not in TIMES} for row in rows(out)]


def tensors(out: Path) -> dict[str, torch.Tensor]:
    return load_file(out / "state.safetensors")


def require_equal_runs(one: Path, other: Path) -> None:
    mine, its = tensors(one), tensors(other)
    assert mine.keys() == its.keys()
    for name, value in mine.items():
        assert torch.equal(value, its[name]), name
    assert untimed(one) == untimed(other)
    weights = [load_file(out / "checkpoint.safetensors") for out in (one, other)]
    assert all(torch.equal(value, weights[1][name]) for name, value in weights[0].items())


@pytest.fixture(scope="module")
def done(pairs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of six steps; nobody writes to it."""
    out = tmp_path_factory.mktemp("done")
    assert train(options(pairs, out, 6, "--k", "1.5", "--gain", "0.2")) == 0
    return out


def test_a_run_leaves_a_network_and_its_story(done: Path) -> None:
    network, header = load(done / "checkpoint.safetensors")
    assert header.arch == Arch(c=1)
    assert header.trained
    assert header.origin.startswith("trained on folder, 6 of 6 steps of 4, seed 0, loss ")
    assert all(p.isfinite().all() for p in network.parameters())
    record = json.loads((done / "record.json").read_text())
    assert record["recipe"]["augmentation"]["gain"] == 0.2
    assert (record["steps"], record["images"], record["samples"]) == (6, 24, 7)
    assert record["versions"]["torch"] == torch.__version__
    assert record["data"] is None
    assert sum(record["class_shares"]) == pytest.approx(1)
    assert [part["step"] for part in record["log"]] == [1, 2, 3, 4, 5, 6]
    log = rows(done)
    assert [row["step"] for row in log] == ["1", "2", "3", "4", "5", "6"]
    assert [row["epoch"] for row in log] == ["0", "0", "1", "1", "2", "2"]  # 7 samples, 4 a step
    assert record["log"][2]["loss"] == float(log[2]["loss"])
    assert image_size(done / "pictures" / "0000006.png") == (3 * 64, 2 * 32)
    assert list((done / "tensorboard").glob("events.*"))


def test_the_log_s_loss_is_the_weighted_sum_of_its_terms(done: Path) -> None:
    for row in rows(done):
        value = {name: float(text) for name, text in row.items()}
        loss = sum(
            weight
            * (value[f"disparity_{s}"] + 2 * value[f"semantic_{s}"] + 2 * value[f"refined_{s}"])
            for s, weight in ((1, 0.25), (2, 0.5), (3, 1))
        )
        assert value["loss"] == pytest.approx(loss, rel=1e-5)
        assert value["images_per_s"] * value["seconds"] == pytest.approx(4, rel=1e-5)
        assert 0 <= value["wait_share"] <= 1


def test_a_network_learns(pairs: Path, tmp_path: Path) -> None:
    assert train(options(pairs, tmp_path, 60, "--lr", "0.002")) == 0
    loss = [float(row["loss"]) for row in rows(tmp_path)]
    assert np.mean(loss[-10:]) < 0.5 * np.mean(loss[:5])


def test_json_is_one_object(
    pairs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train([*options(pairs, tmp_path, 2), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["schema"] == "rts2.train/1"
    assert (told["steps"], told["resumed_at"], told["precision"]) == (2, 0, "fp32")
    assert Path(told["checkpoint"]).is_file()
    assert told["recipe"]["steps"] == 2


def test_a_finished_run_stays_as_it_is(done: Path, pairs: Path, tmp_path: Path) -> None:
    again = shutil.copytree(done, tmp_path / "again")
    before = {path: path.stat().st_mtime_ns for path in again.rglob("*")}
    assert train(options(pairs, again, 6, "--k", "1.5", "--gain", "0.2")) == 0
    assert {path: path.stat().st_mtime_ns for path in again.rglob("*")} == before


def test_workers_and_cache_change_nothing(done: Path, pairs: Path, tmp_path: Path) -> None:
    for place in range(2):  # the second time from the cache
        out = tmp_path / str(place)
        more = ["--k", "1.5", "--gain", "0.2", "--workers", "2", "--cache", str(tmp_path / "cache")]
        assert train(options(pairs, out, 6, *more)) == 0
        require_equal_runs(out, done)


def start(arguments: Sequence[str], **environment: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*COMMAND, *arguments],
        env=os.environ | {"OMP_NUM_THREADS": "1"} | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def killed_at(arguments: Sequence[str], out: Path, lines: int, delay_s: float) -> None:
    """Starts a run and kills it once its log has `lines` lines, and a moment more."""
    process = start(arguments)
    log = out / "log.csv"
    while process.poll() is None and (not log.exists() or log.read_text().count("\n") < lines):
        time.sleep(0.002)
    time.sleep(delay_s)
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL


def test_a_run_killed_at_any_moment_resumes_bit_by_bit(pairs: Path, tmp_path: Path) -> None:
    more = ["--checkpoint-every", "3", "--workers", "1", "--k", "1.5", "--noise", "4"]
    steps, whole, broken = 36, tmp_path / "whole", tmp_path / "broken"
    assert train(options(pairs, whole, steps, *more)) == 0
    given = options(pairs, broken, steps, *more)
    chance = random.Random(7)
    for lines in (chance.randrange(0, 10), chance.randrange(14, 26)):
        killed_at(given, broken, lines, 0.1 * chance.random())
    assert len(rows(broken)) < steps
    assert train(given) == 0
    require_equal_runs(whole, broken)


def started_together(each: Sequence[Sequence[str]]) -> list[subprocess.Popen[str]]:
    """Starts a process for each of the arguments, as torchrun would."""
    processes = len(each)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    shared = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "WORLD_SIZE": str(processes)}
    shared["LOCAL_WORLD_SIZE"] = str(processes)
    return [
        start(arguments, RANK=str(rank), LOCAL_RANK=str(rank), **shared)
        for rank, arguments in enumerate(each)
    ]


def ended_together(running: Sequence[subprocess.Popen[str]]) -> list[tuple[int, str]]:
    """Exit codes and stderr."""
    told = [process.communicate(timeout=120)[1] for process in running]
    return [(process.returncode, text) for process, text in zip(running, told, strict=True)]


def test_two_processes_take_the_steps_of_one(pairs: Path, tmp_path: Path) -> None:
    """The same losses, and the same gradients, whose mean Adam keeps.

    It begins from weights that learned a little: random ones are so ill-conditioned that two
    orders of summation part within a few steps.
    """
    first, alone, both = (tmp_path / name for name in ("first", "alone", "both"))
    assert train(options(pairs, first, 40)) == 0
    more = ["--init", str(first / "checkpoint.safetensors"), "--lr", "2e-5", "--k", "1.5"]
    more += ["--coarse-gamma", "0.1"]
    assert train(options(pairs, alone, 5, *more)) == 0
    codes = ended_together(started_together([options(pairs, both, 5, *more)] * 2))
    assert [code for code, _ in codes] == [0, 0], codes
    for mine, its in zip(untimed(alone), untimed(both), strict=True):
        assert float(its["loss"]) == pytest.approx(float(mine["loss"]), rel=1e-5)
        for name in mine:
            assert float(its[name]) == pytest.approx(float(mine[name]), rel=1e-4), name
    wanted, found = tensors(alone), tensors(both)
    moments = [name for name in wanted if name.startswith("first.")]
    slopes = [torch.cat([t[name].flatten() for name in moments]) for t in (wanted, found)]
    assert (slopes[1] - slopes[0]).norm() < 1e-3 * slopes[0].norm()
    for name in wanted:
        if "running" in name:
            torch.testing.assert_close(found[name], wanted[name], rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("rank", [0, 1])
def test_a_wrong_number_of_processes_is_told_once(
    rank: int,
    pairs: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(cli, "TELLING_SECONDS", 0)
    for name, value in {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": 3}.items():
        monkeypatch.setenv(name, str(value))
    assert train(options(pairs, tmp_path / "out")) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == (1 if rank == 0 else 0)
    assert ("4 samples among 3; start one of 1, 2, 4 processes" in told) == (rank == 0)


def test_what_one_process_lacks_is_told_once_with_its_number(pairs: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    each = [options(data, out) for data in (pairs, tmp_path / "nowhere")]
    (first, told), other = ended_together(started_together(each))
    assert (first, *other) == (2, 2, "")
    assert told.count("\n") == 1
    assert re.search(r": process 1: .*nowhere", told), told
    assert not out.exists()


def test_a_process_that_lost_the_other_says_so(pairs: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    first, other = started_together([options(pairs, out, 10_000)] * 2)
    while not (out / "log.csv").exists() or (out / "log.csv").read_text().count("\n") < 3:
        time.sleep(0.01)
        assert first.poll() is None
    other.kill()
    (code, told), _ = ended_together([first, other])
    assert code == 1
    assert told.count("\n") == 1
    assert re.search(r"step \d+: process 0 lost the others .*; the checkpoint of step 0 is", told)


@pytest.mark.parametrize(("local", "told"), [(1, True), (2, False)])
def test_too_few_gpus_are_told_by_the_first_process_that_finds_none(
    local: int,
    told: bool,
    pairs: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(cli, "TELLING_SECONDS", 0)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    names = {"RANK": local, "LOCAL_RANK": local, "WORLD_SIZE": 4, "LOCAL_WORLD_SIZE": 4}
    for name, value in names.items():
        monkeypatch.setenv(name, str(value))
    assert train(options(pairs, tmp_path / "out")) == 2
    found = capsys.readouterr().err
    assert found.count("\n") == told
    assert told == (": process 1: every process needs a GPU of its own" in found)


@pytest.mark.parametrize("address", [{}, {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "1"}])
def test_processes_that_cannot_meet_are_told_so_in_one_line(
    address: dict[str, str], pairs: Path, tmp_path: Path
) -> None:
    """Torch's own stack, which it prints to the terminal, included."""
    script = (
        "import sys\n"
        "from rts2.model.train import cli\n"
        "whole, cli.TELLING_SECONDS = cli._trained, 0\n"
        "def impatient(*given):\n"
        "    from rts2.model.train import distributed\n"
        "    distributed.MEETING_SECONDS = 1\n"
        "    whole(*given)\n"
        "cli._trained = impatient\n"
        "sys.exit(cli.train())"
    )
    ended = subprocess.run(
        [sys.executable, "-c", script, *options(pairs, tmp_path / "out")],
        env=os.environ | {"RANK": "1", "WORLD_SIZE": "2"} | address,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 2
    assert ended.stderr.count("\n") == 1, ended.stderr
    assert re.search(r"process 1: the processes cannot meet: .* torchrun", ended.stderr)


MISTAKES: dict[str, tuple[list[str], int, str]] = {
    "no data set": (["--steps", "1"], 2, "give --preset or --dataset"),
    "no length": (["--dataset", "streets"], 2, "give --epochs or --steps"),
    "both lengths": (
        ["--preset", "streets", "--epochs", "1", "--steps", "1"],
        2,
        "either --epochs",
    ),
    "no folder": (["--preset", "kitti"], 2, "give --data DIR"),
    "missing folder": (["--preset", "kitti", "--data", "/nowhere"], 2, "no such folder"),
    "unknown preset": (["--preset", "mars"], 2, "invalid choice"),
    "arch without value": (["--preset", "kitti", "--arch", "c"], 2, "name=value, such as c=8"),
    "arch of nothing": (["--preset", "kitti", "--arch", "c=0"], 2, "arch: c: .*given: 0"),
    "arch as JSON": (["--preset", "kitti", "--arch", '{"c": "x"}'], 1, "--arch: c: "),
    "crop": (["--preset", "kitti", "--crop", "100x64"], 2, "multiples of 32, not 100x64"),
    "micro-batches": (["--preset", "kitti", "--accumulate", "4"], 2, "6 does not divide into 4"),
    "k": (["--preset", "kitti", "--k", "1"], 2, "k: .*greater than 1"),
    "init": (["--preset", "kitti", "--init", "nowhere.safetensors"], 2, "there is no such file"),
    "no network in the box": (["--preset", "kitti", "--init", "c99"], 2, "c99 is neither"),
    "count of a folder": (["--preset", "kitti", "--count", "9"], 2, "--count .*kitti2015 lies in"),
    "seed of a folder": (
        ["--preset", "kitti", "--data-seed", "9"],
        2,
        "--data-seed is for gen",
    ),
    "rectification of a folder": (
        ["--preset", "kitti", "--rectification-px", "1"],
        2,
        "--rectification-px is for generated scenes",
    ),
    "scenes that judge": (["--preset", "streets", "--split", "val"], 2, "streets of val judge"),
    "rectification": (["--preset", "streets", "--rectification-px", "9"], 2, "rectification_px: "),
    "count": (["--preset", "streets", "--count", "1000001"], 2, "from 1 to 1000000, not '1000001'"),
    "digits": (["--preset", "streets", "--batch", "9" * 5000], 2, "from 1 to 1000000"),
    "epochs": (["--preset", "streets", "--epochs", "1e7"], 2, "from 1e-6 to 1e6"),
    "threads": (["--preset", "streets", "--threads", "9999"], 2, "from 1 to 1024, not '9999'"),
    "workers": (["--preset", "streets", "--workers", "9999"], 2, "from 0 to 1024, not '9999'"),
    "precision": (["--preset", "streets", "--precision", "fp16", "--on", "cpu"], 2, "CUDA alone"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_are_one_line(
    mistake: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments, code, text = MISTAKES[mistake]
    assert train([*arguments, "--out", str(tmp_path / "out")]) == code
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert re.search(text, told), told
    assert not (tmp_path / "out").exists()


def spoil_labels(data: Path) -> None:
    Image.fromarray(np.full((48, 80), 19, np.uint8)).save(data / "semantic" / "01.png")


def spoil_truth(data: Path) -> None:
    Image.fromarray(np.zeros((48, 80), np.uint16)).save(data / "disparity" / "01.png")


def spoil_loss(data: Path) -> None:
    (data / "disparity" / "01.png").unlink()
    np.save(data / "disparity" / "01.npy", np.full((48, 80), 3e38, np.float32))


SPOILED: dict[str, tuple[Callable[[Path], None], list[str], str]] = {
    "labels outside the classes": (spoil_labels, [], r"01.* 19"),
    "a truth that is all invalid": (spoil_truth, [], r"known disparities: 01 has none"),
    "no truth": (lambda data: shutil.rmtree(data / "disparity"), [], r"disparities: 0\d has none"),
    "no labels": (lambda data: shutil.rmtree(data / "semantic"), [], r"--branches disparity"),
    "a loss that is not finite": (
        spoil_loss,
        [],
        r"step \d: the loss is inf, for the batch of .*01.*; the checkpoint of step \d is kept",
    ),
    "a crop that does not fit": (lambda data: None, ["--crop", "96x32"], r"96x32 does not fit"),
}


@pytest.mark.parametrize("what", SPOILED)
def test_what_cannot_be_learnt_from_stops_in_one_line(
    what: str, own_pairs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spoil, more, text = SPOILED[what]
    spoil(own_pairs)
    out = tmp_path / "out"
    given = options(own_pairs, out, 5, "--batch", "1", "--checkpoint-every", "1", *more)
    assert train(given) in (1, 2)
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert re.search(text, told), told
    if (out / "checkpoint.safetensors").exists():
        load(out / "checkpoint.safetensors")
        assert len(rows(out)) < 5


def test_another_run_in_the_same_folder_is_refused(
    done: Path, pairs: Path, own_pairs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (done / "state.safetensors").read_bytes()
    assert train(options(pairs, done, 6, "--k", "1.5", "--gain", "0.3", "--lr", "1e-3")) == 2
    told = capsys.readouterr().err
    assert "augmentation.gain is 0.2 there, 0.3 here; lr is 0.0005 there, 0.001 here" in told
    assert train(options(own_pairs, done, 6, "--k", "1.5", "--gain", "0.2")) == 2
    assert "7 samples there, 3 here" in capsys.readouterr().err
    assert (done / "state.safetensors").read_bytes() == before


def test_a_folder_with_a_foreign_checkpoint_is_refused(
    pairs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save(build(Arch(c=1)), tmp_path / "checkpoint.safetensors", "dear to somebody")
    assert train(options(pairs, tmp_path)) == 2
    told = capsys.readouterr().err
    assert "checkpoint.safetensors without its run (state.safetensors); choose another" in told
    assert load(tmp_path / "checkpoint.safetensors")[1].origin == "dear to somebody"


@pytest.mark.parametrize("name", ["log.csv", "record.json"])
def test_a_folder_with_a_foreign_file_is_refused(
    name: str, pairs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_text("dear to somebody")
    assert train(options(pairs, tmp_path)) == 2
    assert f"holds {name} without its run" in capsys.readouterr().err
    assert (tmp_path / name).read_text() == "dear to somebody"
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_place_that_cannot_be_written_is_told_before_classes_are_counted(
    pairs: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def counted(*_: object) -> None:
        raise AssertionError("counted")

    monkeypatch.setattr(run, "class_shares", counted)
    (tmp_path / "file").write_text("x")
    assert train(options(pairs, tmp_path / "file" / "out", 4, "--k", "1.5")) == 1
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "cannot write" in told
    with pytest.raises(AssertionError, match="counted"):
        train(options(pairs, tmp_path / "new" / "out", 4, "--k", "1.5"))
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_what_does_not_fit_in_memory_is_one_line(
    pairs: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def full(*_: object) -> None:
        raise MemoryError("9 TiB")

    monkeypatch.setattr(run.Trainer, "step", full)
    assert train(options(pairs, tmp_path / "step")) == 1
    assert "step 1 does not fit in memory; give a larger --accum" in capsys.readouterr().err
    monkeypatch.setattr("rts2.model.train.loader.crop", full)
    assert train(options(pairs, tmp_path / "crop")) == 1
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "does not fit in memory; give a smaller --crop (9 TiB)" in told


def test_the_checkpoint_named_is_the_one_on_the_disk(
    pairs: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Also where the steps between two checkpoints are not what they were."""

    def failing_in(step: int, every: str) -> str:
        taken = run.Trainer.step

        def fails(self: Any, micros: Any, rate: float, beside: Any) -> Any:
            if self.updates == step - 1:
                raise Rts2Error("it broke")
            return taken(self, micros, rate, beside)

        with monkeypatch.context() as patch:
            patch.setattr(run.Trainer, "step", fails)
            assert train(options(pairs, tmp_path, 20, "--checkpoint-every", every)) == 1
        told = capsys.readouterr().err
        origin = load(tmp_path / "checkpoint.safetensors")[1].origin
        assert f"step {step}: it broke; the checkpoint of step " in told
        kept = re.findall(r"step (\d+) is kept", told)[0]
        assert kept == "0" or f" {kept} of 20 steps" in origin
        return kept

    assert failing_in(3, "4") == "0"
    assert failing_in(6, "4") == "4"
    assert failing_in(7, "5") == "5"
    assert failing_in(9, "8") == "8"
    assert failing_in(12, "10") == "10"
    assert failing_in(13, "100") == "10"


def test_a_run_goes_on_with_its_own_generator_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    given = ["--dataset", "streets", "--count", "2", "--batch", "1", "--k", "0", "--steps"]
    more = ["--crop", "64x32", "--arch", "c=1", "--workers", "0", "--threads", "1"]
    more += ["--out", str(tmp_path)]
    assert train([*given, "1", *more]) == 0
    record = json.loads((tmp_path / "record.json").read_text())
    assert record["data"].startswith("streets v")
    assert record["versions"].keys() >= {"opencv-python-headless", "numba"}
    monkeypatch.setattr("rts2.model.data.streets.VERSION", 999)
    capsys.readouterr()
    assert train([*given, "1", *more]) == 2
    assert "another generator made them" in capsys.readouterr().err


def interrupting(work: Callable[..., None], calls: int) -> Callable[..., None]:
    """`work`, until it was called so often; then it is interrupted."""
    left = iter(range(calls))

    def interrupted(*arguments: Any) -> None:
        if next(left, None) is None:
            raise KeyboardInterrupt
        work(*arguments)

    return interrupted


FIRST_WRITES = [("save_state", 0), ("Log", 0), ("Monitor", 0), ("save", 0), ("write_json", 0)]
"""In their order; last comes the state's second."""


@pytest.mark.parametrize(("write", "calls"), [*FIRST_WRITES, ("save_state", 1)])
def test_a_run_interrupted_at_its_first_writes_goes_on(
    write: str,
    calls: int,
    done: Path,
    pairs: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out = tmp_path / "out"
    given = options(pairs, out, 6, "--k", "1.5", "--gain", "0.2")
    with monkeypatch.context() as patch:
        patch.setattr(run, write, interrupting(getattr(run, write), calls))
        assert train(given) == 130
    assert train(given) == 0
    require_equal_runs(out, done)


def test_a_full_disk_leaves_the_last_checkpoint(
    pairs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    given = options(pairs, out, 9, "--checkpoint-every", "3")
    with monkeypatch.context() as patch:
        patch.setattr(run, "save_state", interrupting(run.save_state, calls=3))
        assert train(given) == 130
    before = (out / "state.safetensors").read_bytes()

    def small_files() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))

    found = subprocess.run(
        [*COMMAND, *given], preexec_fn=small_files, capture_output=True, text=True, check=False
    )
    assert found.returncode == 1
    begun, told = found.stderr.splitlines()
    assert begun == "going on from step 3 of 9"
    assert "cannot write" in told
    assert (out / "state.safetensors").read_bytes() == before
    load(out / "checkpoint.safetensors")
    assert train(given) == 0
    assert [row["step"] for row in rows(out)] == [str(step) for step in range(1, 10)]


def test_init_gives_weights_and_arch(pairs: Path, tmp_path: Path) -> None:
    torch.manual_seed(5)
    first = build(Arch(c=2, stages=2))
    path = tmp_path / "first.safetensors"
    save(first, path, "a test")
    given = options(pairs, tmp_path / "out", 1, "--init", str(path), "--lr", "1e-6")
    without = given.index("--arch")
    assert train(given[:without] + given[without + 2 :]) == 0
    network, header = load(tmp_path / "out" / "checkpoint.safetensors")
    assert header.arch == Arch(c=2, stages=2)
    for mine, its in zip(network.parameters(), first.parameters(), strict=True):
        assert (mine - its).abs().max() < 2e-6


def test_init_may_lack_branches(
    pairs: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    first = build(Arch(c=1, semantic=False))
    path = tmp_path / "first.safetensors"
    save(first, path, "a test")
    more = ["--init", str(path), "--lr", "1e-6", "--branches", "full"]
    assert train(options(pairs, tmp_path / "out", 1, *more)) == 0
    assert "the others start from random values" in caplog.text
    network, header = load(tmp_path / "out" / "checkpoint.safetensors")
    assert header.arch == Arch(c=1)
    stem = network.encoder.stem[0][0].weight
    assert (stem - first.encoder.stem[0][0].weight).abs().max() < 2e-6


def test_init_of_another_width_is_refused(
    pairs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "first.safetensors"
    save(build(Arch(c=2)), path, "a test")
    assert train(options(pairs, tmp_path / "out", 1, "--init", str(path))) == 2
    assert "does not fit the arch: c is 2, 1 was asked for" in capsys.readouterr().err


VARIANTS: dict[str, list[str]] = {
    "anynet": ["--arch", "family=anynet,c=1"],
    "disparity": ["--arch", "c=1,stages=2", "--branches", "disparity"],
    "disparity+semantic": ["--arch", '{"c": 1, "refinement": false}'],
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_variants_train_by_the_terms_they_have(variant: str, pairs: Path, tmp_path: Path) -> None:
    assert train(options(pairs, tmp_path, 2, *VARIANTS[variant])) == 0
    arch = load(tmp_path / "checkpoint.safetensors")[1].arch
    names = rows(tmp_path)[0].keys()
    assert ("semantic_1" in names) == arch.semantic == (variant == "disparity+semantic")
    assert "refined_1" not in names
    assert f"disparity_{arch.stages}" in names


def test_a_preset_is_a_start_that_options_change(tmp_path: Path) -> None:
    root = tmp_path / "kitti" / "training"
    for name in ("image_2", "image_3", "disp_occ_0", "semantic"):
        (root / name).mkdir(parents=True)
    noise = np.random.default_rng(0).integers(0, 256, (2, 64, 96, 3), dtype=np.uint8)
    Image.fromarray(noise[0]).save(root / "image_2" / "000000_10.png")
    Image.fromarray(noise[1]).save(root / "image_3" / "000000_10.png")
    Image.fromarray(np.full((64, 96), 2560, np.uint16)).save(root / "disp_occ_0" / "000000_10.png")
    Image.fromarray(np.full((64, 96), 7, np.uint8)).save(root / "semantic" / "000000_10.png")
    given = ["--preset", "kitti", "--data", str(tmp_path / "kitti"), "--split", "all"]
    given += ["--steps", "1", "--batch", "2", "--crop", "64x32", "--arch", "c=1,conv3d=2/1/1"]
    out = tmp_path / "out"
    assert train([*given, "--out", str(out), "--workers", "0", "--threads", "1"]) == 0
    recipe: dict[str, Any] = json.loads((out / "record.json").read_text())["recipe"]
    assert (recipe["schedule"], recipe["k"], recipe["epochs"]) == ("halved", 2.0, None)
    assert (recipe["steps"], recipe["batch"], recipe["crop"]) == (1, 2, [32, 64])
    assert recipe["arch"]["conv3d"] == [2, 1, 1]


def test_a_supernet_is_trained_and_gives_the_weights_of_smaller_networks(
    pairs: Path, tmp_path: Path
) -> None:
    whole = ["--arch", "c=3,d_max=8,conv3d=4/2/2"]
    train(options(pairs, tmp_path / "whole", 2, *whole, "--supernet", "1"))
    network, header = load(tmp_path / "whole" / "checkpoint.safetensors")
    assert header.supernet
    assert network.arch == Arch(c=3, d_max=8, conv3d=(4, 2, 2))
    start = str(tmp_path / "whole" / "checkpoint.safetensors")
    small = ["--arch", "c=2,d_max=6,conv3d=3/2/1", "--init", start]
    train(options(pairs, tmp_path / "small", 1, *small, "--lr", "1e-6"))
    part = load(tmp_path / "small" / "checkpoint.safetensors")[0]
    stem, whole_stem = (net.encoder.stem[0][0].weight for net in (part, network))
    torch.testing.assert_close(stem, whole_stem[:2], rtol=0, atol=1e-5)
