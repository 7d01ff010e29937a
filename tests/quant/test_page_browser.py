"""The page in a browser: its script sorts and filters, and nothing goes wrong."""

from rts2.quant.page import page

from ..browser import Browser
from .reports import REPORT

ACT = """
const names = () => [...document.querySelectorAll("#layers tbody tr:not([hidden]) .name")].map(
  each => each.textContent);
const click = title => [...document.querySelectorAll("#layers th button")].find(
  each => each.textContent === title).click();
const fill = (selector, value) => {
  const field = document.querySelector(selector);
  field.value = value;
  field.dispatchEvent(new Event("input", {bubbles: true}));
};
seen.graph = names();
click("float, ms"); seen.rising = names();
click("float, ms"); seen.falling = names();
seen.told = [...document.querySelectorAll("#layers [aria-sort]")].map(each => each.ariaSort);
click("layer, its kernels, and why it stays float"); seen.named = names();
click("#"); seen.restored = names();
fill("select[data-filter=precision]", "fp32"); seen.fp32 = names();
seen.counted = document.querySelector("#layers output").textContent;
fill("select[data-filter=precision]", "");
fill("select[data-filter=part]", "encoder"); seen.encoder = names();
fill("input[type=search]", "STEM.1"); seen.searched = names();
"""
STEM, CLASSIFY, DISPARITY, LARGE = (row["layer"] for row in REPORT["layers"])


def test_the_table_sorts_and_filters_without_a_fault(browser: Browser) -> None:
    """What nobody knows comes last, whichever way."""
    assert browser.acted(page(REPORT, []), ACT, (500, 900)) == {
        "graph": [STEM, CLASSIFY, DISPARITY, LARGE],
        "rising": [CLASSIFY, STEM, LARGE, DISPARITY],
        "falling": [LARGE, STEM, CLASSIFY, DISPARITY],
        "told": ["descending"],
        "named": sorted([STEM, CLASSIFY, DISPARITY, LARGE]),
        "restored": [STEM, CLASSIFY, DISPARITY, LARGE],
        "fp32": [CLASSIFY],
        "counted": "1 of 4 layers",
        "encoder": [STEM, LARGE],
        "searched": [LARGE],
        "wide": False,
        "fetched": [],
        "faults": [],
    }


def test_the_page_can_be_seen(browser: Browser) -> None:
    image = browser.shot(page(REPORT, []), (1280, 900))
    assert image.size == (1280, 900)
    assert len(image.getcolors(1 << 24)) > 50
