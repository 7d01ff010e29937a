"""What is known of a device before anything was timed on it."""

from __future__ import annotations

from typing import NamedTuple

from ...model.arch import Precision
from ...model.ops import Kind
from ..latency import LatencyModel
from ..profile import Calibration, Profile, Runtime

FUSED: tuple[Kind, ...] = ("norm", "relu")
"""What every runtime but eager PyTorch merges into the convolution before."""

ALWAYS = ("gmac_2d", "gmac_3d", "gbyte", "gbyte_resize", "gbyte_argmax", "mvoxel_warp")
"""What a runtime may pay for, whether the prior knows or not; 0 is what nobody knows."""


class Prior(NamedTuple):
    """A latency model, and in words where it comes from."""

    model: LatencyModel
    source: str


def prior(profile: Profile, runtime: Runtime, precision: Precision) -> Prior:
    """The profile's own model for a runtime and precision, or the nearest that it has.

    A calibration comes first, then a derivation; without either, the first calibration of that
    precision or of any, with what the runtime fuses left out.
    """
    for known in profile.calibrations:
        if (known.runtime, known.precision) == (runtime, precision):
            told = f"the calibration of {runtime} {precision}"
            return Prior(known.prior or _open(known.by_steps), told)
    for derived in profile.derivations:
        if (derived.runtime, derived.precision) == (runtime, precision):
            base = profile.calibration(*derived.base)
            told = f"{' '.join(derived.base)}, scaled: {derived.source}"
            return Prior(_open(derived.scale(base.by_steps)), told)
    nearest = min(profile.calibrations, key=lambda known: known.precision != precision)
    return Prior(_open(_fused(nearest)), f"{nearest.runtime} {nearest.precision}, steps fused")


def _open(model: LatencyModel) -> LatencyModel:
    """`model` with room for what it does not know; one in other units of work is left as it is."""
    if any(name.endswith(("_blocked", "_packed")) for name in model.ms_per):
        return model
    return model.model_copy(update={"ms_per": dict.fromkeys(ALWAYS, 0.0) | model.ms_per})


def _fused(known: Calibration) -> LatencyModel:
    folded = tuple(sorted({*known.by_steps.folded, *FUSED}))
    return known.by_steps.model_copy(update={"folded": folded})
