"""A machine that is made up: what every part of a network takes on it is known exactly."""

from collections.abc import Iterable
from itertools import islice, product
from math import ceil, prod

import numpy as np
import pytest

from rts2.model.arch import Arch, Precision
from rts2.model.ops import ops, padded
from rts2.profiles.here import this_machine
from rts2.profiles.measure import Bench, Journal, Sample, profile_of
from rts2.profiles.parts import AXES, PartModel, PartTable, axis_values, parts
from rts2.profiles.plan import RESOLUTIONS, Job, jobs
from rts2.profiles.profile import Profile, Runtime, load
from rts2.profiles.timing import Timing

REFERENCE_MS = 10.0

FACTORS: dict[Precision, float] = {"fp32": 1.0, "bf16": 0.6, "fp16": 0.55}
"""What a network takes in each precision, over what it takes in the first."""


def cost_ms(part: str, place: tuple[int, ...], pixels: int) -> float:
    """Linear in pixels and along every axis; but of c alone a staircase of sixteen channels."""
    first, *rest = place
    grown = ceil(first / 16) if AXES[part] == ("c",) else first / 16
    planes = rest[0] if rest else 1
    if part.startswith("banded."):  # faster up to seven planes
        return (0.6 + planes / 20) * cost_ms(part.replace("banded", "regularize"), place, pixels)
    return (1 + list(AXES).index(part)) * pixels / 1e6 * (0.2 + grown) * (1 + 0.1 * planes)


def _truth() -> PartModel:
    sizes = sorted(prod(padded(resolution, Arch().multiple)) for resolution in RESOLUTIONS)
    tables = {
        part: PartTable(
            axes=axis_values(part),
            ms=tuple(
                tuple(cost_ms(part, place, size) for place in product(*axis_values(part)))
                for size in sizes
            ),
        )
        for part in AXES
    }
    return PartModel(pixels=tuple(sizes), tables=tables)


TRUTH = _truth()


class Planted(Bench):
    """In the place of a bench: takes what `TRUTH` says, times `factor`, on a day when everything,
    the reference too, takes `drift` times as long. Its runs spread by `spread`; while it is `busy`
    the reference never runs at its own speed.
    """

    truth = TRUTH

    def __init__(self, runtime: Runtime = "onnxruntime", threads: int = 2) -> None:
        self.runtime, self.threads = runtime, threads
        self.precisions: tuple[Precision, ...] = ("fp32",)
        self.factor = self.drift = 1.0
        self.spread = 0.0
        self.busy = False
        self.timed: list[Job] = []

    def latency_ms(self, job: Job) -> float:
        whole = TRUTH.total_ms(parts(ops(job.arch, job.resolution), job.forms))
        return self.factor * FACTORS[job.precision] * whole

    def time(self, job: Job) -> Timing:
        self.timed.append(job)
        latency, reference = self.drift * self.latency_ms(job), self.drift * REFERENCE_MS
        times = latency * np.linspace(1 - self.spread, 1 + self.spread, 11)
        own = reference / (2 if self.busy else 1)
        return Timing(tuple(map(float, times)), (reference,) * 12, own)

    @property
    def own_ms(self) -> float:
        """Nothing faster turns out than the latest timing's reference."""
        return self.drift * REFERENCE_MS

    def harvest(self, job: Job) -> Sample:
        timing = self.time(job)
        found = parts(ops(job.arch, job.resolution), job.forms)
        scale = timing.median_ms / TRUTH.total_ms(found)
        parts_ms = {part.name: scale * TRUTH.cost_ms(part) for part in found}
        return Sample.of(job, timing, parts_ms)

    def journal(self, count: int, drifts: Iterable[float] = (), seed: int = 0) -> Journal:
        """The first `count` networks of a fit; sample k at `drifts[k]` where there is one."""
        slow = [*drifts, *[1.0] * count]
        samples = []
        for job, drift in zip(islice(jobs(seed, self.precisions), count), slow, strict=False):
            self.drift = drift
            samples.append(self.harvest(job))
        machine = this_machine("onnxruntime", self.threads)
        return Journal(machine=machine, runtime=self.runtime, seed=seed, samples=tuple(samples))


@pytest.fixture(scope="session")
def planted() -> type[Planted]:
    """The made-up machine; `planted()` is one on a steady day."""
    return Planted


@pytest.fixture(scope="session")
def exact(planted: type[Planted]) -> Profile:
    """A profile whose model is the made-up machine, its 24 residuals ±1%, ±2%, … ±12%."""
    known = profile_of(planted().journal(24), load("cpu"), "made-up")
    (calibration,) = known.calibrations
    told = {
        "model": TRUTH,
        "residuals": tuple(sign * k / 100 for k in range(1, 13) for sign in (-1, 1)),
    }
    return known.model_copy(update={"calibrations": (calibration.model_copy(update=told),)})
