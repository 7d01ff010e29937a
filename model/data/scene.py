"""What every data set yields: samples that can be read, and the scenes that they hold."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import Rts2Error, UsageError
from .images import Bytes, Disparity

Foreground = Literal["obj_map", "instance"]
"""What tells foreground from background: an object map, or the numbered instances."""


@dataclass(frozen=True, eq=False)
class Scene:
    """One rectified pair with what is known of it; every array has the same H and W."""

    name: str
    left: Bytes
    """(H, W, 3), RGB; so is `right`."""
    right: Bytes
    truth: Disparity
    """Of the left image, hidden pixels included where the data set knows them; NaN elsewhere."""
    foreground: NDArray[np.bool_] | None = None
    semantic: Bytes | None = None
    """(H, W), train ids; 255 is unlabelled."""
    visible: NDArray[np.bool_] | None = None
    """Where the right image sees what the left one shows."""
    instances: NDArray[np.int32] | None = None
    """(H, W), a number for each object of its own, 0 for what is none."""

    def __post_init__(self) -> None:
        sizes = {name: _size(array) for name, array in self.arrays().items()}
        if len(set(sizes.values())) > 1:
            listed = ", ".join(
                f"{name} {width}x{height}" for name, (width, height) in sizes.items()
            )
            raise Rts2Error(f"{self.name}: all images of a scene must have one size: {listed}")

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return _size(self.left)

    def crop(self, left: int, top: int, width: int, height: int) -> Scene:
        """The part of every image that begins at (`left`, `top`)."""
        rows, columns = slice(top, top + height), slice(left, left + width)
        part: dict[str, Any] = {n: array[rows, columns] for n, array in self.arrays().items()}
        return replace(self, **part)

    def bottom_right(self, width: int, height: int) -> Scene:
        """The bottom-right corner of every image, the crop that AnyNet's protocol uses."""
        whole = self.size
        require_crop_fits((width, height), whole, self.name)
        return self.crop(whole[0] - width, whole[1] - height, width, height)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The images and maps that there are, by field."""
        named = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in named.items() if isinstance(value, np.ndarray)}


class Sample(Protocol):
    """One pair of a data set, not read yet."""

    @property
    def name(self) -> str: ...

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the images."""

    @property
    def foreground(self) -> Foreground | None:
        """What the scene's foreground rests on."""

    def read(self) -> Scene:
        """The images and what is known of them."""


def fingerprint(thing: object) -> str | None:
    """What a sample or a data set says it depends on; None where it says nothing."""
    told = getattr(thing, "fingerprint", None)
    return None if told is None else str(told)


def require_crop_fits(crop: tuple[int, int], size: tuple[int, int], name: str) -> None:
    """Raises `UsageError` where a crop (width, height) is larger than the image."""
    if crop[0] > size[0] or crop[1] > size[1]:
        raise UsageError(
            f"the crop must lie within every image: {crop[0]}x{crop[1]} does not fit in "
            f"{name} of {size[0]}x{size[1]}; give a smaller --crop"
        )


def _size(array: NDArray[Any]) -> tuple[int, int]:
    return array.shape[1], array.shape[0]
