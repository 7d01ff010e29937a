"""The integers of a bundle: its usual layers in 8 bits, calibrated on streets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from ...model.data.catalog import STREETS, open_dataset
from ...model.data.scene import fingerprint
from ...model.graph import save_graph
from ...model.qdq import integers, layers, seldom
from ...quant.calibration import Method, calibrate
from ...quant.rules import rule
from ...quant.source import opened
from .schema import Calibration

PAIRS: Final = 16
"""Generated scenes that calibrate: the same ones in every bundle of a network."""

SEED: Final = 0
METHOD: Final[Method] = "percentile"


@dataclass(frozen=True)
class Lowered:
    """What was made of a graph's layers."""

    layers: tuple[str, ...]
    """All of them, in the order of the graph."""
    left: dict[str, str]
    """Those that stay float, each with the reason."""
    calibration: Calibration


def lower(path: Path, symmetric: bool = False) -> Lowered:
    """Makes the float graph at `path` one in 8 bits, in its place.

    Layers are chosen as the latency was timed on CPUs; `symmetric` is for TensorRT, with
    zero points of 0, the layers those that nobody has to time.
    """
    model, header = opened(path)
    names = tuple(layer.name for layer in layers(model))
    left = _by_rules(names) if symmetric else seldom(model)
    pairs = open_dataset(STREETS, split="train", count=PAIRS, size=header.resolution, seed=SEED)
    with TemporaryDirectory() as folder:
        known = calibrate(model, header, pairs, Path(folder) / "calibration.npz")
    chosen = [name for name in names if name not in left]
    made = integers(model, chosen, known.ranges(METHOD), symmetric)
    save_graph(made, header.model_copy(update={"precision": "int8"}), path)
    told = Calibration(
        dataset=STREETS,
        method=METHOD,
        seed=SEED,
        fingerprint=fingerprint(pairs),
        images=tuple(known.pairs),
    )
    return Lowered(names, left, told)


def _by_rules(names: tuple[str, ...]) -> dict[str, str]:
    return {name: why for name in names if (why := rule(name)) is not None}
