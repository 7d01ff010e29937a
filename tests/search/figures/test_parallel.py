"""Parallel coordinates: a line for every network, through its values."""

from __future__ import annotations

from math import log
from typing import Any

import pytest

from rts2.search.figures.parallel import FEW, UNKNOWN, Axis, axes_of, parallel

from ..reports import found

TITLES = ["c", "stages", "branches", "d_max", "3D width 1", "3D width 2", "3D width 3"]
TITLES += ["runs as", "FPS", "D1-all", "EPE", "mIoU"]


def lines() -> dict[int, list[float]]:
    """Where each point of the front crosses the axes."""
    crossed: dict[int, list[float]] = {}
    for trace in parallel(found())["data"]:
        if trace["name"] == "pick":
            continue
        assert len(trace["x"]) == len(trace["y"]) == len(trace["customdata"])
        for x, y, at in zip(trace["x"], trace["y"], trace["customdata"], strict=True):
            if at is None:
                assert (x, y) == (None, None)
                continue
            assert x == len(crossed.setdefault(at, []))
            crossed[at].append(y)
    return crossed


def test_each_network_is_one_line_over_all_axes() -> None:
    assert [axis.title for axis in axes_of(found().front)] == TITLES
    assert sorted(lines()) == list(range(len(found().front)))
    assert {len(line) for line in lines().values()} == {len(TITLES)}


def test_a_line_crosses_an_axis_at_its_value() -> None:
    """From the lowest at 0 to the highest at 1; frame rates by their logarithms."""
    front = found().front
    rates = [log(point.fps) for point in front]
    errors = [point.d1_all or 0.0 for point in front]
    for at, line in lines().items():
        point, crossed = front[at], dict(zip(TITLES, line, strict=True))
        assert crossed["c"] == pytest.approx((point.arch.c - 1) / 15)
        assert crossed["stages"] == (point.arch.stages - 1) / 2
        share = (rates[at] - min(rates)) / (max(rates) - min(rates))
        assert crossed["FPS"] == pytest.approx(share)
        share = (errors[at] - min(errors)) / (max(errors) - min(errors))
        assert crossed["D1-all"] == pytest.approx(share)


def test_what_is_absent_or_unknown_passes_below_the_axis() -> None:
    below = [
        (name, at)
        for at, line in lines().items()
        for name, y in zip(TITLES, line, strict=True)
        if y == UNKNOWN
    ]
    front = found().front
    expected = [
        (name, at)
        for at, point in enumerate(front)
        for name, missing in (
            ("3D width 2", point.arch.stages < 2),
            ("3D width 3", point.arch.stages < 3),
            ("EPE", point.epe is None),
            ("mIoU", point.miou is None),
        )
        if missing
    ]
    assert sorted(below) == sorted(expected)
    assert {name for name, _ in below} == {"3D width 2", "3D width 3", "EPE", "mIoU"}


def test_the_pick_has_the_last_line() -> None:
    last = parallel(found())["data"][-1]
    assert found().selected is not None
    assert last["name"] == "pick"
    assert {at for at in last["customdata"] if at is not None} == {
        found().front.index(found().selected)
    }
    assert all(t["name"] != "pick" for t in parallel(found(target_fps=1e5))["data"])


def test_lines_of_one_kind_are_filtered_together() -> None:
    for trace in parallel(found())["data"]:
        kinds = {
            (p.precision, p.runtime, p.evidence.latency, p.evidence.accuracy)
            for at in trace["customdata"]
            if at is not None
            for p in [found().front[at]]
        }
        meta = trace["meta"]
        assert kinds == {(meta["precision"], meta["runtime"], meta["latency"], meta["accuracy"])}


@pytest.mark.parametrize(
    ("values", "labels"),
    [
        ((3.0, 3.0), [(0.5, "3")]),
        ((1.0, None, 2.0), [(0.0, "1"), (1.0, "2")]),
        ((None, None), []),
        (tuple(map(float, range(101))), [(q, f"{100 * q:g}") for q in (0, 0.25, 0.5, 0.75, 1)]),
    ],
)
def test_an_axis_is_labelled_with_its_values_or_with_a_few(values: Any, labels: Any) -> None:
    axis = Axis("it", values, "{:g}".format)
    assert axis.labels() == labels
    assert len(axis.labels()) <= FEW


def test_an_empty_front_has_axes_alone() -> None:
    empty = parallel(found(min_disparity=1e6))
    assert empty["data"] == []
