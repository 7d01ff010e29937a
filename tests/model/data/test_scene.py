"""A scene's images are of one size and cropped together."""

import numpy as np
import pytest

from rts2.model.data.scene import Scene
from rts2.model.errors import Rts2Error, UsageError


def scene(height: int = 4, width: int = 6) -> Scene:
    image = np.arange(height * width * 3, dtype=np.uint8).reshape(height, width, 3)
    truth = np.arange(height * width, dtype=np.float32).reshape(height, width)
    return Scene("0", image, image, truth, truth > 3, truth.astype(np.uint8))


def test_crop_is_the_bottom_right_of_every_array() -> None:
    cut = scene().bottom_right(2, 3)
    assert cut.truth.tolist() == [[10, 11], [16, 17], [22, 23]]
    assert cut.left.shape == cut.right.shape == (3, 2, 3)
    assert cut.left[0, 0].tolist() == [30, 31, 32]
    assert cut.foreground is not None
    assert cut.foreground.all()
    assert cut.semantic is not None
    assert cut.semantic.tolist() == cut.truth.tolist()


def test_crop_larger_than_the_image_is_refused() -> None:
    assert scene().bottom_right(6, 4).truth.shape == (4, 6)
    for width, height in ((7, 4), (6, 5)):
        with pytest.raises(UsageError, match=f"{width}x{height} does not fit in 0 of 6x4"):
            scene().bottom_right(width, height)


def test_scene_has_one_size() -> None:
    image = np.zeros((4, 6, 3), np.uint8)
    with pytest.raises(Rts2Error, match="left 6x4, right 6x4, truth 5x4"):
        Scene("0", image, image, np.zeros((4, 5), np.float32))
