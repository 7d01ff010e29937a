"""The result in words: the table in the terminal and the file for a spreadsheet."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

from rich.console import Console, JustifyMethod
from rich.table import Table
from rich.text import Text

from ..profiles.profile import Profile, Runtime
from .accuracy import METRICS, Metric
from .result import Found, Point

AXIS: dict[Metric, str] = {
    "d1_all": "D1-all in percent",
    "epe": "EPE in pixels",
    "miou": "mIoU in percent",
    "pacc": "pixel accuracy in percent",
}
NAMES: dict[Metric, str] = {"d1_all": "D1-all", "epe": "EPE", "miou": "mIoU", "pacc": "pAcc"}
UNITS: dict[Metric, str] = {"d1_all": "%", "epe": " px", "miou": "%", "pacc": "%"}
RUNTIMES: dict[Runtime, str] = {
    "pytorch": "PyTorch",
    "onnxruntime": "ONNX Runtime",
    "openvino": "OpenVINO",
    "tensorrt": "TensorRT",
}
TASKS = {"semantic-stereo": "semantic stereo", "stereo": "stereo"}
ROWS = 16
"""Rows of the table; the files have every point."""


def name_of(point: Point) -> str:
    """A candidate in a few words."""
    executor = f"{point.precision} on {RUNTIMES[point.runtime]}"
    return f"{point.arch.label()}, {executor}"


def caption(metric: Metric, value: float | None) -> str:
    """A metric with its name and unit, such as D1-all 4.70%."""
    return f"{NAMES[metric]} {number(metric, value)}"


def number(metric: Metric, value: float | None) -> str:
    """A metric's value with its unit; a dash where nobody knows."""
    return "–" if value is None else f"{value:.2f}{UNITS[metric]}"


def headline(found: Found, title: str) -> str:
    """What was searched, in one line."""
    width, height = found.resolution
    return f"RTS²Net on {title} · {width}×{height} · {TASKS[found.task]}"


def show(found: Found, profile: Profile, written: Sequence[str], console: Console) -> None:
    """Prints the table of the front, the pick, the prospect, and what was left out."""
    scope = f"{found.space.size:,} candidates, every one, in {found.elapsed_s:.1f} s"
    console.print(f"{headline(found, profile.title)} · {scope}\n", highlight=False)
    console.print(_table(found))
    lines = [*_verdict(found, profile), *_left_out(found), *_notes(found, profile)]
    for label, text in [*lines, ("written", "  ".join(written))]:
        row = Table.grid(padding=(0, 2))
        row.add_column(width=9)
        row.add_column(overflow="fold")
        row.add_row(Text(label, style="bold"), Text(text))
        console.print(row)


def _table(found: Found) -> Table:
    """The shown points; a column that says the same of all of them becomes a line below."""
    proven = [point for point in found.front if point.proven]
    shown = _thinned(proven or list(found.front), found)
    rows = [_row(point) for point in shown]
    constant = {
        name: values[0]
        for name, *values in zip(COLUMNS, *rows, strict=True)
        if len(rows) > 1 and len(set(values)) == 1 and name in DROPPABLE
    }
    table = Table(box=None, header_style="bold", pad_edge=False, caption_justify="left")
    table.add_column(" ")
    for name in COLUMNS:
        if name not in constant:
            side: JustifyMethod = "left" if name in LEFT else "right"
            table.add_column(name.format(f"{found.confidence:.0%}"), justify=side, no_wrap=True)
    for point, row in zip(shown, rows, strict=True):
        cells = [cell for name, cell in zip(COLUMNS, row, strict=True) if name not in constant]
        picked = point == found.selected
        table.add_row("▶" if picked else " ", *cells, style="bold" if picked else "")
    hidden = len(found.front) - len(shown)
    same = ", ".join(f"{name} {value}" for name, value in constant.items() if value != "–")
    told = [f"all with {same}" if same else "", f"{hidden} more points in the files" * bool(hidden)]
    table.caption = "; ".join(text for text in told if text) or None
    return table


COLUMNS = (
    "c",
    "stages",
    "branches",
    "d_max",
    "3D widths",
    "precision",
    "runtime",
    "FPS ({})",
    "D1-all",
    "EPE",
    "mIoU",
    "evidence",
)
LEFT = ("branches", "3D widths", "precision", "runtime", "evidence")
DROPPABLE = ("d_max", "precision", "runtime", "EPE", "mIoU")


def _row(point: Point) -> list[str]:
    """The cells of `COLUMNS`."""
    arch, told = point.arch, point.evidence
    latency, accuracy = told.latency, told.accuracy
    return [
        str(arch.c),
        str(arch.stages),
        arch.branches,
        str(arch.d_max),
        "/".join(str(width) for width in arch.conv3d),
        point.precision,
        RUNTIMES[point.runtime],
        f"{point.fps:.1f} ({point.fps_low:.1f}–{point.fps_high:.1f})",
        *(number(metric, point.metric(metric)) for metric in METRICS[:3]),
        latency if latency == accuracy else f"{latency} FPS, {accuracy} accuracy",
    ]


def _thinned(points: list[Point], found: Found) -> list[Point]:
    """At most `ROWS` points: the pick and its neighbours, the rest evenly along the front."""
    if len(points) <= ROWS:
        return points
    at = next((i for i, point in enumerate(points) if point == found.selected), 0)
    near = {i for i in range(at - 2, at + 3) if 0 <= i < len(points)}
    others = [i for i in range(len(points)) if i not in near]
    room = ROWS - len(near)
    spread = {others[round(k * (len(others) - 1) / (room - 1))] for k in range(room)}
    return [points[i] for i in sorted(near | spread)]


def _verdict(found: Found, profile: Profile) -> list[tuple[str, str]]:
    lines = [("pick", _sentence(found, found.selected) if found.selected else _no_pick(found))]
    if found.prospect is not None and found.prospect != found.selected:
        low, high = found.prospect.fps_low, found.prospect.fps_high
        doubt = f"{found.prospect.fps:.1f} FPS (extrapolated, {low:.1f}–{high:.1f})"
        lines.append(
            (
                "prospect",
                f"{name_of(found.prospect)} · {doubt} · "
                f"{caption(found.objective, found.prospect.metric(found.objective))}; "
                f"timing it on your {profile.title} would tell, or --allow-extrapolated",
            )
        )
    return lines


def _sentence(found: Found, point: Point) -> str:
    accuracy = caption(found.objective, point.metric(found.objective))
    return f"{name_of(point)} · {point.fps:.1f} FPS · {accuracy}"


def _no_pick(found: Found) -> str:
    if found.nearest is None:
        return "none: no candidate is left"
    return (
        f"none holds {found.target_fps:g} FPS on evidence better than extrapolation; "
        f"the fastest is {_sentence(found, found.nearest)}"
    )


def _left_out(found: Found) -> list[tuple[str, str]]:
    lines = [f"{entry.count:,} candidates: {entry.reason}" for entry in found.left_out]
    return [("left out" if not i else "", line) for i, line in enumerate(lines)]


def _notes(found: Found, profile: Profile) -> list[tuple[str, str]]:
    """What the numbers rest on, where a user could take them for more."""
    notes = [
        f"{support.precision} is not offered on {profile.title}: {support.reason}"
        for support in profile.precisions
        if not support.supported
    ]
    known = {point.resolution for point in profile.points}
    if found.resolution not in known:
        sizes = ", ".join(f"{width}×{height}" for width, height in sorted(known))
        notes.append(
            f"latencies of {profile.title} are known at {sizes}; accuracies are KITTI's own"
        )
    return [("note" if not i else "", note) for i, note in enumerate(notes)]


def as_csv(found: Found) -> str:
    """The front as a table for a spreadsheet, one line a point, by falling FPS."""
    text = io.StringIO()
    names = [name for name in Point.model_fields if name not in ("arch", "evidence")]
    arch = ["family", "c", "stages", "d_max", "conv3d", "branches"]
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*arch, *names, "latency_evidence", "accuracy_evidence", "selected"])
    for point in found.front:
        shape = point.arch
        widths = "/".join(str(width) for width in shape.conv3d)
        cells = [shape.family, shape.c, shape.stages, shape.d_max, widths, shape.branches]
        values = [getattr(point, name) for name in names]
        told = [point.evidence.latency, point.evidence.accuracy]
        writer.writerow([*cells, *values, *told, point == found.selected])
    return text.getvalue()
