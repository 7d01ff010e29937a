"""Boxes of known networks, by hand and against a rule that knows no boxes."""

from itertools import product

import pytest

from rts2.model.arch import Arch
from rts2.profiles.evidence import BRANCHES, Box, boxes, part_boxes

VARIANTS = {
    "disparity": {"semantic": False, "refinement": False},
    "disparity+semantic": {"semantic": True, "refinement": False},
    "full": {"semantic": True, "refinement": True},
}


def arch(c: int, branches: str, d_max: int, *conv3d: int) -> Arch:
    stages = len(conv3d)
    return Arch(c=c, stages=stages, d_max=d_max, conv3d=conv3d, **VARIANTS[branches])


def test_the_variants_rise() -> None:
    assert tuple(VARIANTS) == BRANCHES
    assert [arch(1, name, 12, 16).branches for name in VARIANTS] == list(BRANCHES)


def test_boxes_by_hand() -> None:
    known = [
        arch(4, "disparity", 12, 16, 4),
        arch(2, "full", 10, 8, 4),
        arch(9, "disparity", 14, 8, 6),
        arch(3, "disparity+semantic", 12, 16),
    ]
    assert boxes(known) == {
        1: Box(c=(3, 3), branches=(1, 1), d_max=(12, 12), conv3d=((16, 16),)),
        2: Box(c=(2, 9), branches=(0, 2), d_max=(10, 14), conv3d=((8, 16), (4, 6))),
    }
    assert boxes([]) == {}


def test_boxes_of_parts_by_hand() -> None:
    """The one stage of the first network is a stage of the others too; its head is its own."""
    known = [
        arch(3, "disparity", 12, 16),
        arch(4, "disparity+semantic", 12, 8, 4),
        arch(9, "full", 14, 24, 6),
    ]
    assert part_boxes(known) == {
        1: Box(c=(3, 9), branches=(0, 0), d_max=(12, 14), conv3d=((8, 24),)),
        2: Box(c=(4, 9), branches=(1, 2), d_max=(12, 14), conv3d=((8, 24), (4, 6))),
    }
    whole = part_boxes([*known, arch(5, "full", 12, 16)])[1]
    assert whole == Box(c=(3, 9), branches=(0, 2), d_max=(12, 14), conv3d=((8, 24),))
    assert part_boxes([]) == {}


def test_a_box_holds_the_points_that_span_it_and_what_lies_between() -> None:
    known = [arch(2, "disparity", 10, 8), arch(8, "full", 12, 16)]
    (box,) = boxes(known).values()
    assert all(box.holds(one) for one in known)
    assert box.holds(arch(5, "disparity+semantic", 11, 12))
    for outside in (
        arch(1, "full", 11, 12),
        arch(9, "full", 11, 12),
        arch(5, "full", 9, 12),
        arch(5, "full", 13, 12),
        arch(5, "full", 11, 4),
        arch(5, "full", 11, 24),
    ):
        assert not box.holds(outside)


@pytest.mark.parametrize(
    "variant", [("disparity",), ("full",), ("disparity", "disparity+semantic")]
)
def test_unknown_variants_lie_outside(variant: tuple[str, ...]) -> None:
    (box,) = boxes([arch(4, name, 12, 16) for name in variant]).values()
    assert [name for name in BRANCHES if box.holds(arch(4, name, 12, 16))] == list(variant)


def test_holding_equals_having_points_on_both_sides() -> None:
    known = [arch(3, "disparity", 8, 4, 4), arch(5, "disparity+semantic", 7, 4, 6)]
    (box,) = boxes(known).values()

    def values(one: Arch) -> tuple[int, ...]:
        return (one.c, 1 * one.semantic + 1 * one.refinement, one.d_max, *one.conv3d)

    held = 0
    for c, name, d_max, w0, w1 in product(range(2, 7), BRANCHES, range(6, 10), (2, 4), (4, 5, 7)):
        one = arch(c, name, d_max, w0, w1)
        between = all(
            any(side <= value for side in column) and any(side >= value for side in column)
            for value, *column in zip(values(one), *map(values, known), strict=True)
        )
        assert box.holds(one) == between
        held += between
    assert held == 3 * 2 * 2 * 2
