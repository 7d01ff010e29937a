"""What a quantization reports: the schema rts2.quantize/1, for every way that one came about."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from math import isfinite
from typing import Any

from ..model.arch import Form, Precision
from ..model.graph import GraphHeader
from ..model.metrics import Score
from .budget import Budget
from .calibration import Calibration
from .ptq import Quantized, Trial
from .race import Duel
from .selection import Cost
from .sensitivity import Effect


@dataclass(frozen=True)
class Metrics:
    """One graph's figures; None for what was not measured."""

    latency_ms: float | None
    d1_all: float | None
    """In percent; so is `miou`."""
    epe: float | None
    miou: float | None
    size_bytes: int
    sqnr_db: float | None


@dataclass(frozen=True)
class Row:
    """One layer: where it runs and why, its times, and what it alone does to the answer."""

    layer: str
    precision: Precision
    reason: str | None
    """Why it stays float; None where it does not."""
    float_kernels: tuple[str, ...] = ()
    quantized_kernels: tuple[str, ...] = ()
    float_ms: float | None = None
    quantized_ms: float | None = None
    sqnr_db: float | None = None
    d1_change: float | None = None
    """In points, above 0 where it got worse; so is `miou_change`, and `epe_change` in pixels."""
    epe_change: float | None = None
    miou_change: float | None = None
    error: float | None = None
    """The pixels that it moves, and those whose class it changes, in percent."""


@dataclass(frozen=True)
class Report:
    """One quantization."""

    network: str
    """Which one, at which resolution, and how its weights came to be, in words."""
    precision: Precision
    outcome: Precision
    """What is delivered: the precision, or fp32 where it was not worth it."""
    why: str
    device: str | None
    runtime: str | None
    evidence: str
    """Whether latency was `measured`, or `rules` decided."""
    machine: str | None
    measured_on: str
    reference: Metrics
    quantized: Metrics
    budget: Budget
    layers: tuple[Row, ...] = ()
    files: tuple[str, ...] = ()
    calibration: dict[str, Any] | None = None
    forms: dict[str, Any] | None = None
    speedup: float | None = None
    speedup_error: float | None = None
    trials: tuple[dict[str, Any], ...] = ()

    @property
    def kept(self) -> tuple[Row, ...]:
        """What stays float of that which could be in another precision."""
        return tuple(row for row in self.layers if row.reason is not None)

    def to_json(self) -> dict[str, Any]:
        return {
            "schema": "rts2.quantize/1",
            "network": self.network,
            "precision": self.precision,
            "outcome": self.outcome,
            "why": self.why,
            "device": self.device,
            "runtime": self.runtime,
            "evidence": self.evidence,
            "machine": self.machine,
            "measured_on": self.measured_on,
            "calibration": self.calibration,
            "forms": self.forms,
            "budget": asdict(self.budget),
            "float": asdict(self.reference),
            "quantized": asdict(self.quantized),
            "speedup": self.speedup,
            "speedup_error": self.speedup_error,
            "kept_float": [{"layer": row.layer, "reason": row.reason} for row in self.kept],
            "layers": [asdict(row) for row in self.layers],
            "trials": list(self.trials),
            "files": list(self.files),
        }


def metrics(score: Score, size_bytes: int, sqnr_db: float | None = None) -> Metrics:
    """The figures of one graph that nobody timed; an infinite ratio, of equal outputs, is None."""
    return Metrics(None, score.d1_all, score.epe, score.miou, size_bytes, _finite(sqnr_db))


def named(header: GraphHeader) -> str:
    """A graph in words."""
    width, height = header.resolution
    return f"{header.arch.label()} · {width}×{height} · {header.origin}"


def sentence(delivered: bool, precision: Precision, duel: Duel, within: bool, parent: str) -> str:
    """What was delivered, and why."""
    error = duel.timing.error
    faster = f"{1 / duel.ratio:.2f} times as fast as {parent} (±{error:.1%})"
    if delivered:
        return f"{precision} is {faster} and within the accuracy budget"
    if not within:
        return f"{precision} does not keep the accuracy budget: fp32 is delivered"
    return f"{precision} would be {faster}, not surely faster: fp32 is delivered"


def rows(found: Quantized) -> tuple[Row, ...]:
    """Every layer of a network that was timed here."""
    return tuple(
        _with_effect(
            Row(
                cost.layer,
                "int8" if cost.layer in found.chosen else "fp32",
                None if cost.layer in found.chosen else _reason(cost, found),
                tuple(found.audited.float_kernels.get(cost.layer, ())),
                tuple(found.audited.integer_kernels.get(cost.layer, ())),
                cost.float_ms,
                cost.integer_ms,
            ),
            found.effects.get(cost.layer),
        )
        for cost in found.audited.costs
    )


def rows_by_rules(
    names: Sequence[str], kept: Mapping[str, str], effects: Mapping[str, Effect]
) -> tuple[Row, ...]:
    """Every layer of a network that nobody timed."""
    return tuple(
        _with_effect(
            Row(name, "fp32" if name in kept else "int8", kept.get(name)), effects.get(name)
        )
        for name in names
    )


def trial(found: Trial) -> dict[str, Any]:
    """One choice that was looked at."""
    score = found.measured and found.measured.other
    return {
        "what": found.what,
        "layers": found.layers,
        "latency_ratio": found.latency_ratio,
        "d1_all": score and score.d1_all,
        "miou": score and score.miou,
        "kept": found.kept,
    }


def calibrated(known: Calibration, method: str, source: str) -> dict[str, Any]:
    """What a network was calibrated on."""
    return {
        "method": method,
        "pairs": len(known.pairs),
        "source": source,
        "skipped": list(known.skipped),
        "names": list(known.pairs),
    }


def in_forms(
    plain: tuple[Form, ...] | None, quantized: tuple[Form, ...] | None
) -> dict[str, Any] | None:
    """The forms of the 3D convs in both graphs, where they have any."""
    if plain is None and quantized is None:
        return None
    return {"float": plain and list(plain), "quantized": quantized and list(quantized)}


def _with_effect(row: Row, effect: Effect | None) -> Row:
    if effect is None:
        return row
    return replace(
        row,
        sqnr_db=_finite(effect.sqnr_db),
        d1_change=effect.d1_change,
        epe_change=effect.epe_change,
        miou_change=effect.miou_change,
        error=effect.harm,
    )


def _reason(cost: Cost, found: Quantized) -> str:
    times = f"{cost.float_ms:.2f} → {cost.integer_ms:.2f} ms"
    if cost.layer in found.restored:
        return f"restored for the accuracy budget ({times})"
    if cost.integer_ms >= cost.float_ms:
        return f"slower in integers: {times}"
    return f"converting its values costs more than it saves: {times}"


def _finite(value: float | None) -> float | None:
    return value if value is not None and isfinite(value) else None
