"""What a person sees: the picture's parts, the lines, the curves."""

from pathlib import Path

import numpy as np
import pytest
import torch

from rts2.model.losses import Truth
from rts2.model.pictures import PALETTE
from rts2.model.rts2net import Stage
from rts2.model.train import monitor
from rts2.model.train.loader import Batch
from rts2.model.train.monitor import Monitor, panel

H, W = 32, 64


def batch(labels: bool = True) -> Batch:
    left = torch.full((2, H, W, 3), 10, dtype=torch.uint8)
    truth = torch.full((2, H, W), 8.0)
    truth[:, :16] = torch.nan
    seen = torch.zeros(2, H, W, dtype=torch.uint8) if labels else None
    return Batch(["a", "b"], left, left + 10, Truth(truth, seen))


def stage(scores: bool = True) -> Stage:
    classes = torch.zeros(2, 19, H // 4, W // 4)
    classes[:, 13] = 1
    disparity = torch.full((2, 1, H // 4, W // 4), 8.0)
    return Stage(disparity, None, classes if scores else None)


def test_a_picture_shows_both_rows() -> None:
    image = panel(batch(), stage())
    assert image.shape == (2 * H, 3 * W, 3)
    assert (image[:H, :W] == 10).all()
    assert (image[H:, :W] == 20).all()
    assert (image[:16, W : 2 * W] == 0).all()  # an unknown truth is black
    np.testing.assert_array_equal(image[H - 1, W], image[2 * H - 1, W])  # equal disparities
    assert (image[:H, 2 * W :] == PALETTE[0]).all()
    assert (image[H:, 2 * W :] == PALETTE[13]).all()


def test_a_picture_without_semantics_has_two_columns() -> None:
    assert panel(batch(), stage(scores=False)).shape == (2 * H, 2 * W, 3)
    assert (panel(batch(labels=False), stage())[:H, 2 * W :] == 0).all()


def row(step: int) -> dict[str, float]:
    return {"step": step, "epoch": 0, "loss": 4.0, "images_per_s": 12.0, "wait_share": 0.25}


def test_where_there_is_no_terminal_lines_tell(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter(range(0, 1000, 20))
    monkeypatch.setattr(monitor, "monotonic", lambda: next(clock))
    watched = Monitor(tmp_path, steps=10, done=2)
    for step in range(3, 7):
        watched.step(row(step))
    watched.close()
    lines = capsys.readouterr().err.splitlines()
    # A step every 20 s, a line every 30 s: after 40 s and 80 s; 4 steps took 80 s, 4 are left.
    assert lines == [
        "going on from step 2 of 10",
        "step 4 of 10 · epoch 0 · loss 4.000 · 12.0 images/s, 25% waiting · 0:02:00 left",
        "step 6 of 10 · epoch 0 · loss 4.000 · 12.0 images/s, 25% waiting · 0:01:20 left",
    ]


def test_pictures_and_curves_are_files(tmp_path: Path) -> None:
    watched = Monitor(tmp_path, steps=20, done=0)
    (tmp_path / "pictures").mkdir()
    watched.step(row(10))
    watched.picture(10, batch(), [stage()])
    watched.close()
    assert (tmp_path / "pictures" / "0000010.png").is_file()
    events = b"".join(path.read_bytes() for path in (tmp_path / "tensorboard").iterdir())
    assert b"images_per_s" in events
    assert b"sample" in events
