"""A folder of small pairs to learn from."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

HEIGHT, WIDTH = 48, 80


def write_pairs(folder: Path, count: int) -> Path:
    """Pairs of texture, each shifted by a disparity of its own, labelled by brightness."""
    rng = np.random.default_rng(0)
    for name in ("left", "right", "disparity", "semantic"):
        (folder / name).mkdir(parents=True)
    for index in range(count):
        shift = int(rng.integers(2, 30))
        coarse = rng.integers(0, 256, (HEIGHT // 4, WIDTH // 4 + 8, 3), dtype=np.uint8)
        texture = cv2.resize(coarse, (WIDTH + 32, HEIGHT))
        left, right = texture[:, :WIDTH], texture[:, shift : shift + WIDTH]
        file = f"{index:02d}.png"
        Image.fromarray(left).save(folder / "left" / file)
        Image.fromarray(right).save(folder / "right" / file)
        truth = np.full((HEIGHT, WIDTH), 256 * shift, np.uint16)
        truth[: 4 + index] = 0
        Image.fromarray(truth).save(folder / "disparity" / file)
        Image.fromarray(left[..., 0] // 100).save(folder / "semantic" / file)
    return folder


@pytest.fixture(scope="session")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Seven pairs of 80×48, with the truth of all but a few rows; nobody writes to it."""
    return write_pairs(tmp_path_factory.mktemp("pairs"), 7)


@pytest.fixture
def own_pairs(tmp_path: Path) -> Path:
    """Three such pairs to break."""
    return write_pairs(tmp_path / "pairs", 3)
