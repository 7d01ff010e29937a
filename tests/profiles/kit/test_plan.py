"""Which networks a kit times."""

import random
from itertools import product

import numpy as np
import pytest

from rts2.model.arch import SPACE_C, SPACE_CONV3D, SPACE_D_MAX
from rts2.model.ops import ops
from rts2.profiles.evidence import BRANCHES, boxes
from rts2.profiles.kit.fewshot import shares
from rts2.profiles.kit.plan import corners, networks
from rts2.profiles.kit.prior import prior
from rts2.profiles.latency import LatencyModel, Steps
from rts2.profiles.plan import RESOLUTIONS, Candidate, random_candidate
from rts2.profiles.profile import load


@pytest.fixture(scope="module")
def known() -> LatencyModel:
    return prior(load("tx2"), "tensorrt", "fp32").model


def test_the_corners_span_the_space_of_every_stage_count() -> None:
    """So that every network of the space is interpolated once a kit was timed."""
    found = boxes(arch for arch, _ in corners())
    assert sorted(found) == [1, 2, 3]
    for stages, box in found.items():
        assert box.c == (SPACE_C[0], SPACE_C[-1])
        assert box.branches == (0, len(BRANCHES) - 1)
        assert box.d_max == (SPACE_D_MAX[0], SPACE_D_MAX[-1])
        assert box.conv3d == tuple((w[0], w[-1]) for w in SPACE_CONV3D[:stages])


def test_no_two_dimensions_rise_together_in_all_corners() -> None:
    rising = [
        (arch.c, BRANCHES.index(arch.branches), arch.d_max, arch.conv3d[0]) for arch, _ in corners()
    ]
    for one, other in product(range(4), range(4)):
        if one != other:
            signs = {
                (a[one] > b[one]) == (a[other] > b[other])
                for a, b in zip(rising[::2], rising[1::2], strict=True)
            }
            assert signs == {True, False}


def test_a_dozen_distinct_networks_of_all_kinds(known: LatencyModel) -> None:
    found = networks(known)
    assert len(found) == len(set(found)) == 12
    assert found[:6] == corners()
    assert found == networks(known)
    assert {arch.stages for arch, _ in found} == {1, 2, 3}
    assert {arch.branches for arch, _ in found} == set(BRANCHES)
    assert {resolution for _, resolution in found} == set(RESOLUTIONS)
    assert len({arch.c for arch, _ in found}) >= 5


def drawn(seed: int) -> list[Candidate]:
    chance = random.Random(seed)
    return [random_candidate(chance) for _ in range(12)]


def information(known: LatencyModel, chosen: list[Candidate]) -> float:
    """About the coefficients, as the logarithm of a determinant."""
    parts = shares(known, Steps.of([ops(*candidate) for candidate in chosen]))
    return float(np.linalg.slogdet(parts.T @ parts / 0.03**2 + np.eye(parts.shape[1]))[1])


def test_the_coefficients_are_told_apart_better_than_by_random_networks(
    known: LatencyModel,
) -> None:
    others = [information(known, drawn(seed)) for seed in range(20)]
    assert information(known, networks(known)) > np.median(others)
