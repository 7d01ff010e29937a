"""Disparity maps of two networks side by side, as pictures inside a page."""

from __future__ import annotations

import io
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, sqrt
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ..model.data.images import Bytes, Disparity
from ..model.metrics import disparity_score
from ..model.pictures import BRIGHTEST, coloured

WIDEST_PX: Final = 3.0
"""Differences of so many pixels, and larger ones, have the strongest colour."""

NEAR_PX, FAR_PX = 1.0, 3.0
"""How many pixels lie farther apart than each of these is told."""

AREAS: Final = (250_000, 120_000, 60_000, 30_000, 10_000)
"""The pixels of a picture: the first that keeps all of them small enough."""

SMALLEST_PX: Final = 1e-6


@dataclass(frozen=True, eq=False)
class Example:
    """One pair, and what the float and the quantized network say of it."""

    name: str
    left: Bytes
    """(H, W, 3) RGB."""
    reference: Disparity
    """(H, W) in pixels, as the two below; NaN where nothing is known."""
    quantized: Disparity
    truth: Disparity | None


@dataclass(frozen=True)
class Figures:
    """How good both are, and how far apart; None where nothing is known."""

    d1_all: tuple[float | None, float | None]
    """In percent, of the float and of the quantized network; `epe` in pixels."""
    epe: tuple[float | None, float | None]
    mean_px: float | None
    """The mean distance of the two."""
    near: float | None
    """The share of the pixels that lie farther apart than `NEAR_PX`, in percent."""
    far: float | None


@dataclass(frozen=True)
class Shown:
    """One example as pictures, each a `data:` address."""

    name: str
    left: str
    reference: str
    quantized: str
    difference: str
    truth: str | None
    highest_px: int
    """The end of the one colour scale of all disparity maps of this example."""
    size: tuple[int, int]
    """Width and height of each picture."""
    figures: Figures

    @property
    def chars(self) -> int:
        pictures = self.left, self.reference, self.quantized, self.difference, self.truth or ""
        return sum(map(len, pictures))


def shown(examples: Sequence[Example], most_chars: int) -> list[Shown]:
    """The examples at the largest of `AREAS` at which all pictures fit into `most_chars`."""
    made: list[Shown] = []
    for area in AREAS:
        made = [_shown(example, area) for example in examples]
        if sum(each.chars for each in made) <= most_chars:
            break
    return made


def figures(example: Example) -> Figures:
    """Of all pixels that both networks, or a network and the truth, know."""
    apart = np.abs(_difference(example))
    known = apart[np.isfinite(apart)]
    truth = np.full_like(example.reference, np.nan) if example.truth is None else example.truth
    reference, quantized = (
        disparity_score(each, truth) for each in (example.reference, example.quantized)
    )
    return Figures(
        d1_all=(reference.d1_all, quantized.d1_all),
        epe=(reference.epe, quantized.epe),
        mean_px=float(known.mean()) if known.size else None,
        near=float(100 * np.mean(known > NEAR_PX)) if known.size else None,
        far=float(100 * np.mean(known > FAR_PX)) if known.size else None,
    )


def signed(difference: Disparity) -> Bytes:
    """(H, W) in pixels → (H, W, 3) RGB: blue below 0, white at it, red above; unknown black."""
    from matplotlib import colormaps

    known = np.isfinite(difference)
    share = np.where(known, difference, 0) / (2 * WIDEST_PX) + 0.5
    colours = colormaps["RdBu_r"](share.clip(0, 1), bytes=True)[..., :3]
    painted: Bytes = np.where(known[..., None], colours, 0).astype(np.uint8)
    return painted


def scales() -> tuple[str, str]:
    """The colours of disparities, from 0 to the highest, and those of differences."""
    ramp = np.linspace(0, 1, 256, dtype=np.float32)[None]
    return _png(coloured(ramp, 1.0)), _png(signed((2 * ramp - 1) * WIDEST_PX))


def reduced(disparity: Disparity, size: tuple[int, int]) -> Disparity:
    """The map at `size` (W, H): each pixel is the mean of the known ones that it covers."""
    known = np.isfinite(disparity)
    total = _resized(np.where(known, disparity, 0).astype(np.float32), size)
    share = _resized(known.astype(np.float32), size)
    mean = np.full(total.shape, np.nan, np.float32)
    np.divide(total, share, out=mean, where=share > SMALLEST_PX)
    return mean


def _shown(example: Example, area: int) -> Shown:
    size = _size(example.reference.shape, area)
    highest = _highest(example.reference)

    def disparity(values: Disparity) -> str:
        return _png(coloured(reduced(values, size), highest))

    return Shown(
        name=example.name,
        left=_photograph(_resized(example.left, size).astype(np.uint8)),
        reference=disparity(example.reference),
        quantized=disparity(example.quantized),
        difference=_png(signed(reduced(_difference(example), size))),
        truth=None if example.truth is None else disparity(example.truth),
        highest_px=highest,
        size=size,
        figures=figures(example),
    )


def _difference(example: Example) -> Disparity:
    """Quantized minus float; NaN where either is not finite."""
    return _finite(example.quantized) - _finite(example.reference)


def _finite(disparity: Disparity) -> Disparity:
    return np.where(np.isfinite(disparity), disparity, np.nan).astype(np.float32)


def _highest(disparity: Disparity) -> int:
    """Where the colour scale ends: a round number that almost all of the map lies below."""
    known = disparity[np.isfinite(disparity)]
    highest = float(np.percentile(known, BRIGHTEST)) if known.size else 0.0
    step = 10 if highest > 10 else 1
    return max(step * ceil(highest / step), 1)


def _size(shape: tuple[int, ...], area: int) -> tuple[int, int]:
    """Width and height of a picture of no more than `area` pixels, and never larger than it is."""
    height, width = shape
    share = min(1.0, sqrt(area / (height * width)))
    return max(1, int(width * share)), max(1, int(height * share))


def _resized(image: Bytes | Disparity, size: tuple[int, int]) -> NDArray[Any]:
    """Each pixel is the mean of those that it covers."""
    import cv2

    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def _png(image: Bytes) -> str:
    return _address(image, "PNG", optimize=True)


def _photograph(image: Bytes) -> str:
    """JPEG: a tenth of what a photograph takes as PNG."""
    return _address(image, "JPEG", quality=85)


def _address(image: Bytes, form: str, **options: object) -> str:
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(image).save(stream, form, **options)
    return f"data:image/{form.lower()};base64,{b64encode(stream.getvalue()).decode()}"
