"""The value that names a network: what it fills in, what it refuses, how it travels."""

from typing import Any

import pytest
from pydantic import ValidationError

from rts2.model.arch import Arch, arch_from
from rts2.model.errors import UsageError


def test_the_default_is_the_papers_c8() -> None:
    arch = Arch()
    assert (arch.c, arch.stages, arch.d_max, arch.conv3d) == (8, 3, 12, (16, 4, 4))
    assert (arch.branches, arch.classes, arch.multiple) == ("full", 19, 32)
    assert arch == Arch(c=8)


@pytest.mark.parametrize(
    ("values", "conv3d", "branches"),
    [
        ({"stages": 1}, (16,), "full"),
        ({"stages": 2}, (16, 4), "full"),
        ({"refinement": False}, (16, 4, 4), "disparity+semantic"),
        ({"semantic": False}, (16, 4, 4), "disparity"),
        ({"family": "anynet", "stages": 2}, (16, 4), "disparity"),
        ({"stages": 2, "conv3d": [3, 5]}, (3, 5), "full"),
    ],
)
def test_what_is_not_said_follows_from_what_is(
    values: dict[str, Any], conv3d: tuple[int, ...], branches: str
) -> None:
    arch = Arch.model_validate(values)
    assert (arch.conv3d, arch.branches) == (conv3d, branches)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"c": 0}, "c: Input should be greater than or equal to 1 (given: 0)"),
        ({"c": 65}, "c: Input should be less than or equal to 64 (given: 65)"),
        ({"c": "x"}, "c: Input should be a valid integer"),
        ({"c": 1.5}, "c: Input should be a valid integer"),
        ({"stages": 4}, "stages: Input should be less than or equal to 3 (given: 4)"),
        ({"d_max": 1}, "d_max: Input should be greater than or equal to 2 (given: 1)"),
        ({"conv3d": [16, 4]}, "conv3d needs one width per stage, 3 in all"),
        ({"conv3d": [16, 4, 0]}, "conv3d.2: Input should be greater than or equal to 1"),
        ({"semantic": False, "refinement": True}, "refinement needs the semantic branch"),
        ({"family": "anynet", "semantic": True}, "the anynet family has no semantic branch"),
        ({"family": "psmnet"}, "family: Input should be 'rts2net' or 'anynet'"),
        ({"classes": 1}, "classes: Input should be greater than or equal to 2 (given: 1)"),
        ({"width": 3}, "width: Extra inputs are not permitted (given: 3)"),
        ({"c": 0, "d_max": 0}, "and 1 more faults"),
    ],
)
def test_a_wrong_one_is_refused_in_one_line(values: dict[str, Any], said: str) -> None:
    with pytest.raises(UsageError) as raised:
        arch_from(values)
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)


def test_it_is_frozen_and_hashable() -> None:
    arch = Arch(c=4)
    assert {arch: "a"}[Arch(c=4)] == "a"
    assert len({arch, Arch(c=4), Arch(c=8)}) == 2
    with pytest.raises(ValidationError):
        arch.c = 8  # type: ignore[misc]


@pytest.mark.parametrize(
    "arch",
    [
        *(Arch(c=c) for c in (1, 4, 8, 16, 32)),
        Arch(stages=2, conv3d=(3, 7), semantic=False),
        Arch(family="anynet", c=1, stages=1, d_max=48),
    ],
    ids=Arch.label,
)
def test_it_comes_back_from_json(arch: Arch) -> None:
    assert Arch.model_validate_json(arch.model_dump_json()) == arch


def test_planes_and_multiple() -> None:
    arch = Arch(d_max=24)
    assert [arch.planes(stage) for stage in range(3)] == [24, 5, 5]
    assert Arch(family="anynet").multiple == 16


def test_up_to_cuts_the_stages_and_their_widths() -> None:
    arch = Arch(conv3d=(7, 5, 3))
    assert arch.up_to(2) == Arch(stages=2, conv3d=(7, 5))
    assert arch.up_to(None) is arch
    assert arch.up_to(3) == arch


@pytest.mark.parametrize("stages", [-1, 0, 3])
def test_up_to_names_what_there_is(stages: int) -> None:
    with pytest.raises(UsageError, match=f"must be 1 to 2 for this network, not {stages}$"):
        Arch(stages=2).up_to(stages)


@pytest.mark.parametrize(
    "part",
    [
        Arch(),
        Arch(stages=1),
        Arch(refinement=False),
        Arch(semantic=False),
        Arch(semantic=False, classes=5),
        Arch(stages=2, semantic=False),
    ],
    ids=Arch.label,
)
def test_parts_are_missing_from_nothing(part: Arch) -> None:
    assert part.missing_from(Arch()) == []


@pytest.mark.parametrize(
    ("wanted", "held", "missing"),
    [
        (Arch(c=4), Arch(), ["c is 8, 4 was asked for"]),
        (Arch(d_max=6), Arch(), ["d_max is 12, 6 was asked for"]),
        (Arch(classes=5), Arch(), ["classes is 19, 5 was asked for"]),
        (Arch(), Arch(stages=2), ["stages is 2, 3 was asked for"]),
        (Arch(stages=2, conv3d=(16, 8)), Arch(), ["conv3d is [16, 4, 4], [16, 8] was asked for"]),
        (Arch(refinement=False), Arch(semantic=False), ["it has no semantic branch"]),
        (
            Arch(),
            Arch(semantic=False),
            ["it has no semantic branch", "it has no refinement branch"],
        ),
        (
            Arch(c=1, semantic=False),
            Arch(family="anynet"),
            ["family is anynet, rts2net was asked for", "c is 8, 1 was asked for"],
        ),
    ],
)
def test_every_difference_is_named(wanted: Arch, held: Arch, missing: list[str]) -> None:
    assert wanted.missing_from(held) == missing


def test_labels() -> None:
    assert Arch(c=1, stages=1).label() == "c=1, 1 stage, full"
    assert Arch(semantic=False).label() == "c=8, 3 stages, disparity"
    assert Arch(family="anynet", c=1, stages=2).label() == "AnyNet c=1, 2 stages"
