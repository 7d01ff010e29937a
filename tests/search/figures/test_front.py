"""The front's figures: every value is front.json's, and every point is drawn once."""

from __future__ import annotations

import json
from math import log10
from typing import Any

import pytest

from rts2.profiles.profile import load
from rts2.search.accuracy import Metric
from rts2.search.context import context
from rts2.search.exhaustive import search
from rts2.search.figures import figures, metrics_of
from rts2.search.figures.front import front
from rts2.search.figures.style import SYMBOLS
from rts2.search.palette import ON_DARK, colours
from rts2.search.report import executor_of
from rts2.search.result import Found
from rts2.search.sources import source

from ..reports import SPACE, demoted, dimensions, found, question

PUBLISHED = context(load("tx2"), (1242, 375))
CASES: list[dict[str, Any]] = [
    {},
    {"objective": "miou", "target_fps": 6.0},
    {"objective": "epe", "target_fps": 6.0},
    {"task": "stereo"},
    {"target_fps": 1e5},
    {"resolution": (640, 480), "allow_extrapolated": True},
]


def drawn(known: Found, metric: Metric) -> list[dict[str, Any]]:
    return front(known, metric, PUBLISHED)["data"]


def series(known: Found, metric: Metric) -> list[dict[str, Any]]:
    """The traces of the front itself."""
    return [trace for trace in drawn(known, metric) if "customdata" in trace]


@pytest.mark.parametrize("asked", CASES)
def test_every_point_of_known_accuracy_is_drawn_once_with_the_values_of_the_json(
    asked: dict[str, Any],
) -> None:
    known = found(**asked)
    stored = json.loads(known.model_dump_json(by_alias=True))["front"]
    for metric in metrics_of(known):
        seen = []
        for trace in series(known, metric):
            bars = trace["error_x"]
            columns = (trace["customdata"], trace["x"], trace["y"], bars["array"])
            for at, x, y, up, down in zip(*columns, bars["arrayminus"], strict=True):
                point = stored[at]
                assert (x, y) == (point["fps"], point[metric])
                assert x + up == pytest.approx(point["fps_high"])
                assert x - down == pytest.approx(point["fps_low"])
                told = point["evidence"] | {"precision": point["precision"]}
                assert trace["meta"] == told | {"runtime": point["runtime"]}
                seen.append(at)
        assert sorted(seen) == [at for at, p in enumerate(stored) if p[metric] is not None]


def test_an_interval_of_an_accuracy_is_a_bar_and_none_has_no_length() -> None:
    doubtful = 0
    for trace in series(found(), "d1_all"):
        bars = trace["error_y"]
        columns = (trace["customdata"], trace["y"], bars["arrayminus"], bars["array"])
        for at, y, down, up in zip(*columns, strict=True):
            low, high = (found().front[at].ranges or {}).get("d1_all", (y, y))
            assert (y - down, y + up) == pytest.approx((low, high))
            doubtful += high > low
    assert 0 < doubtful < len(found().front)


def test_an_error_and_the_miou_are_shown() -> None:
    assert metrics_of(found()) == ("d1_all", "miou")
    assert metrics_of(found(objective="epe", target_fps=6.0)) == ("epe", "miou")
    assert metrics_of(found(objective="miou", target_fps=6.0)) == ("d1_all", "miou")


def test_a_marker_is_the_evidence_and_a_colour_what_runs_it() -> None:
    known = found()
    for trace in series(known, "d1_all"):
        first = known.front[trace["customdata"][0]]
        assert trace["marker"]["symbol"] == SYMBOLS[first.evidence.latency]
        assert trace["marker"]["color"] == colours(known)[executor_of(first)]
        assert (trace["opacity"] > 0.5) == first.proven


def test_proven_runtimes_have_colours_of_their_own(two_runtimes: Any) -> None:
    known = search(question(two_runtimes), source("published"), SPACE)
    proven = {executor_of(point) for point in known.front if point.proven}
    assert len(proven) > 1
    assert len({colours(known)[executor] for executor in proven}) == len(proven)


def test_the_pick_the_prospect_and_the_demoted_are_marked() -> None:
    known = demoted()
    assert known.selected is not None
    assert known.prospect is not None
    assert known.verified is not None
    assert known.verified.demoted is not None
    marks = {trace["name"]: trace for trace in drawn(known, "d1_all")}
    for name, point in (
        ("pick", known.selected),
        ("prospect", known.prospect),
        ("demoted, misses the target", known.verified.demoted),
    ):
        assert (marks[name]["x"], marks[name]["y"]) == ([point.fps], [point.d1_all])
        assert f"{point.fps:.1f} FPS" in marks[name]["hovertext"][0]
    assert known.selected.miou is None
    assert "pick" not in {trace["name"] for trace in drawn(known, "miou")}


def test_the_target_is_where_it_belongs() -> None:
    layout = front(found(), "d1_all", [])["layout"]
    (line,), (word,) = layout["shapes"], layout["annotations"]
    assert (line["x0"], line["x1"]) == (10.0, 10.0)
    assert word["x"] == log10(10.0), "words stand at logarithms, lines at values"
    assert word["text"] == "target 10 FPS"


def test_published_networks_are_named_where_their_metric_is_known() -> None:
    stereo, semantic = (
        {
            trace["meta"]["context"]: trace
            for trace in drawn(found(), m)
            if "context" in trace["meta"]
        }
        for m in metrics_of(found())
    )
    assert len(stereo["paper"]["x"]) == 15
    assert len(stereo["benchmark"]["text"]) == 9
    assert len(semantic["benchmark"]["text"]) == 5
    gan = stereo["benchmark"]["text"].index("GANet")
    assert stereo["benchmark"]["y"][gan] == 1.81
    assert stereo["benchmark"]["x"][gan] == pytest.approx(1 / 1.8)
    assert "other hardware" in stereo["benchmark"]["hovertext"][gan]
    assert "ICRA 2020" in stereo["benchmark"]["hovertext"][gan]
    epe = found(objective="epe", target_fps=6.0)
    assert all(t["meta"].get("context") != "benchmark" for t in drawn(epe, "epe"))


def test_all_figures_are_plain_json_in_colours_that_the_night_knows() -> None:
    text = json.dumps(figures(demoted(), dimensions(), PUBLISHED), allow_nan=False)
    names = json.loads(text).keys()
    assert names == {
        "front-d1_all",
        "front-miou",
        "parallel",
        *(f"dimension-{n}" for n in range(7)),
    }
    used = {part[:7] for part in text.split('"') if part.startswith("#")}
    assert used
    assert used <= ON_DARK.keys()
