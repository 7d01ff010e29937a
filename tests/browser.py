"""A real browser without a window, in which a page is opened, acted on and looked at."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import dataclass
from html import unescape
from pathlib import Path
from typing import Any

from PIL import Image

NAMES = "chromium", "chromium-browser", "google-chrome"
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--virtual-time-budget=10000",
)
WATCH = """<script>window.faults = [];
addEventListener("error", event => faults.push(event.message));
addEventListener("unhandledrejection", event => faults.push(String(event.reason)));
addEventListener("securitypolicyviolation", event => faults.push(event.violatedDirective));
for (const kind of ["error", "warn"]) console[kind] = (...told) => faults.push(told.join(" "));
</script>"""
ACT = """<script>(async () => {
const seen = {};
%s
seen.wide = document.documentElement.scrollWidth > innerWidth;
seen.fetched = performance.getEntriesByType("resource").map(each => each.name);
seen.faults = faults;
document.documentElement.dataset.seen = JSON.stringify(seen);
})();</script></body>"""


@dataclass(frozen=True)
class Browser:
    """The command of a browser, and a folder for what it writes."""

    command: str
    folder: Path

    @classmethod
    def found(cls, folder: Path) -> Browser | None:
        """The first that is installed."""
        command = next(filter(None, map(shutil.which, NAMES)), None)
        return None if command is None else cls(command, folder)

    def acted(self, page: str, act: str, size: tuple[int, int]) -> dict[str, Any]:
        """What the script `act` leaves in `seen` once the page is drawn.

        With it whether the page is wider than the window, what it fetched, and what went wrong.
        """
        head, _, end = page.replace("<head>", "<head>" + WATCH, 1).rpartition("</body>")
        file = self._written(head + (ACT % act) + end)
        dumped = self._run(f"--window-size={size[0]},{size[1]}", "--dump-dom", file.as_uri())
        found = re.search(r'data-seen="([^"]*)"', dumped)
        assert found is not None, "the script stopped before its end"
        seen: dict[str, Any] = json.loads(unescape(found[1]))
        return seen

    def shot(self, page: str, size: tuple[int, int]) -> Image.Image:
        """The page as it is seen in a window of (width, height)."""
        picture, file = self.folder / "shot.png", self._written(page)
        self._run(f"--window-size={size[0]},{size[1]}", f"--screenshot={picture}", file.as_uri())
        with Image.open(picture) as image:
            return image.convert("RGB")

    def _written(self, page: str) -> Path:
        file = self.folder / "page.html"
        file.write_text(page, encoding="utf-8")
        return file

    def _run(self, *arguments: str) -> str:
        command = [self.command, *FLAGS, f"--user-data-dir={self.folder / 'user'}", *arguments]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
        return done.stdout
