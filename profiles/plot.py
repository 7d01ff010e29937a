"""A check as a picture: predicted against measured, and what is left."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from math import exp
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ..model.files import replacing
from .check import Comparison

INK, PALE, ACCENT = "#1f2933", "#9aa5b1", "#c2410c"
COLOURS = ("#1f2933", "#1d6fa5", "#c2410c", "#5f8d4e")
"""One for each precision that a profile has."""


def save(comparisons: Sequence[Comparison], title: str, half_width: float, path: Path) -> None:
    """Draws the check of a profile and writes it as PNG, whole or not at all.

    `half_width` is the interval's, in natural logarithm.
    """
    with replacing(path) as temporary, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")  # a title may be in any script
        draw(comparisons, title, half_width).savefig(temporary, dpi=110)


def draw(comparisons: Sequence[Comparison], title: str, half_width: float) -> Figure:
    """Left the latencies on logarithmic axes, right the errors over the latency."""
    figure = Figure(figsize=(11, 4.8), layout="constrained")
    both, errors = figure.subplots(1, 2)
    measured = np.array([1000 / c.fps_true for c in comparisons])
    predicted = np.array([1000 / c.fps_predicted for c in comparisons])
    names = [f"{c.precision}, {c.resolution[0]}×{c.resolution[1]}" for c in comparisons]
    for index, name in enumerate(dict.fromkeys(names)):
        own = np.array([known == name for known in names])
        colour, marker = COLOURS[index // 2 % len(COLOURS)], "os"[index % 2]
        drawn: dict[str, Any] = {"s": 18, "color": colour, "marker": marker, "alpha": 0.75}
        both.scatter(measured[own], predicted[own], label=name, **drawn)
        error = 100 * (predicted[own] / measured[own] - 1)
        errors.scatter(measured[own], error, **drawn)
    ends = [measured.min(), measured.max()]
    both.plot(ends, ends, color=PALE, linewidth=1)
    both.set(xscale="log", yscale="log", xlabel="measured, ms", ylabel="predicted, ms")
    both.set_title(title, parse_math=False)
    both.legend(frameon=False)
    low, high = 100 * (exp(-half_width) - 1), 100 * (exp(half_width) - 1)
    errors.axhspan(low, high, color=PALE, alpha=0.25, label="90% interval")
    for bound in (-10, -5, 5, 10):
        errors.axhline(
            bound, color=ACCENT, linewidth=0.6, linestyle="--" if abs(bound) > 5 else ":"
        )
    errors.axhline(0, color=INK, linewidth=0.8)
    errors.set(xscale="log", xlabel="measured, ms", ylabel="predicted − measured, %")
    errors.set_title("error; lines at ±5% and ±10%")
    errors.legend(frameon=False)
    return figure
