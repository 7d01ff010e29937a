"""The log: every step once, whatever was killed when."""

from pathlib import Path

import pytest

from rts2.model.errors import Rts2Error
from rts2.model.train.log import Log, read_log

TERMS = ("disparity_1", "refined_1")
HEADER = "step,epoch,lr,loss,disparity_1,refined_1,images_per_s,wait_share,seconds\n"


def row(step: int) -> dict[str, float]:
    return {"step": step, "epoch": step // 3, "lr": 5e-4, "loss": 1 / step} | {
        "disparity_1": 0.1 * step,
        "refined_1": 2.0,
        "images_per_s": 10.0,
        "wait_share": 0.5,
        "seconds": 0.6,
    }


def write(path: Path, steps: range, done: int) -> None:
    log = Log(path, TERMS, done)
    for step in steps:
        log.write(row(step))
    log.sync()
    log.close()


def test_a_line_per_step_in_named_columns(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    write(path, range(1, 4), 0)
    lines = path.read_text().splitlines(keepends=True)
    assert lines[0] == HEADER
    assert lines[3] == "3,1,0.0005,0.333333333,0.3,2,10,0.5,0.6\n"
    assert read_log(path)[1]["loss"] == 0.5


@pytest.mark.parametrize("tail", ["", "6,2,0.00", "6", "junk\n"])
def test_what_came_after_the_checkpoint_is_cut(tmp_path: Path, tail: str) -> None:
    path = tmp_path / "log.csv"
    write(path, range(1, 6), 0)
    path.write_text(path.read_text() + tail)
    write(path, range(4, 7), 3)
    whole = tmp_path / "whole.csv"
    write(whole, range(1, 7), 0)
    assert path.read_text() == whole.read_text()


def test_a_run_without_checkpoint_starts_its_log_anew(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    write(path, range(1, 6), 0)
    write(path, range(1, 2), 0)
    assert [line["step"] for line in read_log(path)] == [1]


def test_a_log_that_lacks_a_step_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    write(path, range(1, 4), 0)
    with pytest.raises(Rts2Error, match=r"each of the 5 steps.* that of step 4 is not there"):
        Log(path, TERMS, 5)
    path.write_text(path.read_text().replace("2,0,", "7,0,"))
    with pytest.raises(Rts2Error, match="that of step 2 is not there"):
        Log(path, TERMS, 3)
    path.unlink()
    with pytest.raises(Rts2Error, match="that of step 1 is not there"):
        Log(path, TERMS, 3)
