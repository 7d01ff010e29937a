"""What a quantization reports: the schema rts2.quantize/1, and the same for people."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from math import isfinite
from typing import Any

from ..model.metrics import Score
from .fp16 import Kept


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
class Report:
    """One quantization."""

    network: str
    """Which one, at which resolution, and how its weights came to be, in words."""
    precision: str
    scenes: str
    """What was measured on, in words."""
    reference: Metrics
    quantized: Metrics
    kept: tuple[Kept, ...]
    layers: tuple[str, ...]
    """The convolutions that run in the new precision."""
    files: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        return {
            "schema": "rts2.quantize/1",
            "network": self.network,
            "precision": self.precision,
            "measured_on": self.scenes,
            "float": asdict(self.reference),
            "quantized": asdict(self.quantized),
            "kept_float": [kept._asdict() for kept in self.kept],
            "layers": [{"layer": name, "precision": self.precision} for name in self.layers],
            "files": list(self.files),
        }


def metrics(score: Score, size_bytes: int, sqnr_db: float | None = None) -> Metrics:
    """The figures of one graph; an infinite ratio, of equal outputs, becomes None."""
    known = sqnr_db if sqnr_db is not None and isfinite(sqnr_db) else None
    return Metrics(None, score.d1_all, score.epe, score.miou, size_bytes, known)
