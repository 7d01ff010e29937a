"""The page of a search, read back as a browser reads it."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import pytest

from rts2.profiles.profile import Profile, load
from rts2.search.context import context
from rts2.search.figures import figures
from rts2.search.page import filters, hides_extrapolated, page
from rts2.search.report import remarks
from rts2.search.result import Found
from rts2.search.sensitivity import Dimension

from ..markup import MARK, Element, Tree
from .reports import demoted, dimensions, found

SCRIPT = re.compile(r"<script>/\*\*.*?</script>", re.DOTALL)


def text(known: Found, shown: tuple[Dimension, ...] = (), profile: Profile | None = None) -> str:
    """The page without Plotly's own script."""
    whole = page(known, profile or load("tx2"), shown)
    own, taken = SCRIPT.subn("", whole)
    assert taken == bool(known.front)
    assert known.front == () or len(whole) - len(own) > 1_000_000
    return own


@cache
def usual() -> Element:
    return Tree(text(found(), dimensions())).root


def rows(root: Element, section: str) -> list[Element]:
    return root.one("section", id=section).all("tbody")[0].all("tr")


def cells(row: Element) -> list[str]:
    return [each.text for each in row.inside if isinstance(each, Element)]


def test_the_page_is_a_document_with_a_language_and_a_title() -> None:
    assert text(found()).lstrip().startswith("<!DOCTYPE html>")
    root = usual()
    assert root.one("html").attributes["lang"] == "en"
    assert root.one("h1").text == "RTS²Net on Jetson TX2 · 1242×375 · semantic stereo"
    assert root.one("title").text.endswith("rts2-search")
    assert "candidates, every one" in root.one("p", class_="eyebrow").text
    headings = [each.text for each in root.all("h2")]
    assert len(set(headings)) == len(headings)


def test_the_headline_is_the_pick() -> None:
    header = usual().one("header")
    assert header.one("span", id="outcome").text == "pick: holds 10 FPS"
    assert header.one("p", class_="speed").text == "10.9 FPS (10.4–11.4, 90% interval)"
    assert header.one("p", class_="why").text == "c=8, 2 stages, full, fp32 on PyTorch"
    facts = {each.one("dt").text: each.one("dd").text for each in header.one("dl").all("div")}
    assert (facts["D1-all"], facts["mIoU"]) == ("4.70%", "–")


def test_without_a_pick_the_nearest_is_told() -> None:
    root = Tree(text(found(target_fps=1000.0), dimensions(target_fps=1000.0))).root
    assert root.one("span", id="outcome").text == "no network holds 1000 FPS"
    nearest = found(target_fps=1000.0).nearest
    assert nearest is not None
    assert root.one("p", class_="speed").text.startswith(f"{nearest.fps:.1f} FPS")
    assert root.one("p", class_="why").text.startswith("The fastest: ")
    assert "from the fastest to" in root.one("section", id="price").text


@pytest.mark.parametrize("searched", [found, demoted, partial(found, target_fps=40.0)])
def test_it_says_what_the_terminal_says(searched: Callable[[], Found]) -> None:
    known = searched()
    told = Tree(text(known)).root.one("section", id="remarks")
    lines = [re.sub(r"\s+", " ", line) for _, line in remarks(known, load("tx2"))]
    assert [each.text for each in told.all("p")] == lines
    labels = [label for label, _ in remarks(known, load("tx2")) if label]
    assert [each.text for each in told.all("dt")] == labels


def test_cost_and_verification_are_told() -> None:
    told = Tree(text(demoted())).root.one("section", id="remarks").text
    for part in ("40 of 1,234 chains judged", "5 points", "misses the target"):
        assert part in told
    assert "demoted" in [each.text for each in Tree(text(demoted())).root.all("li")]


def test_the_table_has_every_point_with_its_values() -> None:
    """Numbers to sort by are front.json's."""
    root = usual()
    titles = [each.text for each in root.one("section", id="front").one("thead").all("th")]
    assert len(rows(root, "front")) == len(found().front)
    for row, point in zip(rows(root, "front"), found().front, strict=True):
        values = dict(zip(titles, (e for e in row.inside if isinstance(e, Element)), strict=True))
        assert float(values["FPS"].attributes["data-value"]) == point.fps
        assert float(values["D1-all, %"].attributes["data-value"]) == point.d1_all
        assert values["mIoU, %"].attributes["data-value"] == (
            "" if point.miou is None else str(point.miou)
        )
        assert (values["mIoU, %"].text == "–") == (point.miou is None)
        assert values["3D widths"].text == "/".join(map(str, point.arch.conv3d))
        assert row.attributes["data-latency"] == point.evidence.latency
        assert row.attributes["data-precision"] == point.precision
        picked = point == found().selected
        assert (row.attributes.get("class") == "picked") == picked
        assert values["role"].text == (
            "▶ pick" if picked else "prospect" if point == found().prospect else ""
        )


def test_what_one_more_frame_costs_is_told() -> None:
    section = usual().one("section", id="price")
    assert section.one("p", class_="sentence").text.startswith("One more FPS costs ")
    for row in rows(usual(), "price"):
        name, fps, more = cells(row)[:3]
        assert float(fps) == pytest.approx(10.9 + float(more.replace("−", "-")), abs=0.11)
        assert "fp32 on PyTorch" in name


def test_each_dimension_has_a_figure_and_its_numbers() -> None:
    section = usual().one("section", id="dimensions")
    drawn = [each.attributes["data-figure"] for each in section.all("div", role="img")]
    assert drawn == [f"dimension-{at}" for at in range(len(dimensions()))]
    for table, known in zip(section.all("table"), dimensions(), strict=True):
        values = [cells(row) for row in table.one("tbody").all("tr")]
        assert [row[0] for row in values] == [each.value for each in known.variations]
        own = next(row for row in values if row[0] == known.own)
        assert own[2:] == ["±0.0", "4.70%", "±0.00"]
        for row, each in zip(values, known.variations, strict=True):
            assert (row[3] == "–") == (each.point.d1_all is None)


def test_the_filters_are_what_occurs_and_is_not_all_alike() -> None:
    published = context(load("tx2"), (1242, 375))
    known = {each.key: [box.value for box in each.boxes] for each in filters(found(), published)}
    assert known["precision"] == ["fp32", "fp16"]
    assert known["context"] == ["paper", "benchmark"]
    for box in usual().one("form").all("input"):
        assert box.attributes["type"] == "checkbox"
        told = (box.attributes["name"], box.attributes["value"])
        hidden = told in (("accuracy", "extrapolated"), ("context", "benchmark"))
        assert ("checked" in box.attributes) == (not hidden)
    only = found(precisions=("fp32",), runtimes=("pytorch",))
    assert {each.key for each in filters(only, published)} == {"latency", "accuracy", "context"}


def test_extrapolated_accuracies_are_shown_where_the_pick_rests_on_one() -> None:
    assert hides_extrapolated(found())
    assert found().selected is not None
    told = found().selected.evidence.model_copy(update={"accuracy": "extrapolated"})
    pick = found().selected.model_copy(update={"evidence": told})
    assert not hides_extrapolated(found().model_copy(update={"selected": pick}))


def test_the_script_gets_the_figures_as_they_are() -> None:
    given = json.loads(usual().one("script", id="data").text)
    drawn = figures(found(), dimensions(), context(load("tx2"), (1242, 375)))
    assert given["figures"].keys() == drawn.keys()
    assert given["figures"]["front-d1_all"]["data"][2]["x"] == drawn["front-d1_all"]["data"][2]["x"]
    assert len(given["texts"]) == len(found().front)
    places = [each.attributes["data-figure"] for each in usual().all("div", role="img")]
    assert sorted(places) == sorted(drawn)


def test_an_empty_front_is_a_page_too() -> None:
    root = Tree(text(found(min_disparity=1e6))).root
    assert [e.attributes["id"] for e in root.all("section")] == ["remarks", "words"]
    assert root.all("script") == []
    linked = {each.attributes["href"] for each in root.one("nav").all("a")}
    assert linked == {"#remarks", "#words"}


@pytest.mark.parametrize(
    "asked",
    [
        {"resolution": (640, 480)},
        {"resolution": (640, 480), "allow_extrapolated": True},
        {"objective": "miou", "target_fps": 6.0},
        {"target_fps": 40.0},
        {"task": "stereo", "max_size_bytes": 30_000},
    ],
)
def test_any_search_has_a_page(asked: dict[str, Any]) -> None:
    root = Tree(text(found(**asked), dimensions(**asked))).root
    main = root.one("main").text
    assert not re.search(r"\b(None|nan|null|undefined)\b", main)
    linked = {each.attributes["href"][1:] for each in root.one("nav").all("a")}
    assert linked == {each.attributes["id"] for each in root.all("section")}


def test_names_are_text() -> None:
    profile = load("tx2").model_copy(update={"title": MARK})
    left_out = found().left_out[0].model_copy(update={"reason": MARK})
    known = found().model_copy(update={"left_out": (left_out,)})
    whole = text(known, dimensions(), profile)
    assert "alert('x')" not in whole
    root = Tree(whole).root
    assert len(root.all("script")) == 2
    assert MARK in root.one("h1").text
    assert MARK in root.one("section", id="remarks").text


def test_nothing_is_fetched() -> None:
    own = text(found(), dimensions())
    assert not re.search(r"https?:|url\(|@import|\bsrc=|<link|\bfetch\(", own)
    policy = usual().one("meta", http_equiv="Content-Security-Policy").attributes["content"]
    assert policy.startswith("default-src 'none'")
    assert "http" not in policy
    assert {each.attributes["href"][0] for each in usual().all("a")} == {"#"}


def test_every_figure_says_what_it_shows() -> None:
    labels = [each.attributes["aria-label"] for each in usual().all("div", role="img")]
    assert "D1-all in percent against frames per second" in labels
    assert len(set(labels)) == len(labels)
    assert all(len(label) > 10 for label in labels)


def test_a_device_of_ones_own_has_no_networks_of_the_paper(by_parts: Profile) -> None:
    root = Tree(text(found(), dimensions(), by_parts)).root
    values = [each.attributes["value"] for each in root.one("form").all("input")]
    assert "paper" not in values
    assert "benchmark" in values
