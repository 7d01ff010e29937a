"""Colours and overlays against values worked out by hand."""

import numpy as np
import pytest
from matplotlib import colormaps
from numpy.lib.stride_tricks import sliding_window_view

from rts2.model.pictures import (
    PALETTE,
    brightest_px,
    captioned,
    coloured,
    legend,
    overlay,
    painted,
)

NAN = np.nan


def turbo(share: float) -> list[int]:
    return [round(255 * part) for part in colormaps["turbo"](share)[:3]]


def disparities(*values: float) -> np.ndarray:
    return np.array([values], np.float32)


def test_colours_run_from_zero_to_the_given_maximum() -> None:
    picture = coloured(disparities(0, 50, 100, 200, -5), 100.0)
    assert picture.dtype == np.uint8
    wanted = [turbo(0.0), turbo(0.5), turbo(1.0), turbo(1.0), turbo(0.0)]
    np.testing.assert_allclose(picture[0], wanted, atol=1)


def test_unknown_is_black() -> None:
    picture = coloured(disparities(NAN, 3, np.inf), 10.0)
    assert picture[0, 0].tolist() == picture[0, 2].tolist() == [0, 0, 0]
    assert picture[0, 1].any()
    assert not coloured(disparities(NAN, NAN)).any()


def test_scale_ends_at_the_98th_percentile() -> None:
    ramp = np.arange(101, dtype=np.float32)[None]
    np.testing.assert_array_equal(coloured(ramp), coloured(ramp, 98.0))
    unknown = np.concatenate([ramp, np.full((1, 500), NAN, np.float32)], axis=1)
    np.testing.assert_array_equal(coloured(unknown)[:, :101], coloured(ramp))


def test_flat_zero_has_one_colour() -> None:
    np.testing.assert_allclose(coloured(disparities(0, 0))[0], [turbo(0.0)] * 2, atol=1)


def test_classes_have_the_colours_of_cityscapes() -> None:
    road, sky, car = painted(np.array([[0, 10, 13]], np.uint8))[0].tolist()
    assert (road, sky, car) == ([128, 64, 128], [70, 130, 180], [0, 0, 142])
    assert not painted(np.array([[19, 255]], np.uint8)).any()
    assert len({tuple(colour) for colour in PALETTE.tolist()}) == 19


def test_the_legend_has_every_colour_and_beside_it_its_name() -> None:
    picture = legend()
    names = set()
    for colour in PALETTE:
        filled = sliding_window_view((picture == colour).all(2), (20, 40)).all((2, 3))
        y, x = np.argwhere(filled)[0]
        beside = picture[y : y + 20, x + 45 : x + 160]
        assert (beside.min(2) < 64).any(), "a name in black"
        names.add(beside.tobytes())
    assert len(names) == 19


def test_overlay_mixes_and_leaves_unlabelled_pixels() -> None:
    image = np.array([[[100, 100, 100], [9, 8, 7]]], np.uint8)
    mixed = overlay(image, np.array([[0, 255]], np.uint8))
    assert mixed.tolist() == [[[114, 82, 114], [9, 8, 7]]]
    full = overlay(image, np.array([[0, 255]], np.uint8), share=1.0)
    assert full[0, 0].tolist() == [128, 64, 128]


@pytest.mark.parametrize("height", [32, 375])
def test_a_caption_stands_at_the_top_left_and_nowhere_else(height: int) -> None:
    picture = np.full((height, 400, 3), 100, np.uint8)
    before = picture.copy()
    found = captioned(picture, "12.3 FPS")
    assert np.array_equal(picture, before), "the picture itself stays"
    assert found.shape == picture.shape
    rows, columns = np.nonzero((found != 100).any(-1))
    assert found.max() > 200
    assert found.min() < 20
    assert rows.max() < max(height // 10, 20)
    assert columns.max() < 200
    assert np.array_equal(captioned(picture, ""), picture)


def test_colours_end_where_two_of_a_hundred_pixels_are_brighter() -> None:
    assert brightest_px(disparities(*range(101), NAN)) == 98
    assert brightest_px(disparities(NAN)) == 1
