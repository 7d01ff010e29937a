"""A street as one soup of triangles, and what collects it.

Places on the street are (s, o): metres along the road's middle and metres to its right. The road
bends and climbs; everything that stands on it follows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..labels import CLASS_NAMES
from . import paint, shapes
from .objects import Labelled, Rng, Thing
from .paint import Paint
from .shapes import Shape

LABEL = {name: number for number, name in enumerate(CLASS_NAMES)}
"""Train ids by name."""

SKY = LABEL["sky"]
UNLABELLED = 255
GROUND = tuple(LABEL[name] for name in ("road", "sidewalk", "terrain"))


@dataclass(frozen=True, eq=False)
class Soup:
    """All triangles of a scene: geometry in the street's coordinates, look, meaning."""

    corners: NDArray[np.float32]
    """(n, 3, 3), metres."""
    uv: NDArray[np.float32]
    """(n, 3, 2), metres."""
    paint: NDArray[np.int32]
    """(n,), a row of `paints`."""
    label: NDArray[np.uint8]
    """(n,), train ids."""
    thing: NDArray[np.int32]
    """(n,), a number for each object of its own, 0 for the rest."""
    part: NDArray[np.int32]
    """(n,), which triangles were set down together."""
    paints: NDArray[np.void]
    eye: NDArray[np.float64]
    """Where the left camera stands, 3 metres."""

    def seen(self, pose: NDArray[np.float64]) -> Soup:
        """In the left camera's coordinates; `pose` (3, 3) turns street directions into its own."""
        corners = (self.corners - self.eye.astype(np.float32)) @ pose.T.astype(np.float32)
        return replace(self, corners=corners, eye=np.zeros(3))

    def only(self, which: NDArray[np.bool_]) -> Soup:
        """The chosen triangles."""
        names = ("corners", "uv", "paint", "label", "thing", "part")
        return replace(self, **{name: getattr(self, name)[which] for name in names})


@dataclass(frozen=True)
class Road:
    """The road's course."""

    bend: float
    """Curvature in 1/m; positive bends to the right."""
    slope: float
    crest: float
    """Change of slope in 1/m."""

    def point(self, s: NDArray[Any], o: NDArray[Any], up: NDArray[Any]) -> NDArray[np.float64]:
        """(…,) places → (…, 3) positions."""
        turn = self.bend * s
        x = self.bend * s**2 / 2 + o * np.cos(turn)
        y = -self.slope * s - self.crest * s**2 / 2 - up
        z = s - o * np.sin(turn)
        places = np.empty((*np.broadcast_shapes(x.shape, y.shape, z.shape), 3))
        places[..., 0], places[..., 1], places[..., 2] = x, y, z
        return places

    def heading(self, s: float) -> float:
        return self.bend * s


@dataclass(frozen=True)
class View:
    """The wedge before the camera, in the street's coordinates; what lies outside is not built."""

    x: float
    yaw: float
    left: float
    """Tangents of the wedge's sides."""
    right: float

    def holds(self, x: float, z: float, reach: float) -> bool:
        """Whether a thing of radius `reach` can be seen, or throw a shadow that is."""
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        across, ahead = (x - self.x) * cos - z * sin, (x - self.x) * sin + z * cos
        reach += 3.0
        if ahead < -reach:
            return False
        near = max(ahead, 0.0)
        return bool(self.left * near - reach < across < self.right * near + reach)


@dataclass
class Builder:
    """Collects painted shapes and sets them onto the street, as far as they are in view."""

    rng: Rng
    road: Road
    view: View
    shapes: list[Shape] = field(default_factory=list)
    tags: list[tuple[int, int, int, int]] = field(default_factory=list)
    """Paint, label, object and part of each shape."""
    places: list[tuple[float, ...]] = field(default_factory=list)
    """Position, and cosine and sine of the turn about the vertical, of each shape."""
    paints: list[Paint] = field(default_factory=list)
    things: int = 0
    puts: int = 0
    closed: list[tuple[float, float, float]] = field(default_factory=list)
    """Where nothing more may stand: (s, o, radius)."""

    def put(
        self,
        make: Callable[[Rng], Thing | Labelled],
        label: str | None,
        s: float,
        o: float,
        reach: float,
        up: float = 0.0,
        yaw: float = 0.0,
        number: int = 0,
    ) -> None:
        """Sets a thing down at (s, o), turned by `yaw` against the road's heading.

        `reach` is its radius in metres, at most.
        """
        at = self.road.point(np.array(s), np.array(o), np.array(up))
        if not self.view.holds(float(at[0]), float(at[2]), reach):
            return
        turn = yaw + self.road.heading(s)
        made = make(self.rng)
        self.puts += 1
        for name, thing in (made if isinstance(made, dict) else {label: made}).items():
            tag = UNLABELLED if name is None else LABEL[name]
            for shape, coat_ in thing:
                self._add(shape, coat_, tag, number, (*at, np.cos(turn), np.sin(turn)))

    def stand(
        self,
        make: Callable[[Rng], Thing],
        label: str,
        s: float,
        o: float,
        reach: float,
        up: float = 0.0,
        yaw: float = 0.0,
    ) -> None:
        """Sets down an object of its own: a car, a person, a bicycle."""
        self.things += 1
        self.put(make, label, s, o, reach, up, yaw, self.things)

    def lay(self, points: NDArray[Any], coat_: Paint, label: str) -> None:
        """Adds a sheet of ground, (rows, columns, 3) positions."""
        self.puts += 1
        self._add(shapes.surface(points), coat_, LABEL[label], 0, (0, 0, 0, 1, 0))

    def free(self, s: float, o: float, radius: float) -> bool:
        """Whether nothing stands there yet; if so, something does now."""
        for other_s, other_o, other in self.closed:
            if abs(s - other_s) < radius + other and abs(o - other_o) < 0.5 * (radius + other):
                return False
        self.closed.append((s, o, radius))
        return True

    def soup(self, eye: NDArray[np.float64]) -> Soup:
        """Everything that was collected, seen from `eye`."""
        counts = [len(shape.corners) for shape in self.shapes]
        paint_, label, thing, part = np.repeat(np.array(self.tags, np.int32), counts, 0).T
        at = np.repeat(np.array(self.places, np.float32), counts, 0)
        x, y, z = np.moveaxis(np.concatenate([shape.corners for shape in self.shapes]), 2, 0)
        cos, sin = at[:, 3, None], at[:, 4, None]
        corners = np.stack(
            [cos * x + sin * z + at[:, :1], y + at[:, 1:2], cos * z - sin * x + at[:, 2:3]], 2
        )
        uv = np.concatenate([shape.uv for shape in self.shapes])
        paints = paint.table(self.paints)
        return Soup(corners, uv, paint_, label.astype(np.uint8), thing, part, paints, eye)

    def _add(
        self, shape: Shape, coat_: Paint, label: int, number: int, place: tuple[float, ...]
    ) -> None:
        if not self.paints or self.paints[-1] is not coat_:
            self.paints.append(coat_)
        self.shapes.append(shape)
        self.tags.append((len(self.paints) - 1, label, number, self.puts))
        self.places.append(place)
