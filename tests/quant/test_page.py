"""The page of a quantization, read back as a browser reads it."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from rts2.quant.page import Example, Kept, changes, kept, page, part_of, parts

from ..markup import MARK, Element, Tree
from .reports import LAYERS, REPORT, UNKNOWN


def read(report: dict[str, Any] = REPORT, *examples: Example) -> Element:
    return Tree(page(report, examples)).root


def example(name: str = "000000", size: tuple[int, int] = (40, 60), truth: bool = True) -> Example:
    """A ramp, and the same with its upper half four pixels nearer."""
    height, width = size
    ramp = np.linspace(1, 50, width, dtype=np.float32)
    reference = np.tile(ramp, (height, 1))
    quantized = reference.copy()
    quantized[: height // 2] += 4
    left = np.zeros((height, width, 3), np.uint8)
    return Example(name, left, reference, quantized, reference.copy() if truth else None)


def rows(root: Element, section: str) -> list[Element]:
    return root.one("section", id=section).one("tbody").all("tr")


def cells(row: Element) -> list[str]:
    return [each.text for each in row.inside if isinstance(each, Element)]


def test_the_page_is_a_document_with_a_language_and_a_title() -> None:
    text = page(REPORT, [])
    assert text.lstrip().startswith("<!DOCTYPE html>")
    root = Tree(text).root
    assert root.one("html").attributes["lang"] == "en"
    assert root.one("title").text == f"int8: {REPORT['network']} – rts2-quantize"
    assert root.one("h1").text == REPORT["network"]
    headings = [each.text for each in root.all("h2")]
    assert len(set(headings)) == len(headings)


def test_the_headline_tells_the_outcome_the_speed_and_why() -> None:
    header = read().one("header")
    assert header.one("span", id="outcome").text == "int8 delivered"
    assert header.one("p", class_="speed").text == "1.31× as fast in int8, ±0.8%"
    assert header.one("p", class_="why").text == REPORT["why"]
    facts = {each.one("dt").text: each.one("dd").text for each in header.one("dl").all("div")}
    assert (facts["layers in int8"], facts["device"]) == ("3 of 4", "cpu")


def test_a_float_outcome_is_told_as_such() -> None:
    root = read(REPORT | {"outcome": "fp32"})
    assert root.one("span", id="outcome").text == "fp32 delivered: the float network, unchanged"
    assert "which was not delivered" in root.one("section", id="metrics").text


@pytest.mark.parametrize(
    ("metric", "difference", "verdict"),
    [
        ("latency_ms", "−10.00", "better"),  # lower is better
        ("d1_all", "+0.20", "worse"),
        ("epe", "±0.000", "same"),
        ("miou", "−1.00", "worse"),  # higher is better
        ("size_bytes", "−900", "better"),
        ("sqnr_db", "–", "unknown"),
    ],
)
def test_a_difference_has_its_sign_and_its_verdict(
    metric: str, difference: str, verdict: str
) -> None:
    card = read().one("article", data_metric=metric)
    assert card.one("span", class_="difference").text == difference
    assert verdict in card.attributes["class"].split()
    assert len(card.all("span", class_=verdict)) == 1


def test_the_budget_is_that_of_d1_and_miou() -> None:
    """0.2 of 0.3 points are taken of one, 1.0 of 0.5 of the other."""
    told = {change.quantity.key: (change.inside, change.used) for change in changes(REPORT)}
    assert told["d1_all"] == (True, pytest.approx(100 * 2 / 3))
    assert told["miou"] == (False, 100)
    assert {told[key] for key in told if key not in ("d1_all", "miou")} == {(None, None)}
    root = read()
    verdicts = {
        metric: root.one("article", data_metric=metric).one("b").text
        for metric in ("d1_all", "miou")
    }
    assert verdicts == {"d1_all": "inside the budget", "miou": "outside the budget"}


def test_every_layer_has_one_row_in_the_order_of_the_graph() -> None:
    found = rows(read(), "layers")
    assert [row.one("span", class_="name").text for row in found] == [
        row["layer"] for row in LAYERS
    ]
    first, stays, unknown, _ = found
    assert cells(first)[2:] == [
        "int8", "", "2.50", "1.50", "40.0", "+0.01", "−0.002", "0.13",
    ]  # fmt: skip
    assert "Conv → QLinearConcat, QLinearConv" in first.text
    assert "slower in integers: 0.40 → 0.60 ms" in stays.text
    assert (stays.attributes["data-precision"], stays.attributes["data-part"]) == (
        "fp32",
        "classify",
    )
    assert cells(unknown)[2:] == ["int8", *"–––––––"]
    assert {cell.attributes["data-value"] for cell in unknown.all("td", class_="n")} == {"3", ""}


def test_bars_are_as_long_as_their_times() -> None:
    """Of the longest, which takes 10 ms; what is not known has none."""
    found = rows(read(), "layers")
    widths = [
        [bar.attributes["width"] for bar in row.one("svg", class_="bars").all("rect")]
        for row in found
        if row.all("svg", class_="bars")
    ]
    assert widths == [["25.0%", "15.0%"], ["4.0%", "6.0%"], ["100.0%", "50.0%"]]
    spare = [row.all("rect", class_="spare") for row in found]
    assert [len(bars) for bars in spare] == [0, 1, 0, 0]


def test_the_parts_add_up() -> None:
    layers = [dict(row, part=part_of(row["layer"])) for row in LAYERS]
    encoder, classify, disparity = parts(layers)
    assert (encoder.name, encoder.layers, encoder.lowered) == ("encoder", 2, 2)
    assert (encoder.float_ms, encoder.quantized_ms, encoder.chosen_ms) == (12.5, 6.5, 6.5)
    assert (classify.chosen_ms, classify.lowered) == (0.4, 0)
    assert (disparity.float_ms, disparity.chosen_ms) == (None, None)
    assert [cells(row)[0] for row in rows(read(), "parts")] == ["encoder", "classify", "disparity"]


@pytest.mark.parametrize(
    ("layer", "part"),
    [
        ("disparity.levels.2.0.0/Conv", "disparity"),
        ("features.0/Conv", "features"),
        ("/refine.1/Conv", "refine"),
        ("…", "…"),
    ],
)
def test_the_part_is_the_first_word(layer: str, part: str) -> None:
    assert part_of(layer) == part


def test_what_stays_float_is_grouped_by_reason() -> None:
    given = [
        {"layer": "a", "reason": "slower in integers: 0.38 → 0.68 ms"},
        {"layer": "b", "reason": "restored for the accuracy budget (0.50 → 0.25 ms)"},
        {"layer": "c", "reason": "slower in integers: 1.00 → 1.10 ms"},
        {"layer": "d", "reason": "tx2: no such kernel"},
        {"layer": "e", "reason": None},
    ]
    assert kept(given) == [
        Kept("slower in integers", (("a", "0.38 → 0.68 ms"), ("c", "1.00 → 1.10 ms"))),
        Kept("restored for the accuracy budget", (("b", "0.50 → 0.25 ms"),)),
        Kept("tx2: no such kernel", (("d", None),)),
        Kept("–", (("e", None),)),
    ]
    (group,) = read().one("section", id="kept").all("article")
    assert group.text == "slower in integers 1 classify.2/Conv0.40 → 0.60 ms"


def test_the_trials_are_listed() -> None:
    assert [cells(row) for row in rows(read(), "trials")] == [
        ["cheapest cut", "3", "0.760", "13.20", "14.00", "kept"],
        ["everything", "4", "0.930", "–", "–", "no"],
    ]


def test_how_it_was_made_is_told() -> None:
    told = read().one("section", id="origin")
    for text in (REPORT["machine"], "percentile", "000007: the right image is cut short"):
        assert text in told.text
    assert "2d, banded, 3d" in told.text
    assert [each.text for each in told.one("ul", id="files").all("li")] == REPORT["files"]


def test_what_nobody_knows_is_a_dash() -> None:
    root = read(UNKNOWN)
    for card in root.all("article", class_="metric"):
        assert "unknown" in card.attributes["class"]
        assert card.one("p", class_="value").text == "–"
        assert card.one("span", class_="difference").text == "–"
    assert root.one("p", class_="speed").text == "– speed-up not timed"
    for row in rows(root, "layers"):
        assert set(cells(row)[3:]) == {"–"}
    for row in rows(root, "parts"):
        assert set(cells(row)[3:]) == {"–"}
    assert cells(rows(root, "trials")[0])[2:5] == ["–"] * 3
    assert not re.search(r"\b(None|nan|null|undefined)\b", root.one("main").text)


def test_empty_parts_are_left_out() -> None:
    root = read(UNKNOWN | {"layers": [], "kept_float": [], "trials": []})
    sections = [each.attributes["id"] for each in root.all("section")]
    assert sections == ["metrics", "origin", "words"]
    linked = {each.attributes["href"] for each in root.one("nav").all("a")}
    assert linked == {f"#{name}" for name in sections}


def test_names_are_text() -> None:
    layers = [LAYERS[0] | {"layer": MARK, "reason": MARK, "float_kernels": [MARK]}]
    report = REPORT | {
        "network": MARK,
        "why": MARK,
        "device": MARK,
        "machine": MARK,
        "measured_on": MARK,
        "layers": layers,
        "kept_float": [{"layer": MARK, "reason": MARK}],
        "trials": [REPORT["trials"][0] | {"what": MARK}],
        "files": [MARK],
        "calibration": REPORT["calibration"] | {"skipped": [MARK], "source": MARK},
    }
    text = page(report, [example(MARK)])
    assert "alert('x')" not in text
    root = Tree(text).root
    assert len(root.all("script")) == 1
    assert root.one("h1").text == MARK
    assert root.one("section", id="examples").one("h3").text == MARK
    assert rows(root, "layers")[0].one("span", class_="name").text == MARK
    assert root.one("ul", id="files").text == MARK


def test_nothing_is_fetched() -> None:
    root = read(REPORT, example())
    text = page(REPORT, [example()])
    assert not re.search(r"https?:|url\(|@import|\bsrc=(?!\"data:)", text)
    assert not root.all("link")
    policy = root.one("meta", http_equiv="Content-Security-Policy").attributes["content"]
    assert policy.startswith("default-src 'none'")
    assert {each.attributes["href"][0] for each in root.all("a")} == {"#"}


def test_every_picture_says_what_it_shows() -> None:
    found = read(REPORT, example()).one("section", id="examples").all("img")
    assert len(found) == 8, "five maps and three scales"
    for picture in found:
        assert len(picture.attributes["alt"]) > 10
    alts = [picture.attributes["alt"] for picture in found]
    assert "Disparity of int8 minus float on 000000, −3 to +3 px" in alts
    assert "Disparity of the Float network on 000000, 0 to 50 px" in alts


def test_an_example_tells_its_figures() -> None:
    """Half of the pixels are four pixels off, where at most 50 are true: outliers."""
    shown = read(REPORT, example()).one("article", class_="example")
    assert [cells(row)[1:] for row in shown.one("tbody").all("tr")] == [
        ["0.00", "50.00"],
        ["0.000", "2.000"],
        ["2.000"],
        ["50.00"],
        ["50.00"],
    ]
    blind = read(REPORT, example(truth=False)).one("article", class_="example")
    assert cells(blind.one("tbody").all("tr")[0])[1:] == ["–", "–"]
    assert "Truth" not in [each.text for each in blind.all("figcaption")]


def test_three_examples_are_shown() -> None:
    found = read(REPORT, *map(example, "abcd")).all("article", class_="example")
    assert [each.one("h3").text for each in found] == ["a", "b", "c"]


def test_the_page_stays_small() -> None:
    """Noise cannot be compressed: three full frames of it must shrink until they fit."""
    rng = np.random.default_rng(0)
    noise = rng.uniform(0, 90, (3, 375, 1242)).astype(np.float32)
    left = rng.integers(0, 256, (375, 1242, 3), np.uint8)
    worst = Example("noise", left, noise[0], noise[1], noise[2])
    assert len(page(REPORT, [worst] * 3).encode()) < 3_000_000
