"""SceneFlow on disk: FlyingThings3D, Driving and Monkaa, each as released or all in one folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

from ..errors import UsageError
from .frame import Coding, Frame
from .kitti import own_objects, read_labels
from .layout import Column, entries, require_folder, require_folders, rows
from .pfm import read_pfm_disparity

TITLE: Final = "SceneFlow"
PARTS: Final = ("FlyingThings3D", "Driving", "Monkaa")
CLEAN, FINAL, DISPARITY = "frames_cleanpass", "frames_finalpass", "disparity"

CODING: Final = Coding("sceneflow", read_pfm_disparity, read_labels, own_objects)
"""There are no semantics; the coding of labels is never asked."""


def open_clean(folder: Path, split: str) -> tuple[Frame, ...]:
    """The frames of the clean pass: `train`, `test` (of FlyingThings3D alone), or `all`.

    `folder` holds one or more of FlyingThings3D, Driving, Monkaa, in any case of letters, or is
    itself such a part, with frames_cleanpass and disparity in it. Frames that lie in no scene's
    folder, as in samples of the data set, are in every split.

    Raises:
        UsageError: there is no such folder, it does not hold the layout, or none of the split.
        Rts2Error: some frames lack a file in one of the folders.
    """
    return _open(folder, split, CLEAN)


def open_final(folder: Path, split: str) -> tuple[Frame, ...]:
    """The frames of the final pass, with motion blur and haze; else as `open_clean`."""
    return _open(folder, split, FINAL)


def _open(folder: Path, split: str, images: str) -> tuple[Frame, ...]:
    require_folder(folder, TITLE, ", ".join(PARTS))
    found = [frame for part in _parts(folder, images) for frame in _frames(part, images, split)]
    if not found:
        place = {"test": "TEST/", "train": "TRAIN/, Driving or Monkaa"}.get(split, "left/")
        raise UsageError(f"{TITLE} has no frames of {split} in {folder}: no {place} in {images}")
    return tuple(found)


def _parts(folder: Path, images: str) -> list[Path]:
    """The folders that hold images and disparity."""
    if (folder / images).is_dir():
        parts = [folder]
    else:
        wanted = {name.lower() for name in PARTS}
        parts = [path for path in sorted(folder.iterdir()) if path.name.lower() in wanted]
    if not parts:
        raise UsageError(
            f"{TITLE} needs {', '.join(PARTS)}, or {images} and {DISPARITY}, in {folder}; "
            f"found {entries(folder)}"
        )
    for part in parts:
        require_folders(part, [images, DISPARITY], TITLE)
    return parts


def _frames(part: Path, images: str, split: str) -> Iterator[Frame]:
    """The frames of one split that a part has."""
    for scene in _scenes(part / images):
        if split in ("all", _split(scene)) or not scene.parts:
            yield from _scene_frames(part, images, scene)


def _scenes(root: Path) -> list[Path]:
    """The folders, relative to `root`, that hold left/."""
    return sorted(left.parent.relative_to(root) for left in root.rglob("left") if left.is_dir())


def _split(scene: Path) -> str:
    """Driving and Monkaa have no split of their own: they train."""
    return "test" if scene.parts[:1] == ("TEST",) else "train"


def _scene_frames(part: Path, images: str, scene: Path) -> Iterator[Frame]:
    """The frames of one scene, which must be complete."""
    columns = {
        "left": _column(part / images / scene / "left", "png"),
        "right": _column(part / images / scene / "right", "png"),
        "truth": _column(part / DISPARITY / scene / "left", "pfm"),
    }
    for name, files in rows(columns, TITLE):
        yield Frame(name="-".join((*scene.parts, name)), coding=CODING, **files)


def _column(folder: Path, suffix: str) -> Column:
    pattern = f"*.{suffix}"
    return Column(folder, pattern, {path.stem: path for path in folder.glob(pattern)})
