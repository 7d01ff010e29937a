"""The kernel audit as a picture: what each layer takes in float and quantized, and its error."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..model.files import replacing

INK, PALE, QUANTIZED, KEPT = "#1f2933", "#9aa5b1", "#1d6fa5", "#c2410c"

DPI: Final = 110
WIDTH_IN, ROW_IN, FRAME_IN, FEWEST = 11.0, 0.25, 1.6, 4
"""The picture grows with its layers: so much for each, from the fewest on, and around them."""

BAR: Final = 0.38
"""The height of a bar, of a row's."""

NAME_CHARS: Final = 44
"""Longer names lose their middle."""


def save_audit(report: Mapping[str, Any], path: Path) -> None:
    """Draws the JSON of rts2.quantize/1 and writes it as PNG, whole or not at all."""
    with replacing(path) as temporary, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")  # a name may be in any script
        draw(report).savefig(temporary, dpi=DPI)


def draw(report: Mapping[str, Any]) -> Figure:
    """Left the time of each layer in milliseconds, right its SQNR; the first layer is on top."""
    layers = report["layers"]
    height = FRAME_IN + ROW_IN * max(len(layers), FEWEST)
    figure = Figure(figsize=(WIDTH_IN, height), layout="constrained")
    times, noise = figure.subplots(1, 2, sharey=True, width_ratios=(5, 3))
    figure.suptitle(_title(report), x=0.01, ha="left", fontsize=11, parse_math=False)
    _times(times, layers, report["precision"])
    _noise(noise, layers)
    _rows(times, layers)
    for axes in (times, noise):
        _frame(axes, layers)
    return figure


def _title(report: Mapping[str, Any]) -> str:
    layers = report["layers"]
    lowered = sum(_lowered(row) for row in layers)
    return (
        f"{report['network']}\n{lowered} of {len(layers)} layers in {report['precision']}, "
        f"{report['outcome']} delivered · {report['machine'] or 'not timed'}"
    )


def _lowered(row: Mapping[str, Any]) -> bool:
    return bool(row["precision"] != "fp32")


def _times(axes: Axes, layers: Sequence[Mapping[str, Any]], precision: str) -> None:
    """Float above quantized; a dot stands at the end of the bar that was chosen."""
    axes.set_xlabel("time of the layer, ms")
    series = (
        ("float_ms", -BAR / 2, PALE, "float"),
        ("quantized_ms", BAR / 2, QUANTIZED, precision),
    )
    if all(row[key] is None for row in layers for key, *_ in series):
        _say(axes, "no layer was timed")
        return
    for key, offset, colour, label in series:
        known = [(n + offset, row[key]) for n, row in enumerate(layers) if row[key] is not None]
        axes.barh([n for n, _ in known], [ms for _, ms in known], BAR, color=colour, label=label)
    for key, offset, _, label in series:
        lowered = key == "quantized_ms"
        own = [
            (row[key], n + offset)
            for n, row in enumerate(layers)
            if _lowered(row) == lowered and row[key] is not None
        ]
        axes.plot(
            [ms for ms, _ in own],
            [n for _, n in own],
            "o",
            color=QUANTIZED if lowered else KEPT,
            markeredgecolor="white",
            markersize=6,
            label=f"{label} chosen" if lowered else "stays float",
        )
    handles = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    order = ["float", precision, f"{precision} chosen", "stays float"]
    axes.legend(
        [handles[label] for label in order],
        order,
        loc="lower left",
        bbox_to_anchor=(0, 1),
        ncols=4,
        fontsize=9,
        frameon=False,
        borderaxespad=0.2,
    )


def _say(axes: Axes, text: str) -> None:
    """In place of what is not known."""
    axes.text(0.5, 0.5, text, color=INK, ha="center", transform=axes.transAxes)
    axes.set_xticks([])


def _noise(axes: Axes, layers: Sequence[Mapping[str, Any]]) -> None:
    """A dot on a stem for each layer; a dash where nobody knows."""
    axes.set_xlabel("SQNR, each layer alone quantized, dB")
    if all(layer["sqnr_db"] is None for layer in layers):
        _say(axes, "no layer was judged alone")
        return
    for row, layer in enumerate(layers):
        value, colour = layer["sqnr_db"], QUANTIZED if _lowered(layer) else KEPT
        if value is None:
            axes.text(0.01, row, "–", color=INK, va="center", transform=axes.get_yaxis_transform())
            continue
        axes.plot([0, value], [row, row], color=PALE, linewidth=1)
        axes.plot([value], [row], "o", color=colour, markersize=5)
        axes.annotate(
            f"{value:.1f}",
            (value, row),
            xytext=(6, 0),
            textcoords="offset points",
            va="center",
            fontsize=7,
            color=INK,
        )
    axes.margins(x=0.12)  # room for the last number


def _rows(axes: Axes, layers: Sequence[Mapping[str, Any]]) -> None:
    """The names, those of layers that stay float in their colour."""
    axes.set_yticks(range(len(layers)), [_short(row["layer"]) for row in layers], fontsize=8)
    for label, row in zip(axes.get_yticklabels(), layers, strict=True):
        label.set_parse_math(False)
        label.set_color(INK if _lowered(row) else KEPT)
    axes.set_ylim(max(len(layers), 1) - 0.4, -0.6)


def _short(name: str) -> str:
    if len(name) <= NAME_CHARS:
        return name
    half = (NAME_CHARS - 1) // 2
    return f"{name[:half]}…{name[-half:]}"


def _frame(axes: Axes, layers: Sequence[Mapping[str, Any]]) -> None:
    """Every second row lies on a band, so that the eye keeps to its row."""
    for row in range(1, len(layers), 2):
        axes.axhspan(row - 0.5, row + 0.5, color=PALE, alpha=0.12, linewidth=0, zorder=0)
    axes.set_xlim(left=0)
    axes.grid(axis="x", color=PALE, alpha=0.3, linewidth=0.5)
    axes.tick_params(axis="y", length=0)
    axes.spines[["top", "right"]].set_visible(False)
