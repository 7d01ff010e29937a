"""The page in a browser: its figures are drawn, its filters act on all of them."""

from __future__ import annotations

from functools import cache

from rts2.profiles.profile import load
from rts2.search.page import page

from ..browser import Browser
from .reports import dimensions, found

ACT = """
const all = (within, what) => [...document.querySelectorAll(`${within} ${what}`)];
const front = "[data-figure=front-d1_all]";
const marks = () => all(front, ".trace .points path").length;
const lines = () => all("[data-figure=parallel]", ".trace .js-line").length;
const rows = () => all("#front tbody", "tr:not([hidden])");
const click = value => document.querySelector(`.boxes input[value="${value}"]`).click();
const told = () => document.querySelector(".boxes output").textContent;
const state = () => ({front: marks(), lines: lines(), rows: rows().length, told: told()});
const settled = () => new Promise(resolve => setTimeout(resolve, 500));
await settled();
seen.figures = [...document.querySelectorAll("[data-figure]")].filter(
  each => !each.querySelector(".main-svg .trace .points path")).map(each => each.dataset.figure);
seen.first = state();
document.querySelector(".boxes input[name=accuracy][value=extrapolated]").click(); await settled();
seen.all = state();
click("fp16"); await settled();
seen.without = state();
seen.precisions = [...new Set(rows().map(each => each.dataset.precision))];
click("fp16"); click("benchmark"); await settled();
seen.benchmark = state();
click("benchmark"); await settled();
seen.restored = state();
const sort = all("#front th", "button").find(each => each.textContent === "FPS");
const rates = () => rows().map(each => Number(each.querySelectorAll("td")[8].dataset.value));
sort.click(); seen.rising = rates();
sort.click(); seen.falling = rates();
const place = document.querySelector(front);
const curveNumber = place.data.findIndex(each => each.customdata);
Plotly.Fx.hover(place, [{curveNumber, pointNumber: 0}]);
await settled();
seen.hover = place.querySelector(".hovertext")?.textContent;
"""


@cache
def usual() -> str:
    return page(found(), load("tx2"), dimensions())


def test_every_figure_is_drawn_and_the_filters_act_on_all_of_them(browser: Browser) -> None:
    seen = browser.acted(usual(), ACT, (1000, 900))
    assert seen["faults"] == []
    assert seen["fetched"] == []
    assert seen["wide"] is False
    assert seen["figures"] == [], "figures without a mark"
    points = found().front
    fp32 = sum(point.precision == "fp32" for point in points)
    hidden = sum(point.evidence.accuracy == "extrapolated" for point in points)
    assert 0 < fp32 < len(points)
    assert seen["first"]["rows"] == len(points) - hidden
    assert seen["first"]["front"] == seen["all"]["front"] - hidden
    assert hidden > 0
    assert seen["all"]["rows"] == len(points)
    assert seen["all"]["told"] == f"{len(points)} of {len(points)} networks"
    without = seen["without"]
    assert (without["rows"], without["told"]) == (fp32, f"{fp32} of {len(points)} networks")
    assert seen["precisions"] == ["fp32"]
    lost = len(points) - fp32 + 1  # the prospect's star is a mark of its own
    assert without["front"] == seen["all"]["front"] - lost
    assert without["lines"] < seen["all"]["lines"]
    assert seen["benchmark"]["front"] == seen["all"]["front"] + 9
    assert seen["restored"] == seen["all"]


def test_the_table_sorts_and_a_mark_tells_all(browser: Browser) -> None:
    seen = browser.acted(usual(), ACT, (1000, 900))
    rates = sorted(point.fps for point in found().front)
    assert seen["rising"] == rates
    assert seen["falling"] == rates[::-1]
    for part in ("FPS", "D1-all", "parameters", "d_max"):
        assert part in seen["hover"]


def test_a_narrow_screen_has_all_in_sight(browser: Browser) -> None:
    seen = browser.acted(usual(), "await new Promise(r => setTimeout(r, 500));", (500, 900))
    assert (seen["wide"], seen["faults"]) == (False, [])


def test_without_a_pick_and_without_a_front_nothing_goes_wrong(browser: Browser) -> None:
    asked = {"target_fps": 1000.0}
    for known, shown in (
        (found(**asked), dimensions(**asked)),
        (found(min_disparity=1e6), ()),
    ):
        assert browser.acted(page(known, load("tx2"), shown), "", (1000, 900))["faults"] == []


def test_the_page_can_be_seen(browser: Browser) -> None:
    image = browser.shot(usual(), (1280, 1600))
    assert image.size == (1280, 1600)
    figures = image.crop((50, 900, 1230, 1500))
    assert len(figures.getcolors(1 << 24)) > 200, "marks of several colours on their ground"
