"""A check as a picture: predicted against measured, and what is left."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from math import exp
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..model.files import replacing
from .check import Comparison, Executor
from .several import titled

INK, PALE, ACCENT = "#1f2933", "#9aa5b1", "#c2410c"
COLOURS = ("#1f2933", "#1d6fa5", "#c2410c", "#5f8d4e", "#8b5fbf", "#b58900")
"""One for each precision of each runtime, in turn."""
MARKERS = "os^v"
"""One for each resolution, in turn."""


def save(
    comparisons: Sequence[Comparison],
    title: str,
    half_widths: Mapping[Executor, float],
    path: Path,
) -> None:
    """Draws the check of a profile and writes it as PNG, whole or not at all.

    `half_widths` are the intervals' of each runtime and precision, in natural logarithm.
    """
    with replacing(path) as temporary, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")  # a title may be in any script
        draw(comparisons, title, half_widths).savefig(temporary, dpi=110)


def draw(
    comparisons: Sequence[Comparison], title: str, half_widths: Mapping[Executor, float]
) -> Figure:
    """Left the latencies on logarithmic axes, right the errors over the latency."""
    figure = Figure(figsize=(11, 4.8), layout="constrained")
    both, errors = figure.subplots(1, 2)
    measured = np.array([1000 / c.fps_true for c in comparisons])
    predicted = np.array([1000 / c.fps_predicted for c in comparisons])
    named = _names(comparisons)
    groups = [(c.executor, c.resolution) for c in comparisons]
    sizes = list(dict.fromkeys(c.resolution for c in comparisons))
    for executor, size in dict.fromkeys(groups):
        own = np.array([group == (executor, size) for group in groups])
        name, colour = named[executor]
        marker = MARKERS[sizes.index(size) % len(MARKERS)]
        drawn: dict[str, Any] = {"s": 18, "color": colour, "marker": marker, "alpha": 0.75}
        label = f"{name}, {size[0]}×{size[1]}"
        both.scatter(measured[own], predicted[own], label=label, **drawn)
        errors.scatter(measured[own], 100 * (predicted[own] / measured[own] - 1), **drawn)
    ends = [measured.min(), measured.max()]
    both.plot(ends, ends, color=PALE, linewidth=1)
    both.set(xscale="log", yscale="log", xlabel="measured, ms", ylabel="predicted, ms")
    both.set_title(title, parse_math=False)
    both.legend(frameon=False)
    _intervals(errors, named, half_widths)
    for bound in (-10, -5, 5, 10):
        errors.axhline(
            bound, color=ACCENT, linewidth=0.6, linestyle="--" if abs(bound) > 5 else ":"
        )
    errors.axhline(0, color=INK, linewidth=0.8)
    errors.set(xscale="log", xlabel="measured, ms", ylabel="predicted − measured, %")
    errors.set_title("error; lines at ±5% and ±10%")
    errors.legend(frameon=False)
    return figure


def _names(comparisons: Sequence[Comparison]) -> dict[Executor, tuple[str, str]]:
    """What each runtime and precision is called in the picture, and its colour."""
    executors = list(dict.fromkeys(c.executor for c in comparisons))
    alone = len({runtime for runtime, _ in executors}) == 1
    return {
        (runtime, precision): (
            precision if alone else f"{precision} on {titled(runtime)}",
            COLOURS[index % len(COLOURS)],
        )
        for index, (runtime, precision) in enumerate(executors)
    }


def _intervals(
    errors: Axes, named: Mapping[Executor, tuple[str, str]], half_widths: Mapping[Executor, float]
) -> None:
    """A band for each runtime and precision, in its colour where there are several."""
    for executor, (name, colour) in named.items():
        half = half_widths[executor]
        several = len(named) > 1
        errors.axhspan(
            100 * (exp(-half) - 1),
            100 * (exp(half) - 1),
            facecolor=(colour, 0.06) if several else (PALE, 0.25),
            edgecolor=(colour, 0.8),
            linewidth=1 if several else 0,
            label=f"90% interval, {name}" if several else "90% interval",
        )
