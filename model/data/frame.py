"""A sample whose maps are files; what the files mean is its coding."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..files import existing_file
from .images import Bytes, Disparity, image_size, read_rgb, read_whole
from .scene import Foreground, Scene

Instances = NDArray[np.int32]


@dataclass(frozen=True)
class Coding:
    """How a data set's files are read. Only functions of modules, as samples go to workers."""

    name: str
    disparity: Callable[[Path], Disparity]
    """(H, W) in pixels, NaN where nothing is known."""
    semantic: Callable[[Path], Bytes]
    """(H, W), train ids."""
    instances: Callable[[Instances], Instances]
    """The values of an instance file → a number for each object of its own, 0 for none."""


@dataclass(frozen=True)
class Frame:
    """The files of one pair; what the data set does not have is None."""

    name: str
    left: Path
    right: Path
    coding: Coding
    truth: Path | None = None
    """Disparity of the left image, hidden pixels included where the data set knows them."""
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

    @property
    def fingerprint(self) -> str:
        """Changes with any of the files: their places, sizes and times of writing."""
        return json.dumps([self.coding.name, self.name, *map(_stamp, self.files())])

    def files(self) -> tuple[Path, ...]:
        """Every file of the frame that there is."""
        optional = (self.truth, self.visible, self.semantic, self.instance, self.objects)
        return (self.left, self.right, *(path for path in optional if path is not None))

    def read(self) -> Scene:
        """The images and maps; without a truth it is NaN everywhere."""
        left = read_rgb(self.left)
        objects = None if self.objects is None else read_whole(self.objects) != 0
        instances = self._instances()
        by_number = None if instances is None else instances != 0
        return Scene(
            name=self.name,
            left=left,
            right=read_rgb(self.right),
            truth=self._truth(left.shape[:2]),
            foreground=by_number if objects is None else objects,
            semantic=None if self.semantic is None else self.coding.semantic(self.semantic),
            visible=self._visible(),
            instances=instances,
        )

    def _truth(self, shape: tuple[int, ...]) -> Disparity:
        if self.truth is None:
            return np.full(shape, np.nan, np.float32)
        return self.coding.disparity(self.truth)

    def _visible(self) -> NDArray[np.bool_] | None:
        return None if self.visible is None else np.isfinite(self.coding.disparity(self.visible))

    def _instances(self) -> Instances | None:
        return None if self.instance is None else self.coding.instances(read_whole(self.instance))


def _stamp(path: Path) -> tuple[str, int, int]:
    state = existing_file(path, "a data set's file").stat()
    return str(path.absolute()), state.st_size, state.st_mtime_ns
