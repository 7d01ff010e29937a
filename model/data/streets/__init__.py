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

from ...errors import UsageError
from ..scene import Foreground, Scene

if TYPE_CHECKING:
    from .shading import Camera, Light
    from .soup import Soup

FOCAL_PX = 721.5377
BASELINE_M = 0.54
KITTI_SIZE = (1242, 375)
CENTRE = (609.559, 172.854)
"""KITTI's rectified colour cameras."""

NEAREST_M = 2.1
"""Nothing that stands on the street comes closer: 185 pixels of disparity in KITTI's frames."""

MOST = 1_000_000
"""So many scenes a seed has at most."""

VAL_SEED = 2**32 - 1
"""The seed of the streets that judge; no training may take it."""

VERSION = 3
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
        return f"{'val' if self.seed == VAL_SEED else self.seed}-{self.index:06d}"

    @property
    def foreground(self) -> Foreground:
        return "instance"

    def read(self) -> Scene:
        """The images, the exact disparity (0 in the sky), labels, occlusion and objects."""
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
        if not 1 <= count <= MOST:
            raise UsageError(f"streets may be 1 to {MOST}, not {count}; change --count")
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


def _scene(street: Street) -> Scene:
    from . import render, sensor
    from .layout import street as drawn

    rng = np.random.default_rng([VERSION, street.seed, street.index])
    left = _camera(rng, street.size)
    right = left._replace(x_m=BASELINE_M)
    yaw = float(rng.normal(0, 0.05))
    pose = _pose(rng, yaw)
    soup = drawn(rng, yaw, _sides(left)).seen(pose)
    world = render.World(_cleared(soup, _nearest_m(left)), _light(rng, pose))
    eyes = (left, _lowered(right, rng.normal(0, 1) * street.look.rectification_px))
    hits = [render.see(world, eye) for eye in eyes]
    first, second = render.look(world, eyes, hits)
    sensors = sensor.pair(rng, first, street.look.difference)
    noise = rng if street.look.noise else None
    ids, things = render.labels(world, hits[0])
    return Scene(
        name=street.name,
        left=sensor.expose(first, sensors[0], noise),
        right=sensor.expose(second, sensors[1], noise),
        truth=(left.focal_px * BASELINE_M * hits[0].nearness).astype(np.float32),
        foreground=things != 0,
        semantic=ids,
        visible=render.visible(world, hits[0], left, right),
        instances=things,
    )


def _camera(rng: np.random.Generator, size: tuple[int, int]) -> Camera:
    """KITTI's camera, or a random window of it; larger images have more pixels per degree."""
    from .shading import Camera

    scale = _scale(size)
    room = [scale * whole - side for whole, side in zip(KITTI_SIZE, size, strict=True)]
    x, y = (rng.uniform(0, max(space, 0.0)) for space in room)
    zoom = 1.0 if size == KITTI_SIZE else float(np.exp(rng.normal(0, 0.1)))
    centre = (float(scale * CENTRE[0] - x), float(scale * CENTRE[1] - y))
    return Camera(FOCAL_PX * scale * zoom, centre, size)


def _lowered(eye: Camera, rows: float) -> Camera:
    """The eye with its image moved up by so many rows."""
    return eye._replace(centre=(eye.centre[0], eye.centre[1] - rows))


def _sides(eye: Camera) -> tuple[float, float]:
    """The tangents of the window's left and right border."""
    left = -eye.centre[0] / eye.focal_px
    return left, left + eye.size[0] / eye.focal_px


def _nearest_m(eye: Camera) -> float:
    """Zooming in moves the nearest things away, so that disparities keep their limit."""
    return NEAREST_M * eye.focal_px / (FOCAL_PX * _scale(eye.size))


def _scale(size: tuple[int, int]) -> float:
    """How many times as large as KITTI's frame an image is; 1 for windows into it."""
    return max(1.0, size[0] / KITTI_SIZE[0], size[1] / KITTI_SIZE[1])


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
    from .shading import Light
    from .textures import patterns

    rise, turn = rng.uniform(0.25, 1.25), rng.uniform(0, 2 * np.pi)
    sun = np.array([np.cos(rise) * np.cos(turn), -np.sin(rise), np.cos(rise) * np.sin(turn)])
    overcast = rng.random() < 0.4
    blue = np.array([0.45, 0.6, 0.95]) * rng.uniform(0.5, 1.3)
    grey = np.full(3, rng.uniform(0.7, 1.6)) * [1, 1.01, 1.04]
    return Light(
        sun=_three(pose @ sun),
        up=_three(pose @ np.array([0.0, -1, 0])),
        strength=0.0 if overcast else float(rng.uniform(0.5, 3.2)),
        warmth=_three(np.array([1, rng.uniform(0.85, 1), rng.uniform(0.7, 1)])),
        ambient=_three(rng.uniform(0.25, 0.75) * np.array([0.93, 1, rng.uniform(1, 1.15)])),
        zenith=_three(grey if overcast else blue),
        horizon=_three(grey * rng.uniform(0.9, 1.2)),
        clouds=float(rng.uniform(0, 0.9)),
        cloud_pattern=int(patterns("noise")[int(rng.integers(4))]),
        haze=float(rng.exponential(0.0004)),
    )


def _three(values: NDArray[np.float64]) -> tuple[float, float, float]:
    first, second, third = values.tolist()
    return first, second, third
