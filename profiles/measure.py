"""Teaching rts2 the machine at hand: timing networks, and the profile that comes of it."""

from __future__ import annotations

import random
import weakref
from collections.abc import Sequence
from functools import cached_property
from math import exp, hypot, log
from pathlib import Path
from shutil import rmtree
from statistics import median
from tempfile import mkdtemp
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, model_validator

from ..model.arch import UNTRAINED, Arch, Form, Precision
from ..model.errors import Rts2Error
from ..model.files import read_json, write_json
from ..model.machine import release_memory
from ..model.ops import ops
from .calibrate import FORMS, fit
from .heldout import hold_outs
from .here import this_machine
from .partfit import Harvest, Known, damping, fit_parts, left_out, missed
from .parts import PartModel, parts, per_part
from .plan import Candidate, Job, random_candidate
from .profile import (
    Calibration,
    Fact,
    Machine,
    Point,
    Profile,
    Resolution,
    Runtime,
)
from .several import FITTED, blank, precision_support, runtime_support, titled
from .timing import BUSY_ERROR, MAX_ERROR, QUIET, Reference, Timing, measure

if TYPE_CHECKING:
    from .runtimes import Session

REFERENCE: tuple[Arch, Resolution] = (Arch(c=4, stages=2), (640, 192))
"""What is timed in between, to see the machine drift."""

PROFILED_RUNS = 5
"""Runs whose nodes are timed, on top of those that time the whole network."""

MADE: dict[Runtime, tuple[Precision, ...]] = {"onnxruntime": ("int8",), "openvino": ("int8",)}
"""What a runtime does not make of a float network by itself, and runs where the graph has it."""

FIT_ERROR, FIT_PATIENCE = 0.02, 3.0
"""What a fit strives for, and for how long: another network tells more than one that is timed
better."""

ASKED, ASKED_SEED = 200, 7
"""Random networks of the space whose usual error is told, and which ones."""

WORTHLESS = 0.1
"""The standard error above which a timing tells a fit nothing."""

NEEDED, NEEDED_LIKE = 24, 12
"""Networks that tables can be made of: of the first precision, and of others that go like it."""


class Sample(BaseModel):
    """One timed network, with the reference beside it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    arch: Arch
    resolution: Resolution
    precision: Precision
    forms: tuple[Form, ...] | None = None
    latency_ms: Annotated[float, Field(gt=0)]
    reference_ms: Annotated[float, Field(gt=0)]
    ratio: Annotated[float, Field(gt=0)]
    """The latency over the reference's, run by run: drift cancels."""
    error: Annotated[float, Field(ge=0)]
    """The relative standard error of the ratio."""
    reliable: bool
    parts_ms: dict[str, Annotated[float, Field(ge=0)]]
    """What of the latency each part took."""

    @model_validator(mode="after")
    def _whole(self) -> Sample:
        if self.forms is not None and len(self.forms) != self.arch.stages:
            raise ValueError(f"forms must be one for each of {self.arch.stages} stages")
        found = parts(ops(self.arch, self.resolution), self.forms)
        missing = [part.name for part in found if part.name not in self.parts_ms]
        if missing:
            raise ValueError(f"parts_ms lacks {missing[0]}")
        return self

    @classmethod
    def of(cls, job: Job, timing: Timing, parts_ms: dict[str, float]) -> Sample:
        """What a journal keeps of one timing."""
        return cls(
            arch=job.arch,
            resolution=job.resolution,
            precision=job.precision,
            forms=job.forms,
            latency_ms=timing.median_ms,
            reference_ms=timing.reference_ms,
            ratio=timing.ratio,
            error=timing.error,
            reliable=timing.reliable,
            parts_ms=parts_ms,
        )


class Journal(BaseModel):
    """What was timed so far: an interrupted fit goes on from here."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    schema_: Literal["rts2.timings/4"] = Field(default="rts2.timings/4", alias="schema")
    machine: Machine
    runtime: Runtime
    seed: int
    samples: tuple[Sample, ...] = ()


class Bench:
    """Times networks of random weights in one runtime, the reference in between."""

    def __init__(self, runtime: Runtime, threads: int) -> None:
        from .runtimes import precisions

        self.runtime, self.threads = runtime, threads
        self.precisions: tuple[Precision, ...] = (*precisions(runtime), *MADE.get(runtime, ()))
        self._folder = Path(mkdtemp(prefix="rts2."))
        weakref.finalize(self, rmtree, self._folder, ignore_errors=True)
        self._last: tuple[Any, ...] | None = None

    @cached_property
    def _reference(self) -> Reference:
        from .runtimes import open_session

        path = self._exported(*REFERENCE, "reference", runtime="onnxruntime")
        session = open_session("onnxruntime", path, "fp32", self.threads)
        return Reference(session.run, settle_s=0.0)

    @property
    def own_ms(self) -> float:
        """What the reference takes while the machine is quiet, as far as it is known by now."""
        return self._reference.own_ms

    def time(self, job: Job) -> Timing:
        """One network as a whole, as carefully as can be."""
        return measure(self._opened(self._graph(job), job.precision).run, self._reference)

    def harvest(self, job: Job) -> Sample:
        """One network as a whole, and node by node."""
        session = self._opened(self._graph(job), job.precision)
        timing = measure(session.run, self._reference, FIT_ERROR, FIT_PATIENCE)
        nodes = session.node_times_ms(PROFILED_RUNS)
        parts_ms = per_part(nodes, job.arch, timing.median_ms, job.forms)
        return Sample.of(job, timing, parts_ms)

    def _graph(self, job: Job) -> Path:
        """The network's file; the one before is kept, for its other precisions."""
        known = job.arch, job.resolution, job.forms
        if self._last != known:
            self._exported(job.arch, job.resolution, "network", job.forms, runtime=self.runtime)
            self._last = known
            release_memory()
        path = self._folder / "network.onnx"
        return self._in_integers(path) if job.precision in MADE.get(self.runtime, ()) else path

    def _in_integers(self, path: Path) -> Path:
        """The network with its usual layers in integers; how long they take no range changes."""
        from ..model.graph import header_of, load_graph, save_graph
        from ..model.qdq import integers, nominal, usual

        model = load_graph(path)
        header = header_of(model, path).model_copy(update={"precision": "int8"})
        made = path.with_name("integers.onnx")
        save_graph(integers(model, usual(model), nominal(model)), header, made)
        return made

    def _exported(
        self,
        arch: Arch,
        resolution: Resolution,
        name: str,
        forms: tuple[Form, ...] | None = None,
        *,
        runtime: Runtime,
    ) -> Path:
        from ..model.checkpoint import build
        from ..model.export import export

        path = self._folder / f"{name}.onnx"
        export(build(arch), path, resolution, UNTRAINED, forms=forms, runtime=runtime)
        return path

    def _opened(self, path: Path, precision: Precision) -> Session:
        from .runtimes import open_session

        return open_session(self.runtime, path, precision, self.threads)


def journal_path(path: Path, runtime: Runtime) -> Path:
    """Where the timings of a profile at `path` stand, one file a runtime."""
    of = "" if runtime == FITTED[0] else f".{runtime}"
    return path.with_name(f"{path.stem}{of}.timings.json")


def open_journal(path: Path, runtime: Runtime, threads: int, seed: int) -> Journal:
    """What was timed before on this machine with this seed, or an empty journal.

    Raises `Rts2Error` where the journal is of another machine, version, runtime or seed.
    """
    from .runtimes import versions

    machine = this_machine(runtime, threads)
    told = machine.versions | versions("onnxruntime")  # the reference's
    fresh = Journal(
        machine=machine.model_copy(update={"versions": told}), runtime=runtime, seed=seed
    )
    if not path.exists():
        return fresh
    known = read_json(path, Journal, "a journal of timings")
    of_another_day = {"date": machine.date, "versions": told | known.machine.versions}
    same = known.machine.model_copy(update=of_another_day) == fresh.machine
    if not same or (known.seed, known.runtime) != (seed, runtime):
        raise Rts2Error(
            f"{path} holds timings of another machine, version, runtime or seed; "
            "delete it to start again, or choose another --out"
        )
    return known


def extend(journal: Journal, path: Path, sample: Sample) -> Journal:
    """One more sample, written down."""
    return _written(journal, path, (*journal.samples, sample))


def in_hindsight(journal: Journal, path: Path, since: int, own_ms: float) -> Journal:
    """The samples from `since` on, of one run, judged by what the reference turned out to take
    while the machine was quiet: the first ones knew of no faster reference than their own.
    """
    before, own = journal.samples[:since], journal.samples[since:]
    slow = [sample.reliable and sample.reference_ms > QUIET * own_ms for sample in own]
    judged = [_doubted(s) if busy else s for s, busy in zip(own, slow, strict=True)]
    return _written(journal, path, (*before, *judged)) if any(slow) else journal


def _doubted(sample: Sample) -> Sample:
    """A sample of a busy machine."""
    error = hypot(sample.error, BUSY_ERROR)
    return sample.model_copy(update={"reliable": error <= MAX_ERROR, "error": error})


def _written(journal: Journal, path: Path, samples: Sequence[Sample]) -> Journal:
    changed = journal.model_copy(update={"samples": tuple(samples)})
    write_json(path, changed.model_dump(mode="json", by_alias=True))
    return changed


def profile_of(
    journal: Journal, template: Profile, name: str, reference_ms: float | None = None
) -> Profile:
    """The profile of this machine in one runtime: the facts of `template`'s data sheets, the
    journal's timings, tables of parts. Where `template` has tables of the same runtime, of whatever
    machine, costs may grow like those: how a runtime fills its kernels is much the same everywhere.

    A timing is its ratio to the reference times `reference_ms`, or else what the reference usually
    took. Timings that are not reliable weigh less in the tables, and are neither points of the
    profile nor in its errors.

    Raises `Rts2Error` where too few are reliable.
    """
    known = [sample for sample in journal.samples if sample.reliable]
    if not known:
        raise _too_few(0, NEEDED)
    usual = median(sample.reference_ms for sample in known)
    speed = Speed(usual, reference_ms or usual)
    before, template = template, blank(template)
    machine, runtime = journal.machine, journal.runtime
    version = machine.versions.get(runtime, "not told")
    source = f"{titled(runtime)} on {machine.processor}, {machine.date}"
    facts = (
        Fact(name="processor", value=machine.processor, source="the operating system"),
        Fact(name="threads", value=str(machine.threads), source="rts2-profile"),
    )
    fitted: list[_Fitted] = []
    for precision in dict.fromkeys(sample.precision for sample in journal.samples):
        samples = [sample for sample in journal.samples if sample.precision == precision]
        first = fitted[0].model if fitted else None
        beside = Known(first, _tables(before, runtime, precision))
        fitted.append(_Fitted(samples, runtime, speed, source, beside))
    calibrations = tuple(known.calibration() for known in fitted)
    return template.model_copy(
        update={
            "name": name,
            "title": f"CPU ({machine.processor.split(',')[0]}, {machine.threads} threads)",
            "hardware": facts,
            "precisions": precision_support(template, calibrations),
            "runtimes": runtime_support(template, runtime, version),
            "calibrations": calibrations,
            "derivations": (),
            "points": tuple(point for known in fitted for point in known.points),
            "machine": machine.model_copy(update={"reference_ms": speed.told_ms}),
        }
    )


class Speed(NamedTuple):
    """What the reference takes, in ms: while the timings were taken, and in the profile."""

    usual_ms: float
    told_ms: float


class _Fitted:
    """What was timed in one precision: points, and tables of them.

    Tables of before are taken for a base where that predicts what was timed better. Raises
    `Rts2Error` where too few timings are reliable.
    """

    def __init__(
        self,
        samples: Sequence[Sample],
        runtime: Runtime,
        speed: Speed,
        source: str,
        known: Known,
    ) -> None:
        self._worthless = sum(sample.error > WORTHLESS for sample in samples)
        samples = [sample for sample in samples if sample.error <= WORTHLESS]
        self._reliable = [index for index, sample in enumerate(samples) if sample.reliable]
        needed = NEEDED_LIKE if known.like else NEEDED
        if len(self._reliable) < needed:
            raise _too_few(len(self._reliable), needed)
        self._source = source
        seen = [_harvest(sample, speed) for sample in samples]
        self._known = min(
            (known, known._replace(before=None)) if known.before else (known,),
            key=lambda each: missed(seen, self._reliable, each),
        )
        power = damping(seen, self._known)
        self._harvests = [_undrifted(harvest, power) for harvest in seen]
        self.model = fit_parts(self._harvests, self._known)
        self.points = tuple(
            _point(samples[index], self._harvests[index], runtime, source)
            for index in self._reliable
        )

    def calibration(self) -> Calibration:
        """Tables from everything, the errors of what is reliable."""
        busy = len(self._harvests) - len(self.points)
        told = f", {busy} more of a busy machine weigh less" if busy else ""
        told += f", {self._worthless} more were worth nothing" if self._worthless else ""
        first = self.points[0]
        told += ", in proportion to earlier tables" if self._known.before else ""
        errors = left_out(self._harvests, self._reliable, _asked(), self._known)
        return Calibration(
            runtime=first.runtime,
            precision=first.precision,
            model=self.model,
            residuals=tuple(map(float, errors)),
            source=f"times by node of {len(self.points)} whole networks{told}; {self._source}",
            held_out=hold_outs(self.points, lambda others: fit(others, FORMS["parts"])),
        )


def _tables(profile: Profile, runtime: Runtime, precision: Precision) -> PartModel | None:
    """What a profile already tells of the parts of networks in a runtime and precision."""
    for known in profile.calibrations:
        same = (known.runtime, known.precision) == (runtime, precision)
        if same and isinstance(known.model, PartModel):
            return known.model
    return None


def _asked() -> list[Candidate]:
    """What a search asks about, for the errors that it should expect."""
    chance = random.Random(ASKED_SEED)
    return [random_candidate(chance) for _ in range(ASKED)]


def _harvest(sample: Sample, speed: Speed) -> Harvest:
    scale = sample.ratio * speed.told_ms / sample.latency_ms
    parts_ms = {part: ms * scale for part, ms in sample.parts_ms.items()}
    drift = 0.0 if sample.reliable else log(sample.reference_ms / speed.usual_ms)
    return Harvest(sample.arch, sample.resolution, parts_ms, sample.error, drift, sample.forms)


def _undrifted(harvest: Harvest, power: float) -> Harvest:
    """What it would have taken beside a reference at its usual speed."""
    scale = exp(-power * harvest.drift)
    parts_ms = {part: ms * scale for part, ms in harvest.ms.items()}
    return harvest._replace(ms=parts_ms, drift=0.0)


def _point(sample: Sample, harvest: Harvest, runtime: Runtime, source: str) -> Point:
    return Point(
        arch=sample.arch,
        runtime=runtime,
        precision=sample.precision,
        resolution=sample.resolution,
        forms=sample.forms,
        fps=1000 / sum(harvest.ms.values()),
        evidence="measured",
        source=source,
        parts_ms={part: float(f"{ms:.6g}") for part, ms in harvest.ms.items()},
    )


def _too_few(count: int, needed: int) -> Rts2Error:
    return Rts2Error(
        f"{count} reliable timings are too few for tables of parts, which need {needed}; "
        "the same command with a longer --budget goes on from here"
    )
