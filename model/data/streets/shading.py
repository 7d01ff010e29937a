"""How a street is lit: what colour of light reaches the eye from each pixel's surface.

Colours are linear RGB. Everything here is compiled, pixel by pixel, and what is compiled together
stands in one file: the compiler's cache sees changes of the file that a function is in.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Tile = NDArray[np.float32]
Colour = tuple[float, float, float]
Vector = tuple[float, float, float]

SIDE = 256
"""Texels of a pattern's side at the finest level."""

LEVELS = 6
"""How many of them there are, each half as large as the one before."""

LIFT_M = 0.02
"""How far above its surface a point asks for the sun, so that no surface shades itself."""


class Camera(NamedTuple):
    """A pinhole that looks along z; all eyes of a scene look the same way."""

    focal_px: float
    centre: tuple[float, float]
    """The principal point, in pixels of the window."""
    size: tuple[int, int]
    """Width and height of the window."""
    x_m: float = 0.0
    """Where it stands beside the left eye."""


class Light(NamedTuple):
    """Sun and sky in linear units; a sun of strength 0 is an overcast day."""

    sun: Vector
    """Where the sun stands, a unit vector in camera coordinates."""
    up: Vector
    strength: float
    warmth: Colour
    """The sun's colour."""
    ambient: Colour
    """The sky's light on surfaces that look up."""
    zenith: Colour
    horizon: Colour
    clouds: float
    cloud_pattern: int
    haze: float
    """How much of a surface's light is lost per metre."""


class Surfaces(NamedTuple):
    """What is one value for a whole triangle, (n, …) each."""

    unit: Doubles
    """(n, 3), normals that look to where the surface is seen from."""
    texture: Doubles
    """(n, 2, 4): texture coordinates as linear functions of a point on the triangle."""
    paint: NDArray[np.int32]
    """(n,), a row of `paints`."""
    paints: NDArray[np.void]


@njit(cache=True)
def slopes(corners: Doubles, uv: Doubles) -> tuple[Doubles, Doubles]:
    """`unit` and `texture` of triangles (n, 3, 3) with texture coordinates (n, 3, 2)."""
    unit = np.empty((len(corners), 3))
    texture = np.empty((len(corners), 2, 4))
    for n in range(len(corners)):
        first = _row(corners[n], 0)
        along = _minus(_row(corners[n], 1), first)
        across = _minus(_row(corners[n], 2), first)
        normal = _cross(along, across)
        # A surface is looked at from its outer side: turned towards the eye once for both eyes.
        length = max(np.sqrt(_dot(normal, normal)), 1e-12)
        length = -length if _dot(normal, first) > 0 else length
        aa, ab, bb = _dot(along, along), _dot(along, across), _dot(across, across)
        area = max(aa * bb - ab * ab, 1e-18)
        for i in range(2):
            du = (uv[n, 1, i] - uv[n, 0, i]) / area
            dv = (uv[n, 2, i] - uv[n, 0, i]) / area
            texture[n, i, 3] = uv[n, 0, i]
            for j in range(3):
                slope = du * (along[j] * bb - across[j] * ab) + dv * (
                    across[j] * aa - along[j] * ab
                )
                texture[n, i, j] = slope
                texture[n, i, 3] -= slope * first[j]
        for j in range(3):
            unit[n, j] = normal[j] / length
    return unit, texture


@njit(cache=True)
def shade(
    which: NDArray[np.int32],
    nearness: Doubles,
    lit: NDArray[np.bool_],
    camera: Camera,
    surfaces: Surfaces,
    light: Light,
    atlas: Tile,
) -> Floats:
    """Linear RGB (H, W, 3) of triangles `which` (H, W) at 1 / z = `nearness`, sunny where `lit`."""
    height, width = which.shape
    colours = np.empty((height, width, 3), np.float32)
    for y in range(height):
        for x in range(width):
            ray = _ray(camera, x, y)
            face = which[y, x]
            if face < 0:
                colour = _sky(ray, light, atlas)
            else:
                depth = 1 / nearness[y, x]
                point = (ray[0] * depth + camera.x_m, ray[1] * depth, depth)
                normal = _row(surfaces.unit, face)
                glance = min(max(abs(_dot(normal, ray)) / np.sqrt(_dot(ray, ray)), 0.05), 1.0)
                span = depth / camera.focal_px / np.sqrt(glance)
                place = _place(surfaces.texture, face, point)
                paint = surfaces.paints[surfaces.paint[face]]
                colour = _albedo(paint, place, span, atlas)
                colour = _times(colour, _fallen(normal, paint.glow, lit[y, x], light))
                if paint.gloss > 0:
                    share = paint.gloss + (1 - paint.gloss) * 0.5 * (1 - glance) ** 4
                    colour = _mixed(colour, _mirror(ray, normal, light, atlas), share)
                colour = _mixed(light.horizon, colour, np.exp(-light.haze * depth))
            for i in range(3):
                colours[y, x, i] = colour[i]
    return colours


@njit(cache=True)
def sunward(
    which: NDArray[np.int32],
    nearness: Doubles,
    camera: Camera,
    unit: Doubles,
    axes: Doubles,
) -> tuple[Doubles, NDArray[np.int64]]:
    """Points (3, m) just above the surfaces that face the sun, and their pixels (m,).

    Points are given along the rows of `axes` (3, 3), the last of which looks to the sun.
    """
    height, width = which.shape
    points, pixels = np.empty((3, height * width)), np.empty(height * width, np.int64)
    sun = _row(axes, 2)
    count = 0
    for y in range(height):
        for x in range(width):
            face = which[y, x]
            if face >= 0 and _dot(_row(unit, face), sun) > 0.01:
                ray, depth = _ray(camera, x, y), 1 / nearness[y, x]
                point = (
                    ray[0] * depth + LIFT_M * unit[face, 0] + camera.x_m,
                    ray[1] * depth + LIFT_M * unit[face, 1],
                    ray[2] * depth + LIFT_M * unit[face, 2],
                )
                for i in range(3):
                    points[i, count] = _dot(_row(axes, i), point)
                pixels[count] = y * width + x
                count += 1
    return points[:, :count], pixels[:count]


@njit(cache=True)
def _ray(camera: Camera, x: int, y: int) -> Vector:
    return (
        (x - camera.centre[0]) / camera.focal_px,
        (y - camera.centre[1]) / camera.focal_px,
        1.0,
    )


@njit(cache=True)
def _fallen(normal: Vector, glow: float, lit: bool, light: Light) -> Colour:
    """The light that a surface sends on: the sky's, the sun's and its own."""
    sky = 0.55 + 0.45 * _dot(normal, light.up)
    direct = light.strength * _dot(normal, light.sun) if lit else 0.0
    return (
        sky * light.ambient[0] + direct * light.warmth[0] + glow,
        sky * light.ambient[1] + direct * light.warmth[1] + glow,
        sky * light.ambient[2] + direct * light.warmth[2] + glow,
    )


@njit(cache=True)
def _place(texture: Doubles, face: int, point: Vector) -> tuple[float, float]:
    """Texture coordinates in metres."""
    u, v = texture[face, 0, 3], texture[face, 1, 3]
    for i in range(3):
        u += texture[face, 0, i] * point[i]
        v += texture[face, 1, i] * point[i]
    return u, v


@njit(cache=True)
def _albedo(paint: Any, place: tuple[float, float], span: float, atlas: Tile) -> Colour:
    """The surface's own colour: two colours mixed by the pattern, and a grain.

    `span` is how many metres a pixel covers.
    """
    u, v = place
    tile, fine = paint.tiles_per_m, paint.grains_per_m
    mix = value(atlas, paint.pattern, u * tile, v * tile, span * tile * SIDE)
    noise = value(atlas, paint.grain, u * fine, v * fine, span * fine * SIDE)
    bright = 1 + paint.grain_strength * (2 * noise - 1)
    colour = _mixed(_field(paint.first), _field(paint.second), mix)
    return (
        min(max(colour[0] * bright, 0.0), 1.0),
        min(max(colour[1] * bright, 0.0), 1.0),
        min(max(colour[2] * bright, 0.0), 1.0),
    )


@njit(cache=True)
def value(atlas: Tile, pattern: int, u: float, v: float, texels: float) -> float:
    """A pattern's value, 0 … 1, at (`u`, `v`), counted in tiles.

    `texels` is how many texels of the finest level one pixel covers; it picks the level, so that
    distant surfaces do not flicker.
    """
    level = 0
    while level < LEVELS - 1 and texels >= 1 << level:
        level += 1
    side = SIDE >> level
    x, y = (u - np.floor(u)) * side, (v - np.floor(v)) * side
    left, top = min(int(x), side - 1), min(int(y), side - 1)
    column, row = 2 * SIDE - 2 * side + level + left, pattern * (SIDE + 1) + top
    x -= left
    y -= top
    upper = atlas[row, column] * (1 - x) + atlas[row, column + 1] * x
    lower = atlas[row + 1, column] * (1 - x) + atlas[row + 1, column + 1] * x
    return float(upper * (1 - y) + lower * y)


@njit(cache=True)
def _sky(ray: Vector, light: Light, atlas: Tile) -> Colour:
    """The sky's colour by direction, with clouds."""
    length = np.sqrt(_dot(ray, ray))
    height = min(max(_dot(ray, light.up) / length, 0.0), 1.0)
    colour = _mixed(light.horizon, light.zenith, height**0.6)
    if light.clouds <= 0:
        return colour
    above = max(height, 0.05)
    u, v = ray[0] / length / above * 0.15, ray[2] / length / above * 0.15
    veil = 1 - light.clouds * (0.5 - value(atlas, light.cloud_pattern, u, v, 2 / above))
    return (colour[0] * veil, colour[1] * veil, colour[2] * veil)


@njit(cache=True)
def _mirror(ray: Vector, normal: Vector, light: Light, atlas: Tile) -> Colour:
    """What a glossy surface mirrors: sky above, a dark street below, blurred houses between."""
    twice = 2 * _dot(ray, normal)
    back = (
        ray[0] - twice * normal[0],
        ray[1] - twice * normal[1],
        ray[2] - twice * normal[2],
    )
    length = np.sqrt(_dot(back, back)) + 1e-6
    height = _dot(back, light.up) / length
    fronts = value(atlas, light.cloud_pattern, back[0] / length, back[2] / length, 8.0)
    dark = 0.25 * (0.4 + 1.2 * fronts)
    below = (dark * light.ambient[0], dark * light.ambient[1], dark * light.ambient[2])
    above = _mixed(light.horizon, light.zenith, 0.5)
    return _mixed(below, above, min(max(3 * (height - 0.12), 0.0), 1.0))


@njit(cache=True)
def _row(values: Doubles, n: int) -> Vector:
    return (values[n, 0], values[n, 1], values[n, 2])


@njit(cache=True)
def _field(values: Any) -> Vector:
    return (values[0], values[1], values[2])


@njit(cache=True)
def _dot(first: Vector, second: Vector) -> float:
    return first[0] * second[0] + first[1] * second[1] + first[2] * second[2]


@njit(cache=True)
def _minus(first: Vector, second: Vector) -> Vector:
    return (first[0] - second[0], first[1] - second[1], first[2] - second[2])


@njit(cache=True)
def _cross(first: Vector, second: Vector) -> Vector:
    return (
        first[1] * second[2] - first[2] * second[1],
        first[2] * second[0] - first[0] * second[2],
        first[0] * second[1] - first[1] * second[0],
    )


@njit(cache=True)
def _times(first: Colour, second: Colour) -> Colour:
    return (first[0] * second[0], first[1] * second[1], first[2] * second[2])


@njit(cache=True)
def _mixed(first: Colour, second: Colour, share: float) -> Colour:
    """`first`, and by `share` of it `second`."""
    return (
        first[0] + share * (second[0] - first[0]),
        first[1] + share * (second[1] - first[1]),
        first[2] + share * (second[2] - first[2]),
    )
