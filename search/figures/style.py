"""What all figures look like, and the pieces that several have."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

from ...profiles.evidence import Evidence
from ..accuracy import Metric
from ..palette import ACCENT, CARD, INK, LINE, PALE, SOFT
from ..result import Point

Figure = dict[str, Any]
"""`data` and `layout` of Plotly."""

Trace = dict[str, Any]
Layout = dict[str, Any]

SYMBOLS: dict[Evidence, str] = {
    "published": "square",
    "measured": "diamond",
    "interpolated": "circle",
    "extrapolated": "triangle-up",
}
"""One marker for each evidence, as in the picture."""


def layout(height: int, margin: dict[str, int], **own: Any) -> Layout:
    """A figure on the ground of the page, `height` pixels high."""
    label = {"bgcolor": CARD, "bordercolor": PALE, "font": {"color": INK, "size": 12}}
    return {
        "height": height,
        "margin": margin,
        "showlegend": False,
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": {"size": 12, "color": INK},
        "hoverlabel": {**label, "align": "left"},
        "hovermode": "closest",
        **own,
    }


def axis(**own: Any) -> dict[str, Any]:
    """An axis with its grid."""
    return {
        "gridcolor": LINE,
        "linecolor": PALE,
        "zeroline": False,
        "automargin": True,
        "tickfont": {"color": SOFT},
        **own,
    }


def interval(points: Sequence[Point]) -> dict[str, Any]:
    """The intervals of frame rates as error bars."""
    return _bars([(point.fps_low, point.fps, point.fps_high) for point in points])


def doubt(points: Sequence[Point], metric: Metric) -> dict[str, Any]:
    """The intervals of a metric as error bars; of no length where none is known."""
    known = [(point.ranges or {}).get(metric) for point in points]
    values = [point.metric(metric) or 0.0 for point in points]
    ends = [each or (value, value) for each, value in zip(known, values, strict=True)]
    return _bars([(low, at, high) for (low, high), at in zip(ends, values, strict=True)])


def _bars(intervals: Sequence[tuple[float, float, float]]) -> dict[str, Any]:
    """Error bars from the low end, the value and the high end of each."""
    return {
        "type": "data",
        "symmetric": False,
        "array": [high - at for _, at, high in intervals],
        "arrayminus": [at - low for low, at, _ in intervals],
        "thickness": 0.7,
        "width": 0,
    }


def target(fps: float, along: Literal["x", "y"]) -> dict[str, Any]:
    """The line that frame rates, drawn along `along`, must reach."""
    across = "y" if along == "x" else "x"
    return {
        "type": "line",
        "layer": "between",
        f"{along}0": fps,
        f"{along}1": fps,
        f"{across}0": 0,
        f"{across}1": 1,
        f"{across}ref": "paper",
        "line": {"color": ACCENT, "width": 1.5, "dash": "dash"},
    }


def note(text: str, color: str = SOFT, **place: Any) -> dict[str, Any]:
    """A word on a figure."""
    font = {"color": color, "size": 11}
    return {"text": text, "font": font, "showarrow": False, **place}


def broken(name: str) -> str:
    """A name in lines that are short enough for the foot or the side of an axis."""
    return name.replace("+", "+<br>").replace(" on ", "<br>")
