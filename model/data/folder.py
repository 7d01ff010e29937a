"""Anybody's own pairs: equally named files in left/, right/, and maybe disparity/ and semantic/."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from ..errors import Rts2Error
from ..files import existing_file
from .frame import Coding, Frame
from .images import Bytes, Disparity, read_disparity, read_whole
from .kitti import own_objects
from .labels import require_train_ids
from .layout import IMAGES, Column, images_of, require_folder, require_folders, rows
from .pfm import read_pfm_disparity, require_disparity

TITLE: Final = "a data set of pairs"
DISPARITIES: Final = {".png": read_disparity, ".pfm": read_pfm_disparity}


def open_all(folder: Path, split: str = "all") -> tuple[Frame, ...]:  # noqa: ARG001
    """Every pair, by name; there is only one split.

    Raises:
        UsageError: there is no such folder, or it does not hold left/ and right/, or no image.
        Rts2Error: some pair lacks a file in one of the folders.
    """
    require_folder(folder, TITLE, "left/ and right/")
    require_folders(folder, ["left", "right"], TITLE)
    columns = {name: _column(folder / name, IMAGES) for name in ("left", "right")}
    if (folder / "disparity").is_dir():
        columns["truth"] = _column(folder / "disparity", (*DISPARITIES, ".npy"))
    if (folder / "semantic").is_dir():
        columns["semantic"] = _column(folder / "semantic", (".png",))
    return tuple(Frame(name=name, coding=CODING, **files) for name, files in rows(columns, TITLE))


def read_any_disparity(path: Path) -> Disparity:
    """A KITTI PNG, a PFM or a NumPy array of disparities: in pixels, NaN where nothing is known."""
    if path.suffix.lower() == ".npy":
        return require_disparity(_read_npy(path), path)
    return DISPARITIES[path.suffix.lower()](path)


def read_train_ids(path: Path) -> Bytes:
    """An 8-bit image of train ids; 255 is unlabelled."""
    return require_train_ids(read_whole(path), str(path))


def _read_npy(path: Path) -> Disparity:
    """A saved array of numbers, (H, W); what is not finite becomes NaN."""
    try:
        values = np.load(existing_file(path, "a disparity map"), allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise Rts2Error(f"{path} is truncated or no NumPy array: {error}") from error
    if not isinstance(values, np.ndarray) or values.ndim != 2 or values.dtype.kind not in "fiu":
        raise Rts2Error(f"{path} must hold numbers of shape (height, width)")
    return np.where(np.isfinite(values), values, np.nan).astype(np.float32)


CODING: Final = Coding("folder", read_any_disparity, read_train_ids, own_objects)
"""There are no instances; their coding is never asked."""


def _column(folder: Path, suffixes: tuple[str, ...]) -> Column:
    return Column(folder, f"*({'|'.join(suffixes)})", images_of(folder, suffixes))
