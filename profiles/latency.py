"""Latency as the sum of a network's steps, predicted for whole tables of networks at once.

A step costs what it takes to start it and what it takes to do its work, either one after the
other (`sum`) or one hidden behind the other (`max`). Both are linear in a few physical features,
so a model is a handful of non-negative coefficients that a person can read in a profile.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, field_validator

from ..model.arch import Arch, Form
from ..model.errors import Rts2Error
from ..model.ops import Kind, Op, ops
from .features import FEATURES
from .parts import PartModel, parts

Floats = NDArray[np.float64]
Milliseconds = Annotated[float, Field(ge=0, le=1e6)]

_KINDS: tuple[Kind, ...] = get_args(Kind)


class LatencyModel(BaseModel):
    """Coefficients of one runtime and precision on one device, in milliseconds.

    `starts` says what is started: every kernel that eager execution launches, or every step once.
    Steps of a `folded` kind cost nothing: the runtime merges them into the convolution before.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    combine: Literal["sum", "max"]
    starts: Literal["kernels", "steps"]
    folded: tuple[Kind, ...] = ()
    start_ms: Milliseconds
    ms_per: dict[str, Milliseconds]

    @field_validator("ms_per")
    @classmethod
    def _known(cls, value: dict[str, float]) -> dict[str, float]:
        unknown = sorted(value.keys() - FEATURES.keys())
        if unknown:
            raise ValueError(f"{unknown[0]} is no feature; known are {', '.join(FEATURES)}")
        return value


@dataclass(frozen=True)
class Steps:
    """Op lists as arrays: n steps in all, list i from `firsts[i]` on."""

    kinds: NDArray[np.int64]
    launches: Floats
    weights: Floats
    macs: Floats
    features: Floats
    """(n, len(FEATURES))"""
    firsts: NDArray[np.int64]
    lists: tuple[Sequence[Op], ...]

    @classmethod
    def of(cls, lists: Iterable[Sequence[Op]]) -> Steps:
        """Lays out op lists; every list needs at least one op."""
        known = list(lists)
        flat = [op for steps in known for op in steps]
        lengths = [len(steps) for steps in known]
        return cls(
            np.array([_KINDS.index(op.kind) for op in flat]),
            np.array([op.launches for op in flat], dtype=np.float64),
            np.array([op.weights for op in flat], dtype=np.float64),
            np.array([op.macs for op in flat], dtype=np.float64),
            np.array([[feature(op) for feature in FEATURES.values()] for op in flat]),
            np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int64),
            tuple(known),
        )

    def summed(self, per_step: Floats) -> Floats:
        """Sums of a quantity of each step over each list: (n,) → (lists,)."""
        totals: Floats = np.add.reduceat(per_step, self.firsts)
        return totals


def step_costs_ms(model: LatencyModel, steps: Steps) -> Floats:
    """The cost of each step, in milliseconds: (n,)."""
    counts = steps.launches if model.starts == "kernels" else np.ones_like(steps.launches)
    start = model.start_ms * counts
    work = steps.features @ np.array([model.ms_per.get(name, 0.0) for name in FEATURES])
    cost = start + work if model.combine == "sum" else np.maximum(start, work)
    folded = [_KINDS.index(kind) for kind in model.folded]
    return np.where(np.isin(steps.kinds, folded), 0.0, cost)


def latencies_ms(model: LatencyModel | PartModel, steps: Steps) -> Floats:
    """The latency of each op list in its fastest form, in milliseconds: (lists,)."""
    if isinstance(model, PartModel):
        return np.array([model.fastest_ms(parts(found)) for found in steps.lists])
    return steps.summed(step_costs_ms(model, steps))


def predict_ms(model: LatencyModel | PartModel, arch: Arch, resolution: tuple[int, int]) -> float:
    """The latency of one arch at (width, height), in milliseconds.

    Raises:
        Rts2Error: the model gives a step of the arch no cost.
    """
    steps = Steps.of([ops(arch, resolution)])
    if isinstance(model, LatencyModel):
        require_costs(model, steps)
    return float(latencies_ms(model, steps)[0])


def fastest_forms(
    model: LatencyModel | PartModel, arch: Arch, resolution: tuple[int, int]
) -> tuple[Form, ...] | None:
    """The forms of the stages' 3D convs in which `predict_ms` takes the network to run; None where
    the model knows one form alone.
    """
    if isinstance(model, LatencyModel):
        return None
    return model.forms(parts(ops(arch, resolution)))


def require_costs(model: LatencyModel, steps: Steps) -> None:
    """Raises `Rts2Error` with the name of the first step that would cost nothing.

    Only steps of a folded kind may: what no coefficient knows is unknown, not free.
    """
    free = step_costs_ms(model, steps) <= 0
    for op, costless in zip((op for found in steps.lists for op in found), free, strict=True):
        if costless and op.kind not in model.folded:
            raise Rts2Error(
                f"the latency model has no cost for {op.name} ({op.kind}); "
                "fit it to timings of networks with that step"
            )
