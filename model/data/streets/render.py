"""From triangles to two images: which surface each pixel sees, how far it is, how it is lit.

Embree finds the triangle that a ray hits; distance and texture follow from that triangle's plane
in double precision, so that disparity is exact whatever the ray caster rounds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .soup import SKY, Soup
from .textures import sample

Floats = NDArray[np.float32]
BLOCK = 8192
"""How many rays are shaded at once, which bounds the memory of large images."""


@dataclass(frozen=True)
class Camera:
    """A pinhole in pixels; `right` eyes stand `baseline_m` along x."""

    focal_px: float
    centre: tuple[float, float]
    """The principal point, in pixels of the window."""
    size: tuple[int, int]
    """Width and height of the window."""
    baseline_m: float
    nearest_m: float = 0.0
    """Nothing that stands on the street is nearer."""

    @property
    def sides(self) -> tuple[float, float]:
        """The tangents of the window's left and right border."""
        left = -self.centre[0] / self.focal_px
        return left, left + self.size[0] / self.focal_px

    def rays(self, x: Floats, y: Floats) -> Floats:
        """(n,) pixel positions → (n, 3) directions with z = 1."""
        return np.stack(
            [
                (x - np.float32(self.centre[0])) / np.float32(self.focal_px),
                (y - np.float32(self.centre[1])) / np.float32(self.focal_px),
                np.ones_like(x),
            ],
            1,
        )

    def grid(self) -> tuple[Floats, Floats]:
        """Columns and rows of all pixel centres, row by row."""
        width, height = self.size
        y, x = np.indices((height, width), dtype=np.float32)
        return x.ravel(), y.ravel()


@dataclass(frozen=True)
class Light:
    """Sun and sky in linear units; a sun of strength 0 is an overcast day."""

    sun: NDArray[np.float32]
    """Where the sun stands, a unit vector in camera coordinates."""
    up: NDArray[np.float32]
    strength: float
    warmth: NDArray[np.float32]
    """The sun's colour, (3,)."""
    ambient: NDArray[np.float32]
    """The sky's light on surfaces that look up, (3,)."""
    zenith: NDArray[np.float32]
    horizon: NDArray[np.float32]
    clouds: float
    cloud_pattern: int
    haze: float
    """How much of a surface's light is lost per metre."""


@dataclass(frozen=True, eq=False)
class Hits:
    """What the pixels of one view see, (n,) each."""

    triangle: NDArray[np.int32]
    """−1 in the sky."""
    depth: NDArray[np.float64]
    """z in metres, infinite in the sky."""


class World:
    """A street in camera coordinates, ready for rays.

    What is one value for a whole triangle is computed once for it: its plane, its colours, how
    much sky and sun its slope receives.
    """

    def __init__(self, soup: Soup, light: Light) -> None:
        """`soup` in the left camera's coordinates."""
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        corners = soup.corners
        exact = corners.astype(np.float64)
        along, across = exact[:, 1] - exact[:, 0], exact[:, 2] - exact[:, 0]
        normal = np.cross(along, across)
        self.plane = np.column_stack([normal, _dot(normal, exact[:, 0])]).T.copy()
        """(4, n): normals and their products with any point of the triangle."""
        # A surface is looked at from its outer side: turned towards the eye once for both eyes.
        away = self.plane[3] > 0
        unit = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        unit[away] *= -1
        self.unit = unit.astype(np.float32)
        self.upward = (self.unit @ light.up).astype(np.float32)
        self.incline = (self.unit @ light.sun).astype(np.float32)
        self.uv_map = _uv_map(exact, along, across, soup.uv.astype(np.float64))
        self.paint = soup.paint
        self.paints = soup.paints
        self.label = np.append(soup.label, SKY)
        self.thing = np.append(soup.thing, 0)
        self.light = light
        self.tree = EmbreeScene()
        TriangleMesh(self.tree, corners)

    def cast(self, origin: NDArray[Any], rays: Floats) -> Hits:
        """What rays (n, 3) from `origin` (3,) hit first."""
        start = np.broadcast_to(np.asarray(origin, np.float32), rays.shape).copy()
        found = self.tree.run(start, rays, query="INTERSECT").astype(np.int32)
        hit = np.flatnonzero(found >= 0)
        face = found[hit]
        nx, ny, nz, reach = (self.plane[i].take(face) for i in range(4))
        ray = rays.take(hit, 0)
        toward = nx * ray[:, 0] + ny * ray[:, 1] + nz * ray[:, 2]
        offset = reach - (nx * origin[0] + ny * origin[1] + nz * origin[2])
        depth = np.full(len(rays), np.inf)
        depth[hit] = np.clip(offset / np.where(np.abs(toward) < 1e-12, 1e-12, toward), 0.05, 1e4)
        return Hits(found, depth)

    def blocked(self, start: Floats, rays: Floats, reach: float) -> NDArray[np.bool_]:
        """Whether something lies on each ray between its start and `reach` times its length."""
        length = np.full(len(rays), reach, np.float32)
        return np.asarray(self.tree.run(start, rays, length, query="OCCLUDED") >= 0)


def _uv_map(
    corners: NDArray[Any], along: NDArray[Any], across: NDArray[Any], uv: NDArray[Any]
) -> Floats:
    """(n, 2, 4): texture coordinates as linear functions of a point on the triangle."""
    aa, ab, bb = _dot(along, along), _dot(along, across), _dot(across, across)
    area = np.maximum(aa * bb - ab**2, 1e-18)
    first = (along * bb[:, None] - across * ab[:, None]) / area[:, None]
    second = (across * aa[:, None] - along * ab[:, None]) / area[:, None]
    steps = uv[:, 1:] - uv[:, :1]
    linear = steps[:, 0, :, None] * first[:, None] + steps[:, 1, :, None] * second[:, None]
    constant = uv[:, 0] - np.einsum("nij,nj->ni", linear, corners[:, 0])
    return np.concatenate([linear, constant[..., None]], 2).astype(np.float32)


def _dot(first: NDArray[Any], second: NDArray[Any]) -> NDArray[Any]:
    """Scalar products row by row: (n, 3) twice → (n,)."""
    return np.asarray(np.einsum("ij,ij->i", first, second))


def look(world: World, rays: Floats, origin: NDArray[Any], focal_px: float) -> tuple[Hits, Floats]:
    """What rays (n, 3) from `origin` hit, and its linear RGB (n, 3)."""
    triangle = np.empty(len(rays), np.int32)
    depth = np.empty(len(rays), np.float64)
    colours = np.empty_like(rays)
    for start in range(0, len(rays), BLOCK):
        part = slice(start, start + BLOCK)
        hits = world.cast(origin, rays[part])
        triangle[part], depth[part] = hits.triangle, hits.depth
        colours[part] = _shade(world, hits, rays[part], origin, focal_px)
    return Hits(triangle, depth), colours


def _shade(world: World, hits: Hits, rays: Floats, origin: NDArray[Any], focal_px: float) -> Floats:
    """Linear RGB (n, 3) of what the rays hit."""
    light = world.light
    seen = np.flatnonzero(hits.triangle >= 0)
    clear = np.flatnonzero(hits.triangle < 0)
    colours = np.empty_like(rays)
    colours[clear] = _sky(rays[clear], light)
    face = hits.triangle.take(seen)
    ray = rays.take(seen, 0)
    depth = hits.depth.take(seen).astype(np.float32)
    normal = world.unit.take(face, 0)
    facing = np.abs(_dot(normal, ray))
    glance = np.clip(facing / np.sqrt(_dot(ray, ray)), 0.05, 1)
    paint = world.paint.take(face)
    point = ray * depth[:, None]
    point += np.asarray(origin, np.float32)
    lit = _albedo(world, face, paint, point, depth / np.float32(focal_px) / np.sqrt(glance))
    glow = world.paints[:, 12].take(paint)
    lit *= _irradiance(world, face, point, normal) + glow[:, None]
    gloss = world.paints[:, 11].take(paint)
    shiny = np.flatnonzero(gloss > 0)
    if shiny.size:
        share = gloss[shiny] + (1 - gloss[shiny]) * 0.5 * (1 - glance[shiny]) ** 4
        lit[shiny] *= (1 - share)[:, None]
        lit[shiny] += share[:, None] * _mirror(ray[shiny], normal[shiny], light)
    fog = np.exp(-np.float32(light.haze) * depth)[:, None]
    colours[seen] = lit * fog + light.horizon * (1 - fog)
    return colours


def _albedo(
    world: World, face: NDArray[np.int32], paint: NDArray[np.int32], point: Floats, span: Floats
) -> Floats:
    """The surface's own colour: two colours mixed by the pattern, and a grain.

    `span` is how many metres a pixel covers.
    """
    flat = world.uv_map.take(face, 0)
    u, v = (np.einsum("ij,ij->i", flat[:, i, :3], point) + flat[:, i, 3] for i in (0, 1))
    columns = world.paints.T
    scale, fine = columns[7].take(paint), columns[9].take(paint)
    pattern, grain = (columns[i].astype(np.int32).take(paint) for i in (6, 8))
    mix = sample(pattern, u * scale, v * scale, span * scale * 256)
    noise = sample(grain, u * fine, v * fine, span * fine * 256)
    bright = 1 + columns[10].take(paint) * (2 * noise - 1)
    first = world.paints[:, :3].take(paint, 0)
    colour = world.paints[:, 3:6].take(paint, 0)
    colour -= first
    colour *= mix[:, None]
    colour += first
    colour *= bright[:, None]
    return np.clip(colour, 0, 1, out=colour)


def _irradiance(world: World, face: NDArray[np.int32], point: Floats, normal: Floats) -> Floats:
    """Light that falls on the surfaces: the sky from above, the sun where nothing is before it."""
    light = world.light
    sky = (0.55 + 0.45 * world.upward).astype(np.float32).take(face)
    total: Floats = sky[:, None] * light.ambient
    if light.strength <= 0:
        return total
    incline = world.incline.take(face)
    sunny = np.flatnonzero(incline > 0.01)
    start = point.take(sunny, 0) + normal.take(sunny, 0) * np.float32(0.02)
    rays = np.broadcast_to(light.sun, start.shape).copy()
    free = sunny[~world.blocked(start, rays, 1e4)]
    total[free] += incline[free, None] * (light.strength * light.warmth).astype(np.float32)
    return total


def _sky(rays: Floats, light: Light) -> Floats:
    """The sky's colour by direction, with clouds."""
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    height = np.clip(unit @ light.up, 0, 1)
    blend = (height**0.6)[:, None]
    colour = light.horizon * (1 - blend) + light.zenith * blend
    if light.clouds > 0:
        above = np.maximum(height, 0.05)
        pattern = np.full(len(rays), light.cloud_pattern, np.int32)
        veil = sample(pattern, unit[:, 0] / above * 0.15, unit[:, 2] / above * 0.15, 2 / above)
        colour = colour * (1 - light.clouds * 0.5 + light.clouds * veil[:, None])
    return np.asarray(colour, np.float32)


def _mirror(ray: Floats, normal: Floats, light: Light) -> Floats:
    """What a glossy surface mirrors: sky above, a dark street below, blurred houses between."""
    rays = ray - 2 * _dot(ray, normal)[:, None] * normal
    unit = rays / (np.linalg.norm(rays, axis=1, keepdims=True) + 1e-6)
    height = unit @ light.up
    street = 0.25 * light.ambient
    share = np.clip(3 * (height - 0.12), 0, 1)[:, None]
    pattern = np.full(len(rays), light.cloud_pattern, np.int32)
    fronts = sample(pattern, unit[:, 0], unit[:, 2], np.full(len(rays), 8, np.float32))[:, None]
    above = 0.5 * (light.horizon + light.zenith)
    return np.asarray(share * above + (1 - share) * street * (0.4 + 1.2 * fronts), np.float32)


def labels(world: World, hits: Hits) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
    """Train ids and object numbers of the pixels."""
    return world.label[hits.triangle].astype(np.uint8), world.thing[hits.triangle].astype(np.int32)


def visible(
    world: World, hits: Hits, seen: Hits | None, rays: Floats, camera: Camera, x: Floats
) -> NDArray[np.bool_]:
    """Whether the right eye sees what each pixel of the left one shows.

    `seen` is what the right eye's pixels show, None where its rows are not those of the left one.
    Where both pixels beside the place lie as far as the surface does, it is seen; everywhere else
    a ray from the right eye decides.
    """
    disparity = camera.focal_px * camera.baseline_m / hits.depth
    column = x - disparity
    inside = column >= 0
    doubtful = np.flatnonzero(inside & ~_surely(hits, seen, column, camera.size[0]))
    eye = np.array([camera.baseline_m, 0, 0], np.float32)
    depth = hits.depth.take(doubtful)
    sky = np.isinf(depth)
    ray = rays.take(doubtful, 0)
    point = np.where(sky[:, None], 1e5 * ray, ray * np.where(sky, 0, depth)[:, None] - eye)
    start = np.broadcast_to(eye, point.shape).copy()
    inside[doubtful] = ~world.blocked(start, point.astype(np.float32), 0.9985)
    return inside


def _surely(
    hits: Hits, seen: Hits | None, column: NDArray[np.float64], width: int
) -> NDArray[np.bool_]:
    """Where the right eye's pixels to both sides of `column` are as far away as the surface."""
    if seen is None:
        return np.zeros(len(column), bool)
    left = np.clip(column.astype(np.int64), 0, width - 2)
    left += np.arange(column.size) // width * width
    with np.errstate(invalid="ignore"):
        close = [
            np.abs(seen.depth.take(place) - hits.depth) <= 0.004 * hits.depth
            for place in (left, left + 1)
        ]
    return np.asarray(close[0] & close[1])
