"""What one dimension alone does: a candidate with each other value of it, all else as it is."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from ..model.arch import CONV3D, Arch
from ..profiles.evidence import BRANCHES
from .accuracy import AccuracySource
from .exhaustive import Candidate, Question, executors_of, look_up
from .lowered import Lowered
from .report import executor_of
from .result import Point
from .space import Space


@dataclass(frozen=True)
class Variation:
    """The candidate with one value of a dimension."""

    value: str
    point: Point
    """As the search predicts it: an accuracy that nobody knows is None."""


@dataclass(frozen=True)
class Dimension:
    """One dimension with everything else held."""

    name: str
    ordered: bool
    """Whether its values are numbers."""
    own: str
    """The candidate's own value."""
    variations: tuple[Variation, ...]
    """In the dimension's order, its own value among them."""

    @property
    def base(self) -> Point:
        """The candidate itself, as predicted."""
        return next(each.point for each in self.variations if each.value == self.own)


@dataclass(frozen=True)
class _Axis:
    name: str
    ordered: bool
    own: str
    candidates: dict[str, Candidate]


def sensitivity(
    question: Question,
    source: AccuracySource,
    point: Point,
    space: Space | None = None,
    lowered: Lowered | None = None,
) -> tuple[Dimension, ...]:
    """Every dimension of the space around `point`, a candidate of it.

    A stage that `point` lacks is added with the paper's 3D width. Candidates that the question
    does not admit are told too. The other arguments are those of `search`, which raises the same.
    """
    space = space or Space()
    axes = [*_of_arch(point, space), _of_executor(question, point)]
    wanted = [candidate for axis in axes for candidate in axis.candidates.values()]
    known = look_up(question, source, wanted, space, lowered)
    return tuple(
        Dimension(
            axis.name,
            axis.ordered,
            axis.own,
            tuple(Variation(v, known[c]) for v, c in axis.candidates.items() if c in known),
        )
        for axis in axes
    )


def _of_arch(point: Point, space: Space) -> Iterator[_Axis]:
    """The dimensions of a network."""
    arch = point.arch

    def axis(name: str, own: object, archs: dict[str, Arch], ordered: bool = True) -> _Axis:
        told = {v: Candidate(a, point.precision, point.runtime) for v, a in archs.items()}
        return _Axis(name, ordered, str(own), told)

    def changed(**update: object) -> Arch:
        return arch.model_copy(update=update)

    yield axis("c", arch.c, {str(c): changed(c=c) for c in space.c})
    yield axis("stages", arch.stages, {str(n): _staged(arch, n) for n in space.stages})
    levels = [changed(semantic=level > 0, refinement=level > 1) for level in range(len(BRANCHES))]
    yield axis("branches", arch.branches, {each.branches: each for each in levels}, ordered=False)
    yield axis("d_max", arch.d_max, {str(d): changed(d_max=d) for d in space.d_max})
    for at, own in enumerate(arch.conv3d):
        before, after = arch.conv3d[:at], arch.conv3d[at + 1 :]
        widths = {str(w): changed(conv3d=(*before, w, *after)) for w in space.conv3d[at]}
        yield axis(f"3D width, stage {at + 1}", own, widths)


def _of_executor(question: Question, point: Point) -> _Axis:
    """The precisions and runtimes that the question admits."""
    known = (Candidate(point.arch, e.precision, e.runtime) for e in executors_of(question))
    told = {executor_of(candidate): candidate for candidate in known}
    return _Axis("precision and runtime", False, executor_of(point), told)


def _staged(arch: Arch, stages: int) -> Arch:
    """`arch` with another number of stages."""
    widths = (arch.conv3d + CONV3D[arch.stages :])[:stages]
    return arch.model_copy(update={"stages": stages, "conv3d": widths})
