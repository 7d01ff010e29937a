"""rts2-search judged by a supernet: what it writes, tells and refuses."""

import json
from pathlib import Path

import pytest
import torch

from rts2.model.arch import Arch
from rts2.model.checkpoint import build, load, save
from rts2.search.cli import deploy, search
from rts2.search.supernet import supernet, trained_s

WHOLE = Arch(c=2, d_max=6, conv3d=(4, 2, 2))
CPU = ("--device", "cpu", "--target-fps", "1")
STREETS = ("--data", "streets", "--data-size", "96x64")


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(1)
    path = tmp_path_factory.mktemp("supernet") / "supernet.safetensors"
    save(build(WHOLE), path, "a test", supernet=True)
    (path.parent / "record.json").write_text(json.dumps({"seconds": 90.5, "other": 1}))
    return path


@pytest.fixture(autouse=True)
def _threads() -> object:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def test_the_pick_its_weights_and_the_cost(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    arguments = [*CPU, *STREETS, "--accuracy", str(weights), "--budget", "3", "--out", str(out)]
    assert search([*arguments, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told == json.loads((out / "front.json").read_text())
    cost = told["cost"]
    assert (cost["evaluations"], cost["fresh"], cost["failed"], cost["workers"]) == (2, 2, 0, 1)
    assert (cost["candidates"], cost["training_s"]) == (2, 90.5)
    assert cost["wall_s"] > cost["evaluation_s"] > 0
    assert {point["evidence"]["accuracy"] for point in told["front"]} <= {
        "measured",
        "interpolated",
    }
    network, header = load(out / "pick.safetensors")
    assert network.arch == Arch.model_validate(told["selected"]["arch"])
    assert not header.supernet
    assert header.origin.startswith("cut out of a supernet (a test), norms calibrated on streets")
    assert search(arguments) == 0
    again = capsys.readouterr().out
    assert "candidates, 2 chains judged, in " in again
    assert "2 of 2 chains judged (0 in this run" in again
    assert "the supernet trained 90 s" in again
    front = ("--front", str(out / "front.json"), "--model", str(out / "pick.safetensors"))
    assert deploy([*front, "--device", "cpu", "--out", str(tmp_path / "bundle")]) == 0


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--budget", "3"], "--budget is for --accuracy SUPERNET"),
        (["--accuracy", "nope.safetensors", *STREETS], "nope.safetensors: there is no such file"),
        (["--verify"], "--verify is for --accuracy SUPERNET"),
        (["--accuracy", "SUPERNET"], "is judged on your data; give --data DIR"),
        (["--accuracy", "SUPERNET", *STREETS, "--budget", "0"], "from 1 to 1000000, not '0'"),
        (["--accuracy", "SUPERNET", *STREETS, "--storage", "x"], "must be a database's URL"),
        (["--accuracy", "SUPERNET", "--data", "/no/such"], "/no/such"),
        (["--accuracy", "SUPERNET", *STREETS, "--device", "tx2", "--verify"], "not this machine"),
        (["--accuracy", "SUPERNET", "--data", "/", "--dataset", "x"], "--dataset must be one of"),
    ],
)
def test_what_is_refused_in_one_line(
    weights: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    told: str,
) -> None:
    given = [str(weights) if each == "SUPERNET" else each for each in arguments]
    assert search([*CPU, *given, "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert told in error
    assert error.count("\n") == 1


def test_nothing_of_an_earlier_question_stays(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ("--out", str(tmp_path))
    measured = ("--accuracy", str(weights), *STREETS, "--budget", "1")
    assert search([*CPU, *measured, *out]) == 0
    assert (tmp_path / "pick.safetensors").is_file()
    assert search([*CPU, *out]) == 0
    assert not (tmp_path / "pick.safetensors").exists()
    assert search([*CPU, *measured, "--max-size-mb", "0.0001", *out]) == 3
    told = capsys.readouterr().err
    assert "within --max-size-mb, and none was judged; lower the target or ask for less" in told
    assert not {path.name for path in tmp_path.iterdir()} - {"judged", "study.db"}


def test_one_network_is_no_supernet(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "one.safetensors"
    save(build(WHOLE), path, "a test")
    given = ["--accuracy", str(path), *STREETS, "--out", str(tmp_path)]
    assert search([*CPU, *given]) == 2
    assert "holds one network, not a supernet" in capsys.readouterr().err


def test_weights_are_told_from_tables_by_content(weights: Path, tmp_path: Path) -> None:
    assert supernet(str(weights)) == weights
    table = tmp_path / "table.safetensors"
    table.write_text('{"schema":"rts2.accuracy/1"}')
    assert supernet(str(table)) is None
    assert supernet("published") is None
    assert trained_s(weights) == 90.5
    assert trained_s(tmp_path / "elsewhere.safetensors") is None
