"""`streets`: driving scenes made by rule, with exact disparity, labels and occlusion.

The camera is KITTI's (f = 721.5 px, 0.54 m between the eyes, 1242×375); smaller images are
windows into it. Sample i of a seed is always the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, overload

import numpy as np
from numpy.typing import NDArray

from ...errors import Rts2Error, UsageError
from ..scene import Foreground, Scene

if TYPE_CHECKING:
    from .render import Camera, Light
    from .soup import Soup

FOCAL_PX = 721.5377
BASELINE_M = 0.54
KITTI_SIZE = (1242, 375)
CENTRE = (609.559, 172.854)
"""KITTI's rectified colour cameras."""

NEAREST_M = 2.1
"""Nothing that stands on the street comes closer: 185 pixels of disparity in KITTI's frames."""

VERSION = 2
"""Another generator makes other scenes."""


@dataclass(frozen=True)
class Look:
    """How unlike the two eyes are."""

    difference: float = 1.0
    """Scales the spread of exposure, colour and sharpness between them; 0 makes them equal."""
    noise: bool = True
    rectification_px: float = 0.0
    """The standard deviation of a vertical offset of the right image, in pixels."""


@dataclass(frozen=True)
class Street:
    """One sample, made when it is read."""

    seed: int
    index: int
    size: tuple[int, int]
    look: Look = field(default_factory=Look)

    @property
    def name(self) -> str:
        return f"{self.seed}-{self.index:06d}"

    @property
    def foreground(self) -> Foreground:
        return "instance"

    def read(self) -> Scene:
        """The images, the exact disparity (0 in the sky), labels, occlusion and objects.

        Raises `Rts2Error` on a machine for which the ray caster has no wheel.
        """
        _require_caster()
        return _scene(self)


class Streets(Sequence[Street]):
    """`count` scenes of one seed, (width, height) pixels each."""

    def __init__(
        self,
        count: int,
        seed: int,
        size: tuple[int, int] = KITTI_SIZE,
        look: Look | None = None,
    ) -> None:
        if count < 1:
            raise UsageError(f"streets needs a count of at least 1, not {count}")
        self.seed, self.size, self.look = seed, size, look or Look()
        self._range = range(count)

    @property
    def fingerprint(self) -> str:
        """Names everything that the scenes depend on, but their index."""
        look = f"{self.look.difference:g}/{self.look.noise:d}/{self.look.rectification_px:g}"
        return f"streets v{VERSION} seed {self.seed} {self.size[0]}x{self.size[1]} {look}"

    def __len__(self) -> int:
        return len(self._range)

    @overload
    def __getitem__(self, index: int) -> Street: ...
    @overload
    def __getitem__(self, index: slice) -> list[Street]: ...
    def __getitem__(self, index: int | slice) -> Street | list[Street]:
        if isinstance(index, slice):
            return [self[i] for i in self._range[index]]
        return Street(self.seed, self._range[index], self.size, self.look)


def _require_caster() -> None:
    try:
        import embreex  # noqa: F401
    except ImportError as error:
        raise Rts2Error(
            "streets needs the ray caster embreex, which has no wheel for this machine; "
            "make the data on an x86-64 machine with --cache, or use another data set"
        ) from error


def _scene(street: Street) -> Scene:
    from . import render, sensor
    from .layout import street as drawn

    rng = np.random.default_rng([VERSION, street.seed, street.index])
    camera = _camera(rng, street.size)
    yaw = float(rng.normal(0, 0.05))
    pose = _pose(rng, yaw)
    soup = drawn(rng, yaw, camera.sides)
    world = render.World(_cleared(soup.seen(pose), camera.nearest_m), _light(rng, pose))
    offset = rng.normal(0, 1) * street.look.rectification_px
    width, height = camera.size
    x, y = camera.grid()
    rays = camera.rays(x, y)
    left_eye, right_eye = np.zeros(3), np.array([camera.baseline_m, 0, 0])
    shape = (height, width, 3)
    hits, first = render.look(world, rays, left_eye, camera.focal_px)
    other = camera.rays(x, y + np.float32(offset))
    seen, second = render.look(world, other, right_eye, camera.focal_px)
    first, second = first.reshape(shape), second.reshape(shape)
    eyes = sensor.pair(rng, first, street.look.difference)
    noise = rng if street.look.noise else None
    ids, things = render.labels(world, hits)
    disparity = camera.focal_px * camera.baseline_m / hits.depth
    visible = render.visible(world, hits, None if offset else seen, rays, camera, x)
    return Scene(
        name=street.name,
        left=sensor.expose(first, eyes[0], noise),
        right=sensor.expose(second, eyes[1], noise),
        truth=disparity.reshape(height, width).astype(np.float32),
        foreground=(things != 0).reshape(height, width),
        semantic=ids.reshape(height, width),
        visible=visible.reshape(height, width),
        instances=things.reshape(height, width),
    )


def _camera(rng: np.random.Generator, size: tuple[int, int]) -> Camera:
    """KITTI's camera, or a random window of it; larger images have more pixels per degree."""
    from .render import Camera

    scale = max(1.0, size[0] / KITTI_SIZE[0], size[1] / KITTI_SIZE[1])
    room = [scale * whole - side for whole, side in zip(KITTI_SIZE, size, strict=True)]
    x, y = (rng.uniform(0, max(space, 0.0)) for space in room)
    zoom = 1.0 if size == KITTI_SIZE else float(np.exp(rng.normal(0, 0.1)))
    centre = (float(scale * CENTRE[0] - x), float(scale * CENTRE[1] - y))
    return Camera(FOCAL_PX * scale * zoom, centre, size, BASELINE_M, NEAREST_M * zoom)


def _pose(rng: np.random.Generator, yaw: float) -> NDArray[np.float64]:
    """The car's heading, nod and tilt: street directions → camera directions."""
    pitch, roll = rng.normal(0, [0.012, 0.008])
    cy, sy, cp, sp, cr, sr = *_turn(yaw), *_turn(pitch), *_turn(roll)
    about_y = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
    about_x = np.array([[1, 0, 0], [0, cp, sp], [0, -sp, cp]])
    about_z = np.array([[cr, sr, 0], [-sr, cr, 0], [0, 0, 1]])
    return np.asarray(about_z @ about_x @ about_y)


def _turn(angle: float) -> tuple[float, float]:
    return float(np.cos(angle)), float(np.sin(angle))


def _cleared(soup: Soup, nearest_m: float) -> Soup:
    """The street, in camera coordinates, without what stands too close before the camera."""
    from .soup import GROUND

    x, _, z = (soup.corners[..., axis] for axis in range(3))
    before = (z < nearest_m) & (z > -1.5) & (np.abs(x) < 1.3 * np.maximum(z, 0) + 0.9)
    close = before.any(1) & ~np.isin(soup.label, GROUND)
    return soup.only(~np.isin(soup.part, np.unique(soup.part[close])))


def _light(rng: np.random.Generator, pose: NDArray[np.float64]) -> Light:
    """A day: sunny, veiled or overcast."""
    from .render import Light
    from .textures import patterns

    rise, turn = rng.uniform(0.25, 1.25), rng.uniform(0, 2 * np.pi)
    sun = np.array([np.cos(rise) * np.cos(turn), -np.sin(rise), np.cos(rise) * np.sin(turn)])
    overcast = rng.random() < 0.4
    blue = np.array([0.45, 0.6, 0.95]) * rng.uniform(0.5, 1.3)
    grey = np.full(3, rng.uniform(0.7, 1.6)) * [1, 1.01, 1.04]
    return Light(
        sun=(pose @ sun).astype(np.float32),
        up=(pose @ np.array([0.0, -1, 0])).astype(np.float32),
        strength=0.0 if overcast else float(rng.uniform(0.5, 3.2)),
        warmth=np.array([1, rng.uniform(0.85, 1), rng.uniform(0.7, 1)], np.float32),
        ambient=(rng.uniform(0.25, 0.75) * np.array([0.93, 1, rng.uniform(1, 1.15)])).astype(
            np.float32
        ),
        zenith=(grey if overcast else blue).astype(np.float32),
        horizon=(grey * rng.uniform(0.9, 1.2)).astype(np.float32),
        clouds=float(rng.uniform(0, 0.9)),
        cloud_pattern=int(patterns("noise")[int(rng.integers(4))]),
        haze=float(rng.exponential(0.0004)),
    )
