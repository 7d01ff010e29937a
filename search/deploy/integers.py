"""The integers of a bundle: the layers that the latency was timed with, calibrated on streets."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ...model.data.catalog import STREETS, open_dataset
from ...model.graph import save_graph
from ...model.inference import open_session
from ...model.qdq import integers, usual
from ...quant.calibration import calibrate
from ...quant.source import opened

PAIRS: Final = 16
"""Generated scenes that calibrate: the same ones in every bundle of a network."""


def lower(path: Path) -> None:
    """Makes the float graph at `path` one with its usual layers in 8 bits, in its place."""
    model, header = opened(path)
    pairs = open_dataset(STREETS, split="train", count=PAIRS, size=header.resolution)
    with TemporaryDirectory() as folder:
        known = calibrate(model, header, pairs, Path(folder) / "calibration.npz")
    made = integers(model, usual(model), known.ranges("percentile"))
    save_graph(made, header.model_copy(update={"precision": "int8"}), path)


def answer(path: Path, left: NDArray[np.float32], right: NDArray[np.float32]) -> NDArray[Any]:
    """The disparity of a graph for normalised inputs, (1, H, W)."""
    (found,) = open_session(path).run(["disparity"], {"left": left, "right": right})
    return np.asarray(found)
