"""What surfaces look like: two colours mixed by a pattern, with a finer grain on top."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .textures import patterns

Colour = tuple[float, float, float]
Shades = Sequence[float] | NDArray[Any]
"""Three reflectances."""


@dataclass(frozen=True)
class Paint:
    """One material. Colours are linear RGB reflectances, sizes are metres per tile."""

    first: Colour
    second: Colour
    pattern: int
    tile_m: float
    grain: int
    grain_m: float
    grain_strength: float
    gloss: float = 0.0
    """The share of light that is mirrored: glass and lacquer."""
    glow: float = 0.0
    """Light of its own: lamps."""


TABLE = np.dtype(
    [
        ("first", np.float64, 3),
        ("second", np.float64, 3),
        ("pattern", np.int64),
        ("tiles_per_m", np.float64),
        ("grain", np.int64),
        ("grains_per_m", np.float64),
        ("grain_strength", np.float64),
        ("gloss", np.float64),
        ("glow", np.float64),
    ]
)


def table(paints: Sequence[Paint]) -> NDArray[np.void]:
    """All paints as rows of `TABLE`."""
    rows = [
        (
            p.first, p.second, p.pattern, 1 / p.tile_m, p.grain, 1 / p.grain_m, p.grain_strength,
            p.gloss, p.glow,
        )
        for p in paints
    ]  # fmt: skip
    return np.array(rows, TABLE)


def coat(
    rng: np.random.Generator,
    colour: Shades,
    kind: str = "noise",
    tile_m: float = 1.5,
    contrast: float = 0.35,
    grain: float = 0.25,
    gloss: float = 0.0,
    second: Shades | None = None,
) -> Paint:
    """A paint around `colour`: its pattern varies the brightness by about `contrast`.

    `second` gives the pattern a colour of its own instead.
    """
    chance = rng.random(8).tolist()
    base = [_within(value * (0.8 + 0.4 * at)) for value, at in zip(colour, chance[:3], strict=True)]
    low, high = 1 - contrast * (0.5 + 0.5 * chance[3]), 1 + contrast * (0.5 + 0.5 * chance[4])
    first = [low * value for value in base] if second is None else base
    other = [high * value for value in base] if second is None else second
    spread, turn = rng.standard_normal(2).tolist()
    pattern, grains = patterns(kind), patterns("noise")
    return Paint(
        first=_colour(first),
        second=_colour(other),
        pattern=pattern[int(chance[5] * len(pattern))],
        tile_m=tile_m * math.exp(0.3 * spread),
        grain=grains[int(chance[6] * len(grains))],
        grain_m=0.8 * math.exp(max(-1.2, min(1.2, turn))),
        grain_strength=grain * (0.3 + 1.3 * chance[7]),
        gloss=gloss,
    )


def plain(rng: np.random.Generator, colour: Shades, gloss: float = 0.0) -> Paint:
    """Nearly one colour."""
    return coat(rng, colour, contrast=0.08, grain=0.08, gloss=gloss)


def lamp(rng: np.random.Generator, colour: Shades, glow: float) -> Paint:
    """Something that shines by itself."""
    return replace(plain(rng, colour), glow=glow)


def any_colour(rng: np.random.Generator, dull: float = 0.0) -> NDArray[np.float64]:
    """A random reflectance; `dull` draws it towards grey."""
    colour = rng.uniform(0.03, 0.8, 3)
    return np.asarray((1 - dull) * colour + dull * colour.mean())


def _within(value: float) -> float:
    return min(0.95, max(0.01, value))


def _colour(values: Shades) -> Colour:
    red, green, blue = (_within(float(value)) for value in values)
    return red, green, blue
