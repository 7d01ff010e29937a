"""The result in words: the table in the terminal and the file for a spreadsheet."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.console import Console, JustifyMethod
from rich.table import Table
from rich.text import Text

from ..profiles.evidence import Evidence
from ..profiles.profile import Profile, Runtime
from .accuracy import METRICS, Metric
from .front import loss, pick
from .result import Found, Point

if TYPE_CHECKING:
    from .exhaustive import Candidate

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
    return f"{point.arch.label()}, {executor_of(point)}"


def executor_of(point: Point | Candidate) -> str:
    """What runs a candidate, such as fp32 on OpenVINO."""
    return f"{point.precision} on {RUNTIMES[point.runtime]}"


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


def scope(found: Found) -> str:
    """How much was searched, and how long that took."""
    judged = "every one" if found.cost is None else f"{found.cost.evaluations:,} chains judged"
    return f"{found.space.size:,} candidates, {judged}, in {found.elapsed_s:.1f} s"


def remarks(found: Found, profile: Profile, folder: str = "") -> list[tuple[str, str]]:
    """The pick, the prospect, the cost, what was left out and the notes, each with its label.

    A label that is empty goes on with the one before it. `folder` is where the front is written.
    """
    return [*_verdict(found, folder), *_cost(found), *_left_out(found), *_notes(found, profile)]


def show(found: Found, profile: Profile, written: Sequence[str], console: Console) -> None:
    """Prints the table of the front, the pick, the prospect, and what was left out.

    The folder stands first in `written`.
    """
    console.print(Text(f"{headline(found, profile.title)} · {scope(found)}\n"))
    console.print(_table(found, console.width))
    told = remarks(found, profile, written[0])
    for label, text in [*told, ("written", "  ".join(written))]:
        row = Table.grid(padding=(0, 2))
        row.add_column(width=9)
        row.add_column(overflow="fold")
        row.add_row(Text(label, style="bold"), Text(text))
        console.print(row)


def _table(found: Found, width: int) -> Table:
    """The shown points; what all of them agree on becomes a line below."""
    shown = _thinned(believable(found), found)
    rows = [_row(point) for point in shown]
    cells = dict(zip(COLUMNS, zip(*rows, strict=True), strict=True)) if rows else {}
    constant = {n: cells[n][0] for n in CONSTANT if len(rows) > 1 and len(set(cells[n])) == 1}
    columns = [name for name in COLUMNS if name not in constant]
    columns = _fitting(columns, rows, found.objective, width) if rows else columns
    table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 1, 0, 0))
    table.add_column(" ", no_wrap=True)
    for name in columns:
        side: JustifyMethod = "left" if name in LEFT else "right"
        table.add_column(name, justify=side, no_wrap=True)
    for at, point in enumerate(shown):
        picked = point == found.selected
        row = ["▶" if picked else " ", *(cells[name][at] for name in columns)]
        table.add_row(*row, style="bold" if picked else "")
    table.caption = _caption(found, constant, len(found.front) - len(shown))
    table.caption_justify = "left"
    return table


def _caption(found: Found, constant: dict[str, str], hidden: int) -> str:
    """What the table leaves unsaid."""
    same = ", ".join(f"{name} {value}" for name, value in constant.items())
    parts = [f"all with {same}"] if same else []
    parts += [f"{hidden} more points in the files"] if hidden else []
    letters = ", ".join(f"{letter} {evidence}" for evidence, letter in LETTERS.items())
    parts.append(f"{found.confidence:.0%} interval; evidence of FPS and accuracy: {letters}")
    return "\n".join(parts)


def believable(found: Found) -> list[Point]:
    """The points on the pick's evidence or better; without a pick, on the best that there is."""
    proven = [point for point in found.front if point.proven]
    known = [point for point in found.front if point.evidence.accuracy != "extrapolated"]
    levels = [level for level in (proven, known, list(found.front)) if level]
    return next((level for level in levels if found.selected in level), [*levels, []][0])


COLUMNS = (
    "c",
    "stages",
    "branches",
    "d_max",
    "3D",
    "precision",
    "runtime",
    "FPS",
    "interval",
    "D1-all",
    "EPE",
    "mIoU",
    "evidence",
)
LEFT = ("branches", "3D", "precision", "runtime", "evidence")
CONSTANT = ("d_max", "precision", "runtime")
"""Told below the table where all rows agree."""
LETTERS: dict[Evidence, str] = {
    "published": "p",
    "measured": "m",
    "interpolated": "i",
    "extrapolated": "x",
}


def _row(point: Point) -> list[str]:
    """The cells of `COLUMNS`."""
    arch, told = point.arch, point.evidence
    return [
        str(arch.c),
        str(arch.stages),
        arch.branches,
        str(arch.d_max),
        "/".join(str(width) for width in arch.conv3d),
        point.precision,
        RUNTIMES[point.runtime],
        f"{point.fps:.1f}",
        f"{point.fps_low:.1f}–{point.fps_high:.1f}",
        *(number(metric, point.metric(metric)) for metric in METRICS[:3]),
        f"{LETTERS[told.latency]} {LETTERS[told.accuracy]}",
    ]


def _fitting(columns: list[str], rows: list[list[str]], objective: Metric, width: int) -> list[str]:
    """`columns` less what a narrow terminal has no room for; the files have them all."""
    cells = dict(zip(COLUMNS, zip(*rows, strict=True), strict=True))
    for spare in ("EPE", "mIoU", "D1-all", "stages", "interval"):
        needed = sum(1 + max(map(len, (name, *cells[name]))) for name in columns)
        if 2 + needed <= width:
            break
        if spare != NAMES[objective]:
            columns = [name for name in columns if name != spare]
    return columns


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


def _verdict(found: Found, folder: str) -> list[tuple[str, str]]:
    lines = [("pick", _sentence(found, found.selected) if found.selected else _no_pick(found))]
    prospect = found.prospect
    if prospect is not None and prospect != found.selected:
        doubt = f"{prospect.evidence.latency}, {prospect.fps_low:.1f}–{prospect.fps_high:.1f}"
        accuracy = caption(found.objective, prospect.metric(found.objective))
        if prospect.evidence.accuracy == "extrapolated":
            accuracy += " (extrapolated)"
        told = f"{name_of(prospect)} · {prospect.fps:.1f} FPS ({doubt}) · {accuracy}"
        remedy = (
            f"rts2-deploy --front {folder}front.json --prospect --untrained --device "
            f"{found.device} writes what times it there; --allow-extrapolated takes it"
        )
        lines += [("prospect", told), ("", remedy)]
    return [*lines, *_untried(found)]


def _untried(found: Found) -> list[tuple[str, str]]:
    """What 3D widths and planes that nobody trained could win, at latencies that are known."""
    points = [p for p in found.front if p.ranges and p.evidence.latency != "extrapolated"]
    best = pick(points, found.target_fps, found.objective, at_lower_bound=False)
    if best is None or (
        found.selected and loss(best, found.objective) >= loss(found.selected, found.objective)
    ):
        return []
    known = (best.ranges or {}).get(found.objective)
    ends = "–".join(number(found.objective, end) for end in known) + ", " if known else ""
    between = f"{ends}extrapolated"
    widths = "/".join(map(str, best.arch.conv3d))
    shape = f"d_max {best.arch.d_max}, 3D {widths}"
    told = f"{_sentence(found, best)} ({between}); {shape}"
    lowered = " --verify" if best.precision != "fp32" else ""
    remedy = f"rts2-train --supernet, then --accuracy SUPERNET{lowered}, measures it on your images"
    return [("untried", told), ("", remedy)]


def _sentence(found: Found, point: Point) -> str:
    accuracy = caption(found.objective, point.metric(found.objective))
    return f"{name_of(point)} · {point.fps:.1f} FPS · {accuracy}"


def _no_pick(found: Found) -> str:
    """Why there is none; the error that the command ends with says the same in one line."""
    rule = f"none holds {found.target_fps:g} FPS"
    if found.prospect is not None:
        return f"{rule} on evidence better than extrapolation"
    if found.nearest is None:
        return f"{rule}; no candidate is left"
    return f"{rule}; the fastest is {_sentence(found, found.nearest)}"


def _cost(found: Found) -> list[tuple[str, str]]:
    """What measuring took, and what timing changed."""
    lines = []
    if (seen := found.verified) is not None:
        told = f"{seen.timed or 'no'} points measured on this device"
        if seen.unreliable:
            told += f", {seen.unreliable} while it was busy, whose latencies stay predictions"
        if seen.predicted:
            told += f", {seen.predicted} could not be, and keep their predictions"
        lines.append(("verified", told))
        if seen.demoted is not None:
            told = f"{_sentence(found, seen.demoted)}: was the pick, and misses the target"
            lines.append(("demoted", told))
    if (cost := found.cost) is not None:
        workers = "1 worker" if cost.workers == 1 else f"{cost.workers} workers"
        told = (
            f"{cost.evaluations} of {cost.candidates:,} chains judged ({cost.fresh} in this run, "
            f"{cost.cache_hits} told by the cache on disk, {cost.failed} failed) by {workers}; "
            f"{cost.wall_s:.0f} s now, evaluations {cost.evaluation_s:.0f} s in all"
        )
        if cost.training_s is not None:
            told += f", the supernet trained {cost.training_s:.0f} s"
        lines.append(("cost", told))
    return lines


def _left_out(found: Found) -> list[tuple[str, str]]:
    lines = [f"{entry.count:,} candidates: {entry.reason}" for entry in found.left_out]
    competing = found.space.size - sum(entry.count for entry in found.left_out)
    told = [("competed", f"{competing:,} candidates, whose accuracy is known")]
    return told + [("left out" if not i else "", line) for i, line in enumerate(lines)]


def _notes(found: Found, profile: Profile) -> list[tuple[str, str]]:
    """What the numbers rest on, where a user could take them for more."""
    notes = [
        f"{support.precision} is not offered on {profile.title}: {support.reason}"
        for support in profile.precisions
        if not support.supported
    ]
    if profile.machine is not None:
        since = "from {} on" if len({c.runtime for c in profile.calibrations}) > 1 else "{}"
        told = f"{profile.machine.processor}, {since.format(profile.machine.date)}"
        notes.append(f"timed on {told}; rts2-profile fit --device {profile.name} times yours")
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
    names = [name for name in Point.model_fields if name not in ("arch", "evidence", "ranges")]
    arch = ["family", "c", "stages", "d_max", "conv3d", "branches"]
    writer = csv.writer(text, lineterminator="\n")
    ends = [f"{metric}_{end}" for metric in METRICS for end in ("low", "high")]
    writer.writerow([*arch, *names, *ends, "latency_evidence", "accuracy_evidence", "selected"])
    for point in found.front:
        shape = point.arch
        widths = "/".join(str(width) for width in shape.conv3d)
        cells = [shape.family, shape.c, shape.stages, shape.d_max, widths, shape.branches]
        values = [getattr(point, name) for name in names]
        known = point.ranges or {}
        between = [end for metric in METRICS for end in known.get(metric, (None, None))]
        told = [point.evidence.latency, point.evidence.accuracy]
        writer.writerow([*cells, *values, *between, *told, point == found.selected])
    return text.getvalue()
