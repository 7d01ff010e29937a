"""The points of a front as figures and table know them: what is told, and what tells them apart."""

from __future__ import annotations

from ..accuracy import METRICS, Metric
from ..report import NAMES, UNITS, executor_of, number
from ..result import Found, Point

Traits = dict[str, str]


def traits(point: Point) -> Traits:
    """What a point can be filtered by."""
    return {
        "precision": point.precision,
        "runtime": point.runtime,
        "latency": point.evidence.latency,
        "accuracy": point.evidence.accuracy,
    }


def groups(found: Found) -> list[tuple[Traits, list[int]]]:
    """The positions of the points of the front by their traits."""
    by_traits: dict[tuple[str, ...], list[int]] = {}
    for at, point in enumerate(found.front):
        by_traits.setdefault(tuple(traits(point).values()), []).append(at)
    return [(traits(found.front[group[0]]), group) for group in by_traits.values()]


def kind(point: Point) -> str:
    """What the points of a group have in common, in words."""
    return f"{executor_of(point)}, {point.evidence.latency}"


def between(point: Point, metric: Metric) -> str:
    """A metric with its unit, and with its interval where one is known."""
    text, unit = number(metric, point.metric(metric)), UNITS[metric]
    ends = (point.ranges or {}).get(metric)
    return f"{text} ({ends[0]:.2f}–{ends[1]:.2f}{unit})" if ends else text


def told(point: Point) -> str:
    """Everything that a point has, for the label under the pointer."""
    arch, evidence = point.arch, point.evidence
    widths = "/".join(str(width) for width in arch.conv3d)
    known = [f"{NAMES[metric]} {between(point, metric)}" for metric in METRICS]
    judged = any(point.metric(metric) is not None for metric in METRICS)
    return "<br>".join(
        [
            f"<b>{arch.label()}</b>",
            f"d_max {arch.d_max}, 3D widths {widths}",
            executor_of(point),
            f"{point.fps:.1f} FPS ({point.fps_low:.1f}–{point.fps_high:.1f}), {evidence.latency}",
            f"{point.latency_ms:.1f} ms a pair",
            f"{known[0]}, {known[1]}",
            f"{known[2]}, {known[3]}",
            f"accuracy {evidence.accuracy if judged else 'not known'}",
            f"{point.params:,} parameters, {point.size_bytes / 1e6:.2f} MB",
            f"{point.macs / 1e9:.2f} billion multiply-adds",
        ]
    )
