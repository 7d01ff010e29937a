"""Models as they are given, timed on this machine: what `rts2-profile measure` tells."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from ..model.arch import Precision
from ..model.box import in_box
from ..model.bundle import graph_of
from ..model.console import KITTI
from ..model.errors import UsageError
from ..model.files import existing_file
from . import measure as references
from . import timing
from .here import this_machine
from .profile import Machine
from .runtimes import Sized, open_session, precisions_of, usable

BOUNDARY: Final = "batch 1, the network alone: padded input in, full-resolution output out"

REFERENCE_TOLD: Final = "{}, timed before and after every run"

SPINNING_S: Final = 0.02
"""How long PyTorch's threads look out for more work, in the way of a reference of a few ms."""

GPU: Final = "cuda"
"""What the names of the runtimes hold that run on a GPU, where the reference must run too."""


@dataclass(frozen=True, eq=False)
class Given:
    """A model as a command takes it: a graph of one size, or a network at a resolution."""

    name: str
    model: Path | Sized
    resolution: tuple[int, int] | None
    """Width and height of the images; None where a graph does not say."""
    stages: int | None
    """How many run; None where a graph does not say."""


@dataclass(frozen=True)
class Row:
    """One model, timed."""

    name: str
    precision: Precision
    resolution: tuple[int, int] | None
    stages: int | None
    timing: timing.Timing
    runtime: str
    versions: dict[str, str]
    threads: int

    @property
    def size(self) -> str | None:
        """The resolution as a table shows it."""
        return None if self.resolution is None else "{}×{}".format(*self.resolution)

    def to_json(self) -> dict[str, Any]:
        """Everything that the timing depends on, and what it is."""
        return {
            "model": self.name,
            "runtime": self.runtime,
            "versions": self.versions,
            "precision": self.precision,
            "threads": self.threads,
            "resolution": self.resolution,
            "stages": self.stages,
            "runs": self.timing.runs,
            "latency_ms": self.timing.median_ms,
            "p95_ms": self.timing.p95_ms,
            "spread": self.timing.spread,
            "error": self.timing.error,
            "fps": 1000 / self.timing.median_ms,
            "reference_ms": self.timing.reference_ms,
            "ratio": self.timing.ratio,
            "reliable": self.timing.reliable,
        }


class Clock:
    """Times models in one runtime, a reference network in between.

    The reference runs in ONNX Runtime, so that the ratios of all runtimes compare; for a GPU it
    runs there, in PyTorch eager.
    """

    def __init__(self, runtime: str, threads: int) -> None:
        self.known = usable(runtime)
        self.runtime = runtime
        self.threads = threads
        self.beside = "pytorch-cuda" if GPU in runtime else "onnxruntime"

    @cached_property
    def machine(self) -> Machine:
        """What the machine at hand is, with the runtime's versions."""
        return this_machine(self.runtime, self.threads)

    @cached_property
    def reference(self) -> str:
        """The reference network, in words."""
        arch, (width, height) = references.REFERENCE
        return f"{arch.label()}, at {width}×{height}, in {usable(self.beside).title} fp32"

    def precision(self, subject: Given, asked: Precision | None) -> Precision:
        """What a model is timed in: what was asked for, or else what it is stored in."""
        return asked or precisions_of(self.runtime, subject.model)[0]

    def time(self, subject: Given, precision: Precision) -> Row:
        """One model; raises as `open_session` does."""
        session = open_session(self.runtime, subject.model, precision, self.threads)
        found = timing.measure(session.run, self._reference)
        return Row(
            subject.name,
            precision,
            subject.resolution,
            subject.stages,
            found,
            self.runtime,
            self.known.versions(),
            self.threads,
        )

    def told(self) -> str:
        """What the timings depend on, in words."""
        versions = self.known.versions()
        device = versions.pop("gpu", self.machine.processor.partition(",")[0])
        listed = ", ".join(f"{name} {version}" for name, version in versions.items())
        counted = "1 thread" if self.threads == 1 else f"{self.threads} threads"
        return f"{self.known.title} ({listed}), {counted}, {device}"

    @cached_property
    def _reference(self) -> timing.Reference:
        from ..model.checkpoint import build

        arch, resolution = references.REFERENCE
        sized = Sized(build(arch), resolution)
        session = open_session(self.beside, sized, "fp32", self.threads)
        settle_s = SPINNING_S if "pytorch" in self.runtime else 0.0
        return timing.Reference(session.run, settle_s)


def given(path: Path, resolution: tuple[int, int] | None, stages: int | None) -> Given:
    """The model that a user means, at a size and a number of stages where it leaves them open.

    Raises:
        UsageError: there is no such file, or a graph of another size or number of stages.
        Rts2Error: the file is broken.
    """
    file = existing_file(graph_of(path), "a model (a checkpoint, an ONNX file or a bundle)")
    name = path.stem if in_box(path) else str(path)
    if file.suffix.lower() == ".onnx":
        return _graph(name, file, resolution, stages)
    from ..model.checkpoint import load

    network, header = load(file)
    depth = network.arch.up_to(stages).stages
    size = resolution or KITTI
    return Given(name, Sized(network, size, depth, header.origin), size, depth)


def _graph(name: str, file: Path, resolution: tuple[int, int] | None, stages: int | None) -> Given:
    """A graph is of one size and one number of stages; what else is asked for is refused."""
    from ..model.graph import HEADER, header_of, load_graph

    model = load_graph(file)
    ours = any(entry.key == HEADER for entry in model.metadata_props)
    header = header_of(model, file) if ours else None
    own = None if header is None else header.resolution
    depth = None if header is None else header.stages
    if resolution not in (None, own):
        size = "of one size" if own is None else "made for {}x{}".format(*own)
        raise UsageError(
            f"{file} is a graph {size}; leave --resolution out, or give the checkpoint"
        )
    if stages not in (None, depth):
        runs = "its own number of" if depth is None else str(depth)
        raise UsageError(
            f"{file} always runs {runs} stages, not {stages}; "
            "leave --stages out, or give the checkpoint"
        )
    return Given(name, file, own, depth)
