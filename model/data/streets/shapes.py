"""Triangle shapes in their own coordinates: x right, y down, z forward, in metres.

A shape stands on y = 0 at the origin. It carries texture coordinates in metres along its surface,
so that a material's grain has one size everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Shape:
    """A soup of n triangles: `corners` (n, 3, 3) and `uv` (n, 3, 2), both in metres."""

    corners: Floats
    uv: Floats

    def moved(
        self, x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0, size: float = 1.0
    ) -> Shape:
        """Scaled, turned about the vertical by `yaw` radians, then shifted."""
        if yaw == 0 and size == 1:
            return Shape(self.corners + np.array([x, y, z], np.float32), self.uv)
        cos, sin = np.cos(yaw), np.sin(yaw)
        turn = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]], np.float32) * size
        corners = self.corners @ turn.T + np.array([x, y, z], np.float32)
        return Shape(corners.astype(np.float32), self.uv * np.float32(size))

    def tilted(self, angle: float) -> Shape:
        """Turned about the z axis: a cylinder leans to its side."""
        cos, sin = np.cos(angle), np.sin(angle)
        turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]], np.float32)
        return Shape((self.corners @ turn.T).astype(np.float32), self.uv)

    def pitched(self, angle: float) -> Shape:
        """Turned about the x axis: a cylinder leans forward."""
        cos, sin = np.cos(angle), np.sin(angle)
        turn = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]], np.float32)
        return Shape((self.corners @ turn.T).astype(np.float32), self.uv)


def joined(*shapes: Shape) -> Shape:
    """Several shapes as one."""
    return Shape(
        np.concatenate([shape.corners for shape in shapes]),
        np.concatenate([shape.uv for shape in shapes]),
    )


_SPLIT = np.array([0, 1, 2, 0, 2, 3])


def quads(corners: NDArray[Any], uv: NDArray[Any]) -> Shape:
    """(n, 4, 3) corners around each quad, (n, 4, 2) → 2n triangles."""
    return Shape(
        np.asarray(corners, np.float32).take(_SPLIT, 1).reshape(-1, 3, 3),
        np.asarray(uv, np.float32).take(_SPLIT, 1).reshape(-1, 3, 2),
    )


def quad(width: float, height: float) -> Shape:
    """An upright rectangle that faces −z, its lower edge on the ground."""
    w = width / 2
    corners = [[[-w, -height, 0], [w, -height, 0], [w, 0, 0], [-w, 0, 0]]]
    return quads(np.array(corners), np.array([[[0, 0], [width, 0], [width, height], [0, height]]]))


def box(width: float, height: float, length: float, taper: float = 1.0) -> Shape:
    """A box of `width` (x), `height` (up) and `length` (z); the top is `taper` times as large."""
    x, z = width / 2, length / 2
    low = np.array([[-x, 0, -z], [x, 0, -z], [x, 0, z], [-x, 0, z]])
    high = low * [taper, 1, taper] - [0, height, 0]
    sides = [[high[i], high[(i + 1) % 4], low[(i + 1) % 4], low[i]] for i in range(4)]
    spans = [width, length, width, length]
    uv = [[[0, 0], [span, 0], [span, height], [0, height]] for span in spans]
    flat = [[0, 0], [width, 0], [width, length], [0, length]]
    return quads(np.array([*sides, high, low]), np.array([*uv, flat, flat]))


def gable(width: float, height: float, length: float) -> Shape:
    """A roof whose ridge runs along z."""
    x, z = width / 2, length / 2
    slope = float(np.hypot(x, height))
    corners, uv = [], []
    for side in (-1, 1):
        corners.append([[0, -height, -z], [0, -height, z], [side * x, 0, z], [side * x, 0, -z]])
        uv.append([[0, 0], [length, 0], [length, slope], [0, slope]])
    for end in (-z, z):
        corners.append([[0, -height, end], [x, 0, end], [-x, 0, end], [-x, 0, end]])
        uv.append([[x, 0], [width, height], [0, height], [0, height]])
    return quads(np.array(corners), np.array(uv))


def tube(bottom: float, top: float, height: float, sides: int = 8) -> Shape:
    """An upright cylinder or cone of the two radii."""
    angles = np.linspace(0, 2 * np.pi, sides + 1)
    ring = np.stack([np.cos(angles), np.zeros(sides + 1), np.sin(angles)], 1)
    low, high = ring * bottom, ring * top - [0, height, 0]
    along = angles * bottom
    corners = np.stack([high[:-1], high[1:], low[1:], low[:-1]], 1)
    tops, bottoms = np.zeros(sides), np.full(sides, height)
    uv = np.stack(
        [
            np.stack([along[:-1], tops], 1),
            np.stack([along[1:], tops], 1),
            np.stack([along[1:], bottoms], 1),
            np.stack([along[:-1], bottoms], 1),
        ],
        1,
    )
    return quads(corners, uv)


def wheel(radius: float, width: float, sides: int = 10) -> Shape:
    """A disc-faced cylinder whose axis is x, standing on the ground."""
    angles = np.linspace(0, 2 * np.pi, sides + 1)
    ring = np.stack([np.cos(angles), np.sin(angles)], 1) * radius
    faces = []
    for x in (-width / 2, width / 2):
        rim = np.column_stack([np.full(sides + 1, x), ring])
        hub = np.tile([x, 0.0, 0.0], (sides, 1))
        faces.append(np.stack([rim[:-1], rim[1:], hub, hub], 1))
    left, right = (np.column_stack([np.full(sides + 1, x), ring]) for x in (-width / 2, width / 2))
    tread = np.stack([left[:-1], left[1:], right[1:], right[:-1]], 1)
    corners = np.concatenate([*faces, tread]) - [0, radius, 0]
    return quads(corners, corners[..., [2, 1]])


def rim(radius: float, width: float, sides: int = 16) -> Shape:
    """A thin ring in the plane x = 0, as a bicycle's wheel; it stands on the ground."""
    angles = np.linspace(0, 2 * np.pi, sides + 1)
    unit = np.column_stack([np.zeros(sides + 1), np.cos(angles), np.sin(angles)])
    outer, inner = unit * radius, unit * (radius - width)
    corners = np.stack([outer[:-1], outer[1:], inner[1:], inner[:-1]], 1) - [0, radius, 0]
    return quads(corners, corners[..., [2, 1]])


def ball(x: float, y: float, z: float) -> Shape:
    """An ellipsoid of these radii, resting on the ground."""
    points, uv = _sphere(8, 5)
    return _resting(points, uv, np.array([x, y, z]))


def lump(rng: np.random.Generator, radii: NDArray[Any], fine: bool) -> Shape:
    """An ellipsoid with dents, resting on the ground."""
    points, uv = _sphere(12, 7) if fine else _sphere(8, 5)
    dents = rng.uniform(0.72, 1.12, points.shape[:2])
    dents[:, -1] = dents[:, 0]
    return _resting(points * dents[..., None], uv, radii)


def _resting(points: NDArray[Any], uv: NDArray[Any], radii: NDArray[Any]) -> Shape:
    scale = np.array([2 * max(radii[0], radii[2]), radii[1]])
    return _woven(points * radii - [0, radii[1], 0], uv * scale)


@lru_cache(maxsize=4)
def _sphere(around: int, levels: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A unit sphere as a sheet (levels + 1, around + 1, 3), and its angles."""
    turn = np.linspace(0, 2 * np.pi, around + 1)
    rise = np.linspace(0, np.pi, levels + 1)
    t, r = np.meshgrid(turn, rise)
    points = np.stack([np.sin(r) * np.cos(t), -np.cos(r), np.sin(r) * np.sin(t)], -1)
    return points, np.stack([t, r], -1)


def surface(points: NDArray[Any]) -> Shape:
    """A woven sheet (rows, columns, 3); texture runs along x and z."""
    return _woven(points, points[..., [0, 2]])


def _woven(points: NDArray[Any], uv: NDArray[Any]) -> Shape:
    """Sheets (rows, columns, 3) and (rows, columns, 2) → two triangles a cell."""
    order = _weave(*points.shape[:2])

    def triangles(values: NDArray[Any]) -> Floats:
        depth = values.shape[-1]
        return values.reshape(-1, depth).astype(np.float32).take(order, 0).reshape(-1, 3, depth)

    return Shape(triangles(points), triangles(uv))


@lru_cache(maxsize=64)
def _weave(rows: int, columns: int) -> NDArray[np.int64]:
    """Which points of a sheet are the triangles' corners, three each."""
    number = np.arange(rows * columns).reshape(rows, columns)
    around = [number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]]
    return np.stack([cells.ravel() for cells in around], 1).take(_SPLIT, 1).ravel()


def foliage(rng: np.random.Generator, radii: NDArray[Any], leaf: float, count: int) -> Shape:
    """`count` triangles of about `leaf` metres, thrown near the shell of an ellipsoid."""
    directions = rng.standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True) + 1e-9
    centres = directions * radii * rng.uniform(0.55, 1.05, (count, 1))
    corners = centres[:, None] + rng.normal(0, leaf, (count, 3, 3))
    corners[..., 1] -= radii[1]
    axes = corners[..., [0, 1]] + corners[..., [2, 2]] * [0.7, 0.3]
    return Shape(corners.astype(np.float32), axes.astype(np.float32))


def loft(profile: NDArray[Any], half_widths: NDArray[Any]) -> Shape:
    """A body whose outline seen from the side is `profile` (n, 2) as (z, height), closed.

    `half_widths` (n,) is how far it reaches to both sides at each of these points; the flanks are
    a fan around the outline's middle.
    """
    z, up = profile[:, 0], profile[:, 1]
    left = np.column_stack([-half_widths, -up, z])
    right = np.column_stack([half_widths, -up, z])
    after = np.roll(np.arange(len(z)), -1)
    skin = np.stack([left, left[after], right[after], right], 1)
    run = np.concatenate([[0], np.hypot(np.diff(z), np.diff(up)).cumsum()])
    across = np.stack(
        [
            np.column_stack([run, -half_widths]),
            np.column_stack([run + 0.3, -half_widths[after]]),
            np.column_stack([run + 0.3, half_widths[after]]),
            np.column_stack([run, half_widths]),
        ],
        1,
    )
    flanks, flank_uv = [], []
    for side in (left, right):
        hub = np.tile(side.mean(0), (len(z), 1))
        hub[:, 0] = np.sign(side[0, 0]) * half_widths.max()
        fan = np.stack([side, side[after], hub, hub], 1)
        flanks.append(fan)
        flank_uv.append(fan[..., [2, 1]])
    return quads(np.concatenate([skin, *flanks]), np.concatenate([across, *flank_uv]))
