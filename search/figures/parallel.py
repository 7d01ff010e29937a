"""Parallel coordinates: every network of a front as a line over its dimensions and metrics."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import log

from ...profiles.evidence import BRANCHES
from ..accuracy import METRICS
from ..palette import ACCENT, CARD, INK, PALE, colours
from ..report import NAMES, UNITS, executor_of
from ..result import Found, Point
from .points import Traits, groups, kind, traits
from .style import SYMBOLS, Figure, Layout, Trace, broken, layout, note

UNKNOWN = -0.12
"""Where a line passes an axis on which it has no value; the axes go from 0 to 1."""

FEW = 7
"""So many different values of an axis are all labelled."""

QUARTERS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Where an axis of more values is labelled."""

Places = Sequence[Sequence[float | None]]
"""Of every point of the front, where it crosses each axis."""


@dataclass(frozen=True)
class Axis:
    """One quantity of every point of a front."""

    title: str
    values: tuple[float | None, ...]
    """One a point; None where it has none, or nobody knows."""
    name: Callable[[float], str]
    """How a value is written."""
    logarithmic: bool = False

    def place(self, at: int) -> float | None:
        """Where a point's value lies, from 0, the lowest, to 1; in the middle where all are one."""
        value = self.values[at]
        return None if value is None else self._share(value)

    def labels(self) -> list[tuple[float, str]]:
        """The values that are written beside the axis, with their places."""
        shares = {self._share(value): value for value in self._known}
        if len(shares) > FEW:
            near = (min(shares, key=lambda share: abs(share - at)) for at in QUARTERS)
            shares = {share: shares[share] for share in near}
        return [(share, self.name(value)) for share, value in shares.items()]

    @cached_property
    def _known(self) -> list[float]:
        return sorted({value for value in self.values if value is not None})

    def _share(self, value: float) -> float:
        low, at, high = map(self._scaled, (self._known[0], value, self._known[-1]))
        return (at - low) / (high - low) if high > low else 0.5

    def _scaled(self, value: float) -> float:
        return log(value) if self.logarithmic else value


def parallel(found: Found) -> Figure:
    """The figure of a front; a line passes below an axis on which it has no value."""
    axes = axes_of(found.front)
    places = [[axis.place(at) for axis in axes] for at in range(len(found.front))]
    data = [_lines(found, places, meta, group) for meta, group in groups(found)]
    if found.selected is not None:
        own = [found.front.index(found.selected)]
        pick = _lines(found, places, traits(found.selected), own)
        line, marker = {"color": ACCENT, "width": 3}, {"size": 8}
        data.append({**pick, "name": "pick", "opacity": 1, "line": line, "marker": marker})
    return {"data": data, "layout": _frame(axes, places)}


def axes_of(points: Sequence[Point]) -> list[Axis]:
    """The dimensions of the space, then what comes of them."""
    stages = max((point.arch.stages for point in points), default=0)
    executors = [executor_of(point) for point in points]
    return [
        _numbers("c", [point.arch.c for point in points]),
        _numbers("stages", [point.arch.stages for point in points]),
        _words("branches", [point.arch.branches for point in points], BRANCHES),
        _numbers("d_max", [point.arch.d_max for point in points]),
        *(_numbers(f"3D width {at + 1}", _widths(points, at)) for at in range(stages)),
        _words("runs as", executors, list(dict.fromkeys(executors))),
        Axis("FPS", tuple(point.fps for point in points), "{:.1f}".format, logarithmic=True),
        *(
            Axis(NAMES[m], tuple(p.metric(m) for p in points), f"{{:.2f}}{UNITS[m]}".format)
            for m in METRICS[:3]
        ),
    ]


def _numbers(title: str, values: Sequence[float | None]) -> Axis:
    return Axis(title, tuple(values), "{:g}".format)


def _words(title: str, values: Sequence[str], order: Sequence[str]) -> Axis:
    """Names as their positions among those that occur, in lines that are short."""
    occurring = [name for name in order if name in values]
    lines = [broken(name) for name in occurring]
    places = tuple(float(occurring.index(value)) for value in values)
    return Axis(title, places, lambda place: lines[int(place)])


def _widths(points: Sequence[Point], stage: int) -> list[float | None]:
    """The 3D widths of one stage; None of networks that stop before it."""
    return [p.arch.conv3d[stage] if stage < p.arch.stages else None for p in points]


def _lines(found: Found, places: Places, meta: Traits, group: Sequence[int]) -> Trace:
    """The lines of points of one kind in one trace, parted by gaps."""
    first = found.front[group[0]]
    x: list[int | None] = []
    y: list[float | None] = []
    customdata: list[int | None] = []
    for at in group:
        x += [*range(len(places[at])), None]
        y += [*(UNKNOWN if place is None else place for place in places[at]), None]
        customdata += [*[at] * len(places[at]), None]
    return {
        "type": "scatter",
        "mode": "lines+markers",
        "name": kind(first),
        "x": x,
        "y": y,
        "customdata": customdata,
        "meta": meta,
        "opacity": 0.5 if first.proven else 0.2,
        "line": {"color": colours(found)[executor_of(first)], "width": 1},
        "marker": {"size": 4, "symbol": SYMBOLS[first.evidence.latency]},
    }


def _frame(axes: Sequence[Axis], places: Places) -> Layout:
    """The axes with their titles and values."""
    missing = [at for at in range(len(axes)) if any(line[at] is None for line in places)]
    hidden = {"visible": False, "fixedrange": True}
    return layout(
        430,
        {"l": 8, "r": 8, "t": 50, "b": 8},
        xaxis={**hidden, "range": [-0.6, len(axes) - 0.6]},
        yaxis={**hidden, "range": [-0.17, 1.04]},
        shapes=[
            {"type": "line", "x0": at, "x1": at, "y0": 0, "y1": 1, "line": {"color": PALE}}
            for at in range(len(axes))
        ],
        annotations=[
            *(word for at, axis in enumerate(axes) for word in _words_of(at, axis)),
            *(_beside("–", at, UNKNOWN) for at in missing),
        ],
    )


def _words_of(at: int, axis: Axis) -> Iterable[dict[str, object]]:
    """The title of an axis, and values beside it."""
    yield note(f"<b>{axis.title}</b>", INK, x=at, y=1, yanchor="bottom", yshift=18)
    for place, text in axis.labels():
        yield _beside(text, at, place)


def _beside(text: str, at: int, place: float) -> dict[str, object]:
    """A value left of its axis, in front of the lines."""
    return note(text, x=at, y=place, xanchor="right", xshift=-5, bgcolor=CARD, borderpad=1)
