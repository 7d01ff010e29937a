"""PFM, the float maps of SceneFlow and Middlebury."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

import numpy as np

from ..errors import Rts2Error
from ..files import existing_file
from .images import Disparity

HEADER: Final = re.compile(
    rb"(P[Ff])\s+(\d{1,6})\s+(\d{1,6})\s+([-+]?[0-9.]+(?:e[-+]?\d+)?)[ \t\r]*\n"
)
"""Kind, width, height, and a scale whose sign tells the byte order."""


def read_pfm(path: Path) -> Disparity:
    """A PFM of one channel: (H, W), the top row first, NaN where it holds no finite number.

    The file begins with the bottom row. A negative scale means little endian; its size is only a
    hint for display, and no factor.

    Raises:
        UsageError: there is no such file.
        Rts2Error: it is no such PFM, or a truncated one.
    """
    try:
        data = existing_file(path, "a PFM").read_bytes()
    except OSError as error:
        raise Rts2Error(f"{path} cannot be read: {error.strerror or error}") from error
    match = HEADER.match(data)
    if match is None:
        raise Rts2Error(f"{path} is no PFM: its header must be Pf, width, height, scale")
    kind, width, height, scale = match.groups()
    shape, factor = (int(height), int(width)), _scale(scale, path)
    if kind != b"Pf":
        raise Rts2Error(f"{path} must be a PFM of one channel (Pf); it has three (PF)")
    given, wanted = len(data) - match.end(), 4 * shape[0] * shape[1]
    if given != wanted or not wanted:
        raise Rts2Error(
            f"{path} is truncated or no PFM: {shape[1]}x{shape[0]} takes {wanted} bytes after the "
            f"header, found {given}"
        )
    stored = np.frombuffer(data, "<f4" if factor < 0 else ">f4", offset=match.end())
    values = stored.reshape(shape)[::-1].astype(np.float32)
    return np.where(np.isfinite(values), values, np.float32(np.nan))


def read_pfm_disparity(path: Path) -> Disparity:
    """A PFM of disparities of the left image: in pixels, NaN where nothing is known."""
    return require_disparity(read_pfm(path), path)


def require_disparity(values: Disparity, path: Path) -> Disparity:
    """The values, if none is negative: that would be another sign, or the right image's map."""
    lowest = np.fmin.reduce(values, axis=None, initial=np.inf)
    if lowest < 0:
        raise Rts2Error(
            f"disparities of the left image must be 0 or more, left minus right column: "
            f"{path} holds {lowest:.3f}"
        )
    return values


def _scale(text: bytes, path: Path) -> float:
    try:
        scale = float(text)
    except ValueError:
        scale = 0.0
    if not scale:
        raise Rts2Error(f"{path} is no PFM: its scale must be a number other than 0")
    return scale
