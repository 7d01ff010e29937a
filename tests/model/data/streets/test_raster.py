"""Random triangles, before, behind and around the eye, held against rays one by one."""

import numpy as np
import pytest

from rts2.model.data.streets import raster

WIDTH, HEIGHT = 24, 16


def triangles(seed: int, count: int = 30) -> np.ndarray:
    """Corners (n, 3, 3) in homogeneous cells; some reach behind the viewer."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(-1, 9, (count, 1)) + rng.normal(0, 1.5, (count, 3))
    place = rng.uniform([-8, -8], [WIDTH + 8, HEIGHT + 8], (count, 3, 2))
    return np.concatenate([place * z[..., None], z[..., None]], 2)


def ray(corner: np.ndarray, near: np.ndarray, x: float, y: float) -> float:
    """Nearness where the ray (x, y, 1) meets one triangle, −∞ where it does not."""
    if abs(np.linalg.det(corner)) < 1e-12:
        return -np.inf
    weights = np.linalg.solve(corner.T, [x, y, 1.0])
    return float(weights @ near) if (weights >= 0).all() else -np.inf


@pytest.mark.parametrize("seed", range(6))
def test_pixels_show_the_triangle_that_their_ray_meets_first(seed: int) -> None:
    corners = triangles(seed)
    near = np.ones(corners.shape[:2])
    which, nearness = raster.nearest(corners, near, WIDTH, HEIGHT)
    for y in range(HEIGHT):
        for x in range(WIDTH):
            met = [ray(corner, np.ones(3), x, y) for corner in corners]
            best = int(np.argmax(met))
            if met[best] == -np.inf:
                assert (which[y, x], nearness[y, x]) == (-1, 0)
            else:
                assert which[y, x] == best
                assert nearness[y, x] == pytest.approx(met[best], rel=1e-9)
    assert (which >= 0).mean() > 0.1


@pytest.mark.parametrize("seed", range(6))
def test_points_are_covered_by_what_their_ray_meets_before_them(seed: int) -> None:
    """Nearness of any kind: heights above a plane, too, as the sun sees them."""
    rng = np.random.default_rng([seed, 1])
    corners = triangles(seed, 8)
    near = rng.normal(0, 1, corners.shape[:2])
    points = rng.uniform([0, 0, -1], [WIDTH, HEIGHT, 1], (400, 3))
    found = raster.covered(corners, near, points, WIDTH, HEIGHT)
    for (x, y, limit), covered in zip(points, found, strict=True):
        met = [ray(corner, at, x, y) for corner, at in zip(corners, near, strict=True)]
        assert covered == (max(met) > limit)
    assert 0.05 < found.mean() < 0.95


def test_no_pixel_falls_through_a_seam() -> None:
    """A fan of thin triangles around a pixel's centre fills the whole plane."""
    turns = np.linspace(0, 2 * np.pi, 38)
    ring = np.stack([11 + 90 * np.cos(turns), 7 + 90 * np.sin(turns), np.ones(38)], 1)
    hub = np.tile([11.0, 7.0, 1.0], (37, 1))
    fan = np.stack([hub, ring[:-1], ring[1:]], 1) * 3.0
    which, _ = raster.nearest(fan, np.ones((37, 3)), WIDTH, HEIGHT)
    assert (which >= 0).all()
    assert len(np.unique(which)) == 37


def test_triangles_seen_edge_on_show_nothing() -> None:
    line = np.array([[[2.0, 2, 1], [5, 5, 1], [9, 9, 1]], [[4.0, 4, 1], [4, 4, 1], [8, 2, 1]]])
    which, _ = raster.nearest(line, np.ones((2, 3)), WIDTH, HEIGHT)
    assert (which == -1).all()
