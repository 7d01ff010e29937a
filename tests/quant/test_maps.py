"""Maps as pictures: colours that can be derived, and means of what is known."""

import io
from base64 import b64decode

import numpy as np
import pytest
from PIL import Image

from rts2.model.pictures import coloured
from rts2.quant.maps import Example, figures, reduced, shown, signed


def example(difference: float = 0.0, size: tuple[int, int] = (30, 50)) -> Example:
    reference = np.full(size, 40, np.float32)
    truth = np.full(size, np.nan, np.float32)
    truth[0] = 40
    return Example("one", np.zeros((*size, 3), np.uint8), reference, reference + difference, truth)


def opened(address: str) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(b64decode(address.split(",")[1]))))


def test_a_difference_of_nothing_is_nearly_white_and_its_sign_a_colour() -> None:
    below, none, above, unknown = signed(np.array([[-3, 0, 3, np.nan]], np.float32))[0].astype(int)
    assert none.min() > 240
    assert below[2] > below[0]
    assert above[0] > above[2]
    assert unknown.tolist() == [0, 0, 0]
    beyond = signed(np.array([[-99, 99]], np.float32))[0]
    assert beyond.tolist() == [below.tolist(), above.tolist()]


def test_a_smaller_map_is_the_mean_of_what_is_known() -> None:
    given = np.array([[1, 3, np.nan, 5], [1, 3, np.nan, np.nan]], np.float32)
    assert reduced(given, (2, 1)).tolist() == [[2, 5]]
    assert np.isnan(reduced(np.full((4, 4), np.nan, np.float32), (2, 2))).all()


def test_both_networks_have_one_scale() -> None:
    """40 px everywhere ends the scale at 40; half of it is the colour of its middle."""
    (found,) = shown([example(-20)], 10**6)
    assert (found.highest_px, found.size) == (40, (50, 30))
    ends = coloured(np.array([[40, 20]], np.float32), 40)[0]
    assert (opened(found.reference) == ends[0]).all()
    assert (opened(found.quantized) == ends[1]).all()


def test_pictures_shrink_until_they_fit() -> None:
    size = 375, 1242
    (large,) = shown([example(size=size)], 10**9)
    (small,) = shown([example(size=size)], 1)
    assert large.size[0] * large.size[1] <= 250_000
    assert small.size[0] * small.size[1] <= 10_000
    assert small.size[0] / small.size[1] == pytest.approx(1242 / 375, rel=0.03)
    assert shown([], 1) == []


def test_figures_are_of_what_both_know() -> None:
    found = figures(example(4))
    assert (found.mean_px, found.near, found.far) == (4, 100, 100)
    assert (found.d1_all, found.epe) == ((0, 100), (0, 4))
    half = example()
    half.quantized[:15] = np.inf
    half.quantized[15:] += 2
    found = figures(half)
    assert (found.mean_px, found.near, found.far) == (2, 100, 0)
    nothing = figures(example(np.nan))
    assert (nothing.mean_px, nothing.near, nothing.epe) == (None, None, (0, None))


def test_maps_without_any_answer_are_drawn() -> None:
    blank = np.full((8, 8), np.nan, np.float32)
    (found,) = shown([Example("blank", np.zeros((8, 8, 3), np.uint8), blank, blank, None)], 10**6)
    assert (found.highest_px, found.truth) == (1, None)
    assert not opened(found.difference).any()
