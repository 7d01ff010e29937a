"""The stereo pairs that two image files or two folders of them make."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from .data.images import image_size, require_same_size
from .data.layout import IMAGES, images_of
from .errors import UsageError

SMALLEST_PX: Final = 32
"""Below this an image has no feature at 1/32."""


@dataclass(frozen=True)
class Pair:
    """Two image files of one size."""

    name: str
    left: Path
    right: Path
    size: tuple[int, int]
    """Width and height."""


def pairs_of(left: Path, right: Path) -> list[Pair]:
    """The pairs that two images or two folders make, each of one size.

    Raises:
        UsageError: one is a folder and the other is not, an image lacks its partner or differs from
            it in size, or there is none at all.
        Rts2Error: a file is no image.
    """
    if left.is_dir() != right.is_dir():
        folder, other = (left, right) if left.is_dir() else (right, left)
        raise UsageError(
            f"LEFT and RIGHT must be two images or two folders: {folder} is a folder, "
            f"{other} is not"
        )
    names = [(left, right)] if not left.is_dir() else _partners(left, right)
    return [_pair(a, b) for a, b in names]


def require_large_enough(size: tuple[int, int], what: object) -> None:
    """Raises `UsageError` for images (width, height) too small for any network."""
    if min(size) < SMALLEST_PX:
        given = "{}x{}".format(*size)
        raise UsageError(f"images need sides of {SMALLEST_PX} pixels or more: {what} is {given}")


def _pair(left: Path, right: Path) -> Pair:
    size = require_same_size({left: image_size(left), right: image_size(right)})
    require_large_enough(size, left)
    return Pair(left.stem, left, right, size)


def _partners(left: Path, right: Path) -> list[tuple[Path, Path]]:
    """The equally named images of two folders; one without partner is an error."""
    found = [images_of(folder) for folder in (left, right)]
    for folder, images, others in ((right, found[1], found[0]), (left, found[0], found[1])):
        lacking = sorted(others.keys() - images.keys())
        if lacking:
            raise UsageError(
                f"every image needs a partner of its name: {folder} has no {lacking[0]} "
                f"({len(others)} images against {len(images)})"
            )
    if not found[0]:
        raise UsageError(f"a folder must hold images ({', '.join(IMAGES)}); {left} holds none")
    return [(found[0][stem], found[1][stem]) for stem in sorted(found[0])]
