"""Teaching rts2 the machine at hand: which networks to time, timing them, and the profile of it."""

from __future__ import annotations

import platform
import random
from collections.abc import Callable, Iterator
from datetime import date
from importlib.metadata import version
from itertools import product
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from ..model.arch import SPACE_C, SPACE_CONV3D, SPACE_D_MAX, UNTRAINED, Arch
from ..model.errors import Rts2Error
from ..model.files import read_json, write_json
from ..model.machine import processor
from .calibrate import FORMS, calibrated
from .profile import Fact, Machine, Point, Profile, Resolution
from .timing import Timing, measure

RESOLUTIONS: tuple[Resolution, ...] = ((1242, 375), (640, 192))
"""KITTI's, and about a quarter of its pixels: between them a latency is interpolated."""

REFERENCE: tuple[Arch, Resolution] = (Arch(c=4, stages=2), (640, 192))
"""What is timed in between, to see the machine drift."""

VARIANTS = ((False, False), (True, False), (True, True))
"""The semantic branch and the refinement, in each variant."""

Candidate = tuple[Arch, Resolution]


class Sample(BaseModel):
    """One timed network, with the reference beside it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    arch: Arch
    resolution: Resolution
    latency_ms: Annotated[float, Field(gt=0)]
    reference_ms: Annotated[float, Field(gt=0)]


class Journal(BaseModel):
    """What was timed so far: an interrupted fit goes on from here."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    schema_: Literal["rts2.timings/1"] = Field(default="rts2.timings/1", alias="schema")
    machine: Machine
    seed: int
    samples: tuple[Sample, ...] = ()


class Bench:
    """Times networks of random weights in ONNX Runtime, the reference in between."""

    def __init__(self, threads: int) -> None:
        self.threads = threads
        self._reference = self._runner(*REFERENCE)

    def time(self, arch: Arch, resolution: Resolution) -> Timing:
        """One network at one resolution."""
        return measure(self._runner(arch, resolution), self._reference)

    def time_file(self, path: Path) -> Timing:
        """An ONNX file."""
        from .runtimes.ort import Session

        return measure(Session(path, self.threads).run, self._reference)

    def _runner(self, arch: Arch, resolution: Resolution) -> Callable[[], None]:
        from ..model.checkpoint import build
        from ..model.export import export
        from .runtimes.ort import Session

        with TemporaryDirectory() as folder:
            path = Path(folder) / "network.onnx"
            export(build(arch), path, resolution, UNTRAINED)
            return Session(path, self.threads).run


def corners() -> list[Candidate]:
    """The extremes of the space, which every other network lies between."""
    ends = ((SPACE_D_MAX[0], 0, VARIANTS[0]), (SPACE_D_MAX[-1], -1, VARIANTS[-1]))
    return [
        (_arch(c, stages, d_max, [widths[end] for widths in SPACE_CONV3D[:stages]], variant), size)
        for size, stages, c, (d_max, end, variant) in product(
            RESOLUTIONS, (1, 2, 3), (SPACE_C[0], SPACE_C[-1]), ends
        )
    ]


def random_candidate(chance: random.Random) -> Candidate:
    """A network and a resolution drawn from the whole space."""
    stages = chance.choice((1, 2, 3))
    widths = [chance.choice(values) for values in SPACE_CONV3D[:stages]]
    arch = _arch(
        chance.choice(SPACE_C),
        stages,
        chance.choice(SPACE_D_MAX),
        widths,
        chance.choice(VARIANTS),
    )
    return arch, chance.choice(RESOLUTIONS)


def candidates(seed: int) -> Iterator[Candidate]:
    """The corners in random order, then random networks without end."""
    chance = random.Random(seed)
    yield from chance.sample(corners(), len(corners()))
    while True:
        yield random_candidate(chance)


def _arch(c: int, stages: int, d_max: int, widths: list[int], variant: tuple[bool, bool]) -> Arch:
    semantic, refinement = variant
    return Arch(
        c=c,
        stages=stages,
        d_max=d_max,
        conv3d=tuple(widths),
        semantic=semantic,
        refinement=refinement,
    )


def open_journal(path: Path, threads: int, seed: int) -> Journal:
    """What was timed before on this machine with this seed, or an empty journal.

    Raises `Rts2Error` where the journal is of another machine, version or seed.
    """
    fresh = Journal(machine=this_machine(threads), seed=seed)
    if not path.exists():
        return fresh
    known = read_json(path, Journal, "a journal of timings")
    same = known.machine.model_copy(update={"date": fresh.machine.date}) == fresh.machine
    if not same or known.seed != seed:
        raise Rts2Error(
            f"{path} holds timings of another machine, version or seed; "
            "delete it to start again, or choose another --out"
        )
    return known


def extend(journal: Journal, path: Path, bench: Bench, candidate: Candidate) -> Journal:
    """Times one more network and writes the journal down."""
    timing = bench.time(*candidate)
    arch, resolution = candidate
    sample = Sample(
        arch=arch,
        resolution=resolution,
        latency_ms=timing.median_ms,
        reference_ms=timing.reference_ms,
    )
    longer = journal.model_copy(update={"samples": (*journal.samples, sample)})
    write_json(path, longer.model_dump(mode="json", by_alias=True))
    return longer


def profile_of(journal: Journal, template: Profile, name: str) -> Profile:
    """The profile of this machine: `template`'s facts, the journal's timings, a fresh fit.

    Each timing is divided by its own reference and multiplied by the reference's median over
    the whole session, so that a drift of the machine cancels.
    """
    usual = median(sample.reference_ms for sample in journal.samples)
    machine = journal.machine
    source = f"ONNX Runtime on {machine.processor}, {machine.date}"
    points = tuple(
        Point(
            arch=sample.arch,
            runtime="onnxruntime",
            precision="fp32",
            resolution=sample.resolution,
            fps=1000 / (sample.latency_ms / sample.reference_ms * usual),
            evidence="measured",
            source=source,
        )
        for sample in journal.samples
    )
    facts = (
        Fact(name="processor", value=machine.processor, source="the operating system"),
        Fact(name="threads", value=str(machine.threads), source="rts2-profile"),
    )
    title = f"CPU ({machine.processor.split(',')[0]}, {machine.threads} threads)"
    told = f"least squares on ln(predicted / measured) over {len(points)} timings; {source}"
    return template.model_copy(
        update={
            "name": name,
            "title": title,
            "hardware": facts,
            "calibrations": (calibrated(points, FORMS["fused_cpu"], told),),
            "derivations": (),
            "points": points,
            "machine": machine.model_copy(update={"reference_ms": usual}),
        }
    )


def this_machine(threads: int) -> Machine:
    """What the machine at hand is, with versions and date."""
    from .runtimes import ort

    own = {"rts2": version("rts2"), "python": platform.python_version()}
    return Machine(
        processor=processor(),
        threads=threads,
        system=f"{platform.system()} {platform.machine()}",
        versions=own | ort.versions(),
        date=date.today().isoformat(),
    )
