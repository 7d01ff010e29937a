"""A profile by parts of a machine that is made up, as a fit on the machine at hand writes it."""

from itertools import product
from math import exp, prod

import pytest

from rts2.model.arch import SPACE_C, SPACE_CONV3D, SPACE_D_MAX, Arch
from rts2.model.machine import cores
from rts2.model.ops import padded
from rts2.profiles.here import this_machine
from rts2.profiles.latency import predict_ms
from rts2.profiles.parts import AXES, PartModel, PartTable, axis_values
from rts2.profiles.profile import Calibration, Point, Profile

RESOLUTIONS = ((640, 192), (1242, 375))
BEST = Arch(c=32)
"""The most accurate of the published networks, which no front is without."""


def _model() -> PartModel:
    """Every further value of the first axis adds a step of another height."""
    sizes = [prod(padded(resolution, Arch().multiple)) for resolution in RESOLUTIONS]
    tables = {}
    for weight, part in enumerate(AXES, 1):
        axes = axis_values(part)
        row = [weight * (1 + at[0] + at[0] // 16) * (9 + at[-1]) / 9 for at in product(*axes)]
        tables[part] = PartTable(
            axes=axes, ms=tuple(tuple(ms * size / 2e8 for ms in row) for size in sizes)
        )
    return PartModel(pixels=tuple(sizes), tables=tables)


def _scaled(model: PartModel, small: float, large: float) -> PartModel:
    """Places of fewer than nine channels take `small` times as long, all others `large`."""
    tables = {}
    for part, table in model.tables.items():
        factors = [small if at[0] < 9 else large for at in product(*axis_values(part))]
        rows = (tuple(f * ms for f, ms in zip(factors, row, strict=True)) for row in table.ms)
        tables[part] = PartTable(axes=table.axes, ms=tuple(rows))
    return PartModel(pixels=model.pixels, tables=tables)


def _ends() -> list[Arch]:
    """Of every stage count the networks that span the space."""
    return [
        Arch(
            c=SPACE_C[end],
            stages=stages,
            d_max=SPACE_D_MAX[end],
            conv3d=tuple(values[end] for values in SPACE_CONV3D[:stages]),
            semantic=full,
            refinement=full,
        )
        for stages, end, full in product((1, 2, 3), (0, -1), (False, True))
    ]


@pytest.fixture(scope="session")
def by_parts(ort_alone: Profile) -> Profile:
    """Timed 1% to 26% faster or slower than its tables say, the `BEST` 5% faster."""
    model = _model()
    timed = [*product(_ends(), RESOLUTIONS), *((BEST, size) for size in RESOLUTIONS)]
    residuals = [(-1) ** k * k / 100 for k in range(1, len(timed) - 1)] + [-0.05, -0.05]
    points = [
        Point(
            arch=arch,
            runtime="onnxruntime",
            precision="fp32",
            resolution=resolution,
            fps=1000 / (predict_ms(model, arch, resolution) * exp(residual)),
            evidence="measured",
            source="made up",
        )
        for (arch, resolution), residual in zip(timed, residuals, strict=True)
    ]
    known = ort_alone.model_copy(
        update={
            "name": "made-up",
            "calibrations": (
                Calibration(
                    runtime="onnxruntime",
                    precision="fp32",
                    model=model,
                    residuals=tuple(residuals),
                    source="made up",
                ),
            ),
            "points": tuple(points),
            "machine": this_machine("onnxruntime", cores()),
        }
    )
    return Profile.model_validate(known.model_dump(by_alias=True))


@pytest.fixture(scope="session")
def two_runtimes(by_parts: Profile) -> Profile:
    """ONNX Runtime is faster for small networks, OpenVINO for large ones, and in bf16 for all."""
    (first,) = by_parts.calibrations
    calibrations, points = [first], list(by_parts.points)
    for precision, small, large in (("fp32", 2.0, 0.5), ("bf16", 0.9, 0.3)):
        model = _scaled(first.model, small, large)
        told = {"runtime": "openvino", "precision": precision}
        calibrations.append(first.model_copy(update=told | {"model": model}))
        for point, residual in zip(by_parts.points, first.residuals, strict=True):
            latency_ms = predict_ms(model, point.arch, point.resolution) * exp(residual)
            points.append(point.model_copy(update=told | {"fps": 1000 / latency_ms}))
    support = by_parts.precisions[0].model_copy(update={"precision": "bf16"})
    runtime = by_parts.runtimes[0].model_copy(update={"runtime": "openvino", "version": "2026.3"})
    both = by_parts.model_copy(
        update={
            "calibrations": tuple(calibrations),
            "points": tuple(points),
            "precisions": (*by_parts.precisions, support),
            "runtimes": (*by_parts.runtimes, runtime),
        }
    )
    return Profile.model_validate(both.model_dump(by_alias=True))
