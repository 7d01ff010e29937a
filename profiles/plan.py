"""Which networks to time, so that the fewest tell the most."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, cycle, product, repeat
from typing import Any, TypeVar, get_args

from ..model.arch import SPACE_C, SPACE_CONV3D, SPACE_D_MAX, Arch, Form, Precision
from .profile import Resolution

RESOLUTIONS: tuple[Resolution, ...] = ((1242, 375), (640, 192))
"""KITTI's, and about a quarter of its pixels: between them a latency is interpolated."""

CORNERS = 4
"""Whole networks at both ends of c, at both resolutions."""

HEADS = 12
"""Heads of shallower networks and other variants than the whole one, at both resolutions."""

VARIANTS = ((False, False), (True, False), (True, True))
"""The semantic branch and the refinement, in each variant."""

Candidate = tuple[Arch, Resolution]
"""A network, and the width and height of its images."""


@dataclass(frozen=True)
class Job:
    """One network to time."""

    arch: Arch
    resolution: Resolution
    precision: Precision
    forms: tuple[Form, ...] | None = None
    """Of the 3D convs, one a stage; all are 3d without them."""


def random_candidate(chance: random.Random) -> Candidate:
    """A network and a resolution drawn from the whole space."""
    stages = chance.choice((1, 2, 3))
    variant = chance.choice(VARIANTS)
    c = chance.choice(SPACE_C)
    return _arch(lambda _, values: chance.choice(values), c, stages, variant), chance.choice(
        RESOLUTIONS
    )


Value = TypeVar("Value")


class Deck:
    """Values in random order, each of them once before any comes again."""

    def __init__(self, chance: random.Random) -> None:
        self._chance = chance
        self._left: dict[str, list[Any]] = {}

    def __call__(self, name: str, values: Sequence[Value]) -> Value:
        """The next of `values`, which `name` stands for."""
        left: list[Value] = self._left.setdefault(name, [])
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

    First every c at both resolutions, and every head; then rounds of networks of all stage counts
    and variants in which every c comes once more. Planes and widths go round in the same way, for
    each resolution; each width of the 3D convs takes its forms in turn. The first precision is
    timed throughout, the others after the heads in every other pair of networks: they go much like
    the first.
    """
    chance = random.Random(seed)
    decks = {resolution: Deck(chance) for resolution in RESOLUTIONS}
    form = Deck(chance)
    rounds = (_round(chance, decks) for _ in repeat(None))
    chosen = chain(_first(chance, decks), chain.from_iterable(rounds))
    for count, (arch, resolution) in enumerate(chosen):
        forms = tuple(
            form(f"{stage} {width}", get_args(Form)) for stage, width in enumerate(arch.conv3d)
        )
        both = count < CORNERS + HEADS or count // 2 % 2 == 0
        timed = precisions if both else precisions[:1]
        yield from (Job(arch, resolution, precision, forms) for precision in timed)


def _first(chance: random.Random, decks: dict[Resolution, Deck]) -> list[Candidate]:
    """Every c twice: as a whole network at one resolution, and at the other one as a network of
    each stage count and variant in turn, whose heads no whole network has.

    The corners of the space are the first, and all heads follow: what lies between is interpolated.
    """
    ends = SPACE_C[0], SPACE_C[-1]
    between = [c for c in chance.sample(SPACE_C, len(SPACE_C)) if c not in ends]
    corners = list(product(ends, RESOLUTIONS))
    whole = [(c, RESOLUTIONS[at % 2]) for at, c in enumerate(between)]
    heads = cycle(product((1, 2, 3), VARIANTS[:2], RESOLUTIONS[::-1]))
    shallow = [
        (_arch(decks[resolution], c, stages, variant), resolution)
        for c, (stages, variant, resolution) in zip(between, heads, strict=False)
    ]
    told = [
        (_arch(decks[resolution], c, 3, (True, True)), resolution)
        for c, resolution in corners + whole
    ]
    return [*told[:CORNERS], *shallow[:HEADS], *told[CORNERS:], *shallow[HEADS:]]


def _round(chance: random.Random, decks: dict[Resolution, Deck]) -> Iterator[Candidate]:
    for c in chance.sample(SPACE_C, len(SPACE_C)):
        resolution = chance.choice(RESOLUTIONS)
        stages, variant = chance.choice((1, 2, 3)), chance.choice(VARIANTS)
        yield _arch(decks[resolution], c, stages, variant), resolution
