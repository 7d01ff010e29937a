"""Procedural surface patterns, drawn once a process into one atlas with all levels of detail.

A pattern is a tileable square of values in 0 … 1; materials mix two colours by it.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from .shading import LEVELS, SIDE, Tile

_SEED = 20200531

KINDS: dict[str, int] = {
    "noise": 16,
    "asphalt": 5,
    "grass": 4,
    "leaves": 6,
    "brick": 5,
    "windows": 12,
    "panels": 5,
    "print": 8,
    "stripes": 3,
}
"""How many patterns of each kind there are."""


@lru_cache
def patterns(kind: str) -> range:
    """The indices of a kind's patterns in the atlas."""
    start = 0
    for name, count in KINDS.items():
        if name == kind:
            return range(start, start + count)
        start += count
    raise KeyError(kind)


@lru_cache(maxsize=1)
def atlas() -> Tile:
    """All patterns below each other, the levels side by side; drawn when first asked for.

    Every level carries its first row and column again at its end, so that interpolation wraps.
    """
    sides = [SIDE >> level for level in range(LEVELS)]
    rows = []
    for kind, count in KINDS.items():
        for number in range(count):
            rng = np.random.default_rng([_SEED, sum(kind.encode()), number])
            rows.append(_with_levels(_PAINTERS[kind](rng), sides))
    return np.concatenate(rows)


def _with_levels(tile: Tile, sides: list[int]) -> Tile:
    """(256, 256) → (257, sum of all levels' sides + 1), finest level first."""
    row = np.zeros((SIDE + 1, sum(sides) + len(sides)), np.float32)
    start = 0
    for side in sides:
        small = cv2.resize(tile, (side, side), interpolation=cv2.INTER_AREA)
        row[: side + 1, start : start + side + 1] = np.pad(small, ((0, 1), (0, 1)), mode="wrap")
        start += side + 1
    return row


def _spectrum(rng: np.random.Generator, slope: float, stretch: float = 1.0) -> Tile:
    """Noise whose amplitude falls with frequency to the power −`slope`; values spread over 0 … 1.

    `stretch` above 1 draws it out along v.
    """
    frequency = np.fft.fftfreq(SIDE) * SIDE
    radius = np.hypot(frequency[:, None] * stretch, frequency[None, :])
    radius[0, 0] = np.inf
    wave = np.fft.fft2(rng.standard_normal((SIDE, SIDE))) * np.maximum(radius, 1) ** -slope
    values = np.fft.ifft2(wave).real
    values = (values - values.mean()) / (values.std() + 1e-9)
    return np.asarray(1 / (1 + np.exp(-1.6 * values)), np.float32)


def _noise(rng: np.random.Generator) -> Tile:
    return _spectrum(rng, rng.uniform(0.3, 1.8), rng.choice([1.0, 1.0, 0.4, 2.5]))


def _asphalt(rng: np.random.Generator) -> Tile:
    grain, stains = _spectrum(rng, rng.uniform(0.1, 0.5)), _spectrum(rng, 1.4)
    tile = 0.65 * grain + 0.35 * stains
    for _ in range(rng.integers(0, 6)):  # cracks
        _crack(rng, tile)
    return np.clip(tile, 0, 1)


def _crack(rng: np.random.Generator, tile: Tile) -> None:
    steps = rng.normal(0, 0.35, 60).cumsum() + rng.uniform(0, 2 * np.pi)
    points = rng.uniform(0, SIDE, 2) + 5 * np.cumsum([np.cos(steps), np.sin(steps)], 1).T
    cv2.polylines(tile, [np.mod(points, SIDE).astype(np.int32)[:20]], False, 0.1, 1, cv2.LINE_AA)


def _grass(rng: np.random.Generator) -> Tile:
    return np.clip(0.6 * _spectrum(rng, 0.4, 0.5) + 0.4 * _spectrum(rng, 1.1), 0, 1)


def _leaves(rng: np.random.Generator) -> Tile:
    """Overlapping small blots of different brightness."""
    tile = 0.3 * _spectrum(rng, 1.0)
    count, size = int(rng.integers(250, 900)), rng.uniform(4, 11)
    places, turns = rng.uniform(0, SIDE, (count, 2)), rng.uniform(0, 180, count)
    lights = rng.uniform(0.05, 1.0, count)
    for (x, y), turn, light in zip(places.astype(int), turns, lights, strict=True):
        cv2.ellipse(
            tile, (int(x), int(y)), (int(size), int(size / 2) + 1), turn, 0, 360, float(light), -1
        )
    return tile


def _brick(rng: np.random.Generator) -> Tile:
    rows, columns = int(rng.choice([8, 16, 32])), int(rng.choice([4, 8, 16]))
    height, width = SIDE // rows, SIDE // columns
    tile = np.empty((SIDE, SIDE), np.float32)
    shades = rng.uniform(0.3, 1.0, (rows, columns))
    for row in range(rows):
        line = np.repeat(shades[row], width)
        shifted = np.roll(line, (row % 2) * width // 2)
        tile[row * height : (row + 1) * height] = shifted
        seams = (np.arange(columns) * width + (row % 2) * width // 2) % SIDE
        tile[row * height : (row + 1) * height, seams] = 0.05
        tile[row * height] = 0.05
    return np.clip(0.75 * tile + 0.25 * _spectrum(rng, 0.6), 0, 1)


def _windows(rng: np.random.Generator) -> Tile:
    """One to four windows with frames; the wall is dark, the panes are bright values."""
    tile = 0.25 * _spectrum(rng, rng.uniform(0.2, 1.2))
    columns, rows = int(rng.choice([1, 2, 2, 4])), int(rng.choice([1, 2, 2, 4]))
    cell_w, cell_h = SIDE // columns, SIDE // rows
    width, height = rng.uniform(0.35, 0.8) * cell_w, rng.uniform(0.4, 0.8) * cell_h
    for row in range(rows):
        for column in range(columns):
            x, y = column * cell_w + (cell_w - width) / 2, row * cell_h + (cell_h - height) / 2
            _window(rng, tile, (int(x), int(y)), (int(width), int(height)))
    if rng.random() < 0.4:  # a ledge between the storeys
        tile[: int(rng.integers(4, 14))] = rng.uniform(0.0, 0.5)
    return tile


def _window(
    rng: np.random.Generator, tile: Tile, corner: tuple[int, int], size: tuple[int, int]
) -> None:
    (x, y), (w, h) = corner, size
    frame = float(rng.uniform(0.0, 0.5))
    cv2.rectangle(tile, (x - 4, y - 4), (x + w + 4, y + h + 4), frame, -1)
    pane = np.linspace(rng.uniform(0.6, 1), rng.uniform(0.6, 1), h)[:, None]
    tile[y : y + h, x : x + w] = pane
    if rng.random() < 0.7:
        tile[y : y + h, x + w // 2 - 2 : x + w // 2 + 2] = frame
    if rng.random() < 0.5:
        tile[y + h // 3 - 2 : y + h // 3 + 2, x : x + w] = frame
    if rng.random() < 0.3:  # a curtain or a blind
        tile[y : y + int(h * rng.uniform(0.2, 0.9)), x : x + w] = rng.uniform(0.3, 0.8)


def _panels(rng: np.random.Generator) -> Tile:
    """Large plates with thin seams."""
    count = int(rng.choice([2, 4, 8]))
    shades = rng.uniform(0.35, 0.75, (count, count)).astype(np.float32)
    tile = np.kron(shades, np.ones((SIDE // count, SIDE // count), np.float32))
    tile[:: SIDE // count] = tile[:, :: SIDE // count] = 0.0
    return np.clip(0.8 * tile + 0.2 * _spectrum(rng, 0.9), 0, 1)


def _print(rng: np.random.Generator) -> Tile:
    """Shapes as on posters, signs and lorries."""
    tile = np.full((SIDE, SIDE), rng.uniform(0, 1), np.float32)
    for _ in range(int(rng.integers(4, 30))):
        x, y = (int(value) for value in rng.uniform(0, SIDE, 2))
        w, h = (int(value) for value in rng.uniform(6, 110, 2))
        shade = float(rng.uniform(0, 1))
        if rng.random() < 0.6:
            cv2.rectangle(tile, (x, y), (x + w, y + h), shade, -1)
        else:
            cv2.ellipse(tile, (x, y), (w // 2, h // 2), rng.uniform(0, 180), 0, 360, shade, -1)
    return tile


def _stripes(rng: np.random.Generator) -> Tile:
    count = int(rng.choice([4, 8, 16, 32]))
    line = (np.arange(SIDE) * count // SIDE % 2).astype(np.float32)
    tile = np.tile(line, (SIDE, 1))
    return np.clip(0.85 * (tile if rng.random() < 0.5 else tile.T) + 0.15 * _spectrum(rng, 1), 0, 1)


_PAINTERS = {
    "noise": _noise,
    "asphalt": _asphalt,
    "grass": _grass,
    "leaves": _leaves,
    "brick": _brick,
    "windows": _windows,
    "panels": _panels,
    "print": _print,
    "stripes": _stripes,
}
