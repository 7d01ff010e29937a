"""What a person reads of a search: one HTML page that needs nothing beside it and no network."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any, get_args

from ..model.arch import Precision
from ..profiles.profile import Profile
from ..quant.html import template
from .accuracy import LOWER_IS_BETTER
from .context import Published, benchmarks, context
from .figures import figures, metrics_of
from .figures.front import CONTEXT
from .figures.points import between, told, traits
from .figures.style import SYMBOLS
from .palette import ACCENT, INK, ON_DARK, PALE, PROMISE, SOFT, colours
from .report import AXIS, NAMES, RUNTIMES, headline, name_of, number, remarks, scope
from .result import Found
from .sensitivity import Dimension
from .table import COLUMNS
from .tradeoff import POINTS, Step, sentence, steps

PLOTLY = "package_data/plotly.min.js"
"""Where the package `plotly` keeps its script."""

FILTERS = {
    "precision": "precision",
    "runtime": "runtime",
    "latency": "evidence of FPS",
    "accuracy": "evidence of accuracy",
}
"""What points can be filtered by, with what it is called."""

VALUES = {name: name for name in (*get_args(Precision), *SYMBOLS)} | {
    str(runtime): name for runtime, name in RUNTIMES.items()
}
"""Every value that a trait can take, in order, with what it is called."""


@dataclass(frozen=True)
class Box:
    """One value of a filter."""

    value: str
    label: str
    checked: bool = True
    symbol: str | None = None
    """The marker of what it shows, where that has one of its own."""


@dataclass(frozen=True)
class Filter:
    """The values that a trait takes."""

    key: str
    title: str
    boxes: tuple[Box, ...]


@dataclass(frozen=True)
class Key:
    """What a marker or a colour stands for."""

    symbol: str
    colour: str
    label: str


def page(found: Found, profile: Profile, dimensions: Sequence[Dimension]) -> str:
    """The page of a search as HTML, with everything that it needs in it.

    `dimensions` are those around the pick, or around the nearest where there is none.
    """
    published = context(profile, found.resolution)
    base = found.selected or found.nearest
    drawn = figures(found, dimensions, published)
    return template(__package__, "report.html").render(
        found=found,
        title=headline(found, profile.title),
        scope=scope(found),
        base=base,
        remarks=_labelled(remarks(found, profile)),
        filters=filters(found, published),
        hides_extrapolated=hides_extrapolated(found),
        keys=keys(found),
        metrics=metrics_of(found),
        lower_is_better=LOWER_IS_BETTER,
        names=NAMES,
        axes=AXIS,
        units=POINTS,
        sentence=sentence(found, base) if base else None,
        steps=steps(found, base) if base else [],
        dimensions=[(each, _changes(each)) for each in dimensions],
        columns=COLUMNS,
        traits=traits,
        name_of=name_of,
        metric=number,
        between=between,
        benchmarks=benchmarks(),
        pale=PALE,
        dark=ON_DARK,
        plotly=_plotly(),
        data=_json(drawn, found),
    )


def filters(found: Found, published: Sequence[Published]) -> list[Filter]:
    """A box for every value that occurs; what has one value alone is no filter."""
    own = [Filter(key, title, _boxes(found, key)) for key, title in FILTERS.items()]
    origins = {each.origin for each in published}
    others = tuple(
        Box(origin, label, checked=origin == "paper", symbol=symbol)
        for origin, (label, symbol) in CONTEXT.items()
        if origin in origins
    )
    return [
        *(each for each in own if len(each.boxes) > 1),
        Filter("context", "other networks", others),
    ]


def keys(found: Found) -> list[Key]:
    """What colours and markers mean, as far as they occur."""
    evidence = {point.evidence.latency for point in found.front}
    marks = [
        Key("star", ACCENT, "pick" if found.selected else ""),
        Key("star", PROMISE, "prospect" if _promising(found) else ""),
        Key("x", INK, "demoted" if found.verified and found.verified.demoted else ""),
    ]
    return [
        *(key for key in marks if key.label),
        *(Key("circle", colour, executor) for executor, colour in colours(found).items()),
        *(Key(s, SOFT, f"FPS {each}") for each, s in SYMBOLS.items() if each in evidence),
    ]


def _boxes(found: Found, key: str) -> tuple[Box, ...]:
    occurring = {traits(point)[key] for point in found.front}
    hidden = {"extrapolated"} if key == "accuracy" and hides_extrapolated(found) else set()
    return tuple(
        Box(value, label, checked=value not in hidden)
        for value, label in VALUES.items()
        if value in occurring
    )


def hides_extrapolated(found: Found) -> bool:
    """Whether accuracies that were extrapolated appear only when asked for, as in the picture.

    Not where the pick, or the nearest, rests on one.
    """
    base = found.selected or found.nearest
    known = {point.evidence.accuracy for point in found.front}
    return base is not None and base.evidence.accuracy != "extrapolated" and "extrapolated" in known


def _promising(found: Found) -> bool:
    return found.prospect is not None and found.prospect != found.selected


def _labelled(lines: Iterable[tuple[str, str]]) -> list[tuple[str, list[str]]]:
    """Lines by their labels; one without a label belongs to the label before it."""
    found: list[tuple[str, list[str]]] = []
    for label, text in lines:
        if label or not found:
            found.append((label, []))
        found[-1][1].append(text)
    return found


def _changes(dimension: Dimension) -> list[tuple[str, Step]]:
    """Each value with the step to it from the candidate's own."""
    return [(each.value, Step(dimension.base, each.point)) for each in dimension.variations]


def _plotly() -> str:
    """Plotly's script as its package ships it."""
    return (resources.files("plotly") / PLOTLY).read_text("utf-8")


def _json(drawn: dict[str, Any], found: Found) -> str:
    """What the page's script draws, with nothing in it that could end the element around it."""
    data = {"figures": drawn, "texts": [told(point) for point in found.front], "dark": ON_DARK}
    text = json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c")
