"""From disparity to metres: camera calibrations and point clouds."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from .data.images import Bytes, Disparity
from .errors import Rts2Error, UsageError
from .files import existing_file, write_bytes

NEAREST_TO_INFINITY_PX: Final = 1.0
"""Below this disparity an error of one pixel leaves no depth: the cloud omits such points."""

_FIELDS: Final = (
    ("x", "<f4"),
    ("y", "<f4"),
    ("z", "<f4"),
    ("red", "u1"),
    ("green", "u1"),
    ("blue", "u1"),
)
_POINT: Final = np.dtype(list(_FIELDS))
"""A point of a cloud, as PLY stores it."""

_KITTI_PAIRS: Final = {"P_rect_02": "P_rect_03", "P2": "P3"}
"""The projections of the left and the right colour camera, in the raw data and in benchmarks."""

_KITTI_SIZE: Final = "S_rect_02"
"""The size of the left camera's rectified images, which only the raw data name."""


@dataclass(frozen=True)
class Calibration:
    """What turns disparity into metres: a rectified pair of pinhole cameras."""

    focal_px: float
    baseline_m: float
    centre_px: tuple[float, float] | None = None
    """The left camera's principal point (x, y); None is the middle of the image."""
    offset_px: float = 0.0
    """The right principal point's x less the left one's; it is added to every disparity."""
    size: tuple[int, int] | None = None
    """(width, height) of the images it holds for, where that is known."""

    def require_fits(self, size: tuple[int, int]) -> None:
        """Raises `UsageError` where it belongs to images of another size."""
        if self.size is not None and self.size != size:
            own, given = ("{}x{}".format(*sides) for sides in (self.size, size))
            raise UsageError(
                f"the calibration must fit the images: it is for {own}, they are {given}; "
                "give the calibration of these images"
            )


def cloud(disparity: Disparity, image: Bytes, calibration: Calibration) -> NDArray[Any]:
    """The points of one image as records x, y, z (metres) and red, green, blue.

    x points right, y down, z away from the left camera; z is focal · baseline / (disparity +
    offset). Points of less than 1 px are left out. Raises `UsageError` as
    `Calibration.require_fits` does.
    """
    height, width = disparity.shape
    calibration.require_fits((width, height))
    shifted = np.where(np.isfinite(disparity), disparity, 0) + calibration.offset_px
    rows, columns = np.nonzero(shifted >= NEAREST_TO_INFINITY_PX)
    centre_x, centre_y = calibration.centre_px or ((width - 1) / 2, (height - 1) / 2)
    per_pixel = calibration.baseline_m / shifted[rows, columns]
    points = np.empty(len(rows), _POINT)
    points["x"] = (columns - centre_x) * per_pixel
    points["y"] = (rows - centre_y) * per_pixel
    points["z"] = calibration.focal_px * per_pixel
    for channel, name in enumerate(("red", "green", "blue")):
        points[name] = image[rows, columns, channel]
    return points


def write_cloud(path: Path, points: NDArray[Any]) -> None:
    """Writes the records of `cloud` as a binary little-endian PLY file."""
    kinds = {"<f4": "float", "u1": "uchar"}
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment metres; x right, y down, z away from the left camera",
        f"element vertex {len(points)}",
        *(f"property {kinds[kind]} {name}" for name, kind in _FIELDS),
        "end_header\n",
    ]
    write_bytes(path, "\n".join(header).encode() + points.astype(_POINT).tobytes())


def read_calibration(path: Path) -> Calibration:
    """A Middlebury `calib.txt`, or a KITTI calibration with the colour cameras' projections.

    Raises:
        UsageError: there is no such file.
        Rts2Error: it is neither, or a number in it is wrong.
    """
    try:
        text = existing_file(path, "a calibration").read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise Rts2Error(f"a calibration must be text: {path}: {error}") from error
    lines = (re.split(r"\s*[=:]\s*", line.strip(), maxsplit=1) for line in text.splitlines())
    entries = {parts[0]: parts[1] for parts in lines if len(parts) == 2}
    if "cam0" in entries:
        calibration = _middlebury(entries, path)
    elif _KITTI_PAIRS.keys() & entries.keys():
        calibration = _kitti(entries, path)
    else:
        raise Rts2Error(
            f"{path} must be a Middlebury calib.txt (cam0=…) or a KITTI calibration "
            "(P_rect_02: or P2: …); give one, or --focal and --baseline"
        )
    if not (calibration.focal_px > 0 and calibration.baseline_m > 0):
        raise Rts2Error(
            f"{path}: focal length and baseline must be above 0: "
            f"{calibration.focal_px:g} px, {calibration.baseline_m:g} m"
        )
    return calibration


def _middlebury(entries: dict[str, str], path: Path) -> Calibration:
    """cam0 is [f 0 cx; 0 f cy; 0 0 1]; the baseline is in millimetres."""
    camera = _numbers(entries, "cam0", 9, path)
    sized = "width" in entries and "height" in entries
    sides = [int(_numbers(entries, side, 1, path)[0]) for side in ("width", "height") if sized]
    return Calibration(
        focal_px=camera[0],
        baseline_m=_numbers(entries, "baseline", 1, path)[0] / 1000,
        centre_px=(camera[2], camera[5]),
        offset_px=_numbers(entries, "doffs", 1, path)[0] if "doffs" in entries else 0.0,
        size=(sides[0], sides[1]) if sized else None,
    )


def _kitti(entries: dict[str, str], path: Path) -> Calibration:
    """Projections are 3×4 by rows: the last column of the first is −focal · distance."""
    name = next(name for name in _KITTI_PAIRS if name in entries)
    left = _numbers(entries, name, 12, path)
    right = _numbers(entries, _KITTI_PAIRS[name], 12, path)
    focal = left[0]
    sides = _numbers(entries, _KITTI_SIZE, 2, path) if _KITTI_SIZE in entries else None
    return Calibration(
        focal_px=focal,
        baseline_m=(left[3] - right[3]) / focal if focal > 0 else 0.0,
        centre_px=(left[2], left[6]),
        offset_px=right[2] - left[2],
        size=None if sides is None else (int(sides[0]), int(sides[1])),
    )


def _numbers(entries: dict[str, str], name: str, count: int, path: Path) -> list[float]:
    parts = re.split(r"[\s;]+", entries.get(name, "").strip("[] \t"))
    try:
        numbers = [float(part) for part in parts if part]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(np.isfinite(numbers)):
        raise Rts2Error(f"{path}: {name} must be {count} finite numbers, not {entries.get(name)!r}")
    return numbers
