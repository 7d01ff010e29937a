"""KITTI 2015 on disk: which files make a sample, and what they hold."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import Rts2Error, UsageError
from ..metrics import IGNORED
from .images import Bytes, image_size, read_disparity, read_rgb, read_whole
from .scene import Foreground, Scene

FRAME = "*_10.png"
"""The reference frames; the `_11` frames beside them serve scene flow alone."""

REQUIRED = {"left": "image_2", "right": "image_3", "occluded": "disp_occ_0"}
OPTIONAL = {
    "visible": "disp_noc_0",
    "semantic": "semantic",
    "instance": "instance",
    "objects": "obj_map",
}
"""The folders of the official layout, by the field of `Sample` they fill."""

LABEL_IDS = (7, 8, 11, 12, 13, 17, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 31, 32, 33)
"""The label ids of train ids 0 … 18; KITTI shares them with Cityscapes."""

NUMBERED = 256
"""An instance map holds label id · 256 + number; number 0 is no object of its own."""


@dataclass(frozen=True)
class Sample:
    """The files of one frame; what the data set does not have is None."""

    name: str
    left: Path
    right: Path
    occluded: Path
    """Disparity of all pixels, also of those hidden in the right image."""
    visible: Path | None = None
    """Disparity of the pixels that both images see."""
    semantic: Path | None = None
    instance: Path | None = None
    objects: Path | None = None

    @property
    def foreground(self) -> Foreground | None:
        """What tells foreground from background: the official object map, else the instances."""
        if self.objects is not None:
            return "obj_map"
        return None if self.instance is None else "instance"

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the left image."""
        return image_size(self.left)

    def read(self) -> Scene:
        """The images; the truth is that of all pixels, as the server scores it."""
        return Scene(
            name=self.name,
            left=read_rgb(self.left),
            right=read_rgb(self.right),
            truth=read_disparity(self.occluded),
            foreground=self._foreground_mask(),
            semantic=None if self.semantic is None else train_ids(read_whole(self.semantic)),
        )

    def _foreground_mask(self) -> NDArray[np.bool_] | None:
        if self.objects is not None:
            return np.asarray(read_whole(self.objects) != 0)
        if self.instance is not None:
            return np.asarray(read_whole(self.instance) % NUMBERED != 0)
        return None


def samples(folder: Path) -> tuple[Sample, ...]:
    """The frames of KITTI 2015, by name.

    `folder` is the one that holds `training`, or that one itself.

    Raises:
        UsageError: there is no such folder, or it does not hold the layout.
        Rts2Error: some frames lack a file in one of the folders.
    """
    root = _training(folder)
    named = {field: _frames(root / name) for field, name in REQUIRED.items()}
    named |= {f: _frames(root / name) for f, name in OPTIONAL.items() if (root / name).is_dir()}
    names = sorted(set().union(*named.values()))
    if not names:
        raise UsageError(f"KITTI 2015 needs images {FRAME} in {root / 'image_2'}; none is there")
    _require_complete(root, named, names)
    return tuple(
        Sample(name=name, **{field: files[name] for field, files in named.items()})
        for name in names
    )


def train_ids(label_ids: NDArray[np.int32]) -> Bytes:
    """Label ids as train ids 0 … 18; every other label becomes `IGNORED`."""
    if label_ids.min(initial=0) < 0 or label_ids.max(initial=0) > 255:
        raise Rts2Error(f"label ids must be 0 to 255, found {label_ids.max()}")
    table = np.full(256, IGNORED, np.uint8)
    table[list(LABEL_IDS)] = np.arange(len(LABEL_IDS))
    return table[label_ids]


def _training(folder: Path) -> Path:
    """The folder in which the layout begins."""
    if not folder.is_dir():
        found = "it is a file" if folder.exists() else "there is no such folder"
        raise UsageError(f"KITTI 2015 must be a folder that holds training: {folder}: {found}")
    root = folder / "training" if (folder / "training").is_dir() else folder
    missing = [name for name in REQUIRED.values() if not (root / name).is_dir()]
    if missing:
        found = ", ".join(sorted(path.name for path in root.iterdir())[:8]) or "nothing"
        raise UsageError(
            f"KITTI 2015 needs the folders {', '.join(REQUIRED.values())} in {root}: "
            f"{', '.join(missing)} not there; found {found}"
        )
    return root


def _frames(folder: Path) -> dict[str, Path]:
    return {path.stem: path for path in folder.glob(FRAME)}


def _require_complete(root: Path, named: dict[str, dict[str, Path]], names: list[str]) -> None:
    """Every folder must hold every frame; the first that does not is named with both counts."""
    for field, files in named.items():
        lacking = [name for name in names if name not in files]
        if lacking:
            place = root / (REQUIRED | OPTIONAL)[field]
            raise Rts2Error(
                f"every frame needs its file in every folder: {place} has {len(files)} "
                f"of {len(names)} files {FRAME}, first missing {lacking[0]}.png"
            )
