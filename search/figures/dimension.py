"""What one dimension does: the frame rate above, the objective below, over its values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ...profiles.evidence import Evidence
from ..palette import ACCENT, INK, PALE
from ..report import NAMES
from ..result import Found
from ..sensitivity import Dimension
from .points import told
from .style import SYMBOLS, Figure, Trace, axis, broken, doubt, interval, layout, note, target


def dimension(found: Found, shown: Dimension) -> Figure:
    """The figure of one dimension; a value that nobody knows has no mark."""
    points = [each.point for each in shown.variations]
    rates = _marks(shown, [p.fps for p in points], [p.evidence.latency for p in points])
    values = [point.metric(found.objective) for point in points]
    accuracies = _marks(shown, values, [p.evidence.accuracy for p in points])
    unknown = sum(value is None for value in values)
    fastest = max(point.fps_high for point in points)
    title = NAMES[found.objective]
    if unknown:
        title += f" ({unknown} of {len(values)} not known)"
    names = [each.value for each in shown.variations]
    words = {} if shown.ordered else {"tickvals": names, "ticktext": [broken(n) for n in names]}
    heading: dict[str, Any] = {"x": 0, "xref": "paper", "xanchor": "left"}
    heading |= {"yref": "paper", "yanchor": "bottom"}
    return {
        "data": [
            {**rates, "error_y": {**interval(points), "color": PALE}},
            {
                **accuracies,
                "yaxis": "y2",
                "error_y": {**doubt(points, found.objective), "color": PALE},
            },
        ],
        "layout": layout(
            290,
            {"l": 44, "r": 10, "t": 20, "b": 30},
            xaxis=axis(
                type="category",
                anchor="y2",
                showgrid=False,
                fixedrange=True,
                tickangle=0,
                nticks=9,
                **words,
            ),
            yaxis=axis(domain=[0.58, 1], rangemode="tozero", fixedrange=True),
            yaxis2=axis(domain=[0, 0.42], fixedrange=True),
            shapes=[target(found.target_fps, "y")] if found.target_fps <= fastest else [],
            annotations=[note("FPS", y=1, **heading), note(title, y=0.42, **heading)],
        ),
    }


def _marks(shown: Dimension, y: Sequence[float | None], evidence: Sequence[Evidence]) -> Trace:
    """One mark a value, the candidate's own larger."""
    own = [each.value == shown.own for each in shown.variations]
    return {
        "type": "scatter",
        "mode": "lines+markers" if shown.ordered else "markers",
        "x": [each.value for each in shown.variations],
        "y": list(y),
        "hovertext": [told(each.point) for each in shown.variations],
        "line": {"color": PALE, "width": 1},
        "marker": {
            "symbol": [SYMBOLS[each] for each in evidence],
            "size": [11 if each else 6 for each in own],
            "color": [ACCENT if each else INK for each in own],
        },
    }
