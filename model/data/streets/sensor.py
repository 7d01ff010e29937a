"""What cameras make of light: exposure, tone, colour, blur, noise, each eye for itself."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class Sensor:
    """One eye's answer to linear light."""

    gain: NDArray[np.float32]
    """(3,), exposure and white balance."""
    gamma: float
    blur_px: float
    shot: float
    """Noise that grows with the root of the signal."""
    read: float
    vignette: float
    black: float
    """The signal that is shown as black: dark shadows lose their detail."""


def pair(rng: np.random.Generator, left: NDArray[Any], difference: float) -> tuple[Sensor, Sensor]:
    """The two eyes' sensors, exposed for the left image (H, W, 3) of linear light.

    `difference` scales how unlike the two are; 0 makes them equal but for their noise.
    """
    level = float(np.mean(left[left.shape[0] // 3 :])) + 1e-3
    exposure = rng.uniform(0.14, 0.42) / level
    black = rng.uniform(-0.01, 0.03)
    balance = np.exp(rng.normal(0, 0.06, 3))
    gamma, blur = rng.uniform(0.4, 0.62), rng.uniform(0.3, 0.75)
    noise, read = rng.uniform(0.002, 0.02), rng.uniform(0.001, 0.008)
    fall = difference * rng.uniform(0, 0.25)

    def one(other: float) -> Sensor:
        gain = exposure * balance * np.exp(other * rng.normal(0, 0.07))
        return Sensor(
            (gain * np.exp(other * rng.normal(0, 0.02, 3))).astype(np.float32),
            gamma * float(np.exp(other * rng.normal(0, 0.03))),
            blur * float(np.exp(other * rng.normal(0, 0.15))),
            noise,
            read,
            fall,
            black,
        )

    return one(0.0), one(difference)


def expose(light: NDArray[np.float32], sensor: Sensor, rng: np.random.Generator | None) -> Bytes:
    """Linear RGB (H, W, 3) → bytes; without `rng` there is no noise."""
    signal = light * sensor.gain
    if sensor.vignette:
        signal *= _falloff(light.shape[:2], sensor.vignette)
    if sensor.blur_px > 0:
        signal = np.asarray(cv2.GaussianBlur(signal, (0, 0), sensor.blur_px), np.float32)
    noisy = rng is not None
    return _developed(
        signal,
        _tones(sensor.gamma),
        sensor.black,
        sensor.shot if noisy else 0.0,
        sensor.read if noisy else 0.0,
        _pool(),
        int(rng.integers(_POOL)) if rng is not None else 0,
    )


@njit(cache=True)
def _developed(
    signal: NDArray[np.float32],
    tones: Bytes,
    black: float,
    shot: float,
    read: float,
    pool: NDArray[np.float32],
    start: int,
) -> Bytes:
    """Adds noise from `start` of the pool on, and gives each step of the signal its tone."""
    image = np.empty(signal.shape, np.uint8)
    flat, shown = signal.reshape(-1), image.reshape(-1)
    for i in range(len(flat)):
        grain = pool[(start + i) % len(pool)]
        value = flat[i] + grain * (read + shot * np.sqrt(max(flat[i], 0.0)))
        step = (value - black) / (1 - black) * _STEPS
        shown[i] = tones[int(min(max(step, 0.0), _STEPS))]
    return image


_STEPS = 65535
_POOL = 1 << 21


@lru_cache(maxsize=1)
def _pool() -> NDArray[np.float32]:
    """Normal values that are drawn once; an image takes a stretch of them, which is faster."""
    return np.random.default_rng(1).standard_normal(_POOL, np.float32)


def _tones(gamma: float) -> Bytes:
    """The byte for each step of the signal."""
    signal = np.arange(_STEPS + 1, dtype=np.float32) / _STEPS
    return np.asarray(np.rint(255 * np.power(signal, np.float32(gamma))), np.uint8)


def _falloff(size: tuple[int, int], strength: float) -> NDArray[np.float32]:
    y = np.linspace(-1, 1, size[0], dtype=np.float32)[:, None] ** 2
    x = np.linspace(-1, 1, size[1], dtype=np.float32)[None] ** 2
    return np.asarray(1 - strength * (0.3 * y + 0.7 * x), np.float32)[..., None]
