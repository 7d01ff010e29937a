"""The front as a table that is sorted by a click: its columns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from ..quant.html import number
from .accuracy import METRICS, Metric
from .report import NAMES, RUNTIMES, UNITS
from .result import Point


@dataclass(frozen=True)
class Column:
    """One column of the table: how a point is written in it, and what it is sorted by."""

    title: str
    text: Callable[[Point], str]
    value: Callable[[Point], float | str | None]
    kind: Literal["number", "text"] = "number"


def _metric(name: Metric) -> Column:
    """The column of an accuracy."""
    return Column(
        f"{NAMES[name]}, {UNITS[name].strip()}",
        lambda point: number(point.metric(name), 2),
        lambda point: point.metric(name),
    )


def _number(title: str, value: Callable[[Point], float], written: str = "{:,}") -> Column:
    return Column(title, lambda point: written.format(value(point)), value)


def _word(title: str, value: Callable[[Point], str]) -> Column:
    return Column(title, value, value, "text")


COLUMNS = (
    _number("c", lambda point: point.arch.c),
    _number("stages", lambda point: point.arch.stages),
    _word("branches", lambda point: point.arch.branches),
    _number("d_max", lambda point: point.arch.d_max),
    _word("3D widths", lambda point: "/".join(str(width) for width in point.arch.conv3d)),
    _word("precision", lambda point: point.precision),
    _word("runtime", lambda point: RUNTIMES[point.runtime]),
    _number("FPS", lambda point: point.fps, "{:.1f}"),
    Column("interval", lambda p: f"{p.fps_low:.1f}–{p.fps_high:.1f}", lambda p: p.fps_low),
    _number("ms", lambda point: point.latency_ms, "{:.1f}"),
    *(_metric(name) for name in METRICS),
    _word("FPS is", lambda point: point.evidence.latency),
    _word("accuracy is", lambda point: point.evidence.accuracy),
    _number("parameters", lambda point: point.params),
    _number("MB", lambda point: point.size_bytes / 1e6, "{:.2f}"),
)
"""Of a point of the front, all that it has."""
