"""The things of a street, each a list of painted shapes that stands on the origin and looks +z."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import shapes
from .paint import Paint, any_colour, coat, lamp, plain
from .shapes import Shape

Rng = np.random.Generator
Thing = list[tuple[Shape, Paint]]
Labelled = dict[str, Thing]
"""A thing whose parts have labels of their own."""

WOOD, METAL, GLASS, TYRE = (0.22, 0.15, 0.1), (0.35, 0.36, 0.38), (0.03, 0.035, 0.04), (0.03,) * 3
SKINS = ((0.55, 0.38, 0.3), (0.3, 0.19, 0.13), (0.65, 0.48, 0.4))


def car(rng: Rng, detail: float) -> Thing:
    """A saloon, an estate, a hatchback or a small van."""
    length, width = rng.uniform(3.5, 4.9), rng.uniform(1.62, 1.9)
    van = rng.random() < 0.15
    height = rng.uniform(1.75, 2.1) if van else rng.uniform(1.38, 1.65)
    shoulder = rng.uniform(0.82, 1.0) + 0.25 * van
    front, back = length / 2, -length / 2
    hood = front - rng.uniform(0.85, 1.25) * (0.5 if van else 1)
    boot = back + rng.choice([0.05, 0.25, 0.8]) * (0.2 if van else 1)
    half = width / 2
    body_profile = np.array(
        [
            [back + 0.08, 0.28], [back, 0.5], [back + 0.05, shoulder - 0.05], [boot, shoulder],
            [hood, shoulder], [front - 0.15, shoulder - 0.22], [front, 0.55], [front - 0.1, 0.25],
        ]
    )  # fmt: skip
    body = shapes.loft(body_profile, half * np.array([0.93, 0.98, 1, 1, 1, 0.95, 0.93, 0.9]))
    lean = rng.uniform(0.3, 0.75) * (0.5 if van else 1)
    cabin_profile = np.array(
        [
            [boot, shoulder - 0.02], [boot + 0.6 * lean, height - 0.08],
            [hood - lean, height - 0.06], [hood, shoulder - 0.02],
        ]
    )  # fmt: skip
    cabin = shapes.loft(cabin_profile, half * np.array([0.95, 0.78, 0.78, 0.95]))
    roof_length = hood - lean - boot - 0.6 * lean
    roof = shapes.box(half * 1.6, 0.09, max(roof_length, 0.5) + 0.1, 0.93).moved(
        y=-height + 0.1, z=(hood - lean + boot + 0.6 * lean) / 2
    )
    dull = rng.random() < 0.6
    colour = np.full(3, rng.choice([0.03, 0.1, 0.25, 0.5, 0.75])) if dull else any_colour(rng) * 0.8
    lacquer = coat(rng, colour, contrast=0.06, grain=0.05, gloss=rng.uniform(0.03, 0.18))
    glass = coat(rng, GLASS, contrast=0.6, grain=0.4, gloss=rng.uniform(0.04, 0.3))
    thing: Thing = [(body, lacquer), (cabin, glass), (roof, lacquer)]
    if rng.random() < 0.7:
        mid = (hood - lean + boot + 0.6 * lean) / 2
        thing += [
            (
                shapes.box(half * 1.84, height - shoulder, 0.09, 0.86).moved(y=-shoulder, z=mid),
                lacquer,
            )
        ]
    if detail < 0.15:
        return thing
    return thing + _wheels(rng, length, half) + _car_ends(rng, back, front, half, shoulder)


def _wheels(rng: Rng, length: float, half: float, radius: float = 0.31) -> Thing:
    tyre, hub = plain(rng, TYRE), coat(rng, METAL, "print", 0.5)
    thing: Thing = []
    for x in (-half + 0.08, half - 0.08):
        for z in (-0.31 * length, 0.31 * length):
            thing += [
                (shapes.wheel(radius, 0.2).moved(x=x, z=z), tyre),
                (shapes.wheel(0.6 * radius, 0.22).moved(x=x, y=-0.4 * radius, z=z), hub),
            ]
    return thing


def _car_ends(rng: Rng, back: float, front: float, half: float, shoulder: float) -> Thing:
    """Lamps, number plates and a bumper line."""
    red = lamp(rng, (0.6, 0.02, 0.02), float(rng.choice([0, 0, 0.8])))
    white = lamp(rng, (0.8, 0.8, 0.75), float(rng.choice([0, 0, 1.2])))
    plate = coat(rng, (0.7, 0.7, 0.66), "print", 0.4, second=(0.05, 0.05, 0.05))
    bumper = plain(rng, (0.06, 0.06, 0.065))
    small = shapes.box(0.3, 0.16, 0.08)
    thing: Thing = [
        (shapes.quad(0.5, 0.12).moved(y=-0.62, z=back - 0.02), plate),
        (shapes.quad(0.5, 0.12).moved(y=-0.42, z=front + 0.02), plate),
        (shapes.box(1.9 * half, 0.14, 0.1).moved(y=-0.3, z=back), bumper),
        (shapes.box(1.85 * half, 0.14, 0.1).moved(y=-0.28, z=front - 0.03), bumper),
    ]
    for side in (-1, 1):
        x = side * (half - 0.22)
        thing += [
            (small.moved(x=x, y=-shoulder + 0.28, z=back), red),
            (small.moved(x=x, y=-0.58, z=front - 0.06), white),
        ]
    return thing


def truck(rng: Rng) -> Thing:
    """A lorry with a cab and a box, a tarpaulin or an open bed."""
    length, width, height = rng.uniform(6, 12), rng.uniform(2.2, 2.5), rng.uniform(2.8, 3.9)
    cab_length = rng.uniform(1.6, 2.2)
    cab_paint = coat(rng, any_colour(rng), contrast=0.1, gloss=0.05)
    kind = str(rng.choice(["print", "panels", "noise", "stripes"]))
    load = coat(rng, any_colour(rng, 0.3), kind, rng.uniform(2, 5), second=any_colour(rng))
    rear = -length / 2 + (length - cab_length) / 2 - 0.1
    front = length / 2 - cab_length / 2
    cab_height = min(height, rng.uniform(2.4, 3.0))
    glass = coat(rng, GLASS, gloss=0.3)
    return [
        (shapes.box(width, height - 1, length - cab_length - 0.2).moved(y=-1.0, z=rear), load),
        (shapes.box(width * 0.95, 0.35, length).moved(y=-0.65), plain(rng, (0.05, 0.05, 0.05))),
        (shapes.box(width, cab_height - 0.5, cab_length, 0.94).moved(y=-0.5, z=front), cab_paint),
        (
            shapes.box(width * 0.99, 0.75, cab_length * 0.9).moved(y=-1.6, z=front + 0.12), glass,
        ),
        *_wheels(rng, length, width / 2, 0.48),
    ]  # fmt: skip


def bus(rng: Rng) -> Thing:
    """A long box with a band of windows."""
    return _coach(rng, rng.uniform(9, 13), rng.uniform(2.4, 2.55), rng.uniform(2.8, 3.3), True)


def train(rng: Rng) -> Thing:
    """A tram or a train of two cars."""
    first = _coach(rng, rng.uniform(14, 22), 2.6, rng.uniform(3.2, 3.8), False)
    length = float(np.ptp(first[0][0].corners[..., 2]))
    return first + [(shape.moved(z=-length - 0.6), paint) for shape, paint in first]


def _coach(rng: Rng, length: float, width: float, height: float, wheels: bool) -> Thing:
    paint = coat(rng, any_colour(rng), contrast=0.15, gloss=0.05)
    stripe = coat(rng, any_colour(rng), "print", 4.0)
    glass = coat(rng, GLASS, "panels", rng.uniform(2, 4), contrast=0.9, gloss=0.3)
    thing: Thing = [
        (shapes.box(width, height - 0.35, length, 0.99).moved(y=-0.35), paint),
        (shapes.box(width + 0.03, 0.9, length - 0.4).moved(y=-0.45 * height - 0.1), glass),
        (shapes.box(width + 0.02, 0.4, length - 0.2).moved(y=-0.5), stripe),
        (shapes.box(width * 0.9, 0.9, length + 0.04).moved(y=-0.45 * height), glass),
    ]
    return thing + (_wheels(rng, length, width / 2, 0.45) if wheels else [])


def person(rng: Rng) -> Thing:
    """Someone standing or walking."""
    height = rng.uniform(1.45, 1.95)
    stride = rng.uniform(0, 0.4)
    trousers, coat_, skin, hair = _clothes(rng)
    leg = shapes.tube(0.07, 0.1, 0.48 * height, 6)
    hip = 0.48 * height
    shoulder = 0.82 * height
    arm = shapes.tube(0.05, 0.06, 0.36 * height, 6)
    swing = rng.uniform(0, 0.4)
    thing: Thing = [
        (leg.moved(y=hip - 0.48 * height).pitched(stride / 2).moved(x=-0.1), trousers),
        (leg.moved(y=hip - 0.48 * height).pitched(-stride / 2).moved(x=0.1), trousers),
        (shapes.box(0.42, shoulder - hip + 0.05, 0.24, 1.06).moved(y=-hip + 0.04), coat_),
        (arm.pitched(-swing).moved(x=-0.26, y=-shoulder + 0.36 * height), coat_),
        (arm.pitched(swing).moved(x=0.26, y=-shoulder + 0.36 * height), coat_),
        (shapes.ball(0.09, 0.13, 0.11).moved(y=-height + 0.26), skin),
        (shapes.ball(0.1, 0.08, 0.12).moved(y=-height + 0.14), hair),
    ]
    if rng.random() < 0.35:
        bag = coat(rng, any_colour(rng), grain=0.4)
        thing.append((shapes.box(0.3, 0.4, 0.16).moved(y=-shoulder + 0.45, z=-0.2), bag))
    return thing


def _clothes(rng: Rng) -> tuple[Paint, Paint, Paint, Paint]:
    kind = str(rng.choice(["noise", "stripes", "noise", "print"]))
    return (
        coat(rng, any_colour(rng, 0.6) * 0.5, tile_m=0.5),
        coat(rng, any_colour(rng, 0.2), kind, 0.6),
        plain(rng, SKINS[int(rng.integers(3))]),
        coat(rng, any_colour(rng, 0.7) * 0.4, tile_m=0.2),
    )


def bicycle(rng: Rng) -> Thing:
    """Two thin wheels and a frame."""
    tyre, paint = plain(rng, TYRE), plain(rng, any_colour(rng), 0.05)
    bar = shapes.tube(0.025, 0.025, 0.75, 5)
    return [
        (shapes.rim(0.34, 0.06).moved(z=-0.52), tyre),
        (shapes.rim(0.34, 0.06).moved(z=0.52), tyre),
        (bar.pitched(-0.75).moved(y=-0.34, z=-0.05), paint),
        (bar.pitched(0.45).moved(y=-0.34, z=-0.1), paint),
        (bar.pitched(-0.3).moved(y=-0.3, z=0.5), paint),
        (bar.pitched(1.45).moved(y=-0.85, z=0.4), paint),
        (bar.tilted(np.pi / 2).moved(x=0.37, y=-1.0, z=0.32), plain(rng, METAL)),
        (shapes.box(0.14, 0.06, 0.26).moved(y=-0.95, z=-0.25), plain(rng, TYRE)),
    ]


def motorcycle(rng: Rng) -> Thing:
    """Thicker wheels, a tank and a seat."""
    tyre, paint = plain(rng, TYRE), coat(rng, any_colour(rng), gloss=0.1)
    return [
        (shapes.wheel(0.31, 0.14).moved(z=-0.65), tyre),
        (shapes.wheel(0.31, 0.12).moved(z=0.68), tyre),
        (shapes.box(0.26, 0.35, 0.7).moved(y=-0.28), plain(rng, METAL)),
        (shapes.ball(0.17, 0.16, 0.32).moved(y=-0.62, z=0.15), paint),
        (shapes.box(0.26, 0.12, 0.7).moved(y=-0.72, z=-0.4), plain(rng, TYRE)),
        (shapes.tube(0.04, 0.04, 0.8, 5).pitched(-0.45).moved(y=-0.3, z=0.68), plain(rng, METAL)),
        (shapes.box(0.7, 0.05, 0.05).moved(y=-1.02, z=0.38), plain(rng, METAL)),
        (shapes.ball(0.1, 0.1, 0.08).moved(y=-0.85, z=0.55), lamp(rng, (0.8, 0.8, 0.8), 0.3)),
    ]


def rider(rng: Rng) -> Thing:
    """Someone who sits on a bicycle or a motorcycle."""
    trousers, coat_, skin, hair = _clothes(rng)
    helmet = hair if rng.random() < 0.4 else coat(rng, any_colour(rng), "print", 0.4, gloss=0.05)
    leg = shapes.tube(0.06, 0.09, 0.8, 6)
    return [
        (leg.pitched(0.35).moved(x=-0.13, y=-0.25, z=0.1), trousers),
        (leg.pitched(0.1).moved(x=0.13, y=-0.2, z=-0.12), trousers),
        (shapes.box(0.4, 0.62, 0.24).pitched(-0.3).moved(y=-0.95, z=-0.22), coat_),
        (shapes.tube(0.05, 0.06, 0.6, 6).pitched(1.0).moved(x=-0.25, y=-1.05, z=0.4), coat_),
        (shapes.tube(0.05, 0.06, 0.6, 6).pitched(1.0).moved(x=0.25, y=-1.05, z=0.4), coat_),
        (shapes.ball(0.09, 0.13, 0.11).moved(y=-1.52, z=0.02), skin),
        (shapes.ball(0.12, 0.1, 0.14).moved(y=-1.66, z=0.0), helmet),
    ]


GREENS = ((0.1, 0.16, 0.05), (0.16, 0.2, 0.06), (0.06, 0.1, 0.04), (0.22, 0.19, 0.06))


def _leaf_paint(rng: Rng, tile_m: float) -> Paint:
    base = np.array(GREENS[int(rng.integers(len(GREENS)))]) * rng.uniform(0.6, 1.5)
    return coat(rng, base, "leaves", tile_m, contrast=0.75, grain=0.5)


def tree(rng: Rng, detail: float) -> Thing:
    """A trunk, branches where it is bare, and crowns of leaves; `detail` is 1 near, 0 far."""
    height = rng.uniform(3.5, 13)
    trunk = rng.uniform(0.25, 0.45) * height
    thick = rng.uniform(0.08, 0.25) * height / 7
    bark = coat(rng, WOOD, "noise", 0.6, contrast=0.5)
    thing: Thing = [(shapes.tube(thick, 0.7 * thick, trunk * 1.3, 8), bark)]
    if rng.random() < 0.08:
        return thing + _branches(rng, bark, trunk, height, thick)
    radius = rng.uniform(0.25, 0.5) * (height - trunk)
    for _ in range(int(rng.integers(2, 5))):
        x, z = rng.normal(0, 0.45 * radius, 2)
        radii = radius * rng.uniform(0.6, 1.1, 3) * [1, 1.2, 1]
        up = -trunk - rng.uniform(0, 0.35) * radius
        thing += _crown(rng, radii, x, up, z, detail)
    return thing


def _branches(rng: Rng, bark: Paint, trunk: float, height: float, thick: float) -> Thing:
    """A tree in winter."""
    thing: Thing = []
    for _ in range(int(rng.integers(6, 14))):
        branch = shapes.tube(0.45 * thick, 0.1 * thick, rng.uniform(0.3, 0.6) * height, 5)
        branch = branch.tilted(rng.uniform(-1, 1)).pitched(rng.uniform(-0.9, 0.9))
        thing.append((branch.moved(y=-trunk * rng.uniform(0.7, 1.25)), bark))
    return thing


def _crown(rng: Rng, radii: NDArray[Any], x: float, y: float, z: float, detail: float) -> Thing:
    paint = _leaf_paint(rng, rng.uniform(0.7, 2.0))
    leaf = rng.uniform(0.07, 0.2) * (1 + 0.7 * (1 - detail))
    count = int(np.clip(detail * 2.5 * radii.max() ** 2 / leaf**2, 8, 16 + 130 * detail))
    core = shapes.lump(rng, 0.92 * radii, detail > 0.4).moved(x=x, y=y - 0.08 * radii[1], z=z)
    return [(core, paint), (shapes.foliage(rng, radii, leaf, count).moved(x=x, y=y, z=z), paint)]


def bush(rng: Rng, detail: float) -> Thing:
    """One to three low crowns."""
    thing: Thing = []
    for _ in range(int(rng.integers(1, 4))):
        radii = rng.uniform(0.3, 1.3, 3)
        x, z = rng.normal(0, 0.6, 2)
        thing += _crown(rng, radii, x, 0.1, z, detail)
    return thing


def hedge(rng: Rng, length: float, detail: float) -> Thing:
    """A clipped wall of leaves along z."""
    height, depth = rng.uniform(0.7, 2.4), rng.uniform(0.4, 1.2)
    paint = _leaf_paint(rng, rng.uniform(0.5, 1.2))
    radii = np.array([0.55 * depth, 0.5 * height, 0.52 * length])
    leaves = shapes.foliage(rng, radii * [1.1, 1.1, 1.0], 0.12, int(20 + 180 * detail))
    return [(shapes.box(depth, height, length), paint), (leaves, paint)]


def building(rng: Rng, width: float, depth: float) -> Thing:
    """A house whose front looks to −x; `width` runs along z."""
    storey = rng.uniform(2.8, 3.6)
    height = storey * int(rng.choice([1, 2, 2, 3, 3, 4, 5, 7])) + rng.uniform(0, 0.6)
    wall_colour = any_colour(rng, rng.uniform(0.6, 1)) * rng.uniform(0.5, 1.0) + 0.05
    glass = np.array(GLASS) * rng.uniform(1, 6)
    front = coat(rng, wall_colour, "windows", 2 * storey, grain=0.2, second=glass)
    kind = str(rng.choice(["brick", "noise", "panels", "windows"]))
    side = coat(rng, wall_colour, kind, rng.uniform(1, 4), grain=0.3)
    walls = shapes.box(depth, height, width)
    paint = front if rng.random() < 0.85 else side
    thing: Thing = [(walls, paint)]
    roof = coat(rng, (0.25, 0.12, 0.09) if rng.random() < 0.6 else (0.12, 0.12, 0.13), "brick", 1.5)
    if rng.random() < 0.6:
        thing.append(
            (
                shapes.gable(depth * 1.08, rng.uniform(0.2, 0.45) * depth, width).moved(y=-height),
                roof,
            )
        )
    else:
        thing.append((shapes.box(depth * 1.04, 0.4, width * 1.02).moved(y=-height), side))
    return thing + _ornaments(rng, side, width, depth, height, storey)


def _ornaments(
    rng: Rng, paint: Paint, width: float, depth: float, height: float, storey: float
) -> Thing:
    """Balconies, ledges, a shop front, a door: what stands out of a façade."""
    face = -depth / 2
    thing: Thing = []
    if rng.random() < 0.5:
        thing += [
            (shapes.box(0.35, 0.2, width).moved(x=face, y=-up), paint)
            for up in np.arange(storey, height, storey)
        ]
    if rng.random() < 0.4 and height > storey:
        rail = coat(rng, any_colour(rng, 0.5), "stripes", 0.5)
        for _ in range(int(rng.integers(1, 6))):
            up = storey * int(rng.integers(1, max(2, int(height / storey))))
            z = rng.uniform(-0.4, 0.4) * width
            thing.append((shapes.box(1.4, 1.1, 2.6).moved(x=face - 0.5, y=-up, z=z), rail))
    if rng.random() < 0.5:
        shop = coat(rng, any_colour(rng, 0.5), "print", rng.uniform(2, 6), second=any_colour(rng))
        thing.append((shapes.box(0.3, storey * 0.85, width * 0.9).moved(x=face), shop))
    door = coat(rng, any_colour(rng) * 0.5, "panels", 1.0)
    thing.append((shapes.box(0.12, 2.1, 1.1).moved(x=face, z=rng.uniform(-0.4, 0.4) * width), door))
    return thing


def wall(rng: Rng, length: float) -> Thing:
    """A masonry wall along z."""
    kind = str(rng.choice(["brick", "noise", "panels"]))
    paint = coat(rng, any_colour(rng, 0.7), kind, rng.uniform(1, 3))
    height = rng.uniform(0.7, 3.0)
    cap = (shapes.box(0.45, 0.12, length).moved(y=-height), coat(rng, any_colour(rng, 0.8)))
    return [(shapes.box(0.3, height, length), paint), cap]


def fence(rng: Rng, length: float) -> Thing:
    """Posts with rails or pickets along z."""
    height = rng.uniform(0.8, 2.0)
    paint = coat(rng, WOOD if rng.random() < 0.5 else METAL, grain=0.3)
    pitch = float(rng.choice([0.15, 0.3, 1.5, 2.5]))
    thick = min(0.08, 0.4 * pitch)
    count = int(np.clip(length / pitch, 2, 45))
    post = shapes.box(thick, height, thick)
    posts = [post.moved(z=z) for z in np.linspace(-length / 2, length / 2, count)]
    rails = [
        shapes.box(0.04, 0.09, length).moved(y=-height * up)
        for up in rng.choice([0.2, 0.4, 0.6, 0.8, 0.95], int(rng.integers(2, 4)), replace=False)
    ]
    return [(shapes.joined(*posts, *rails), paint)]


def guard_rail(rng: Rng, length: float) -> Thing:
    """A crash barrier along z."""
    paint = coat(rng, METAL, grain=0.3)
    posts = [shapes.box(0.12, 0.7, 0.12).moved(z=z) for z in np.arange(-length / 2, length / 2, 3)]
    return [
        (shapes.box(0.08, 0.32, length).moved(x=-0.1, y=-0.42), paint),
        (shapes.joined(*posts), paint),
    ]


def lamp_post(rng: Rng) -> Thing:
    """A lamp on an arm over the road (towards −x), or a bare mast."""
    height, thick = rng.uniform(4, 9), rng.uniform(0.05, 0.1)
    paint = coat(rng, METAL if rng.random() < 0.7 else any_colour(rng) * 0.5, grain=0.2)
    thing: Thing = [(shapes.tube(thick, 0.7 * thick, height), paint)]
    if rng.random() < 0.7:
        arm = rng.uniform(0.8, 2.2)
        bar = shapes.tube(0.05, 0.04, arm, 6).tilted(-np.pi / 2 + 0.1)
        thing += [
            (bar.moved(y=-height + 0.1), paint),
            (shapes.box(0.6, 0.14, 0.25).moved(x=-arm, y=-height), paint),
        ]
    return thing


def wooden_pole(rng: Rng) -> Thing:
    """A mast of wood with a cross-beam."""
    bark = coat(rng, WOOD, contrast=0.4)
    height = rng.uniform(6, 9)
    beam = shapes.box(1.8, 0.1, 0.1).moved(y=-height + 0.6)
    return [(shapes.tube(0.14, 0.11, height), bark), (beam, bark)]


def bollard(rng: Rng) -> Thing:
    """A short post."""
    paint = coat(rng, any_colour(rng), "stripes", 0.5)
    return [(shapes.tube(rng.uniform(0.05, 0.12), 0.06, rng.uniform(0.6, 1.1)), paint)]


def sign(rng: Rng) -> Labelled:
    """A traffic sign: its pole, and its plate that looks to −z."""
    height = rng.uniform(2.0, 3.2)
    pole = shapes.tube(0.04, 0.04, height, 6)
    size = rng.uniform(0.5, 1.0)
    face = coat(rng, any_colour(rng), "print", size, grain=0.05, second=any_colour(rng))
    plates: Thing = []
    for level in range(int(rng.choice([1, 1, 2]))):
        up = -height + level * size * 1.05 + size
        kind = rng.integers(3)
        if kind == 0:
            plate = shapes.wheel(size / 2, 0.03, 12).moved(yaw=np.pi / 2).moved(y=up)
        elif kind == 1:
            plate = shapes.quad(size, size).moved(y=up)
        else:
            plate = shapes.quad(size * 1.4, size * 0.6).moved(y=up)
        plates.append((plate.moved(z=-0.06), face))
    return {"pole": [(pole, coat(rng, METAL))], "traffic sign": plates}


def traffic_light(rng: Rng) -> Labelled:
    """A signal: its pole with an arm now and then, and the box with three lamps."""
    height = rng.uniform(2.4, 3.4)
    metal = coat(rng, METAL if rng.random() < 0.6 else (0.6, 0.5, 0.05))
    pole: Thing = [(shapes.tube(0.07, 0.06, height), metal)]
    head: Thing = _signal(rng, 0.0, height)
    if rng.random() < 0.35:
        arm = rng.uniform(2, 5)
        pole = [(shapes.tube(0.1, 0.07, 5.6), metal)]
        bar = shapes.tube(0.06, 0.05, arm, 6).tilted(-np.pi / 2)
        pole.append((bar.moved(y=-5.5), metal))
        head = head + _signal(rng, -arm, 6.0)
    return {"pole": pole, "traffic light": head}


def _signal(rng: Rng, x: float, top: float) -> Thing:
    box = (shapes.box(0.32, 0.95, 0.25).moved(x=x, y=-top + 0.9, z=-0.15), plain(rng, TYRE))
    lit = int(rng.integers(3))
    colours = ((0.8, 0.05, 0.03), (0.8, 0.5, 0.03), (0.05, 0.7, 0.3))
    lamps = [
        (
            shapes.ball(0.1, 0.1, 0.04).moved(x=x, y=-top + 0.25 + 0.29 * i, z=-0.29),
            lamp(rng, np.array(colour) * (1 if i == lit else 0.15), 1.5 * (i == lit)),
        )
        for i, colour in enumerate(colours)
    ]
    return [box, *lamps]


def clutter(rng: Rng) -> Thing:
    """Bins, boxes and barriers: things of no class."""
    paint = coat(rng, any_colour(rng), str(rng.choice(["noise", "print", "stripes"])), 0.8)
    w, h, d = rng.uniform(0.3, 1.1, 3)
    shape = (
        shapes.box(w, h, d, rng.uniform(0.7, 1.1))
        if rng.random() < 0.7
        else shapes.tube(w / 2, w / 2.5, h)
    )
    return [(shape, paint)]
