"""KITTI 2015 and 2012 on disk: which files make a frame, and what they hold."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Final, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from ..errors import UsageError
from ..files import parse_json
from .frame import Coding, Frame, Instances
from .images import Bytes, read_disparity, read_whole
from .labels import train_ids
from .layout import chosen, column, entries, require_folder, require_folders, rows

FRAME: Final = "*_10.png"
"""The reference frames; the `_11` frames beside them serve scene flow and flow alone."""

NUMBERED: Final = 256
"""An instance map holds label id · 256 + number; number 0 is no object of its own."""

TRAINING, TESTING = "training", "testing"


@dataclass(frozen=True)
class Layout:
    """The folders of one release, by the field of `Frame` that they fill."""

    title: str
    images: tuple[dict[str, str], ...]
    """Left and right; the first of these that is there."""
    truth: dict[str, str]
    """Needed in `training`."""
    optional: dict[str, str]
    """Taken where they are there."""


KITTI_2015: Final = Layout(
    "KITTI 2015",
    ({"left": "image_2", "right": "image_3"},),
    {"truth": "disp_occ_0"},
    {
        "visible": "disp_noc_0",
        "semantic": "semantic",
        "instance": "instance",
        "objects": "obj_map",
    },
)

KITTI_2012: Final = Layout(
    "KITTI 2012",
    ({"left": "colored_0", "right": "colored_1"}, {"left": "image_0", "right": "image_1"}),
    {"truth": "disp_occ"},
    {"visible": "disp_noc"},
)


class Split(BaseModel):
    """A written split: which frames train and which judge."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_: Literal["rts2.split/1"] = Field(alias="schema")
    dataset: str
    seed: int
    drawn: str
    """The expression that drew the frames."""
    train: tuple[str, ...]
    val: tuple[str, ...]


def open_2015(folder: Path, split: str = "all") -> tuple[Frame, ...]:
    """The frames of KITTI 2015, by name.

    `folder` is the one that holds `training` and `testing`, or one of these itself. `split` is
    `all` of training, `train` or `val` of the written split, or `test`, which has no truth.

    Raises:
        UsageError: there is no such folder, it does not hold the layout, or a frame of the split.
        Rts2Error: some frames lack a file in one of the folders.
    """
    if split == "test":
        return _frames(_testing(folder, KITTI_2015), KITTI_2015, with_truth=False)
    frames = _frames(_training(folder, KITTI_2015), KITTI_2015, with_truth=True)
    if split == "all":
        return frames
    names = {"train": paper_split().train, "val": paper_split().val}[split]
    return chosen(frames, names, f"the split {split} (all takes every frame there is)", folder)


def open_2012(folder: Path, split: str = "all") -> tuple[Frame, ...]:
    """The frames of KITTI 2012, by name: `all` of training, or `test`. As `open_2015`."""
    if split == "test":
        return _frames(_testing(folder, KITTI_2012), KITTI_2012, with_truth=False)
    return _frames(_training(folder, KITTI_2012), KITTI_2012, with_truth=True)


def paper_split() -> Split:
    """160 frames to train and 40 to judge, as many as in the paper, whose own are not known."""
    file = resources.files(__package__) / "splits" / "kitti2015.json"
    return parse_json(file.read_text("utf-8"), Split, "the split of KITTI 2015")


def read_labels(path: Path) -> Bytes:
    """A file of label ids as train ids."""
    return train_ids(read_whole(path))


def own_objects(values: Instances) -> Instances:
    """KITTI's instance codes; 0 where the number is 0, as for a crowd far away.

    The code stays whole, because numbers start anew with every class.
    """
    return np.where(values % NUMBERED != 0, values, 0).astype(np.int32)


CODING: Final = Coding("kitti", read_disparity, read_labels, own_objects)


def _frames(root: Path, layout: Layout, *, with_truth: bool) -> tuple[Frame, ...]:
    """Every frame of one folder of the release."""
    folders = _images(root, layout)
    if with_truth:
        folders = folders | layout.truth
        folders |= {f: name for f, name in layout.optional.items() if (root / name).is_dir()}
    columns = {field: column(root / name, FRAME) for field, name in folders.items()}
    return tuple(
        Frame(name=f"{name}_10", coding=CODING, **files)
        for name, files in rows(columns, layout.title)
    )


def _images(root: Path, layout: Layout) -> dict[str, str]:
    """The folders of the images: the first choice that is there."""
    for choice in layout.images:
        if all((root / name).is_dir() for name in choice.values()):
            return choice
    return layout.images[0]


def _training(folder: Path, layout: Layout) -> Path:
    """The folder in which the frames with truth begin."""
    require_folder(folder, layout.title, TRAINING)
    root = folder / TRAINING if (folder / TRAINING).is_dir() else folder
    require_folders(root, [*_images(root, layout).values(), *layout.truth.values()], layout.title)
    return root


def _testing(folder: Path, layout: Layout) -> Path:
    """The folder in which the frames without truth begin."""
    require_folder(folder, layout.title, TESTING)
    root = folder / TESTING if (folder / TESTING).is_dir() else folder
    if root is folder and _holds_training(folder, layout):
        raise UsageError(
            f"{layout.title} needs the folder {TESTING} for its test frames: "
            f"it is not in {folder}; found {entries(folder)}"
        )
    require_folders(root, [*_images(root, layout).values()], layout.title)
    return root


def _holds_training(folder: Path, layout: Layout) -> bool:
    return any((folder / name).is_dir() for name in (TRAINING, *layout.truth.values()))
