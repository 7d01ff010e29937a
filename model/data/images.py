"""Stereo images and disparity maps as files.

In memory a disparity map is float32 in pixels, and NaN where nothing is known: a forgotten mask
then shows, where a zero would pass for an answer.
"""

from __future__ import annotations

import io
import struct
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ..errors import Rts2Error, UsageError
from ..files import existing_file, write_bytes

Bytes = NDArray[np.uint8]
Disparity = NDArray[np.float32]

STEPS = 256
"""KITTI's 16-bit PNG holds disparities in steps of 1/256 pixel; 0 stands for none."""

LARGEST_PX = 65535 / STEPS
"""The largest disparity that such a file holds; larger ones are written as this."""


def require_same_size(sizes: Mapping[Path, tuple[int, int]]) -> tuple[int, int]:
    """The one (width, height) of these images; different ones raise `UsageError`."""
    if len(set(sizes.values())) > 1:
        listed = ", ".join(f"{path} is {width}x{height}" for path, (width, height) in sizes.items())
        raise UsageError(f"a stereo pair must have one size: {listed}; give a rectified pair")
    return next(iter(sizes.values()))


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) of an image file, from its header alone."""
    with _opened(path) as image:
        return image.size


def read_rgb(path: Path) -> Bytes:
    """An image as (H, W, 3) RGB bytes; grey becomes RGB, alpha is dropped, 16 bits become 8.

    Raises:
        UsageError: there is no such file.
        Rts2Error: it is no image, or a truncated one.
    """
    with _opened(path) as image:
        if image.mode == "F":
            raise Rts2Error(f"{path}: a float image has no known white; save it with 8 or 16 bits")
        if not image.mode.startswith("I"):
            return np.asarray(image.convert("RGB"))
        grey = np.asarray(image).clip(0, 65535) >> 8
        return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)


def read_whole(path: Path) -> NDArray[np.int32]:
    """An image of one channel as (H, W) whole numbers: labels, instances, 16-bit disparity."""
    with _opened(path) as image:
        if image.mode not in ("L", "P", "1") and not image.mode.startswith("I"):
            raise Rts2Error(f"{path} must have one channel of whole numbers; it is {image.mode}")
        return np.asarray(image).astype(np.int32)


def read_disparity(path: Path) -> Disparity:
    """A KITTI 16-bit disparity PNG: (H, W) in pixels, NaN where the file holds 0."""
    stored = read_steps(path)
    return np.where(stored > 0, stored / STEPS, np.float32(np.nan)).astype(np.float32)


def read_steps(path: Path) -> NDArray[np.float32]:
    """A 16-bit disparity PNG as it is stored: (H, W) whole steps, 0 where nothing is known."""
    with _opened(path) as image:
        if not image.mode.startswith("I"):
            raise Rts2Error(f"{path} must be a 16-bit disparity PNG; it is {image.mode}")
        return np.asarray(image).astype(np.float32)


def write_disparity(path: Path, disparity: Disparity) -> int:
    """Writes a KITTI 16-bit PNG that holds `storable(disparity)`.

    Returns how many pixels exceed `LARGEST_PX` and had to be stored as that.
    """
    steps = _steps(disparity)
    write_image(path, np.nan_to_num(steps.clip(1, 65535)).astype(np.uint16))
    return int((steps > 65535).sum())


def storable(disparity: Disparity) -> Disparity:
    """What a KITTI 16-bit PNG makes of a map: steps of 1/256 pixel, unknown what is not finite.

    Disparities of nearly 0 and less become 1/256 pixel, KITTI's smallest, those beyond
    `LARGEST_PX` become that.
    """
    return (_steps(disparity).clip(1, 65535) / STEPS).astype(np.float32)


def _steps(disparity: Disparity) -> NDArray[np.float64]:
    """Whole steps, as many as there are; NaN where nothing is known."""
    known = np.where(np.isfinite(disparity), disparity, np.nan)
    return np.rint(known.astype(np.float64) * STEPS)


def write_image(path: Path, pixels: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    """Writes (H, W, 3) RGB bytes, or (H, W) grey of 8 or 16 bits, as PNG."""
    _write_png(path, Image.fromarray(pixels))


def write_indexed(path: Path, ids: Bytes, palette: Bytes) -> None:
    """Writes (H, W) ids as a PNG whose values are the ids and whose look is `palette` (N, 3)."""
    image = Image.fromarray(ids)
    image.putpalette(palette.tobytes())
    _write_png(path, image)


def _write_png(path: Path, image: Image.Image) -> None:
    encoded = io.BytesIO()
    image.save(encoded, "PNG")
    write_bytes(path, encoded.getvalue())


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """An opened image; whatever Pillow finds wrong becomes one line, and its remarks none."""
    existing_file(path, "an image")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path) as image:
                yield image
    except Rts2Error:
        raise
    except (OSError, ValueError, EOFError, SyntaxError, struct.error) as error:
        raise Rts2Error(f"{path} is truncated or no image: {error}") from error
    except Image.DecompressionBombError as error:
        raise Rts2Error(f"{path} is too large an image: {error}") from error
