"""Teaching rts2 the machine at hand: which networks to time, timing them, and the profile of it."""

from __future__ import annotations

import random
import weakref
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from shutil import rmtree
from statistics import median
from tempfile import mkdtemp
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from ..model.arch import SPACE_C, SPACE_CONV3D, SPACE_D_MAX, UNTRAINED, Arch, Precision
from ..model.errors import Rts2Error
from ..model.files import read_json, write_json
from .calibrate import FORMS, calibrated
from .here import this_machine
from .parts import per_part
from .profile import (
    Calibration,
    Fact,
    Machine,
    Point,
    PrecisionSupport,
    Profile,
    Resolution,
    Runtime,
    RuntimeSupport,
)
from .timing import Timing, measure

if TYPE_CHECKING:
    from .runtimes import Session

RESOLUTIONS: tuple[Resolution, ...] = ((1242, 375), (640, 192))
"""KITTI's, and about a quarter of its pixels: between them a latency is interpolated."""

REFERENCE: tuple[Arch, Resolution] = (Arch(c=4, stages=2), (640, 192))
"""What is timed in between, to see the machine drift."""

VARIANTS = ((False, False), (True, False), (True, True))
"""The semantic branch and the refinement, in each variant."""

Candidate = tuple[Arch, Resolution]


PROFILED_RUNS = 4
"""Runs whose nodes are timed, on top of those that time the whole network."""

ATTEMPTS = 2
"""How often a fit times a network whose runs disagree: another network tells as much."""

NEEDED = 24
"""Networks of one precision that tables can be made of."""


class Sample(BaseModel):
    """One timed network, with the reference beside it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    arch: Arch
    resolution: Resolution
    precision: Precision
    latency_ms: Annotated[float, Field(gt=0)]
    reference_ms: Annotated[float, Field(gt=0)]
    ratio: Annotated[float, Field(gt=0)]
    """The latency over the reference's, run by run: drift cancels."""
    reliable: bool
    parts_ms: dict[str, Annotated[float, Field(ge=0)]]
    """What of the latency each part took."""


class Journal(BaseModel):
    """What was timed so far: an interrupted fit goes on from here."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    schema_: Literal["rts2.timings/2"] = Field(default="rts2.timings/2", alias="schema")
    machine: Machine
    runtime: Runtime
    seed: int
    samples: tuple[Sample, ...] = ()


@dataclass(frozen=True)
class Job:
    """One network to time."""

    arch: Arch
    resolution: Resolution
    precision: Precision


class Bench:
    """Times networks of random weights in one runtime, the reference in between."""

    def __init__(self, runtime: Runtime, threads: int) -> None:
        from .runtimes import open_session, precisions

        self.runtime, self.threads = runtime, threads
        self.precisions = precisions(runtime)
        self._folder = Path(mkdtemp(prefix="rts2."))
        weakref.finalize(self, rmtree, self._folder, ignore_errors=True)
        reference = self._exported(*REFERENCE, "reference")
        self._reference = open_session("onnxruntime", reference, "fp32", threads)
        self._last: tuple[Arch, Resolution] | None = None

    def time(self, job: Job) -> Timing:
        """One network, as a whole."""
        return measure(self._opened(self._graph(job), job.precision).run, self._reference.run)

    def harvest(self, job: Job) -> Sample:
        """One network as a whole, and node by node."""
        session = self._opened(self._graph(job), job.precision)
        timing = measure(session.run, self._reference.run, ATTEMPTS)
        nodes = session.node_times_ms(PROFILED_RUNS)
        return Sample(
            arch=job.arch,
            resolution=job.resolution,
            precision=job.precision,
            latency_ms=timing.median_ms,
            reference_ms=timing.reference_ms,
            ratio=timing.ratio,
            reliable=timing.reliable,
            parts_ms=per_part(nodes, job.arch, timing.median_ms),
        )

    def _graph(self, job: Job) -> Path:
        """The network's file; the one before is kept, for its other precisions."""
        if self._last != (job.arch, job.resolution):
            self._exported(job.arch, job.resolution, "network")
            self._last = (job.arch, job.resolution)
        return self._folder / "network.onnx"

    def _exported(self, arch: Arch, resolution: Resolution, name: str) -> Path:
        from ..model.checkpoint import build
        from ..model.export import export

        path = self._folder / f"{name}.onnx"
        export(build(arch), path, resolution, UNTRAINED)
        return path

    def _opened(self, path: Path, precision: Precision) -> Session:
        from .runtimes import open_session

        return open_session(self.runtime, path, precision, self.threads)


def random_candidate(chance: random.Random) -> Candidate:
    """A network and a resolution drawn from the whole space."""
    stages = chance.choice((1, 2, 3))
    variant = chance.choice(VARIANTS)
    c = chance.choice(SPACE_C)
    return _arch(lambda _, values: chance.choice(values), c, stages, variant), chance.choice(
        RESOLUTIONS
    )


class Deck:
    """Values in random order, each of them once before any comes again."""

    def __init__(self, chance: random.Random) -> None:
        self._chance = chance
        self._left: dict[str, list[int]] = {}

    def __call__(self, name: str, values: Sequence[int]) -> int:
        """The next of `values`, which `name` stands for."""
        left = self._left.setdefault(name, [])
        if not left:
            left += self._chance.sample(values, len(values))
        return left.pop()


def _arch(
    pick: Callable[[str, Sequence[int]], int], c: int, stages: int, variant: tuple[bool, bool]
) -> Arch:
    semantic, refinement = variant
    return Arch(
        c=c,
        stages=stages,
        d_max=pick("d_max", SPACE_D_MAX),
        conv3d=tuple(
            pick(f"width {stage}", values) for stage, values in enumerate(SPACE_CONV3D[:stages])
        ),
        semantic=semantic,
        refinement=refinement,
    )


def jobs(seed: int, precisions: tuple[Precision, ...]) -> Iterator[Job]:
    """What to time, the most telling first, without end.

    First every part at every c and both resolutions, within whole networks in random order; then
    rounds of networks of all stage counts and variants in which every c comes once more. Planes
    and widths go round in the same way, for each resolution.
    """
    chance = random.Random(seed)
    decks = {resolution: Deck(chance) for resolution in RESOLUTIONS}
    for arch, resolution in _first(chance, decks):
        yield from (Job(arch, resolution, precision) for precision in precisions)
    while True:
        for arch, resolution in _round(chance, decks):
            yield from (Job(arch, resolution, precision) for precision in precisions)


def _first(chance: random.Random, decks: dict[Resolution, Deck]) -> list[Candidate]:
    """Whole networks of every c, and the heads of all the others, in random order.

    The corners of the space are among the first: what lies between them is interpolated.
    """
    whole = [
        (_arch(decks[resolution], c, 3, (True, True)), resolution)
        for c, resolution in product(chance.sample(SPACE_C, len(SPACE_C)), RESOLUTIONS)
    ]
    heads = [
        (_arch(decks[resolution], chance.choice(SPACE_C), stages, variant), resolution)
        for stages, variant, resolution in product((1, 2, 3), VARIANTS[:2], RESOLUTIONS)
    ]
    ends = [known for known in whole if known[0].c in (SPACE_C[0], SPACE_C[-1])]
    return [*heads, *ends, *(known for known in whole if known not in ends)]


def _round(chance: random.Random, decks: dict[Resolution, Deck]) -> Iterator[Candidate]:
    for c in chance.sample(SPACE_C, len(SPACE_C)):
        resolution = chance.choice(RESOLUTIONS)
        stages, variant = chance.choice((1, 2, 3)), chance.choice(VARIANTS)
        yield _arch(decks[resolution], c, stages, variant), resolution


def open_journal(path: Path, runtime: Runtime, threads: int, seed: int) -> Journal:
    """What was timed before on this machine with this seed, or an empty journal.

    Raises `Rts2Error` where the journal is of another machine, version, runtime or seed.
    """
    fresh = Journal(machine=this_machine(runtime, threads), runtime=runtime, seed=seed)
    if not path.exists():
        return fresh
    known = read_json(path, Journal, "a journal of timings")
    same = known.machine.model_copy(update={"date": fresh.machine.date}) == fresh.machine
    if not same or (known.seed, known.runtime) != (seed, runtime):
        raise Rts2Error(
            f"{path} holds timings of another machine, version, runtime or seed; "
            "delete it to start again, or choose another --out"
        )
    return known


def extend(journal: Journal, path: Path, sample: Sample) -> Journal:
    """One more sample, written down."""
    longer = journal.model_copy(update={"samples": (*journal.samples, sample)})
    write_json(path, longer.model_dump(mode="json", by_alias=True))
    return longer


def profile_of(journal: Journal, template: Profile, name: str) -> Profile:
    """The profile of this machine: `template`'s facts, the journal's timings, tables of parts.

    A timing is its ratio to the reference times the reference's median over the whole session, so
    that a drift of the machine cancels. Timings that are not reliable are left out.

    Raises `Rts2Error` where too few are left.
    """
    if not journal.samples:
        raise _too_few(0)
    usual = median(sample.reference_ms for sample in journal.samples)
    machine = journal.machine
    title = titled(journal.runtime)
    source = f"{title} on {machine.processor}, {machine.date}"
    known = [sample for sample in journal.samples if sample.reliable]
    precisions = tuple(dict.fromkeys(sample.precision for sample in journal.samples))
    points = tuple(_point(sample, journal.runtime, usual, source) for sample in known)
    facts = (
        Fact(name="processor", value=machine.processor, source="the operating system"),
        Fact(name="threads", value=str(machine.threads), source="rts2-profile"),
    )
    return template.model_copy(
        update={
            "name": name,
            "title": f"CPU ({machine.processor.split(',')[0]}, {machine.threads} threads)",
            "hardware": facts,
            "precisions": _precisions(template, precisions, title),
            "runtimes": _runtimes(template, journal),
            "calibrations": tuple(
                _calibrated(
                    [point for point in points if point.precision == precision],
                    [sample for sample in journal.samples if sample.precision == precision],
                    source,
                )
                for precision in precisions
            ),
            "derivations": (),
            "points": points,
            "machine": machine.model_copy(update={"reference_ms": usual}),
        }
    )


def _precisions(
    template: Profile, timed: tuple[Precision, ...], title: str
) -> tuple[PrecisionSupport, ...]:
    """What the template says, but for the precisions that were timed."""
    told = tuple(
        PrecisionSupport(
            precision=precision, supported=True, reason=f"timed in {title}", source="rts2-profile"
        )
        for precision in timed
    )
    return told + tuple(known for known in template.precisions if known.precision not in timed)


def _runtimes(template: Profile, journal: Journal) -> tuple[RuntimeSupport, ...]:
    """The template's, and the one that was timed."""
    if journal.runtime in {known.runtime for known in template.runtimes}:
        return template.runtimes
    version = journal.machine.versions.get(journal.runtime, "not told")
    timed = RuntimeSupport(runtime=journal.runtime, version=version, source="rts2-profile")
    return (*template.runtimes, timed)


def _point(sample: Sample, runtime: Runtime, usual_ms: float, source: str) -> Point:
    latency = sample.ratio * usual_ms
    scale = latency / sample.latency_ms
    return Point(
        arch=sample.arch,
        runtime=runtime,
        precision=sample.precision,
        resolution=sample.resolution,
        fps=1000 / latency,
        evidence="measured",
        source=source,
        parts_ms={part: float(f"{ms * scale:.6g}") for part, ms in sample.parts_ms.items()},
    )


def _calibrated(points: Sequence[Point], timed: Sequence[Sample], source: str) -> Calibration:
    """Tables from the reliable ones of all that was timed in a precision."""
    if len(points) < NEEDED:
        raise _too_few(len(points))
    left_out = len(timed) - len(points)
    told = f", {left_out} more were unreliable" if left_out else ""
    told = f"times by node of {len(points)} whole networks{told}; {source}"
    return calibrated(points, FORMS["parts"], told)


def _too_few(count: int) -> Rts2Error:
    return Rts2Error(
        f"{count} reliable timings are too few for tables of parts, which need {NEEDED}; "
        "the same command with a longer --budget goes on from here"
    )


def titled(runtime: str) -> str:
    """A runtime's own name."""
    from .runtimes import RUNTIMES

    return RUNTIMES[runtime].title
