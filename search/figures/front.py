"""A metric against the frame rate: published networks, the front with its intervals, the pick."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import log10
from typing import Any

from ..accuracy import Metric
from ..context import Origin, Published
from ..palette import ACCENT, CARD, INK, PALE, PROMISE, SOFT, colours
from ..report import caption, executor_of
from ..result import Found, Point
from .points import Traits, groups, kind, told, traits
from .style import SYMBOLS, Figure, Trace, axis, doubt, interval, layout, note, target

CONTEXT: dict[Origin, tuple[str, str]] = {
    "paper": ("the paper's networks on this device", "square-open"),
    "benchmark": ("KITTI benchmark, other hardware", "hexagon-open"),
}
"""What published networks are called, and their markers."""


def front(found: Found, metric: Metric, published: Sequence[Published]) -> Figure:
    """The figure of one metric; points of which it is unknown are missing."""
    data = [*_context(found, metric, published), *_series(found, metric), *_marks(found, metric)]
    title = {"text": "frames per second", "standoff": 8}
    goal = note(
        f"target {found.target_fps:g} FPS",
        ACCENT,
        x=log10(found.target_fps),
        y=1,
        yref="paper",
        yanchor="bottom",
    )
    return {
        "data": data,
        "layout": layout(
            400,
            {"l": 44, "r": 14, "t": 26, "b": 44},
            xaxis=axis(type="log", title=title, tickformat=".6~g", nticks=4),
            yaxis=axis(),
            shapes=[target(found.target_fps, "x")],
            annotations=[goal],
        ),
    }


def _series(found: Found, metric: Metric) -> Iterable[Trace]:
    """The front, one trace a group."""
    for meta, group in groups(found):
        known = [at for at in group if found.front[at].metric(metric) is not None]
        if known:
            yield _points(found, metric, meta, known)


def _points(found: Found, metric: Metric, meta: Traits, known: Sequence[int]) -> Trace:
    points = [found.front[at] for at in known]
    first = points[0]
    colour = colours(found)[executor_of(first)]
    return {
        "type": "scatter",
        "mode": "markers",
        "name": kind(first),
        "x": [point.fps for point in points],
        "y": [point.metric(metric) for point in points],
        "error_x": interval(points),
        "error_y": doubt(points, metric),
        "customdata": list(known),
        "meta": meta,
        "opacity": 0.9 if first.proven else 0.45,
        "marker": {"symbol": SYMBOLS[first.evidence.latency], "size": 7, "color": colour},
    }


def _marks(found: Found, metric: Metric) -> Iterable[Trace]:
    """What of the front is told by name, and what was demoted."""
    prospect = None if found.prospect == found.selected else found.prospect
    demoted = found.verified.demoted if found.verified else None
    if demoted is not None:
        yield from _mark("demoted, misses the target", demoted, metric, "x", INK)
    for role, point, colour in (("prospect", prospect, PROMISE), ("pick", found.selected, ACCENT)):
        if point is not None:
            yield from _mark(role, point, metric, "star", colour)


def _mark(role: str, point: Point, metric: Metric, symbol: str, colour: str) -> Iterable[Trace]:
    """One point; none where its metric is unknown."""
    value = point.metric(metric)
    if value is None:
        return
    marker: dict[str, Any] = {"symbol": symbol, "size": 17 if symbol == "star" else 12}
    yield {
        "type": "scatter",
        "mode": "markers",
        "name": role,
        "x": [point.fps],
        "y": [value],
        "hovertext": [f"{role}<br>{told(point)}"],
        "meta": traits(point),
        "marker": {**marker, "color": colour, "line": {"color": CARD, "width": 1}},
    }


def _context(found: Found, metric: Metric, published: Sequence[Published]) -> Iterable[Trace]:
    """Published networks, hollow and pale."""
    for origin, (name, symbol) in CONTEXT.items():
        known = [each for each in published if each.origin == origin and metric in each.metrics]
        if known:
            yield {
                "type": "scatter",
                "mode": "markers" if origin == "paper" else "markers+text",
                "name": name,
                "x": [each.fps for each in known],
                "y": [each.metrics[metric] for each in known],
                "text": [each.name for each in known],
                "textposition": [_side(found, each) for each in known],
                "textfont": {"color": SOFT, "size": 10},
                "cliponaxis": False,
                "hovertext": [_told(each, metric, name) for each in known],
                "meta": {"context": origin},
                "marker": {"symbol": symbol, "size": 11, "color": PALE, "line": {"width": 1.5}},
            }


def _side(found: Found, network: Published) -> str:
    """Names point to where the front is, away from the edges."""
    return "middle left" if network.fps > found.target_fps else "middle right"


def _told(network: Published, metric: Metric, name: str) -> str:
    value = caption(metric, network.metrics[metric])
    lines = [f"<b>{network.name}</b>", f"{network.fps:.1f} FPS, {value}", name, *network.notes]
    return "<br>".join(lines)
