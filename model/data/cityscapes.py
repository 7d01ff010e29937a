"""Cityscapes on disk: stereo pairs, SGM disparity, fine or coarse labels."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from ..errors import UsageError
from .frame import Coding, Frame, Instances
from .images import Disparity, read_steps
from .kitti import read_labels
from .layout import Column, column, entries, require_folder, require_folders, rows

STEPS: Final = 256
NUMBERED: Final = 1000
"""An instance map holds label id · 1000 + number from 0 on; smaller values are label ids."""

LEFT, RIGHT, DISPARITY = "leftImg8bit", "rightImg8bit", "disparity"
FINE, COARSE = "gtFine", "gtCoarse"

LABELLED: Final = {FINE: ("train", "val"), COARSE: ("train", "train_extra", "val")}
"""The splits that each kind of labels covers."""


def open_fine(folder: Path, split: str) -> tuple[Frame, ...]:
    """The frames of one split with gtFine: `train`, `val`, `all` of both, or `test`.

    `test` has no labels, and no truth unless its disparity is there.

    Raises:
        UsageError: there is no such folder, or it does not hold the layout.
        Rts2Error: some frames lack a file in one of the folders.
    """
    return _open(folder, split, FINE)


def open_coarse(folder: Path, split: str) -> tuple[Frame, ...]:
    """The frames of one split with gtCoarse: `train_extra`, `train`, `val`, or `all`."""
    return _open(folder, split, COARSE)


def read_sgm(path: Path) -> Disparity:
    """The disparity by semi-global matching: (p − 1) / 256 pixels, NaN where p is 0."""
    steps = read_steps(path)
    disparity = np.where(steps > 0, (steps - 1) / STEPS, np.nan)
    return disparity.astype(np.float32)


def own_objects(values: Instances) -> Instances:
    """Cityscapes' instance codes; 0 where there is only a label id, as for a crowd."""
    return np.where(values >= NUMBERED, values, 0).astype(np.int32)


CODING: Final = Coding("cityscapes", read_sgm, read_labels, own_objects)


def _open(folder: Path, split: str, labels: str) -> tuple[Frame, ...]:
    require_folder(folder, "Cityscapes", f"{LEFT}/")
    if split != "all":
        return _frames(folder, split, labels)
    there = [each for each in LABELLED[labels] if (folder / LEFT / each).is_dir()]
    if not there:
        wanted = ", ".join(f"{LEFT}/{each}" for each in LABELLED[labels])
        raise UsageError(f"Cityscapes needs {wanted} in {folder}; found {entries(folder)}")
    return tuple(frame for each in there for frame in _frames(folder, each, labels))


def _frames(folder: Path, split: str, labels: str) -> tuple[Frame, ...]:
    """The frames of one split, which lie by city."""
    truth = {} if split == "test" else {"truth": DISPARITY, "semantic": labels}
    kinds = {"left": LEFT, "right": RIGHT, **truth}
    require_folders(folder, [f"{kind}/{split}" for kind in kinds.values()], "Cityscapes")
    columns = {field: _column(folder, split, kind) for field, kind in kinds.items()}
    columns |= _optional(folder, split, labels)
    return tuple(
        Frame(name=name, coding=CODING, **files) for name, files in rows(columns, "Cityscapes")
    )


def _optional(folder: Path, split: str, labels: str) -> dict[str, Column]:
    """What counts where there is any of it: the disparity of test, the instances of the rest."""
    if split == "test":
        found = {"truth": _column(folder, split, DISPARITY)}
    else:
        found = {"instance": column(folder / labels / split, f"*/*_{labels}_instanceIds.png")}
    return {field: each for field, each in found.items() if each.files}


def _column(folder: Path, split: str, kind: str) -> Column:
    tail = f"{kind}_labelIds" if kind in LABELLED else kind
    return column(folder / kind / split, f"*/*_{tail}.png")
