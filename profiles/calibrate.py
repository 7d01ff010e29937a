"""From timings to coefficients: non-negative least squares on relative error, and its honest check.

Few coefficients against few points, so a fit is judged by leaving each point out in turn.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, nnls

from ..model.errors import Rts2Error
from ..model.ops import ops
from .heldout import hold_outs
from .kit import fewshot
from .latency import Floats, LatencyModel, Steps, latencies_ms
from .partfit import Harvest, fit_parts
from .parts import PartModel
from .profile import Calibration, Point, Profile

Form = LatencyModel | PartModel
"""What a fit fills: coefficients by step, or tables by part."""


def fit(points: Sequence[Point], form: Form) -> Form:
    """`form` with values that fit `points`; its own do not matter.

    The sum form is linear and starts the search; the max form is refined from there.

    Raises:
        Rts2Error: fewer points than coefficients, or a coefficient that no point exercises.
    """
    if isinstance(form, PartModel):
        return fit_parts(_harvests(points))
    steps, truth = _table(points)
    return _fit(steps, truth, form)


def recalibrated(profile: Profile) -> Profile:
    """`profile` with every calibration fitted again to the profile's own points.

    Tables of parts stay as they are; what rests on a prior starts from it again.
    """
    fitted = tuple(_again(profile, known) for known in profile.calibrations)
    return profile.model_copy(update={"calibrations": fitted})


def _again(profile: Profile, known: Calibration) -> Calibration:
    points = profile.points_of(known.runtime, known.precision)
    if known.prior is not None:
        return fewshot.calibrated(points, known.prior, known.source)
    if not isinstance(known.model, LatencyModel):
        return known
    return calibrated(points, known.model, known.source)


def calibrated(points: Sequence[Point], form: LatencyModel, source: str) -> Calibration:
    """`form` fitted to the points of one runtime and precision, with the errors of each left out,
    of each family left out, and of each stage count.
    """
    return Calibration(
        runtime=points[0].runtime,
        precision=points[0].precision,
        model=fit(points, form),
        residuals=tuple(float(residual) for residual in leave_one_out(points, form)),
        source=source,
        held_out=hold_outs(points, lambda others: fit(others, form)),
    )


def leave_one_out(points: Sequence[Point], form: LatencyModel) -> Floats:
    """ln(true / predicted) of each point, predicted by a fit on all the others."""
    needed = len(form.ms_per) + 2
    if len(points) < needed:
        raise Rts2Error(
            f"{needed - 1} coefficients need at least {needed} timings to leave one out, "
            f"not {len(points)}"
        )
    residuals = []
    for index, point in enumerate(points):
        others = [*points[:index], *points[index + 1 :]]
        predicted = latencies_ms(fit(others, form), Steps.of([ops(point.arch, point.resolution)]))
        residuals.append(np.log(point.latency_ms / predicted[0]))
    return np.array(residuals)


def _harvests(points: Sequence[Point]) -> list[Harvest]:
    for point in points:
        if point.parts_ms is None:
            raise Rts2Error(
                f"{point.arch.label()} was not timed part by part, which tables of parts need"
            )
    return [
        Harvest(point.arch, point.resolution, point.parts_ms or {}, forms=point.forms)
        for point in points
    ]


def _table(points: Sequence[Point]) -> tuple[Steps, Floats]:
    steps = Steps.of([ops(point.arch, point.resolution) for point in points])
    return steps, np.array([point.latency_ms for point in points])


def _fit(steps: Steps, truth: Floats, form: LatencyModel) -> LatencyModel:
    if len(truth) <= len(form.ms_per):
        raise Rts2Error(
            f"{len(form.ms_per) + 1} coefficients need at least as many timings, not {len(truth)}"
        )
    columns = np.stack([latencies_ms(unit, steps) for unit in _units(form)], 1)
    scale = (columns / truth[:, None]).max(0)
    idle = [name for name, most in zip(("start", *form.ms_per), scale, strict=True) if most == 0]
    if idle:
        raise Rts2Error(f"no timing exercises {idle[0]}; time networks that do")
    start, _ = nnls(columns / truth[:, None] / scale, np.ones(len(truth)))

    def misses(values: NDArray[np.float64]) -> Floats:
        predicted = latencies_ms(_with(form, values / scale), steps)
        return np.asarray(np.log(predicted / truth))

    bounded = np.maximum(start, 1e-3)
    found = least_squares(misses, bounded, bounds=(0, np.inf), xtol=1e-12, ftol=1e-12)
    return _with(form, found.x / scale)


def _with(form: LatencyModel, values: NDArray[np.float64]) -> LatencyModel:
    start, *rest = (float(value) for value in values)
    per = dict(zip(form.ms_per, rest, strict=True))
    return form.model_copy(update={"start_ms": start, "ms_per": per})


def _units(form: LatencyModel) -> list[LatencyModel]:
    """One model per coefficient, that coefficient 1 and the others 0, costs added up."""
    rows = np.eye(1 + len(form.ms_per))
    return [_with(form, row).model_copy(update={"combine": "sum"}) for row in rows]


def summary(residuals: Sequence[float]) -> dict[str, float]:
    """Mean and worst relative error of the frame rate, and the shares within 5% and 10%.

    All are fractions; a residual is ln(true / predicted latency).
    """
    errors = np.abs(np.exp(np.asarray(residuals)) - 1)
    return {
        "mape": float(errors.mean()),
        "max_ape": float(errors.max()),
        "within_5": float((errors <= 0.05).mean()),
        "within_10": float((errors <= 0.10).mean()),
    }


FORMS: dict[str, Form] = {
    # Eager PyTorch behind a slow processor: each kernel's launch adds to its work.
    "eager": LatencyModel(
        combine="sum",
        starts="kernels",
        start_ms=0,
        ms_per=dict.fromkeys(("gmac_2d", "gmac_2d_single", "gbyte", "mvoxel_warp"), 0.0),
    ),
    # A GPU that waits for launches: a step takes its launch or its work, whichever is longer. The
    # many small kernels of a volume follow each other faster than steps do. 3D convs compute at
    # the rate of 2D ones: no published point is slow enough in either to tell them apart.
    "launch_bound": LatencyModel(
        combine="max",
        starts="steps",
        folded=("norm", "relu"),
        start_ms=0,
        ms_per=dict.fromkeys(("gmac", "extra_kernel"), 0.0),
    ),
    # A runtime that tells what each node takes.
    "parts": PartModel(pixels=(1,), tables={}),
    # A fused graph on a CPU: norm and ReLU live inside the convs, channels come in blocks.
    "fused_cpu": LatencyModel(
        combine="sum",
        starts="steps",
        folded=("norm", "relu"),
        start_ms=0,
        ms_per=dict.fromkeys(("gmac_2d_blocked", "gmac_3d_blocked", "gbyte", "gbyte_resize"), 0.0),
    ),
}
"""The shapes that a fit fills with coefficients."""
