"""Scan conversion: which triangle each pixel sees, and what stands before given points.

All of it happens in homogeneous coordinates of a plane of cells, whether they are an eye's pixels
or cells of a plane across the sunlight: a corner is (x·w, y·w, w), so that triangles reach behind
the viewer without being cut (Olano and Greer, "Triangle Scan Conversion using 2D Homogeneous
Coordinates", 1997). Points between the pixels are sorted into cells and tested one by one, which
makes shadows and occlusion as exact as rays (Johnson et al., "The Irregular Z-Buffer", 2005).

Edges are evaluated in double precision and are each other's exact negative on both sides of a
seam: no pixel falls between two triangles.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Doubles = NDArray[np.float64]
Row = tuple[tuple[float, float, float, float], tuple[float, float, float, float]]

BEHIND = 1e-3
"""A corner with less than this w counts as behind the viewer."""


@njit(cache=True)
def nearest(
    corners: Doubles, near: Doubles, width: int, height: int
) -> tuple[NDArray[np.int32], Doubles]:
    """Which of the triangles (n, 3, 3) each pixel shows, −1 for none, and how near it is there.

    `near` (n, 3) holds nearness × w at the corners: 1 gives 1 / w, which is 0 where nothing is.
    """
    which = np.full((height, width), -1, np.int32)
    nearness = np.zeros((height, width))
    lines = np.empty((4, 3))
    for number in range(len(corners)):
        corner = corners[number]
        if not _lines(corner, near[number], lines):
            continue
        first, last, top, bottom = _bounds(corner, width, height)
        for y in range(top, bottom + 1):
            start, end = _span(lines, y, first, last)
            row = _row(lines, y)
            for x in range(start, end + 1):
                value = _within(row, x)
                if value > nearness[y, x]:
                    nearness[y, x] = value
                    which[y, x] = number
    return which, nearness


@njit(cache=True)
def covered(
    corners: Doubles,
    near: Doubles,
    points: Doubles,
    width: int,
    height: int,
) -> NDArray[np.bool_]:
    """Which of the points (m, 3) have a triangle (n, 3, 3) before them.

    A point is its place (x, y), 0 … `width` and 0 … `height`, and the nearness above which a
    triangle is before it.
    """
    starts, order = _sorted(points, width, height)
    ends = starts[1:].copy()
    waiting = points[order]
    lowest = _lowest(waiting, starts)
    found = np.zeros(len(points), np.bool_)
    lines, wide = np.empty((4, 3)), np.empty((4, 3))
    for number in range(len(corners)):
        if not _lines(corners[number], near[number], lines):
            continue
        _widen(lines, wide)
        first, last, top, bottom = _bounds(corners[number], width, height)
        for y in range(max(top - 1, 0), bottom + 1):
            start, end = _span(wide, y, max(first - 1, 0), last)
            slope, rest = wide[3, 0], wide[3, 1] * y + wide[3, 2]
            for x in range(start, end + 1):
                cell = y * width + x
                if slope * x + rest > lowest[cell]:
                    ends[cell] = _settle(lines, waiting, order, starts[cell], ends[cell], found)
    return found


@njit(cache=True)
def _settle(
    lines: Doubles,
    waiting: Doubles,
    order: NDArray[np.int64],
    start: int,
    end: int,
    found: NDArray[np.bool_],
) -> int:
    """Marks a cell's points that the triangle covers and takes them from those that wait.

    They wait at `start` … `end`; returns the new end.
    """
    i = start
    while i < end:
        if _within(_row(lines, waiting[i, 1]), waiting[i, 0]) > waiting[i, 2]:
            found[order[i]] = True
            end -= 1
            order[i] = order[end]
            for j in range(3):
                waiting[i, j] = waiting[end, j]
        else:
            i += 1
    return end


@njit(cache=True)
def _lines(corner: Doubles, near: Doubles, lines: Doubles) -> bool:
    """Fills `lines` (4, 3) with functions of (x, y, 1): three edges, and the nearness.

    The edges are positive within the triangle. False where it is seen edge-on.
    """
    for i in range(3):
        p, q = (i + 1) % 3, (i + 2) % 3
        lines[i, 0] = corner[p, 1] * corner[q, 2] - corner[p, 2] * corner[q, 1]
        lines[i, 1] = corner[p, 2] * corner[q, 0] - corner[p, 0] * corner[q, 2]
        lines[i, 2] = corner[p, 0] * corner[q, 1] - corner[p, 1] * corner[q, 0]
    volume = corner[0, 0] * lines[0, 0] + corner[0, 1] * lines[0, 1] + corner[0, 2] * lines[0, 2]
    if volume == 0.0:
        return False
    for j in range(3):
        total = near[0] * lines[0, j] + near[1] * lines[1, j] + near[2] * lines[2, j]
        lines[3, j] = total / volume
        if volume < 0:
            for i in range(3):
                lines[i, j] = -lines[i, j]
    return True


@njit(cache=True)
def _row(lines: Doubles, y: float) -> Row:
    """The four functions on one row: their slopes along x, and their values at x = 0."""
    return (
        (lines[0, 0], lines[1, 0], lines[2, 0], lines[3, 0]),
        (
            lines[0, 1] * y + lines[0, 2],
            lines[1, 1] * y + lines[1, 2],
            lines[2, 1] * y + lines[2, 2],
            lines[3, 1] * y + lines[3, 2],
        ),
    )


@njit(cache=True)
def _within(row: Row, x: float) -> float:
    """The triangle's nearness at a place of a row, −∞ outside of it."""
    slope, rest = row
    if slope[0] * x + rest[0] < 0 or slope[1] * x + rest[1] < 0 or slope[2] * x + rest[2] < 0:
        return -np.inf
    return slope[3] * x + rest[3]


@njit(cache=True)
def _bounds(corner: Doubles, width: int, height: int) -> tuple[int, int, int, int]:
    """First and last column, first and last row that the triangle may touch."""
    left, right = float(width), -1.0
    top, bottom = float(height), -1.0
    for i in range(3):
        if corner[i, 2] < BEHIND:
            return 0, width - 1, 0, height - 1
        x, y = corner[i, 0] / corner[i, 2], corner[i, 1] / corner[i, 2]
        left, right = min(left, x), max(right, x)
        top, bottom = min(top, y), max(bottom, y)
    slack = 1e-6
    return (
        int(max(np.ceil(left - slack), 0)),
        int(min(np.floor(right + slack), width - 1)),
        int(max(np.ceil(top - slack), 0)),
        int(min(np.floor(bottom + slack), height - 1)),
    )


@njit(cache=True)
def _span(lines: Doubles, y: int, first: int, last: int) -> tuple[int, int]:
    """The columns of a row between which the edges may all be positive; one too many at most."""
    start, end = float(first), float(last)
    for i in range(3):
        slope, rest = lines[i, 0], lines[i, 1] * y + lines[i, 2]
        if slope > 0:
            start = max(start, np.floor(-rest / slope))
        elif slope < 0:
            end = min(end, np.ceil(-rest / slope))
        elif rest < 0:
            return 0, -1
    return int(min(start, last + 1.0)), int(max(end, first - 1.0))


@njit(cache=True)
def _widen(lines: Doubles, wide: Doubles) -> None:
    """The same functions, at the corner of a cell (x … x + 1, y … y + 1) where each is largest."""
    for i in range(4):
        wide[i, 0], wide[i, 1] = lines[i, 0], lines[i, 1]
        wide[i, 2] = lines[i, 2] + max(lines[i, 0], 0.0) + max(lines[i, 1], 0.0)


@njit(cache=True)
def _sorted(
    points: Doubles, width: int, height: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Where each cell's points start in an order by cells, (cells + 1,), and that order, (m,)."""
    cells = np.empty(len(points), np.int64)
    starts = np.zeros(width * height + 1, np.int64)
    for i in range(len(points)):
        x, y = int(points[i, 0]), int(points[i, 1])
        cells[i] = min(max(y, 0), height - 1) * width + min(max(x, 0), width - 1)
        starts[cells[i] + 1] += 1
    starts = np.cumsum(starts)
    order = np.empty(len(points), np.int64)
    filled = starts.copy()
    for i in range(len(points)):
        order[filled[cells[i]]] = i
        filled[cells[i]] += 1
    return starts, order


@njit(cache=True)
def _lowest(waiting: Doubles, starts: NDArray[np.int64]) -> Doubles:
    """The lowest limit of each cell's points, which stand in order; ∞ where there are none."""
    lowest = np.full(len(starts) - 1, np.inf)
    for cell in range(len(lowest)):
        for i in range(starts[cell], starts[cell + 1]):
            lowest[cell] = min(lowest[cell], waiting[i, 2])
    return lowest
