"""What a frame per second costs, counted by hand."""

from __future__ import annotations

from typing import Any

import pytest

from rts2.model.arch import Arch
from rts2.search.result import Coverage, Found, Point, PointEvidence
from rts2.search.tradeoff import Step, price, sentence, steps


def point(
    fps: float, d1_all: float, miou: float | None = None, told: Any = "interpolated"
) -> Point:
    return Point(
        arch=Arch(c=8),
        precision="fp32",
        runtime="pytorch",
        latency_ms=1000 / fps,
        fps=fps,
        fps_low=fps,
        fps_high=fps,
        d1_all=d1_all,
        epe=None,
        miou=miou,
        pacc=None,
        params=0,
        size_bytes=0,
        macs=0,
        evidence=PointEvidence(latency=told, accuracy="interpolated"),
    )


PICK = point(10.0, 4.0, 60.0)
PROMISED = point(11.5, 3.0, told="extrapolated")
FRONT = [
    point(30.0, 9.0),
    point(14.0, 6.5),
    point(12.0, 5.0, 58.0),
    PROMISED,
    point(11.0, 4.5),
    point(10.5, 4.1),
    PICK,
    point(8.0, 3.5, 62.0),
    point(7.9, 3.4),
    point(7.8, 3.3),
    point(1.0, 3.0),
]


def found(front: list[Point], selected: Point | None) -> Found:
    return Found(
        device="tx2",
        target_fps=10.0,
        resolution=(1242, 375),
        task="stereo",
        objective="d1_all",
        confidence=0.9,
        space=Coverage(size=0, evaluated=0, exhaustive=True),
        front=tuple(front),
        selected=selected,
        prospect=None,
        nearest=None,
        left_out=(),
        elapsed_s=0.0,
    )


def test_three_neighbours_on_either_side_on_the_same_evidence() -> None:
    rates = [step.point.fps for step in steps(found(FRONT, PICK), PICK)]
    assert rates == [12.0, 11.0, 10.5, 8.0, 7.9, 7.8]


def test_at_an_end_there_are_fewer() -> None:
    assert [step.fps for step in steps(found(FRONT, FRONT[0]), FRONT[0])] == [-16.0, -18.0, -19.0]
    assert steps(found([PICK], PICK), PICK) == []


def test_a_step_is_a_difference_and_a_rate() -> None:
    """Two frames more lose a point of D1-all, two of mIoU; two fewer win half a point, and two."""
    faster, slower = Step(PICK, FRONT[2]), Step(PICK, FRONT[7])
    assert (faster.fps, faster.change("d1_all"), faster.change("miou")) == (2.0, 1.0, -2.0)
    assert (faster.per_fps("d1_all"), faster.per_fps("miou")) == (0.5, 1.0)
    assert (slower.fps, slower.change("d1_all"), slower.change("miou")) == (-2.0, -0.5, 2.0)
    assert (slower.per_fps("d1_all"), slower.per_fps("miou")) == (0.25, 1.0)


def test_what_is_not_known_of_both_has_no_price() -> None:
    unknown = Step(PICK, FRONT[4])
    assert unknown.change("miou") is None
    assert unknown.per_fps("miou") is None
    assert unknown.change("epe") is None


def test_the_price_is_that_of_the_best_at_least_one_frame_faster() -> None:
    """11 FPS are exactly one more; 10.5 are not, and what is only promised does not count."""
    known = found(FRONT, PICK)
    step = price(known, PICK)
    assert step is not None
    assert step.point.fps == 11.0
    assert "One more FPS costs 0.50 points of D1-all" in sentence(known, PICK)
    assert "11.0 FPS and 4.50%" in sentence(known, PICK)


@pytest.mark.parametrize("base", [FRONT[0], PROMISED])
def test_without_a_faster_one_that_is_said(base: Point) -> None:
    known = found([base, FRONT[-1]], base)
    assert price(known, base) is None
    assert sentence(known, base).startswith("No network of the front is one FPS faster")
