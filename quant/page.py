"""What a person reads of a quantization: one HTML page that needs nothing beside it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from .html import DASH, template
from .maps import FAR_PX, NEAR_PX, WIDEST_PX, Example, scales, shown

__all__ = ["Example", "page"]

EXAMPLES: Final = 3
"""Shown at most."""

PICTURES_CHARS: Final = 2_000_000
"""What the pictures of a page may take, so that it can be sent by mail."""

TIMES: Final = re.compile(r"(?P<title>.+?)(?:: | \()(?P<times>[\d.]+ → [\d.]+ ms)\)?")
"""A reason that ends in the layer's own times."""


@dataclass(frozen=True)
class Quantity:
    """One figure of a network: how it is written, and which way is better."""

    key: str
    title: str
    unit: str
    digits: int
    lower_is_better: bool = True
    change_unit: str | None = None
    """Of a difference, where it is another than the unit."""
    scale: float = 1.0
    """From the report's unit to that of the page."""
    relative: bool = False
    """Whether a difference is told as a share too."""
    allowance: str | None = None
    """The budget's name of what may be lost of it."""
    note: str | None = None
    """Said where the float network has no such figure."""


QUANTITIES: Final = (
    Quantity("latency_ms", "Latency", "ms", 2, relative=True),
    Quantity("d1_all", "D1-all", "%", 2, change_unit="points", allowance="max_d1_drop"),
    Quantity("epe", "EPE", "px", 3),
    Quantity("miou", "mIoU", "%", 2, False, "points", allowance="max_miou_drop"),
    Quantity("size_bytes", "Size", "kB", 0, scale=1e-3, relative=True),
    Quantity("sqnr_db", "SQNR", "dB", 1, False, note="it is the reference"),
)


@dataclass(frozen=True)
class Change:
    """One figure before and after; None where it is not known."""

    quantity: Quantity
    before: float | None
    after: float | None
    allowed: float | None
    """By how much it may get worse; None where the budget says nothing of it."""

    @property
    def difference(self) -> float | None:
        return None if self.before is None or self.after is None else self.after - self.before

    @property
    def share(self) -> float | None:
        """The difference in percent of what it was."""
        difference = self.difference
        return 100 * difference / self.before if difference is not None and self.before else None

    @property
    def worse_by(self) -> float | None:
        difference = self.difference
        return difference if difference is None or self.quantity.lower_is_better else -difference

    @property
    def verdict(self) -> str:
        """`better`, `worse`, `same` as far as the page's digits tell, or `unknown`."""
        if self.worse_by is None:
            return "unknown"
        seen = round(self.worse_by, self.quantity.digits)
        return "worse" if seen > 0 else "better" if seen < 0 else "same"

    @property
    def inside(self) -> bool | None:
        """Whether it keeps the budget; None where there is none for it, or nothing to judge."""
        if self.allowed is None or self.worse_by is None:
            return None
        return self.worse_by <= self.allowed

    @property
    def used(self) -> float | None:
        """How much of the budget is taken, in percent from 0 to 100."""
        if self.allowed is None or self.worse_by is None:
            return None
        if self.worse_by <= 0:
            return 0.0
        return min(100.0, 100 * self.worse_by / self.allowed) if self.allowed else 100.0


@dataclass(frozen=True)
class Part:
    """The layers of one part of the network together."""

    name: str
    layers: int
    lowered: int
    """How many of them are not in float."""
    float_ms: float | None
    quantized_ms: float | None
    chosen_ms: float | None
    """Each layer at the precision that was chosen for it; None where one was not timed."""


@dataclass(frozen=True)
class Kept:
    """Layers that stay float for one reason."""

    reason: str
    layers: tuple[tuple[str, str | None], ...]
    """The name of each, and its own times where the reason gave them."""


def page(report: Mapping[str, Any], examples: Sequence[Example]) -> str:
    """The page of `report`, which is the JSON of rts2.quantize/1, as HTML.

    Shows the first `EXAMPLES` examples. Everything that the page needs is in it.
    """
    layers = [dict(row, part=part_of(row["layer"])) for row in report["layers"]]
    disparities, differences = scales()
    return template(__package__, "report.html").render(
        report=report,
        changes=changes(report),
        layers=layers,
        longest_ms=_highest(row[key] for row in layers for key in ("float_ms", "quantized_ms")),
        highest_db=_highest(row["sqnr_db"] for row in layers),
        lowered=sum(row["precision"] != "fp32" for row in layers),
        parts=parts(layers),
        whole=_part("all", layers),
        kept=kept(report["kept_float"]),
        examples=shown(examples[:EXAMPLES], PICTURES_CHARS),
        scales={"disparity": disparities, "difference": differences},
        bounds={"widest": WIDEST_PX, "near": NEAR_PX, "far": FAR_PX},
    )


def changes(report: Mapping[str, Any]) -> list[Change]:
    """Every figure of `QUANTITIES` before and after."""
    return [
        Change(
            quantity,
            _scaled(report["float"][quantity.key], quantity.scale),
            _scaled(report["quantized"][quantity.key], quantity.scale),
            report["budget"][quantity.allowance] if quantity.allowance else None,
        )
        for quantity in QUANTITIES
    ]


def parts(layers: Sequence[Mapping[str, Any]]) -> list[Part]:
    """The parts of the network, in the order in which they first run."""
    names = dict.fromkeys(row["part"] for row in layers)
    return [_part(name, [row for row in layers if row["part"] == name]) for name in names]


def part_of(layer: str) -> str:
    """The first word of a layer's name: `disparity` of `disparity.levels.2.0.0/Conv`."""
    found = re.search(r"\w+", layer)
    return found[0] if found else layer


def kept(rows: Iterable[Mapping[str, Any]]) -> list[Kept]:
    """What stays float, by reason; times that a reason ends in belong to the layer."""
    found: dict[str, list[tuple[str, str | None]]] = {}
    for row in rows:
        reason = row["reason"] or DASH
        timed = TIMES.fullmatch(reason)
        title, times = (timed["title"], timed["times"]) if timed else (reason, None)
        found.setdefault(title, []).append((row["layer"], times))
    return [Kept(reason, tuple(layers)) for reason, layers in found.items()]


def _part(name: str, layers: Sequence[Mapping[str, Any]]) -> Part:
    return Part(
        name,
        len(layers),
        sum(row["precision"] != "fp32" for row in layers),
        _sum(row["float_ms"] for row in layers),
        _sum(row["quantized_ms"] for row in layers),
        _sum(row["float_ms" if row["precision"] == "fp32" else "quantized_ms"] for row in layers),
    )


def _sum(values: Iterable[float | None]) -> float | None:
    """None where one of them is not known."""
    total = 0.0
    for value in values:
        if value is None:
            return None
        total += value
    return total


def _highest(values: Iterable[float | None]) -> float:
    """The largest that is known; 1 where none is, or none is above 0."""
    return max((value for value in values if value is not None and value > 0), default=1.0)


def _scaled(value: float | None, scale: float) -> float | None:
    return None if value is None else value * scale
