"""Patterns tile without a seam, keep their range, and lose detail with distance."""

import numpy as np
import pytest

from rts2.model.data.streets import sensor, shading, textures


def values(pattern: int, u: np.ndarray, v: np.ndarray, texels: float) -> np.ndarray:
    atlas, places = textures.atlas(), zip(u.ravel(), v.ravel(), strict=True)
    return np.array([shading.value(atlas, pattern, *at, texels) for at in places]).reshape(u.shape)


@pytest.mark.parametrize("kind", textures.KINDS)
def test_patterns_tile_and_stay_within_0_and_1(kind: str) -> None:
    u, v = np.meshgrid(np.linspace(0, 1, 65), np.linspace(0, 1, 65))
    for pattern in textures.patterns(kind):
        tile = values(pattern, u, v, 0.5)
        assert tile.min() >= 0
        assert tile.max() <= 1
        assert tile.std() > 0.01
        assert values(pattern, u + 3, v - 2, 0.5) == pytest.approx(tile, abs=1e-3)
        # The last column is the first one of the next tile.
        assert tile[:, -1] == pytest.approx(tile[:, 0], abs=1e-3)
        assert tile[-1] == pytest.approx(tile[0], abs=1e-3)


def test_distance_blurs_a_pattern_and_keeps_its_mean() -> None:
    u, v = np.meshgrid(
        np.linspace(0, 1, 256, endpoint=False), np.linspace(0, 1, 256, endpoint=False)
    )
    near, far = (values(textures.patterns("asphalt")[0], u, v, texels) for texels in (1, 32))
    assert far.std() < 0.8 * near.std()
    assert far.mean() == pytest.approx(near.mean(), abs=0.02)


def test_kinds_are_laid_out_without_gap() -> None:
    rows = [row for kind in textures.KINDS for row in textures.patterns(kind)]
    assert rows == list(range(sum(textures.KINDS.values())))
    with pytest.raises(KeyError):
        textures.patterns("marble")


def plain(**changes: float) -> sensor.Sensor:
    fields = {"gamma": 1.0, "blur_px": 0.0, "shot": 0.0, "read": 0.0, "vignette": 0.0, "black": 0.0}
    return sensor.Sensor(np.full(3, 2.0, np.float32), **(fields | changes))


def test_sensor_scales_tones_and_clips() -> None:
    light = np.array([[[0.0, 0.125, 0.25], [0.5, 0.6, 9.0]]], np.float32)
    assert sensor.expose(light, plain(), None).tolist() == [[[0, 64, 127], [255, 255, 255]]]
    root = sensor.expose(light, plain(gamma=0.5), None)
    assert root[0, 0].tolist() == [0, 127, 180]  # 255·√0.25 and 255·√0.5, rounded down a step
    dark = sensor.expose(light, plain(black=0.25), None)
    assert dark[0, 0].tolist() == [0, 0, 85]  # (0.5 − 0.25) / 0.75 of 255


def test_noise_has_the_spread_that_was_asked_for() -> None:
    light = np.full((200, 200, 3), 0.25, np.float32)
    noisy = sensor.expose(light, plain(shot=0.02, read=0.01), np.random.default_rng(3))
    expected = 255 * (0.02 * np.sqrt(0.5) + 0.01)
    assert noisy.std() == pytest.approx(expected, rel=0.03)
    assert noisy.mean() == pytest.approx(127.5, abs=0.5)


def test_eyes_without_difference_are_equal() -> None:
    light = np.full((30, 30, 3), 0.3, np.float32)
    first, second = sensor.pair(np.random.default_rng(1), light, 0.0)
    assert np.array_equal(first.gain, second.gain)
    assert (first.gamma, first.blur_px) == (second.gamma, second.blur_px)
    first, second = sensor.pair(np.random.default_rng(1), light, 1.0)
    assert not np.array_equal(first.gain, second.gain)
