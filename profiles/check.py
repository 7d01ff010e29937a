"""How well a profile predicts: points left out of the fit in turn, or networks timed now."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import exp, log
from typing import Any

from ..model.arch import Arch, Form, Precision
from ..model.console import progress
from ..model.errors import Rts2Error
from .calibrate import summary
from .conformal import half_width
from .latency import fastest_forms, predict_ms
from .measure import Bench
from .plan import Job, random_candidate
from .profile import Profile, Resolution, Runtime
from .timing import Timing

CHECK_SEED = 1_000_003
"""Fresh networks are drawn from another stream than those that a fit is made of."""

Executor = tuple[Runtime, Precision]

Benches = Callable[[Runtime], Bench]
"""The bench of a runtime; asked again it gives the same one."""


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
    reliable: bool = True
    """Whether the runs agreed; no error is told of a timing that is not."""

    @property
    def executor(self) -> Executor:
        return self.runtime, self.precision

    @property
    def residual(self) -> float:
        """ln(true latency / predicted latency)."""
        return log(self.fps_predicted / self.fps_true)


def held_out(profile: Profile) -> list[Comparison]:
    """Every point of the profile, predicted from all the others of its runtime and precision.

    The errors are those that stand in the profile: `recalibrated` computes them anew.
    """
    found = []
    for known in profile.calibrations:
        points = profile.points_of(known.runtime, known.precision)
        residuals = known.residuals
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


def groups_held_out(profile: Profile) -> list[dict[str, Any]]:
    """The profile's errors of whole families and stage counts left out, one entry per calibration.

    Fractions, and null where too few points remain to fit.
    """
    return [
        {
            "runtime": known.runtime,
            "precision": known.precision,
            **known.held_out.model_dump(mode="json"),
        }
        for known in profile.calibrations
        if known.held_out is not None
    ]


RETRIES = 2
"""How often a network is timed again, after all the others, while its timing is unreliable."""


def executors_here(profile: Profile, benches: Benches) -> tuple[list[Executor], list[str]]:
    """What of the profile can be timed on this machine, and why the rest cannot, a line each.

    Raises `Rts2Error` where nothing can.
    """
    from .runtimes import RUNTIMES

    able: list[Executor] = []
    told: dict[str, None] = {}
    for known in profile.calibrations:
        row = RUNTIMES.get(known.runtime)
        title = row.title if row else known.runtime
        reason = row.missing() if row else f"no network can be timed in {title}"
        if reason is None and known.precision not in benches(known.runtime).precisions:
            reason = f"{title} does not run {known.precision} on this machine"
        if reason is None:
            able.append((known.runtime, known.precision))
        else:
            told[reason] = None
    if not able:
        raise Rts2Error(f"nothing of {profile.title} can be timed here: {next(iter(told))}")
    return able, list(told)


def fresh(
    profile: Profile,
    benches: Benches,
    executors: Sequence[Executor],
    samples: int,
    seed: int,
) -> list[Comparison]:
    """Random networks that no fit has seen, timed on this machine now, each in one of `executors`;
    those whose timing is unreliable are timed again, after all others.

    What counts is the ratio to the reference beside it: a machine drifts from day to day. Whether
    it was quiet is told in hindsight: the first timings know of no faster reference than their own.
    """
    chance = random.Random(CHECK_SEED + seed)
    drawn: list[tuple[Bench, Job]] = []
    for _ in range(samples):
        candidate = random_candidate(chance)
        runtime, precision = chance.choice(executors)
        bench, job = benches(runtime), Job(*candidate, precision)
        drawn.append((bench, replace(job, forms=_forms(profile, bench, job))))
    found: dict[int, Timing] = {}
    for _ in range(1 + RETRIES):
        left = [at for at in range(samples) if at not in found or not found[at].reliable]
        for at in progress(left, "timing", len(left)):
            bench, job = drawn[at]
            found[at] = bench.time(job)
        found = {at: timing.beside(drawn[at][0].own_ms) for at, timing in found.items()}
    return [_compared(profile, *drawn[at], found[at]) for at in range(samples)]


def _forms(profile: Profile, bench: Bench, job: Job) -> tuple[Form, ...] | None:
    known = profile.calibration(bench.runtime, job.precision)
    return fastest_forms(known.model, job.arch, job.resolution)


def _compared(profile: Profile, bench: Bench, job: Job, timing: Timing) -> Comparison:
    """One network in its fastest form, as it was timed now."""
    known = profile.calibration(bench.runtime, job.precision)
    then = (profile.machine and profile.machine.reference_ms) or timing.reference_ms
    return Comparison(
        job.arch,
        job.precision,
        bench.runtime,
        job.resolution,
        1000 / (timing.ratio * then),
        1000 / predict_ms(known.model, job.arch, job.resolution),
        timing.reference_ms / then,
        timing.reliable,
    )


def half_widths(profile: Profile, confidence: float) -> dict[Executor, float]:
    """Of the interval that each calibration gives at a confidence, in natural logarithm."""
    return {
        (known.runtime, known.precision): half_width(known.residuals, confidence)
        for known in profile.calibrations
    }


def coverage(profile: Profile, comparisons: Sequence[Comparison], confidence: float) -> float:
    """The share of reliable timings within the interval that the profile gives at a confidence."""
    widths = half_widths(profile, confidence)
    inside = [abs(c.residual) <= widths[c.executor] for c in comparisons if c.reliable]
    return sum(inside) / len(inside)


def report(profile: Profile, comparisons: Sequence[Comparison]) -> dict[str, Any]:
    """The check as JSON: schema rts2.profile-check/1; errors are fractions, of reliable timings.

    Raises `Rts2Error` where no timing was reliable.
    """
    from scipy.stats import spearmanr

    told = len(comparisons)
    comparisons = [comparison for comparison in comparisons if comparison.reliable]
    if not comparisons:
        raise Rts2Error(
            f"none of {told} timings was reliable: close what else runs on this machine, "
            "and check again"
        )
    true = [comparison.fps_true for comparison in comparisons]
    predicted = [comparison.fps_predicted for comparison in comparisons]
    ranked = len(set(true)) > 1 and len(set(predicted)) > 1
    rank = float(spearmanr(true, predicted).statistic) if ranked else None
    return {
        "schema": "rts2.profile-check/1",
        "device": profile.name,
        "n": len(comparisons),
        "unreliable": told - len(comparisons),
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
