"""Images and disparity maps survive the disk; what is broken is told in one line."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rts2.model.data.images import (
    image_size,
    read_disparity,
    read_rgb,
    read_whole,
    require_same_size,
    storable,
    write_disparity,
    write_image,
    write_indexed,
)
from rts2.model.errors import Rts2Error, UsageError

NAN = np.nan


def saved(path: Path, pixels: np.ndarray) -> Path:
    Image.fromarray(pixels).save(path)
    return path


def test_disparity_is_rounded_and_saturates(tmp_path: Path) -> None:
    disparity = np.array([[NAN, np.inf, -2.0, 0.0], [0.0059, 1.0, 255.998, 300.0]], np.float32)
    saturated = write_disparity(tmp_path / "d.png", disparity)
    stored = np.asarray(Image.open(tmp_path / "d.png"))
    # 0.0059 px is 1.51 steps: rounded 2, truncated it would be 1.
    assert stored.tolist() == [[0, 0, 1, 1], [2, 256, 65535, 65535]]
    assert saturated == 1
    np.testing.assert_array_equal(storable(disparity), read_disparity(tmp_path / "d.png"))


def test_disparity_of_zero_is_unknown(tmp_path: Path) -> None:
    path = saved(tmp_path / "d.png", np.array([[0, 1, 256, 65535]], np.uint16))
    read = read_disparity(path)
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, np.array([[NAN, 1 / 256, 1.0, 255.99609375]], np.float32))


def test_disparity_returns_within_half_a_step(tmp_path: Path) -> None:
    disparity = np.linspace(0.1, 200, 600, dtype=np.float32).reshape(20, 30)
    write_disparity(tmp_path / "d.png", disparity)
    assert np.abs(read_disparity(tmp_path / "d.png") - disparity).max() <= 0.5 / 256 + 1e-5


def test_disparity_of_eight_bits_is_refused(tmp_path: Path) -> None:
    path = saved(tmp_path / "d.png", np.zeros((4, 4), np.uint8))
    with pytest.raises(Rts2Error, match="16-bit"):
        read_disparity(path)


def test_real_truth_has_the_pixels_that_the_kit_counts(real_data: Path) -> None:
    truth = read_disparity(real_data / "kitti_devkit" / "disp_gt.png")
    assert truth.shape == (375, 1242)
    assert np.isfinite(truth).sum() == 111_326


@pytest.mark.parametrize(
    ("pixels", "expected"),
    [
        (np.array([[[1, 2, 3]]], np.uint8), [1, 2, 3]),
        (np.array([[[1, 2, 3, 0]]], np.uint8), [1, 2, 3]),
        (np.array([[7]], np.uint8), [7, 7, 7]),
        (np.array([[65535]], np.uint16), [255, 255, 255]),
        (np.array([[512]], np.uint16), [2, 2, 2]),
    ],
    ids=["rgb", "rgba", "grey", "white of 16 bits", "dark of 16 bits"],
)
def test_every_kind_of_image_becomes_rgb(
    tmp_path: Path, pixels: np.ndarray, expected: list[int]
) -> None:
    read = read_rgb(saved(tmp_path / "i.png", pixels))
    assert read.dtype == np.uint8
    assert read.tolist() == [[expected]]


def test_float_image_is_refused(tmp_path: Path) -> None:
    path = saved(tmp_path / "i.tiff", np.ones((2, 2), np.float32))
    with pytest.raises(Rts2Error, match="8 or 16 bits"):
        read_rgb(path)


def test_colours_are_no_labels(tmp_path: Path) -> None:
    path = saved(tmp_path / "i.png", np.zeros((2, 2, 3), np.uint8))
    with pytest.raises(Rts2Error, match="one channel"):
        read_whole(path)


def test_indexed_holds_ids_and_shows_colours(tmp_path: Path) -> None:
    palette = np.array([(0, 0, 0), (10, 20, 30), (200, 100, 50)], np.uint8)
    write_indexed(tmp_path / "i.png", np.array([[2, 1]], np.uint8), palette)
    assert read_whole(tmp_path / "i.png").tolist() == [[2, 1]]
    assert read_rgb(tmp_path / "i.png").tolist() == [[[200, 100, 50], [10, 20, 30]]]


@pytest.mark.parametrize("read", [read_rgb, read_whole, read_disparity, image_size])
def test_what_is_no_file_is_wrong_use(tmp_path: Path, read: object) -> None:
    assert callable(read)
    with pytest.raises(UsageError, match="no such file"):
        read(tmp_path / "none.png")
    with pytest.raises(UsageError, match="it is a folder"):
        read(tmp_path)


@pytest.mark.parametrize("name", ["i.png", "i.jpg"])
@pytest.mark.parametrize("kept", [0, 10, 100, 700])
def test_truncated_image_is_one_line(tmp_path: Path, name: str, kept: int) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (40, 40, 3), dtype=np.uint8)
    path = saved(tmp_path / name, noise)
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(Rts2Error, match="truncated or no image") as caught:
        read_rgb(path)
    assert not isinstance(caught.value, UsageError)


def test_text_is_no_image(tmp_path: Path) -> None:
    (tmp_path / "i.png").write_text("hello")
    with pytest.raises(Rts2Error, match="truncated or no image"):
        image_size(tmp_path / "i.png")


def test_size_is_width_and_height(tmp_path: Path) -> None:
    assert image_size(saved(tmp_path / "i.png", np.zeros((3, 5), np.uint8))) == (5, 3)


def test_failed_write_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(Rts2Error, match="cannot write"):
        write_image(tmp_path / "none" / "i.png", np.zeros((3, 5), np.uint8))
    assert list(tmp_path.iterdir()) == []


def test_pair_of_two_sizes_names_both() -> None:
    assert require_same_size({Path("l"): (6, 4), Path("r"): (6, 4)}) == (6, 4)
    with pytest.raises(UsageError, match="l is 6x4, r is 6x5"):
        require_same_size({Path("l"): (6, 4), Path("r"): (6, 5)})
