"""Where things stand: a road with its sides, drawn at random."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import objects, shapes
from .objects import Rng, Thing
from .paint import Paint, any_colour, coat
from .soup import Builder, Road, Soup, View

FAR_M = 190.0
"""The street ends here."""


def detail(s: float) -> float:
    """How finely a thing at `s` metres is made: 1 near, falling to 0 far."""
    return float(np.clip(1.15 - max(s, 0) / 45, 0, 1))


@dataclass(frozen=True)
class District:
    """How a kind of street looks: what stands along it, and how often."""

    lanes: tuple[int, ...]
    walk: float
    """Share of streets with pavements."""
    setback: tuple[float, float]
    """Metres from the pavement's end to the fronts."""
    frontage: dict[str, float]
    """What follows along a side, with weights."""
    cars: float
    """Parked cars, as a share of the places; moving ones follow it."""
    people: float
    trees: float
    """Trees in a row along the road, as a share of the places."""


DISTRICTS = {
    "city": District(
        (2, 2, 3, 4), 0.95, (0, 2.5),
        {"building": 9, "gap": 1, "wall": 0.7, "fence": 0.5, "trees": 1}, 0.5, 9, 0.25,
    ),
    "suburb": District(
        (2, 2, 1), 0.8, (3, 9),
        {"building": 4, "trees": 6, "hedge": 3, "fence": 1.5, "wall": 1, "gap": 1}, 0.35, 3, 0.2,
    ),
    "country": District(
        (2, 2, 1), 0.12, (2, 10),
        {"trees": 8, "hedge": 2, "gap": 3, "building": 0.6, "fence": 1}, 0.06, 0.7, 0.2,
    ),
    "highway": District(
        (3, 4, 4), 0.03, (3, 8),
        {"rail": 5, "trees": 4, "wall": 1.5, "gap": 2, "building": 0.3}, 0.02, 0.1, 0.05,
    ),
}  # fmt: skip


def street(rng: Rng, yaw: float, sides: tuple[float, float]) -> Soup:
    """A random street, seen from a car in one of its lanes.

    The camera looks `yaw` radians off the road; `sides` are the tangents of what it sees.
    """
    name = str(rng.choice(list(DISTRICTS), p=[0.4, 0.32, 0.18, 0.1]))
    district = DISTRICTS[name]
    road = Road(rng.normal(0, 0.0035), rng.normal(0, 0.018), rng.normal(0, 0.0002))
    lanes = int(rng.choice(district.lanes))
    lane_m = rng.uniform(2.7, 3.7)
    parking = 2.1 * (rng.random() < 0.8 * (district.cars > 0.1))
    half = lanes * lane_m / 2 + parking
    walks = [rng.uniform(1.2, 4.5) * (rng.random() < district.walk) for _ in range(2)]
    o = _own_lane(rng, lanes, lane_m)
    builder = Builder(rng, road, View(o, yaw, *sides))
    builder.closed.append((0.0, o, 2.2))
    _ground(rng, builder, half, walks)
    _markings(rng, builder, lanes, lane_m)
    if rng.random() < 0.08:
        _tram(rng, builder, half)
    for side in (-1, 1):
        walk = walks[(side + 1) // 2]
        _traffic_side(rng, builder, district, side, half, parking, walk)
        _frontage(rng, builder, district, side, half + walk + rng.uniform(*district.setback))
    _moving(rng, builder, lanes, lane_m, o, 0.25 if name in ("city", "highway") else 0.12)
    _crossing(rng, builder, district, half)
    _horizon(rng, builder, half)
    if rng.random() < 0.25:
        _scatter(rng, builder, half)
    height = rng.normal(1.65, 0.06)
    return builder.soup(road.point(np.array(0.0), np.array(o), np.array(height)))


def _own_lane(rng: Rng, lanes: int, lane_m: float) -> float:
    """Right-hand traffic, mostly."""
    right = max(1, lanes // 2)
    lane = int(rng.integers(right)) + lanes - right
    middle = (lane + 0.5) * lane_m - lanes * lane_m / 2
    return float(middle * (1 if rng.random() < 0.85 else -1) + rng.normal(0, 0.25))


def _ground(rng: Rng, builder: Builder, half: float, walks: list[float]) -> None:
    """Road, kerbs, pavements and the land beside them, as sheets along the road."""
    s = np.concatenate([np.linspace(-8, 30, 16), np.geomspace(34, FAR_M, 16)])
    asphalt = rng.uniform(0.06, 0.32)
    tint = asphalt * np.array([1, rng.uniform(0.95, 1.02), rng.uniform(0.9, 1.08)])
    road = coat(rng, tint, "asphalt", rng.uniform(1, 5), rng.uniform(0.1, 0.6), rng.uniform(0, 0.5))
    builder.lay(_sheet(builder.road, s, np.linspace(-half, half, 5), np.zeros(5)), road, "road")
    for side, walk in zip((-1, 1), walks, strict=True):
        edge = half
        kerb = 0.0
        if walk:
            kerb = rng.uniform(0.04, 0.16)
            grey = np.full(3, rng.uniform(0.12, 0.5))
            stone = coat(rng, grey, str(rng.choice(["panels", "brick", "asphalt", "noise"])), 2.0)
            edge = half + walk
            offsets = side * np.array([half, half, half + walk / 2, edge])
            heights = np.array([0, kerb, kerb + 0.01, kerb + 0.02])
            builder.lay(_sheet(builder.road, s, offsets, heights), stone, "sidewalk")
        _land(rng, builder, s, side, edge, kerb)


def _land(
    rng: Rng, builder: Builder, s: NDArray[Any], side: int, edge: float, height: float
) -> None:
    """Grass, soil or paving out to the horizon, rising, falling or flat."""
    offsets = edge + np.array([0, 1, 2.5, 5, 9, 16, 30, 90])
    rise = rng.normal(0, 0.05) if rng.random() < 0.6 else rng.normal(0, 0.2)
    heights = height + rise * (offsets - edge).clip(0, 12) + np.zeros((len(s), 1))
    heights = heights + rng.normal(0, 0.05, heights.shape) * (offsets > edge + 0.5)
    if rng.random() < 0.7:
        green = np.array(objects.GREENS[int(rng.integers(4))]) * rng.uniform(1.0, 2.2)
        land = coat(rng, green, "grass", rng.uniform(0.8, 3), 0.6, 0.5)
    else:
        land = coat(rng, any_colour(rng, 0.7) * 0.6, "noise", rng.uniform(1, 4), 0.4, 0.4)
    builder.lay(_sheet(builder.road, s, side * offsets, heights), land, "terrain")


def _sheet(
    road: Road, s: NDArray[Any], offsets: NDArray[Any], heights: NDArray[Any]
) -> NDArray[np.float64]:
    """Positions (len(s), len(offsets), 3); `heights` broadcasts over them."""
    return road.point(s[:, None], offsets[None], np.broadcast_to(heights, (len(s), len(offsets))))


def _markings(rng: Rng, builder: Builder, lanes: int, lane_m: float) -> None:
    """Lines, patches and covers, a few millimetres above the road."""
    white = coat(rng, np.full(3, rng.uniform(0.35, 0.8)), "asphalt", 1.0, 0.3, 0.4)
    dash, gap = (rng.uniform(2, 6), rng.uniform(3, 9))
    if rng.random() < 0.8:
        for lane in range(lanes + 1):
            o = lane * lane_m - lanes * lane_m / 2
            if rng.random() < 0.2:
                continue
            solid = lane in (0, lanes)
            starts = np.arange(-4, 90, 30 if solid else dash + gap)
            for start in starts:
                _strip(builder, white, start, 30 if solid else dash, o, 0.13)
    for _ in range(int(rng.integers(0, 8))):
        patch = coat(rng, np.full(3, rng.uniform(0.04, 0.35)), "asphalt", 2.0)
        s, o = rng.uniform(3, 40), rng.uniform(-0.5, 0.5) * lanes * lane_m
        _strip(builder, patch, s, rng.uniform(0.5, 9), o, rng.uniform(0.3, 2.2), 0.003)


def _strip(
    builder: Builder,
    coat_: Paint,
    s: float,
    length: float,
    o: float,
    width: float,
    up: float = 0.006,
) -> None:
    steps = np.linspace(s, s + length, max(2, int(length / 8) + 1))
    across = np.array([o - width / 2, o + width / 2])
    builder.lay(_sheet(builder.road, steps, across, np.array([up, up])), coat_, "road")


def _traffic_side(
    rng: Rng,
    builder: Builder,
    district: District,
    side: int,
    half: float,
    parking: float,
    walk: float,
) -> None:
    """Parked cars, and what stands and walks between the road and the fronts."""
    if parking:
        for s in np.arange(rng.uniform(-3, 3), 75, rng.uniform(5.2, 7)):
            if rng.random() < district.cars:
                _vehicle(rng, builder, s, side * (half - 1.1), 0.0 if side > 0 else np.pi, 0.03)
    strip = half + (0.5 if walk else 1.0)
    _furniture(rng, builder, district, side, strip)
    for _ in range(rng.poisson(0.6 * district.people)):
        s = float(np.exp(rng.uniform(np.log(4), np.log(60))))
        o = side * (half + rng.uniform(0.4, max(walk, 1.2)))
        _someone(rng, builder, s, o)
    for _ in range(rng.poisson(0.25 * (1 + district.people) ** 0.5)):
        s, o = rng.uniform(4, 40), side * (half + rng.uniform(0.3, max(walk, 1)))
        if builder.free(s, o, 1.0):
            make, label = _two_wheels(rng, 0.65)
            builder.stand(make, label, s, o, 1, up=0.1, yaw=rng.uniform(-np.pi, np.pi))


def _two_wheels(rng: Rng, bicycles: float) -> tuple[Callable[[Rng], Thing], str]:
    if rng.random() < bicycles:
        return objects.bicycle, "bicycle"
    return objects.motorcycle, "motorcycle"


def _furniture(rng: Rng, builder: Builder, district: District, side: int, strip: float) -> None:
    """Lamps, trees in a row, signs, bollards, bins."""
    if rng.random() < 0.75:
        _masts(rng, builder, side, strip)
    for s in np.arange(rng.uniform(3, 12), 110, rng.uniform(6, 14)):
        if rng.random() < district.trees and builder.free(s, side * (strip + 0.4), 0.9):
            make = partial(objects.tree, detail=detail(s))
            builder.put(make, "vegetation", s, side * (strip + 0.4), 5)
    if rng.random() < 0.2:
        for s in np.arange(rng.uniform(3, 10), 30, rng.uniform(1.5, 3)):
            builder.put(objects.bollard, "pole", s, side * strip, 1)
    _oddments(rng, builder, side, strip)


def _masts(rng: Rng, builder: Builder, side: int, strip: float) -> None:
    """A row of lamps, or of wooden poles."""
    maker: Callable[[Rng], Thing] = objects.wooden_pole if rng.random() < 0.2 else objects.lamp_post
    turn = 0.0 if side > 0 else np.pi
    for s in np.arange(rng.uniform(3, 20), 130, rng.uniform(14, 35)):
        if builder.free(s, side * strip, 0.6):
            builder.put(maker, "pole", s, side * strip, 2, yaw=turn)


def _oddments(rng: Rng, builder: Builder, side: int, strip: float) -> None:
    """Signs, and things of no class."""
    for _ in range(rng.poisson(1.3)):
        s, o = rng.uniform(5, 60), side * (strip + rng.uniform(-0.2, 0.6))
        if builder.free(s, o, 0.5):
            turn = rng.normal(0, 0.25) + (np.pi if rng.random() < 0.15 else 0)
            builder.put(objects.sign, None, s, o, 1, yaw=turn)
    for _ in range(rng.poisson(0.8)):
        s, o = rng.uniform(4, 50), side * (strip + rng.uniform(0, 1.5))
        if builder.free(s, o, 0.6):
            builder.put(objects.clutter, None, s, o, 1, up=0.05, yaw=rng.uniform(0, 3))


def _vehicle(
    rng: Rng, builder: Builder, s: float, o: float, yaw: float, sway: float, moving: bool = False
) -> None:
    shares = [0.8, 0.11, 0.09] if moving else [0.92, 0.055, 0.025]
    kind = str(rng.choice(["car", "truck", "bus"], p=shares))
    radius = {"car": 2.5, "truck": 6.0, "bus": 6.5}[kind]
    makers: dict[str, Callable[[Rng], Thing]] = {
        "car": partial(objects.car, detail=detail(s)), "truck": objects.truck, "bus": objects.bus,
    }  # fmt: skip
    if builder.free(s, o, radius + 0.2):
        builder.stand(makers[kind], kind, s, o, radius, yaw=yaw + rng.normal(0, sway))


def _moving(
    rng: Rng, builder: Builder, lanes: int, lane_m: float, own: float, density: float
) -> None:
    """Traffic in the lanes, ahead and oncoming, and riders among it."""
    for lane in range(lanes):
        o = (lane + 0.5) * lane_m - lanes * lane_m / 2
        same = abs(o - own) < lane_m / 2 or (o > 0) == (own > 0)
        yaw = 0.0 if same else np.pi
        for s in np.arange(rng.uniform(5, 16), 110, rng.uniform(7, 14)):
            if rng.random() < density:
                _vehicle(
                    rng, builder, s + rng.normal(0, 1), o + rng.normal(0, 0.2), yaw, 0.03, True
                )
        if rng.random() < 0.12:
            _ridden(rng, builder, rng.uniform(6, 45), o + rng.normal(0, 0.6), yaw)


def _tram(rng: Rng, builder: Builder, half: float) -> None:
    """A tram on the street, or a train beside it; it takes its place before other traffic."""
    side = float(rng.choice([-1, 1]))
    s = rng.uniform(28, 75)
    o = side * (half - 1.6 if rng.random() < 0.6 else half + rng.uniform(5, 12))
    builder.closed.append((s - 11, o, 22.0))
    builder.stand(objects.train, "train", s, o, 40)


def _ridden(rng: Rng, builder: Builder, s: float, o: float, yaw: float) -> None:
    """A bicycle or motorcycle with its rider: two objects, as the labels have it."""
    if not builder.free(s, o, 1.3):
        return
    turn = yaw + rng.normal(0, 0.3)
    make, label = _two_wheels(rng, 0.7)
    builder.stand(make, label, s, o, 1, yaw=turn)
    builder.stand(objects.rider, "rider", s, o, 1, yaw=turn)


def _someone(rng: Rng, builder: Builder, s: float, o: float) -> None:
    if builder.free(s, o, 0.5):
        turn = float(rng.choice([0, np.pi, rng.uniform(0, 6)]))
        builder.stand(objects.person, "person", s, o, 1, up=0.08, yaw=turn)


def _frontage(rng: Rng, builder: Builder, district: District, side: int, start: float) -> None:
    """One thing after the other along a side, out to the end of the street."""
    kinds = list(district.frontage)
    weights = np.array([district.frontage[kind] for kind in kinds])
    s = rng.uniform(-12, -4)
    depth = start
    while s < 150:
        kind = str(rng.choice(kinds, p=weights / weights.sum()))
        length = rng.uniform(7, 24) if kind in ("building", "wall", "rail") else rng.uniform(4, 14)
        if rng.random() < 0.3:
            depth = start + rng.uniform(0, 3)
        _front(rng, builder, kind, side, s + length / 2, depth, length)
        s += length + (rng.uniform(0, 5) if rng.random() < 0.35 else 0.0)


def _front(
    rng: Rng, builder: Builder, kind: str, side: int, s: float, depth: float, length: float
) -> None:
    """A piece of frontage `length` metres long around `s`, and what grows behind it."""
    turn = 0.0 if side > 0 else np.pi
    if kind == "building":
        deep = rng.uniform(7, 14)
        house = partial(objects.building, width=length, depth=deep)
        builder.put(house, "building", s, side * (depth + deep / 2), 16, yaw=turn)
        if rng.random() < 0.4:
            _plant(rng, builder, s + rng.uniform(-0.4, 0.4) * length, side * (depth - 0.6), 0.1)
    elif kind == "trees":
        _grove(rng, builder, side, s, depth, length)
        _grove(rng, builder, side, s, depth + 5, length)
    elif kind != "gap":
        barriers: dict[str, tuple[Callable[[Rng], Thing], str, float, float]] = {
            "wall": (partial(objects.wall, length=length), "wall", 1, 1.5),
            "fence": (partial(objects.fence, length=length), "fence", 1, 2),
            "rail": (partial(objects.guard_rail, length=length), "fence", 0.5, 2),
            "hedge": (
                partial(objects.hedge, length=length, detail=detail(s)), "vegetation", 1, 3,
            ),
        }  # fmt: skip
        make, label, green, behind = barriers[kind]
        builder.put(make, label, s, side * depth, 12, yaw=turn)
        if rng.random() < green:
            _grove(rng, builder, side, s, depth + behind, length)


def _grove(rng: Rng, builder: Builder, side: int, s: float, depth: float, length: float) -> None:
    """Trees and bushes without order."""
    for _ in range(rng.poisson(length / (3 if s < 45 else 8))):
        at, o = s + rng.uniform(-0.5, 0.5) * length, side * (depth + rng.uniform(0.5, 5))
        _plant(rng, builder, at, o, 0.5)


def _plant(rng: Rng, builder: Builder, s: float, o: float, trees: float) -> None:
    make = objects.tree if rng.random() < trees else objects.bush
    builder.put(partial(make, detail=detail(s)), "vegetation", s, o, 5, up=-0.1)


def _crossing(rng: Rng, builder: Builder, district: District, half: float) -> None:
    """Signals, a zebra, and people who cross."""
    if rng.random() > (0.3 if district.walk > 0.5 else 0.06):
        return
    s = rng.uniform(9, 40)
    if rng.random() < 0.7:
        white = coat(rng, np.full(3, rng.uniform(0.4, 0.75)), "asphalt", 1.0, 0.3, 0.3)
        for o in np.arange(-half + 0.4, half, 1.0):
            _strip(builder, white, s, 3.0, o, 0.5)
    for side in (-1, 1):
        turn = 0.0 if side > 0 else np.pi * float(rng.random() < 0.5)
        builder.put(objects.traffic_light, None, s + 4, side * (half + 0.5), 5, yaw=turn)
    for _ in range(rng.poisson(1.5)):
        _someone(rng, builder, s + rng.uniform(0, 3), rng.uniform(-half, half))


def _horizon(rng: Rng, builder: Builder, half: float) -> None:
    """What closes the view: woods, houses, or nothing."""
    if rng.random() < 0.15:
        return
    houses = rng.random() < 0.4
    for _ in range(int(rng.integers(8, 26))):
        s, o = rng.uniform(130, FAR_M - 5), rng.normal(0, 45)
        if houses and abs(o) > half:
            make = partial(objects.building, width=rng.uniform(8, 20), depth=10.0)
            builder.put(make, "building", s, o, 16, up=-1)
        else:
            builder.put(_wood, "vegetation", s, o, 20, up=-2)


def _wood(rng: Rng) -> Thing:
    """A far clump of trees: a few large blots."""
    thing: Thing = []
    for _ in range(3):
        radii = rng.uniform([4, 4, 3], [12, 9, 6])
        green = coat(rng, np.array(objects.GREENS[int(rng.integers(4))]), "leaves", 5.0, 0.6, 0.4)
        thing.append((shapes.ball(*radii).moved(x=rng.normal(0, 7), z=rng.normal(0, 4)), green))
    return thing


def _scatter(rng: Rng, builder: Builder, half: float) -> None:
    """Unlabelled things in the air and on the ground: matching must not rest on habit."""
    for _ in range(int(rng.integers(1, 6))):
        s = float(np.exp(rng.uniform(np.log(6), np.log(40))))
        o = rng.uniform(-1, 1) * (half + 3)
        kind = str(rng.choice(["noise", "print", "brick", "leaves", "stripes"]))
        cover = coat(rng, any_colour(rng), kind, rng.uniform(0.3, 2), second=any_colour(rng))
        w, h, d = np.exp(rng.uniform(np.log(0.2), np.log(1.6), 3))
        shape = shapes.box(w, h, d) if rng.random() < 0.6 else shapes.ball(w / 2, h / 2, d / 2)
        turned = shape.tilted(rng.uniform(-1, 1)).pitched(rng.uniform(-1, 1))
        builder.put(partial(_just, [(turned, cover)]), None, s, o, 2, up=rng.uniform(0, 3))


def _just(thing: Thing, _rng: Rng) -> Thing:
    return thing
