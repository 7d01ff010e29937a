"""The space counted by hand, its sums against op lists, its boxes against a plain loop."""

from collections.abc import Callable
from itertools import product
from math import prod

import numpy as np
import pytest

from rts2.model.arch import Arch
from rts2.model.checkpoint import build, parameters
from rts2.model.ops import Op, ops
from rts2.profiles.evidence import BRANCHES, Box, boxes
from rts2.profiles.latency import latencies_ms, predict_ms
from rts2.profiles.profile import load
from rts2.search.exhaustive import Question, search
from rts2.search.sources import source
from rts2.search.space import Parts, Space

SMALL = Space(
    c=(1, 3, 8),
    stages=(1, 2, 3),
    d_max=(7, 12, 13),
    conv3d=((8, 16), (4, 6, 8), (2, 4, 12)),
)
RESOLUTION = (161, 90)
"""Not a multiple of 32 on either side."""


def every(space: Space, stages: int) -> list[tuple[int, ...]]:
    """The positions of a block, the last axis fastest."""
    return list(product(*(range(length) for length in space.shape(stages))))


def test_the_size_by_hand() -> None:
    """32 widths × 3 variants × 19 first volumes × (6 + 36 + 216) 3D widths."""
    assert Space().size() == 32 * 3 * 19 * (6 + 6**2 + 6**3) == 470_592
    executors = 4  # fp32 and fp16, each on PyTorch and TensorRT: INT8 is refused
    tx2 = Question(load("tx2"), target_fps=10, runtimes=(), precisions=())
    assert search(tx2, source("published")).space.size == executors * 470_592 == 1_882_368


def test_the_papers_networks_are_in_the_space() -> None:
    for profile in (load("tx2"), load("rtx2080ti")):
        assert all(Space().position(point.arch) is not None for point in profile.points)


@pytest.mark.parametrize("stages", [1, 2, 3])
def test_positions_and_archs_are_one_to_one(stages: int) -> None:
    positions = every(SMALL, stages)
    archs = [SMALL.arch(stages, position) for position in positions]
    assert len(set(archs)) == len(archs) == prod(SMALL.shape(stages))
    assert [SMALL.position(arch) for arch in archs] == positions


def test_positions_of_the_whole_space_return() -> None:
    space, random = Space(), np.random.default_rng(1)
    for stages in space.stages:
        for _ in range(50):
            position = tuple(int(random.integers(length)) for length in space.shape(stages))
            arch = space.arch(stages, position)
            assert (arch.family, arch.stages, arch.classes) == ("rts2net", stages, 19)
            assert space.position(arch) == position


@pytest.mark.parametrize(
    "arch",
    [
        Arch(c=33),
        Arch(d_max=25),
        Arch(d_max=5),
        Arch(conv3d=(16, 4, 5)),
        Arch(classes=11),
        Arch(family="anynet", c=8),
    ],
    ids=str,
)
def test_what_is_outside_has_no_position(arch: Arch) -> None:
    assert Space().position(arch) is None


def test_a_stage_count_that_is_not_searched_is_outside() -> None:
    assert Space(stages=(3,)).position(Arch(stages=1)) is None


def test_values_along_an_axis_broadcast_over_the_block() -> None:
    for stages in SMALL.stages:
        for axis, values in enumerate(SMALL.axes(stages)):
            along = np.broadcast_to(SMALL.along(stages, axis), SMALL.shape(stages))
            for position in every(SMALL, stages)[::11]:
                assert along[position] == values[position[axis]]


@pytest.mark.parametrize("stages", [1, 2, 3])
@pytest.mark.parametrize("quantity", ["macs", "weights", "launches"])
def test_sums_over_parts_are_sums_over_the_steps(stages: int, quantity: str) -> None:
    """Exact: they are integers far below 2⁵³."""
    count: Callable[[Op], int] = lambda op: getattr(op, quantity)  # noqa: E731
    parts = Parts.of(SMALL, RESOLUTION)
    totals = parts.totals(stages, parts.steps.summed(getattr(parts.steps, quantity)))
    assert totals.shape == SMALL.shape(stages)
    random = np.random.default_rng(stages)
    positions = every(SMALL, stages)
    for index in random.choice(len(positions), 40, replace=False):
        arch = SMALL.arch(stages, positions[index])
        assert totals[positions[index]] == sum(count(op) for op in ops(arch, RESOLUTION))


def test_sums_over_parts_at_random_places_of_the_whole_space() -> None:
    space, random = Space(), np.random.default_rng(2)
    parts = Parts.of(space, (1242, 375))
    macs, weights = (parts.steps.summed(q) for q in (parts.steps.macs, parts.steps.weights))
    for stages in space.stages:
        whole = parts.totals(stages, macs), parts.totals(stages, weights)
        seen = set()
        for level in (0, 1, 2) * 8:
            shape = space.shape(stages)[1:]
            position = (level, *(int(random.integers(length)) for length in shape))
            arch = space.arch(stages, position)
            steps = ops(arch, (1242, 375))
            assert whole[0][position] == sum(op.macs for op in steps)
            assert whole[1][position] == sum(op.weights for op in steps)
            seen.add(arch.branches)
        assert seen == set(BRANCHES)


def test_weights_of_the_block_are_those_of_a_built_network() -> None:
    parts = Parts.of(SMALL, RESOLUTION)
    weights = parts.totals(3, parts.steps.summed(parts.steps.weights))
    for position in ((0, 1, 0, 1, 2, 0), (1, 2, 2, 0, 0, 1), (2, 0, 1, 1, 1, 2)):
        assert weights[position] == parameters(build(SMALL.arch(3, position)))


@pytest.mark.parametrize("device", ["tx2", "rtx2080ti"])
def test_latencies_over_parts_are_single_predictions(device: str) -> None:
    profile = load(device)
    parts = Parts.of(SMALL, RESOLUTION)
    derived = profile.derivations[-1]
    model = profile.calibrations[0].model
    for form in (model, derived.scale(model)):
        for stages in SMALL.stages:
            totals = parts.totals(stages, latencies_ms(form, parts.steps))
            for position in every(SMALL, stages)[::23]:
                single = predict_ms(form, SMALL.arch(stages, position), RESOLUTION)
                assert totals[position] == pytest.approx(single, rel=1e-12)


@pytest.mark.parametrize("later", [((4, 6, 8), (4,)), ((4,), (2, 4, 12))])
def test_stages_may_have_different_numbers_of_widths(
    later: tuple[tuple[int, ...], tuple[int, ...]],
) -> None:
    space = Space(c=(2, 5), d_max=(12,), conv3d=((16,), *later))
    parts = Parts.of(space, (64, 32))
    for stages in space.stages:
        weights = parts.totals(stages, parts.steps.summed(parts.steps.weights))
        for position in every(space, stages):
            steps = ops(space.arch(stages, position), (64, 32))
            assert weights[position] == sum(op.weights for op in steps)


BOXES = {
    "at one point": [Arch(c=3)],
    "a range in each dimension": [
        Arch(c=2, d_max=8, conv3d=(8, 4, 4), semantic=False),
        Arch(c=9, d_max=12, conv3d=(16, 7, 4), refinement=False),
    ],
    "beside the space": [Arch(c=40, d_max=30, conv3d=(64, 64, 64))],
    "two stages": [Arch(c=1, stages=2), Arch(c=5, stages=2, conv3d=(9, 5))],
}


@pytest.mark.parametrize("name", BOXES)
def test_inside_is_what_the_box_holds(name: str) -> None:
    ((stages, box),) = boxes(BOXES[name]).items()
    inside = SMALL.inside(stages, box)
    assert inside.shape == SMALL.shape(stages)
    for position in every(SMALL, stages):
        assert inside[position] == box.holds(SMALL.arch(stages, position))


@pytest.mark.parametrize("name", BOXES)
def test_nearest_is_the_closest_value_in_the_box(name: str) -> None:
    """Where the box has a value of the axis; else the value closest to the box."""
    ((stages, box),) = boxes(BOXES[name]).items()
    ranges = (box.branches, box.c, box.d_max, *box.conv3d)
    nearest = SMALL.nearest(stages, box)
    for values, (low, high), positions in zip(SMALL.axes(stages), ranges, nearest, strict=True):
        for value, position in zip(values, positions, strict=True):
            held = [other for other in values if low <= other <= high]
            if held:
                assert values[position] in held
                assert abs(values[position] - value) == min(abs(v - value) for v in held)
            else:
                away = [max(low - v, v - high) for v in values]
                assert away[position] == min(away)


def test_a_value_outside_the_box_does_not_stand_for_one_inside() -> None:
    """9 to 13 holds 12 alone, although 8 is closer to 9."""
    box = Box(c=(1, 8), branches=(0, 2), d_max=(7, 13), conv3d=((9, 13),))
    space = Space(conv3d=((4, 8, 12, 16), (4,), (4,)))
    assert space.nearest(1, box)[3].tolist() == [2, 2, 2, 2]
