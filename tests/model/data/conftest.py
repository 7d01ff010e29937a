"""What the tests of the data sets share: writing tiny trees, and looking at real pairs."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rts2.model.data.scene import Scene


def _put(path: Path, pixels: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)
    return path


def _put_pfm(path: Path, values: np.ndarray, order: str = "<", scale: float = 1.0) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = values.shape
    sign = -1 if order == "<" else 1
    head = f"Pf\n{width} {height}\n{sign * scale}\n".encode()
    path.write_bytes(head + values[::-1].astype(f"{order}f4").tobytes())
    return path


def _unexplained(scene: Scene) -> float:
    """How much of the difference of the two images is left once right is moved by the truth."""
    rows, columns = np.nonzero(np.isfinite(scene.truth))
    shift = np.rint(scene.truth[rows, columns]).astype(int)
    seen = columns >= shift
    rows, columns, shift = rows[seen], columns[seen], shift[seen]
    left = scene.left[rows, columns].astype(float)
    moved, unmoved = scene.right[rows, columns - shift], scene.right[rows, columns]
    return float(np.abs(left - moved).mean() / np.abs(left - unmoved).mean())


@pytest.fixture
def put() -> Callable[..., Path]:
    """Writes an array as an image, with the folders that it needs."""
    return _put


@pytest.fixture
def put_pfm() -> Callable[..., Path]:
    """Writes an array, top row first, as a PFM."""
    return _put_pfm


@pytest.fixture
def unexplained() -> Callable[[Scene], float]:
    """1 where the truth explains nothing, near 0 where it explains all."""
    return _unexplained
