"""What rts2-infer writes of an estimate, and what it reports of it."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from .cloud import Calibration, cloud, write_cloud
from .data.images import LARGEST_PX, storable, write_disparity, write_image, write_indexed
from .pictures import PALETTE, coloured, legend, overlay

if TYPE_CHECKING:
    from .data.images import Bytes
    from .predictor import Estimate

LEGEND: Final = "classes.png"
"""Which colour of a picture is which class, once for all pairs of a folder."""


@dataclass(frozen=True)
class Results:
    """Where the files of estimates go, and what belongs to them."""

    folder: Path
    calibration: Calibration | None
    """With one there is a point cloud."""
    highest_px: float | None
    """Where the colours end; None for each map's own (see `coloured`)."""

    def write(self, name: str, image: Bytes, estimate: Estimate) -> dict[str, Any]:
        """Writes everything that one estimate gives; returns its row of the report."""
        files: list[str] = []

        def named(what: str) -> Path:
            files.append(f"{name}_{what}")
            return self.folder / files[-1]

        self._write_disparity(named, estimate)
        if estimate.semantic is not None:
            write_indexed(named("semantic.png"), estimate.semantic, PALETTE)
            write_image(named("overlay.png"), overlay(image, estimate.semantic))
        if self.calibration is not None:
            points = cloud(estimate.disparity, image, self.calibration)
            write_cloud(named("cloud.ply"), points)
        height, width = estimate.disparity.shape
        return {
            "name": name,
            "size": (width, height),
            "stage": estimate.stage,
            "disparity_px": known_range(estimate),
            "network_ms": 1000 * estimate.seconds,
            "files": files,
        }

    def write_legend(self) -> str:
        """Writes which colour is which class; returns the file's name."""
        write_image(self.folder / LEGEND, legend())
        return LEGEND

    def _write_disparity(self, named: Callable[[str], Path], estimate: Estimate) -> None:
        path = named("disparity.png")
        saturated = write_disparity(path, estimate.disparity)
        if saturated:
            note = "%s: %d pixels exceed %.3f px, the most that the format holds"
            logging.getLogger(__name__).warning(note, path, saturated, LARGEST_PX)
        write_image(named("color.png"), coloured(estimate.disparity, self.highest_px))


def known_range(estimate: Estimate) -> list[float] | None:
    """The least and the largest disparity that a file of it holds; None without a known pixel.

    A network's residuals may lead below 0, where no disparity lies and no file holds one.
    """
    known = storable(estimate.disparity)
    known = known[np.isfinite(known)]
    return [float(known.min()), float(known.max())] if known.size else None
