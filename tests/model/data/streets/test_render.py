"""Known surfaces: what they must measure, hide, show and reflect."""

import numpy as np
import pytest

from rts2.model.data.streets import paint, render, shapes
from rts2.model.data.streets.render import World
from rts2.model.data.streets.shading import Camera, Light
from rts2.model.data.streets.soup import Soup

LEFT = Camera(focal_px=100.0, centre=(31.5, 15.5), size=(64, 32))
RIGHT = LEFT._replace(x_m=0.5)
LIGHT = Light(
    sun=(0.0, -1.0, 0.0),
    up=(0.0, -1.0, 0.0),
    strength=0.0,
    warmth=(1.0, 1.0, 1.0),
    ambient=(1.0, 1.0, 1.0),
    zenith=(1.0, 1.0, 1.0),
    horizon=(1.0, 1.0, 1.0),
    clouds=0.0,
    cloud_pattern=0,
    haze=0.0,
)
GREY = paint.Paint((0.5, 0.5, 0.5), (0.5, 0.5, 0.5), 0, 1.0, 0, 1.0, 0.0)


def world(*parts: shapes.Shape, light: Light = LIGHT) -> World:
    """Grey shapes, each an object of its own with its number as label."""
    counts = [len(part.corners) for part in parts]
    number = np.repeat(np.arange(len(parts)), counts).astype(np.int32)
    whole = shapes.joined(*parts)
    return World(
        Soup(
            corners=whole.corners,
            uv=whole.uv,
            paint=np.zeros_like(number),
            label=number.astype(np.uint8),
            thing=number + 1,
            part=number,
            paints=paint.table([GREY]),
            eye=np.zeros(3),
        ),
        light,
    )


def sheet(z: float, left: float, right: float, far_z: float | None = None) -> shapes.Shape:
    """An upright rectangle from x = `left` at depth `z` to x = `right` at `far_z`."""
    end = z if far_z is None else far_z
    corners = [[[left, -9, z], [right, -9, end], [right, 9, end], [left, 9, z]]]
    return shapes.quads(np.array(corners), np.zeros((1, 4, 2)))


def seen(scene: World) -> tuple[render.Hits, np.ndarray, np.ndarray]:
    """What both eyes see, as maps: left hits, left disparity, visibility."""
    hits = render.see(scene, LEFT)
    return hits, 100 * 0.5 * hits.nearness, render.visible(scene, hits, LEFT, RIGHT)


def colours(scene: World) -> np.ndarray:
    """The left eye's image."""
    return render.look(scene, [LEFT], [render.see(scene, LEFT)])[0]


def test_disparity_of_a_wall_is_focal_times_baseline_over_depth() -> None:
    _, disparity, _ = seen(world(sheet(8.0, -50, 50)))
    assert disparity == pytest.approx(np.full((32, 64), 100 * 0.5 / 8), rel=1e-6)


def test_disparity_of_a_slanted_wall_is_linear_in_x() -> None:
    """On the plane z = 10 + x a ray (x', ·, 1) ends at z = 10 / (1 − x')."""
    _, disparity, _ = seen(world(sheet(5.0, -5, 40, far_z=50.0)))
    x = (np.arange(64) - 31.5) / 100
    assert disparity[7] == pytest.approx(50 * (1 - x) / 10, rel=1e-5)


def test_sky_is_infinitely_far_and_has_a_label() -> None:
    """The wall starts at column 31.5 of the left eye, at 25.25 of the right one."""
    scene = world(sheet(8.0, 0, 50))
    hits, disparity, visible = seen(scene)
    labels, things = render.labels(scene, hits)
    assert (disparity[:, :32] == 0).all()
    assert (labels[:, :32] == 10).all()
    assert (things[:, :32] == 0).all()
    assert (things[:, 32:] == 1).all()
    assert visible[:, :26].all()
    assert not visible[:, 26:32].any()


def test_a_post_hides_the_wall_to_its_left() -> None:
    """A post at 5 m (10 px) before a wall at 10 m (5 px) hides a strip of 5 px beside it.

    From pixel 36.5 on, the post covers columns 37 … 46; its left border is at 36.5 px, and the
    strip of the wall that it hides from the right eye is 31.5 … 36.5 px.
    """
    post = sheet(5.0, 0.25, 0.75)
    _, disparity, visible = seen(world(sheet(10.0, -50, 50), post))
    assert disparity[0, 36:48] == pytest.approx([5] + [10] * 10 + [5], rel=1e-6)
    row = visible[10]
    assert not row[:5].any()  # out of the right eye's view: 5 px of wall
    assert row[5:32].all()
    assert not row[32:37].any()
    assert row[37:].all()


def test_a_thin_wire_between_two_pixels_hides_nothing_else() -> None:
    wire = sheet(5.0, 0.2540, 0.2541)
    _, disparity, visible = seen(world(sheet(10.0, -50, 50), wire))
    assert (disparity < 6).all()
    assert (visible[:, 5:].sum(1) >= 58).all()


def test_light_falls_by_slope_and_shadow() -> None:
    """Grey 0.5: level ground gets all sky and sun, in the shadow of a roof the sky alone."""
    ground = np.array([[[-50, 1, 1], [50, 1, 1], [50, 1, 80], [-50, 1, 80]]], float)
    roof = ground.copy()
    roof[..., 1] = -60
    sunny = LIGHT._replace(strength=0.8)

    def brightness(*sheets: np.ndarray, light: Light) -> float:
        flat = [shapes.quads(corners, np.zeros((1, 4, 2))) for corners in sheets]
        return float(colours(world(*flat, light=light))[30, 31, 0])

    assert brightness(ground, light=LIGHT) == pytest.approx(0.5, rel=1e-4)
    assert brightness(ground, light=sunny) == pytest.approx(0.5 * 1.8, rel=1e-4)
    assert brightness(ground, roof, light=sunny) == pytest.approx(0.5, rel=1e-4)


def test_haze_leaves_the_horizons_light() -> None:
    light = LIGHT._replace(haze=0.05, horizon=(2.0, 2.0, 2.0))
    kept = np.exp(-0.05 * 10)
    image = colours(world(sheet(10.0, -50, 50), light=light))
    assert image == pytest.approx(0.5 * 0.55 * kept + 2 * (1 - kept), rel=1e-4)
