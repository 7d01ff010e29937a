"""Which networks a kit times: the corners of the space, then those that tell the most."""

from __future__ import annotations

import random

import numpy as np

from ...model.arch import SPACE_C, SPACE_CONV3D, SPACE_D_MAX, Arch
from ...model.ops import ops
from ..latency import Floats, LatencyModel, Steps
from ..plan import RESOLUTIONS, VARIANTS, Candidate, random_candidate
from .fewshot import COMMON, NOISE, shares

NETWORKS = 12

POOL = 400
"""How many random networks the later ones are chosen from."""

SPREAD = 0.3
"""What each coefficient's logarithm is taken to stray from the prior, beside the common one."""

MISFIT = 0.1
"""What the model itself is taken to miss, alike for networks that are alike."""

REACH = 0.5
"""How far apart two networks are alike; the space is 1 wide in each dimension."""

Signs = tuple[int, int, int]

CORNERS: tuple[tuple[int, Signs], ...] = ((1, (0, 1, 1)), (2, (1, 0, 1)), (3, (1, 1, 0)))
"""For each stage count: which end of variant, d_max and 3D widths goes with the narrowest c. The
opposite corner takes the other ends, so that both together span the space of that stage count, and
no two dimensions rise together in all three."""


def networks(prior: LatencyModel, count: int = NETWORKS, seed: int = 0) -> list[Candidate]:
    """`count` networks, 6 at least, that tell the most about a device that `prior` describes.

    The six corners make every network of the space lie between timed ones. Each further network
    is the one of a random pool that leaves the latencies of the whole pool least uncertain, once
    the ones before are known: a Gaussian process over the prior's coefficients and the place in
    the space.
    """
    chance = random.Random(seed)
    chosen = corners()
    pool = [*chosen, *(random_candidate(chance) for _ in range(POOL))]
    covariance = _covariance(prior, pool)
    for index in range(len(chosen)):
        covariance = _told(covariance, index)
    while len(chosen) < count:
        gained = (covariance**2).sum(0) / (np.diag(covariance) + NOISE**2)
        best = int(np.argmax(gained))
        chosen.append(pool[best])
        covariance = _told(covariance, best)
    return chosen


def corners() -> list[Candidate]:
    """Two opposite corners of each stage count; the narrow one at the full resolution."""
    full, small = RESOLUTIONS
    found = []
    for stages, signs in CORNERS:
        found.append((_corner(stages, 0, signs), full if stages != 2 else small))
        opposite = (1 - signs[0], 1 - signs[1], 1 - signs[2])
        found.append((_corner(stages, 1, opposite), small if stages != 2 else full))
    return found


def _corner(stages: int, c: int, signs: Signs) -> Arch:
    variant, d_max, widths = signs
    semantic, refinement = VARIANTS[-variant]
    return Arch(
        c=SPACE_C[-c],
        stages=stages,
        d_max=SPACE_D_MAX[-d_max],
        conv3d=tuple(values[-widths] for values in SPACE_CONV3D[:stages]),
        semantic=semantic,
        refinement=refinement,
    )


def _covariance(prior: LatencyModel, pool: list[Candidate]) -> Floats:
    """Of the logarithms of the latencies: (pool, pool)."""
    steps = Steps.of([ops(arch, resolution) for arch, resolution in pool])
    parts = shares(prior, steps)
    places = np.array([_place(arch, resolution) for arch, resolution in pool])
    squares = ((places[:, None] - places[None]) ** 2).sum(-1)
    alike = np.exp(-squares / (2 * REACH**2))
    found: Floats = COMMON**2 + SPREAD**2 * parts @ parts.T + MISFIT**2 * alike
    return found


def _told(covariance: Floats, index: int) -> Floats:
    """The covariance once one more latency is known, up to the noise of its timing."""
    row = covariance[index]
    left: Floats = covariance - np.outer(row, row) / (row[index] + NOISE**2)
    return left


def _place(arch: Arch, resolution: tuple[int, int]) -> list[float]:
    """Where a network lies in the space: each dimension from 0 to 1, widths by logarithm."""
    widths = [
        _between(np.log(width), np.log(values[0]), np.log(values[-1]))
        for width, values in zip(arch.conv3d, SPACE_CONV3D, strict=False)
    ]
    return [
        _between(np.log(arch.c), 0, np.log(SPACE_C[-1])),
        (arch.stages - 1) / 2,
        VARIANTS.index((arch.semantic, arch.refinement)) / 2,
        _between(arch.d_max, SPACE_D_MAX[0], SPACE_D_MAX[-1]),
        float(np.mean(widths)),
        float(RESOLUTIONS.index(resolution)),
    ]


def _between(value: float, low: float, high: float) -> float:
    return float((value - low) / (high - low))
