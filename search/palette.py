"""The colours of a front, in the picture and on the page, by day and by night."""

from __future__ import annotations

from collections.abc import Iterable

from .report import executor_of
from .result import Found, Point

INK, PALE, ACCENT, PROMISE = "#1f2933", "#9aa5b1", "#c2410c", "#1d6fa5"
SOFT, LINE, CARD = "#52606d", "#dfe5ea", "#ffffff"
COLOURS = (INK, "#2e7d6b", "#8b5fbf", "#b58900", "#5b7fa6", "#a0526d")
"""One for each runtime and precision of the proven points, where there are several."""

ON_DARK = {
    INK: "#e6ebf0",
    PALE: "#71808f",
    ACCENT: "#f5874f",
    PROMISE: "#58a9e0",
    SOFT: "#a3b1bf",
    LINE: "#303b46",
    CARD: "#1a2129",
    "#2e7d6b": "#5fbfa9",
    "#8b5fbf": "#b492e0",
    "#b58900": "#d9b23c",
    "#5b7fa6": "#8fb0d3",
    "#a0526d": "#d38aa3",
}
"""What each colour becomes on a dark ground."""


def colours(found: Found) -> dict[str, str]:
    """The colour of each runtime and precision of the front, those with proven points first.

    What is only promised has one colour.
    """
    proven = _executors(point for point in found.front if point.proven)
    promised = [each for each in _executors(found.front) if each not in proven]
    own = {each: COLOURS[at % len(COLOURS)] for at, each in enumerate(proven)}
    return own | dict.fromkeys(promised, PROMISE)


def _executors(points: Iterable[Point]) -> list[str]:
    return list(dict.fromkeys(executor_of(point) for point in points))
