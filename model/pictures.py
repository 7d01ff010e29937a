"""What a person looks at: coloured disparity and painted semantics."""

from __future__ import annotations

from functools import cache
from typing import Final

import numpy as np

from .data.images import Bytes, Disparity
from .data.labels import CLASS_NAMES

BRIGHTEST: Final = 98
"""The percentile of a disparity map that its colours end at, unless a maximum is given."""

COLOURS: Final = 256

CAPTION_LINES: Final = 20
"""How many lines of captions a picture has room for."""

PALETTE: Bytes = np.array(
    [
        (128, 64, 128),  # road
        (244, 35, 232),  # sidewalk
        (70, 70, 70),  # building
        (102, 102, 156),  # wall
        (190, 153, 153),  # fence
        (153, 153, 153),  # pole
        (250, 170, 30),  # traffic light
        (220, 220, 0),  # traffic sign
        (107, 142, 35),  # vegetation
        (152, 251, 152),  # terrain
        (70, 130, 180),  # sky
        (220, 20, 60),  # person
        (255, 0, 0),  # rider
        (0, 0, 142),  # car
        (0, 0, 70),  # truck
        (0, 60, 100),  # bus
        (0, 80, 100),  # train
        (0, 0, 230),  # motorcycle
        (119, 11, 32),  # bicycle
    ],
    np.uint8,
)
"""Cityscapes' colours of train ids 0 … 18."""


def coloured(disparity: Disparity, highest_px: float | None = None) -> Bytes:
    """(H, W) in pixels → (H, W, 3) RGB: turbo from 0 (blue) to `highest_px` (red), unknown black.

    Without `highest_px` the scale ends at the map's 98th percentile.
    """
    known = np.isfinite(disparity)
    if highest_px is None:
        highest_px = brightest_px(disparity)
    share = np.where(known, disparity, 0) / max(highest_px, 1e-6)
    steps = (share.clip(0, 1) * COLOURS).clip(0, COLOURS - 1).astype(np.uint8)
    coloured: Bytes = _turbo()[steps]
    coloured[~known] = 0
    return coloured


def brightest_px(disparity: Disparity) -> float:
    """Where the colours of a map end: its 98th percentile; 1 where nothing is known."""
    known = disparity[np.isfinite(disparity)]
    return float(np.percentile(known, BRIGHTEST)) if known.size else 1.0


def painted(semantic: Bytes) -> Bytes:
    """(H, W) train ids → (H, W, 3) RGB in Cityscapes' colours; other ids are black."""
    return _full_palette()[semantic]


def overlay(image: Bytes, semantic: Bytes, share: float = 0.5) -> Bytes:
    """The image (H, W, 3) with its classes' colours laid over it; `share` of 1 hides the image."""
    import cv2

    mixed = cv2.addWeighted(image, 1 - share, painted(semantic), share, 0)
    unknown = semantic >= len(PALETTE)
    mixed[unknown] = image[unknown]
    return np.asarray(mixed, np.uint8)


def captioned(picture: Bytes, text: str) -> Bytes:
    """The picture (H, W, 3) with a line of white text, edged in black, at its top left."""
    from PIL import Image, ImageDraw, ImageFont

    size = max(picture.shape[0] // CAPTION_LINES, 10)
    strip = Image.fromarray(picture[: 2 * size])
    draw, font = ImageDraw.Draw(strip), ImageFont.load_default(size)
    edge = max(size // 10, 1)
    draw.text((size / 2, size / 3), text, "white", font, stroke_width=edge, stroke_fill="black")
    return np.concatenate([np.asarray(strip), picture[2 * size :]])


def legend() -> Bytes:
    """(H, W, 3) RGB: the name of each class beside its colour, in two columns."""
    from PIL import Image, ImageDraw, ImageFont

    rows, height, width = -(-len(CLASS_NAMES) // 2), 28, 170
    picture = Image.new("RGB", (2 * width, rows * height + 8), "white")
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(16)
    for train_id, name in enumerate(CLASS_NAMES):
        x, y = train_id // rows * width + 8, train_id % rows * height + 6
        draw.rectangle((x, y, x + 40, y + height - 6), fill=tuple(PALETTE[train_id].tolist()))
        draw.text((x + 50, y + (height - 6) / 2), name, "black", font, anchor="lm")
    return np.asarray(picture)


@cache
def _turbo() -> Bytes:
    """The colours of disparities, (256, 3)."""
    from matplotlib import colormaps

    return colormaps["turbo"](np.arange(COLOURS), bytes=True)[:, :3]


def _full_palette() -> Bytes:
    """A colour for every id that a byte can hold."""
    colours = np.zeros((256, 3), np.uint8)
    colours[: len(PALETTE)] = PALETTE
    return colours
