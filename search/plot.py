"""The front as a picture: accuracy against frames per second, the pick, the target, the doubt."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..model.files import replacing
from ..profiles.evidence import Evidence
from .accuracy import LOWER_IS_BETTER
from .palette import ACCENT, COLOURS, INK, PALE, PROMISE
from .report import AXIS, caption, executor_of, headline
from .result import Found, Point

MARKERS: dict[Evidence, str] = {
    "published": "s",
    "measured": "D",
    "interpolated": "o",
    "extrapolated": "^",
}
"""One marker for each evidence of the latency."""


def save(found: Found, title: str, path: Path) -> None:
    """Draws the front and writes it as PNG, whole or not at all."""
    figure = draw(found, title)
    with replacing(path) as temporary, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")  # a title may be in any script
        figure.savefig(temporary, dpi=110)


def draw(found: Found, title: str) -> Figure:
    """The picture of a front; `title` names the device."""
    figure = Figure(figsize=(9, 5.6), layout="constrained")
    axes = figure.add_subplot()
    proven = [point for point in found.front if point.proven]
    promised = [point for point in found.front if not point.proven and _only_latency(point)]
    for point, role, color in (
        (found.selected, "pick", ACCENT),
        (found.prospect if found.prospect != found.selected else None, "prospect", PROMISE),
    ):
        if point is not None:
            _mark(axes, found, point, role, color)
    if found.verified is not None and found.verified.demoted is not None:
        _mark(axes, found, found.verified.demoted, "demoted, misses the target", INK, "X")
    _series(axes, found, proven, INK)
    _series(axes, found, promised, PROMISE)
    if not found.front:
        axes.text(0.5, 0.5, "no candidate is left", ha="center", transform=axes.transAxes)
    axes.axvline(found.target_fps, color=ACCENT, linestyle="--", linewidth=1)
    axes.text(
        found.target_fps,
        1.0,
        f" target {found.target_fps:g} FPS",
        color=ACCENT,
        fontsize=9,
        va="bottom",
        transform=axes.get_xaxis_transform(),
    )
    _frame(axes, found, title)
    return figure


def _only_latency(point: Point) -> bool:
    return point.evidence.accuracy != "extrapolated"


def _series(axes: Axes, found: Found, points: Sequence[Point], color: str) -> None:
    """One line of points with their intervals, a marker for each evidence of the latency.

    Proven points of several runtimes or precisions have a colour for each.
    """
    drawn = [(point, y) for point in points if (y := point.metric(found.objective)) is not None]
    if not drawn:
        return
    axes.plot([p.fps for p, _ in drawn], [y for _, y in drawn], color=color, alpha=0.25, zorder=1)
    executors = list(dict.fromkeys(executor_of(point) for point, _ in drawn))
    several = color == INK and len(executors) > 1
    groups: dict[tuple[str, Evidence], list[tuple[Point, float]]] = {}
    for point, y in drawn:
        executor = executor_of(point) if several else ""
        groups.setdefault((executor, point.evidence.latency), []).append((point, y))
    for evidence in MARKERS:
        for executor in executors if several else [""]:
            own = COLOURS[executors.index(executor) % len(COLOURS)] if several else color
            label = f"{executor}, {evidence}" if several else f"latency {evidence}"
            _group(axes, groups.get((executor, evidence), []), own, MARKERS[evidence], label)


def _group(
    axes: Axes, group: Sequence[tuple[Point, float]], color: str, marker: str, label: str
) -> None:
    """Points of one colour and marker, with their intervals."""
    if not group:
        return
    spread = (
        [point.fps - point.fps_low for point, _ in group],
        [point.fps_high - point.fps for point, _ in group],
    )
    axes.errorbar(
        [point.fps for point, _ in group],
        [y for _, y in group],
        xerr=spread,
        fmt=marker,
        color=color,
        ecolor=color,
        elinewidth=0.5,
        alpha=0.4 if color == PROMISE else 0.85,
        markersize=4.5,
        label=label,
        zorder=2,
    )


def _mark(axes: Axes, found: Found, point: Point, role: str, color: str, marker: str = "*") -> None:
    """A star or another marker, and in the legend what it stands for."""
    value = point.metric(found.objective)
    if value is None:
        return
    told = f"{point.fps:.1f} FPS, {caption(found.objective, value)}"
    label = f"{role}: {point.arch.label()}\n{executor_of(point)}, {told}"
    axes.plot(
        [point.fps],
        [value],
        marker,
        label=label,
        color=color,
        markersize=17,
        markeredgecolor="white",
        zorder=4,
    )


def _frame(axes: Axes, found: Found, title: str) -> None:
    width, height = found.resolution
    better = "lower" if LOWER_IS_BETTER[found.objective] else "higher"
    axes.set_title(headline(found, title), loc="left", fontsize=11, pad=18, parse_math=False)
    axes.set_xlabel(
        f"frames per second at {width}×{height}, batch 1, network alone "
        f"(bars: {found.confidence:.0%} interval)"
    )
    axes.set_ylabel(f"{AXIS[found.objective]}, {better} is better")
    axes.set_xscale("log")
    _plain_ticks(axes)
    axes.grid(color=PALE, alpha=0.25, which="both", linewidth=0.5)
    axes.spines[["top", "right"]].set_visible(False)
    _legend(axes, found)


def _legend(axes: Axes, found: Found) -> None:
    """Where the front never is: slow and inaccurate."""
    if not axes.get_legend_handles_labels()[0]:
        return
    axes.legend(
        fontsize=9,
        loc="upper left" if LOWER_IS_BETTER[found.objective] else "lower left",
        framealpha=0.9,
        edgecolor="none",
        labelspacing=0.7,
    )


def _plain_ticks(axes: Axes) -> None:
    """Frame rates as a person writes them, a few in each decade."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0, 7.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
