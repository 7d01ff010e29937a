"""How well a profile predicts: points left out of the fit in turn, or networks timed now."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import exp, log
from typing import Any

from ..model.arch import Arch, Precision
from .calibrate import leave_one_out, summary
from .latency import predict_ms
from .measure import Bench, random_candidate
from .profile import Profile, Resolution, Runtime

CHECK_SEED = 1_000_003
"""Fresh networks are drawn from another stream than those that a fit is made of."""


@dataclass(frozen=True)
class Comparison:
    """One network, as it is and as it was predicted."""

    arch: Arch
    precision: Precision
    runtime: Runtime
    resolution: Resolution
    fps_true: float
    fps_predicted: float
    drift: float = 1.0
    """How much slower the machine ran than when the profile was made; divided out of `fps_true`."""

    @property
    def residual(self) -> float:
        """ln(true latency / predicted latency)."""
        return log(self.fps_predicted / self.fps_true)


def held_out(profile: Profile) -> list[Comparison]:
    """Every point of the profile, predicted from all the others of its runtime and precision."""
    found = []
    for known in profile.calibrations:
        points = profile.points_of(known.runtime, known.precision)
        residuals = leave_one_out(points, known.model)
        for point, residual in zip(points, residuals, strict=True):
            found.append(
                Comparison(
                    point.arch,
                    point.precision,
                    point.runtime,
                    point.resolution,
                    point.fps,
                    point.fps * exp(residual),
                )
            )
    return found


def fresh(profile: Profile, bench: Bench, samples: int, seed: int) -> Iterator[Comparison]:
    """Random networks that no fit has seen, timed on this machine now.

    A machine drifts from day to day; what the reference network in between takes now and took
    then is divided out.
    """
    known = profile.calibration("onnxruntime", "fp32")
    chance = random.Random(CHECK_SEED + seed)
    for _ in range(samples):
        arch, resolution = random_candidate(chance)
        timing = bench.time(arch, resolution)
        then = profile.machine.reference_ms if profile.machine is not None else None
        drift = 1.0 if then is None else timing.reference_ms / then
        predicted = predict_ms(known.model, arch, resolution)
        yield Comparison(
            arch,
            "fp32",
            "onnxruntime",
            resolution,
            drift * 1000 / timing.median_ms,
            1000 / predicted,
            drift,
        )


def report(profile: Profile, comparisons: Sequence[Comparison]) -> dict[str, Any]:
    """The check as JSON: schema rts2.profile-check/1; errors are fractions."""
    from scipy.stats import spearmanr

    true = [comparison.fps_true for comparison in comparisons]
    predicted = [comparison.fps_predicted for comparison in comparisons]
    ranked = len(set(true)) > 1 and len(set(predicted)) > 1
    rank = float(spearmanr(true, predicted).statistic) if ranked else None
    return {
        "schema": "rts2.profile-check/1",
        "device": profile.name,
        "n": len(comparisons),
        **summary([comparison.residual for comparison in comparisons]),
        "spearman": rank,
        "points": [
            {
                "arch": comparison.arch.model_dump(mode="json"),
                "precision": comparison.precision,
                "runtime": comparison.runtime,
                "resolution": comparison.resolution,
                "fps_true": comparison.fps_true,
                "fps_predicted": comparison.fps_predicted,
            }
            for comparison in comparisons
        ],
    }
