"""The pairs that a bundle is checked with: generated scenes that no training may take."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from ...model.files import write_bytes
from .schema import Check, Sample
from .target import Tolerance

if TYPE_CHECKING:
    from ...model.data.images import Bytes
    from ...model.data.scene import Scene
    from ...model.predictor import Estimate

FOLDER: Final = "samples"
PAIRS: Final = 2

PERCENTILE: Final = 99.0
"""Beside the mean: a few pixels far off at edges of depth are in the nature of a stereo network."""


def scenes(size: tuple[int, int]) -> list[Scene]:
    """The pairs at a size (width, height)."""
    from ...model.data.catalog import STREETS, open_dataset

    return [sample.read() for sample in open_dataset(STREETS, split="val", count=PAIRS, size=size)]


def answers(graph: Path, pairs: Sequence[Scene]) -> list[Estimate]:
    """What the graph says of each pair, in ONNX Runtime."""
    from ...model.predictor import OnnxPredictor

    predictor = OnnxPredictor(graph)
    return [predictor.predict(pair.left, pair.right) for pair in pairs]


def written(
    folder: Path, pairs: Sequence[Scene], expected: Sequence[Estimate], tolerance: Tolerance
) -> Check:
    """Writes the pairs and what is expected of them into a bundle."""
    first, second = (
        _written(folder, pair, estimate) for pair, estimate in zip(pairs, expected, strict=True)
    )
    return Check(
        samples=(first, second),
        tolerance_px=tolerance.mean_px,
        percentile=PERCENTILE,
        percentile_px=tolerance.percentile_px,
        equal_classes=tolerance.equal_classes,
    )


def _written(folder: Path, pair: Scene, expected: Estimate) -> Sample:
    place = f"{FOLDER}/{pair.name}"
    (folder / place).mkdir(parents=True)
    files = {
        f"{place}/left.ppm": ppm(pair.left),
        f"{place}/right.ppm": ppm(pair.right),
        f"{place}/disparity.bin": expected.disparity.astype("<f4").tobytes(),
    }
    semantic = None
    if expected.semantic is not None:
        semantic = f"{place}/semantic.bin"
        files[semantic] = expected.semantic.tobytes()
    for name, data in files.items():
        write_bytes(folder / name, data)
    left, right, disparity, *_ = files
    return Sample(name=pair.name, images=(left, right), disparity=disparity, semantic=semantic)


def ppm(image: Bytes) -> bytes:
    """(H, W, 3) RGB bytes as a binary PPM: any viewer shows it, and ten lines read it."""
    height, width = image.shape[:2]
    return f"P6\n{width} {height}\n255\n".encode() + np.ascontiguousarray(image).tobytes()
