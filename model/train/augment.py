"""What happens to a scene on its way into a batch: crop, colours, noise.

Everything random comes from one generator that the caller seeds by sample and epoch.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..data.images import Bytes
from ..data.scene import Scene, require_crop_fits
from .recipe import Augmentation

LEVELS = np.arange(256, dtype=np.float32) / 255


def crop(scene: Scene, size: tuple[int, int], rng: np.random.Generator) -> Scene:
    """A random part of `size` (height, width); `UsageError` where the scene is smaller."""
    height, width = size
    whole = scene.size
    require_crop_fits((width, height), whole, scene.name)
    left = int(rng.integers(whole[0] - width + 1))
    top = int(rng.integers(whole[1] - height + 1))
    return scene.crop(left, top, width, height)


def augmented(scene: Scene, how: Augmentation, rng: np.random.Generator) -> Scene:
    """The scene in other colours and, half of the time if `how` says so, upside down."""
    if how.flip and rng.random() < 0.5:
        upside: dict[str, Any] = {name: array[::-1] for name, array in scene.arrays().items()}
        scene = replace(scene, **upside)
    shared = rng.uniform(-1, 1, 5)
    level = rng.uniform(0, how.noise)
    left, right = (
        _recoloured(image, how, _nearby(shared, how.apart, rng), level, rng)
        for image in (scene.left, scene.right)
    )
    return replace(scene, left=left, right=right)


def _nearby(
    shared: NDArray[np.float64], apart: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """One eye's draw: up to `apart` from what both share, and no further from 0 than 1."""
    return np.clip(shared + apart * rng.uniform(-1, 1, shared.size), -1, 1)


def _recoloured(
    image: Bytes,
    how: Augmentation,
    draw: NDArray[np.float64],
    level: float,
    rng: np.random.Generator,
) -> Bytes:
    """One eye's image: gain, gamma and colour as a table of 256 values, then noise."""
    gain, power = 1 + how.gain * draw[0], 2 ** (how.gamma * draw[1])
    channels = gain * (1 + how.colour * draw[2:])
    if how.gain or how.gamma or how.colour:
        table = 255 * np.power(LEVELS, np.float32(power))[:, None] * channels
        rounded = np.rint(table).clip(0, 255).astype(np.uint8)
        image = cv2.LUT(np.ascontiguousarray(image), rounded[None]).astype(np.uint8, copy=False)
    if not level:
        return image
    noisy = image + np.float32(level) * rng.standard_normal(image.shape, np.float32)
    return np.rint(noisy).clip(0, 255).astype(np.uint8)
