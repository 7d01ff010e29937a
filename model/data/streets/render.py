"""From triangles to two images: which surface each pixel sees, how far it is, how it is lit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import raster, shading
from .shading import Camera, Floats, Light, Surfaces
from .soup import SKY, Soup
from .textures import atlas

SUN_CELLS = (512, 256)
"""Into how many cells the plane across the sunlight is divided."""

SUN_MARGIN_M = 25.0
"""How far behind the rearmost point the perspective of that plane starts."""

SAME_DEPTH = 0.0015
"""What is nearer by less than this share is the same surface."""


@dataclass(frozen=True, eq=False)
class Hits:
    """What the pixels of one eye see, (H, W) each."""

    triangle: NDArray[np.int32]
    """−1 in the sky."""
    nearness: NDArray[np.float64]
    """1 / z, per metre; 0 in the sky."""


class World:
    """A street in the left eye's coordinates, ready to be looked at."""

    def __init__(self, soup: Soup, light: Light) -> None:
        """`soup` in the left camera's coordinates."""
        self.corners = soup.corners.astype(np.float64)
        unit, texture = shading.slopes(self.corners, soup.uv.astype(np.float64))
        self.surfaces = Surfaces(unit, texture, soup.paint, soup.paints)
        self.label = np.append(soup.label, SKY)
        self.thing = np.append(soup.thing, 0)
        self.light = light
        self.alike = np.ones(self.corners.shape[:2])
        """Nearness × z of all corners."""


def see(world: World, eye: Camera) -> Hits:
    """What an eye's pixels show."""
    return Hits(*raster.nearest(_projected(world.corners, eye), world.alike, *eye.size))


def look(world: World, eyes: Sequence[Camera], hits: Sequence[Hits]) -> list[Floats]:
    """The eyes' images of what they see, linear RGB (H, W, 3)."""
    return [
        shading.shade(seen.triangle, seen.nearness, lit, eye, world.surfaces, world.light, atlas())
        for eye, seen, lit in zip(eyes, hits, _sunny(world, eyes, hits), strict=True)
    ]


def labels(world: World, hits: Hits) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
    """Train ids and object numbers of the pixels."""
    return world.label[hits.triangle].astype(np.uint8), world.thing[hits.triangle].astype(np.int32)


def visible(world: World, hits: Hits, left: Camera, right: Camera) -> NDArray[np.bool_]:
    """Whether the right eye has in view and sees what the left one's pixels show, (H, W)."""
    disparity = left.focal_px * (right.x_m - left.x_m) * hits.nearness
    columns = np.arange(left.size[0]) - disparity
    inside = columns >= 0
    points = np.empty((np.count_nonzero(inside), 3))
    points[:, 0] = columns[inside]
    points[:, 1] = np.repeat(np.arange(left.size[1]), np.count_nonzero(inside, 1))
    points[:, 2] = hits.nearness[inside] / (1 - SAME_DEPTH)
    corners = _projected(world.corners, right)
    inside[inside] = ~raster.covered(corners, world.alike, points, *right.size)
    return inside


def _projected(corners: NDArray[np.float64], eye: Camera) -> NDArray[np.float64]:
    """Corners (n, 3, 3) in an eye's homogeneous pixel coordinates."""
    focal, (x, y) = eye.focal_px, eye.centre
    turn = np.array([[focal, 0, 0], [0, focal, 0], [x, y, 1]])
    moved = _turned(corners, turn)
    moved[..., 0] -= focal * eye.x_m
    return moved


def _turned(corners: NDArray[np.float64], turn: NDArray[Any]) -> NDArray[np.float64]:
    """Corners (n, 3, 3) times a matrix (3, 3), as one product: many small ones are slow."""
    return np.asarray(corners.reshape(-1, 3) @ turn).reshape(corners.shape)


def _sunny(world: World, eyes: Sequence[Camera], hits: Sequence[Hits]) -> list[NDArray[np.bool_]]:
    """Where the sun shines on what the eyes see."""
    lit = [np.zeros(seen.triangle.shape, bool) for seen in hits]
    if world.light.strength <= 0:
        return lit
    axes = _across(np.array(world.light.sun))
    facing = [
        shading.sunward(seen.triangle, seen.nearness, eye, world.surfaces.unit, axes)
        for eye, seen in zip(eyes, hits, strict=True)
    ]
    free = ~_shaded(
        _turned(world.corners, axes.T), np.concatenate([points for points, _ in facing], 1)
    )
    ends = np.cumsum([len(pixels) for _, pixels in facing])
    for image, (_, pixels), part in zip(lit, facing, np.split(free, ends[:-1]), strict=True):
        image.ravel()[pixels[part]] = True
    return lit


def _shaded(corners: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which of the points (3, m) have a triangle (n, 3, 3) between them and the sun, in its axes.

    The plane across the light is seen in perspective, as from behind the eye, so that its cells
    hold about as many points each (Wimmer et al., "Light Space Perspective Shadow Maps", 2004).
    """
    if not points.size:
        return np.zeros(0, bool)
    aside, ahead, high = points
    start = ahead.min() - SUN_MARGIN_M
    y = 1 / (ahead - start)
    x = aside * y
    low = x.min(), y.min()
    scale = [count / max(np.ptp(at), 1e-9) for count, at in zip(SUN_CELLS, (x, y), strict=True)]
    places = np.empty((len(x), 3))
    places[:, 0] = scale[0] * (x - low[0])
    places[:, 1] = scale[1] * (y - low[1])
    places[:, 2] = high * y
    behind = corners[..., 1] - start
    cells = np.empty_like(corners)
    cells[..., 0] = scale[0] * (corners[..., 0] - low[0] * behind)
    cells[..., 1] = scale[1] * (1 - low[1] * behind)
    cells[..., 2] = behind
    return np.asarray(raster.covered(cells, corners[..., 2], places, *SUN_CELLS))


def _across(sun: NDArray[Any]) -> NDArray[np.float64]:
    """(3, 3): rows aside and ahead in the plane across the sunlight, and towards the sun."""
    ahead = np.array([0.0, 0.0, 1.0]) - sun[2] * sun
    ahead /= np.linalg.norm(ahead)
    return np.stack([np.cross(ahead, sun), ahead, sun])
