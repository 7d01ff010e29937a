"""Crops and colours: what may change, and what must not."""

import numpy as np
import pytest

from rts2.model.data.scene import Scene
from rts2.model.errors import UsageError
from rts2.model.train.augment import augmented, crop
from rts2.model.train.recipe import Augmentation

H, W = 40, 60


def scene() -> Scene:
    """Every map holds y·W + x, so that a place can be told."""
    place = np.arange(H * W, dtype=np.float32).reshape(H, W)
    image = np.repeat((place % 251).astype(np.uint8)[..., None], 3, 2)
    return Scene("s", image, image.copy(), place, semantic=(place % 19).astype(np.uint8))


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_a_crop_is_one_place_of_every_map() -> None:
    corners = set()
    for seed in range(200):
        part = crop(scene(), (32, 32), rng(seed))
        top, left = divmod(int(part.truth[0, 0]), W)
        corners.add((top, left))
        assert part.truth.shape == (32, 32)
        assert part.truth[31, 31] == (top + 31) * W + left + 31
        assert part.left[0, 0, 0] == part.right[0, 0, 0] == part.truth[0, 0] % 251
        assert part.semantic is not None
        assert (part.semantic == part.truth % 19).all()
    assert {top for top, _ in corners} == set(range(H - 32 + 1))
    assert {left for _, left in corners} == set(range(W - 32 + 1))


def test_a_crop_as_large_as_the_scene_is_the_scene_and_a_larger_one_is_refused() -> None:
    assert crop(scene(), (H, W), rng()).truth.shape == (H, W)
    with pytest.raises(UsageError, match="64x40 does not fit in s of 60x40"):
        crop(scene(), (40, 64), rng())


def test_without_strengths_nothing_changes() -> None:
    given = scene()
    found = augmented(given, Augmentation(), rng())
    for name, array in given.arrays().items():
        np.testing.assert_array_equal(found.arrays()[name], array)


def test_truth_and_labels_stay_while_colours_change() -> None:
    given = scene()
    found = augmented(given, Augmentation(gain=0.3, gamma=0.3, colour=0.2, noise=5), rng())
    np.testing.assert_array_equal(found.truth, given.truth)
    assert (found.left != given.left).any()
    assert (found.left != found.right).any()
    assert found.left.dtype == np.uint8


def test_eyes_that_are_not_apart_see_the_same_but_for_noise() -> None:
    together = Augmentation(gain=0.3, gamma=0.3, colour=0.2, apart=0)
    found = augmented(scene(), together, rng())
    np.testing.assert_array_equal(found.left, found.right)
    noisy = augmented(scene(), together.model_copy(update={"noise": 8.0}), rng())
    apart = noisy.left.astype(int) - noisy.right
    assert 0 < apart.std() < 8 * 2**0.5


def test_gain_is_a_factor() -> None:
    image = np.full((H, W, 3), 100, np.uint8)
    given = Scene("s", image, image, np.zeros((H, W), np.float32))
    factors = []
    for seed in range(300):
        found = augmented(given, Augmentation(gain=0.2, apart=0), rng(seed))
        assert np.unique(found.left).size == 1
        factors.append(found.left[0, 0, 0] / 100)
    assert 0.8 <= min(factors) < 0.82
    assert 1.18 < max(factors) <= 1.2


def test_no_eye_goes_beyond_the_strengths_however_far_they_are_apart() -> None:
    image = np.full((2, 2, 3), 100, np.uint8)
    given = Scene("s", image, image, np.zeros((2, 2), np.float32))
    for apart in (0.5, 1.0):
        how = Augmentation(gain=0.9, apart=apart)
        assert apart != 0.5 or how == Augmentation(gain=0.9)  # the default
        found = [augmented(given, how, rng(seed)) for seed in range(400)]
        values = {int(eye[0, 0, 0]) for f in found for eye in (f.left, f.right)}
        assert (min(values), max(values)) == (10, 190)
        assert any(f.left[0, 0, 0] != f.right[0, 0, 0] for f in found)


def test_upside_down_is_half_of_the_time_and_of_every_map() -> None:
    given = scene()
    found = [augmented(given, Augmentation(flip=True), rng(seed)) for seed in range(100)]
    flipped = [f for f in found if f.truth[0, 0] == given.truth[-1, 0]]
    assert 30 < len(flipped) < 70
    for each in flipped:
        for name, array in given.arrays().items():
            np.testing.assert_array_equal(each.arrays()[name], array[::-1])


def test_a_seed_is_an_outcome() -> None:
    how = Augmentation(gain=0.3, gamma=0.3, colour=0.2, noise=5, flip=True)
    first, again, other = (augmented(scene(), how, rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.right, again.right)
    assert (first.right != other.right).any()
