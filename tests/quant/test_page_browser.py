"""The page in a browser: its script sorts and filters, and nothing goes wrong."""

import json
import re
import shutil
import subprocess
from html import unescape
from pathlib import Path

import pytest
from PIL import Image

from rts2.quant.page import page

from .reports import REPORT

BROWSERS = "chromium", "chromium-browser", "google-chrome"
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
WATCH = """<script>window.faults = [];
addEventListener("error", event => faults.push(event.message));
addEventListener("securitypolicyviolation", event => faults.push(event.violatedDirective));
</script>"""
ACT = """<script>
const names = () => [...document.querySelectorAll("#layers tbody tr:not([hidden]) .name")].map(
  each => each.textContent);
const click = title => [...document.querySelectorAll("#layers th button")].find(
  each => each.textContent === title).click();
const fill = (selector, value) => {
  const field = document.querySelector(selector);
  field.value = value;
  field.dispatchEvent(new Event("input", {bubbles: true}));
};
const seen = {};
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
seen.wide = document.documentElement.scrollWidth > innerWidth;
seen.faults = faults;
document.documentElement.dataset.seen = JSON.stringify(seen);
</script>"""
STEM, CLASSIFY, DISPARITY, LARGE = (row["layer"] for row in REPORT["layers"])


@pytest.fixture(scope="module")
def browser() -> str:
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        pytest.skip("needs a browser: install chromium")
    return found


def run(browser: str, folder: Path, *arguments: str) -> str:
    command = [browser, *FLAGS, f"--user-data-dir={folder / 'user'}", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    return done.stdout


def test_the_table_sorts_and_filters_without_a_fault(browser: str, tmp_path: Path) -> None:
    """What nobody knows comes last, whichever way."""
    text = page(REPORT, []).replace("<head>", "<head>" + WATCH).replace("</body>", ACT + "</body>")
    file = tmp_path / "report.html"
    file.write_text(text, encoding="utf-8")
    dumped = run(browser, tmp_path, "--window-size=500,900", "--dump-dom", file.as_uri())
    found = re.search(r'data-seen="([^"]*)"', dumped)
    assert found is not None, "the script of the page stopped before its end"
    seen = json.loads(unescape(found[1]))
    assert seen == {
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
        "faults": [],
    }


def test_the_page_can_be_seen(browser: str, tmp_path: Path) -> None:
    file, shot = tmp_path / "report.html", tmp_path / "shot.png"
    file.write_text(page(REPORT, []), encoding="utf-8")
    run(browser, tmp_path, "--window-size=1280,900", f"--screenshot={shot}", file.as_uri())
    with Image.open(shot) as image:
        assert image.size == (1280, 900)
        assert len(image.convert("RGB").getcolors(1 << 24)) > 50
