"""One dimension at a time, against the search itself and against single predictions."""

from __future__ import annotations

from functools import cache
from typing import Any

import pytest

from rts2.model.arch import Arch
from rts2.profiles.latency import predict_ms
from rts2.profiles.profile import Profile, load
from rts2.search.exhaustive import Candidate, Question, look_up, search
from rts2.search.result import Found, Point
from rts2.search.sensitivity import Dimension, sensitivity
from rts2.search.sources import Measured, MeasuredRows, source
from rts2.search.space import Space

SPACE = Space(c=(1, 4, 8, 16), d_max=(8, 12), conv3d=((8, 16), (4, 8), (4,)))
PUBLISHED = source("published")


def question(profile: Profile | None = None, **asked: Any) -> Question:
    return Question(profile or load("tx2"), **{"target_fps": 10.0, **asked})


@cache
def found() -> Found:
    return search(question(), PUBLISHED, SPACE)


def pick() -> Point:
    assert found().selected is not None
    return found().selected


@cache
def around_the_pick() -> dict[str, Dimension]:
    known = sensitivity(question(), PUBLISHED, pick(), SPACE)
    return {dimension.name: dimension for dimension in known}


def points(dimension: Dimension) -> dict[str, Point]:
    return {each.value: each.point for each in dimension.variations}


def test_what_is_looked_up_is_what_the_search_found() -> None:
    wanted = [Candidate(p.arch, p.precision, p.runtime) for p in found().front]
    known = look_up(question(), PUBLISHED, wanted, SPACE)
    assert [known[candidate] for candidate in wanted] == list(found().front)


def test_what_lies_outside_is_missing() -> None:
    beyond = Candidate(Arch(c=5), "fp32", "pytorch")
    elsewhere = Candidate(Arch(c=8), "fp32", "openvino")
    assert look_up(question(), PUBLISHED, [beyond, elsewhere], SPACE) == {}


def test_every_dimension_has_every_value_of_the_space() -> None:
    """The pick has c = 8, two stages, all branches."""
    assert pick().arch == Arch(c=8, stages=2)
    values = {
        name: [each.value for each in dimension.variations]
        for name, dimension in around_the_pick().items()
    }
    assert values == {
        "c": ["1", "4", "8", "16"],
        "stages": ["1", "2", "3"],
        "branches": ["disparity", "disparity+semantic", "full"],
        "d_max": ["8", "12"],
        "3D width, stage 1": ["8", "16"],
        "3D width, stage 2": ["4", "8"],
        "precision and runtime": [
            "fp32 on PyTorch",
            "fp16 on PyTorch",
            "fp32 on TensorRT",
            "fp16 on TensorRT",
        ],
    }


def test_each_differs_in_its_dimension_alone() -> None:
    own = {
        "c": ("8", lambda p: p.arch.model_copy(update={"c": 8})),
        "d_max": ("12", lambda p: p.arch.model_copy(update={"d_max": 12})),
        "branches": (
            "full",
            lambda p: p.arch.model_copy(update={"semantic": True, "refinement": True}),
        ),
    }
    for name, (value, back) in own.items():
        dimension = around_the_pick()[name]
        assert dimension.own == value
        assert dimension.base == pick()
        for each in dimension.variations:
            assert back(each.point) == pick().arch
            assert (each.point.arch == pick().arch) == (each.value == value)


def test_a_further_stage_has_the_papers_width() -> None:
    """The published three-stage network of c = 8: 6.3 FPS, 3.33%."""
    more = points(around_the_pick()["stages"])["3"]
    assert more.arch == Arch(c=8)
    assert (more.fps, more.d1_all) == (6.3, 3.33)
    assert points(around_the_pick()["stages"])["1"].arch == Arch(c=8, stages=1)


def test_a_latency_is_that_of_the_network_alone() -> None:
    """No published network of eight planes bounds it."""
    model = load("tx2").calibrations[0].model
    eight = points(around_the_pick()["d_max"])["8"]
    assert eight.latency_ms == pytest.approx(predict_ms(model, eight.arch, (1242, 375)), rel=1e-9)
    assert eight.evidence.latency == "extrapolated"


def test_an_accuracy_that_was_carried_over_is_in_doubt_and_an_unknown_one_stays_unknown() -> None:
    widths = points(around_the_pick()["3D width, stage 1"])
    assert (widths["16"].d1_all, widths["16"].ranges) == (4.7, None)
    assert widths["8"].evidence.accuracy == "extrapolated"
    assert widths["8"].ranges is not None
    assert widths["8"].ranges.keys() == {"d1_all"}
    assert (widths["8"].epe, widths["8"].miou) == (None, None)
    assert widths["8"].fps > widths["16"].fps


def test_what_the_question_does_not_admit_is_told_too() -> None:
    """Without its semantic branch the pick is faster, and no answer to what was asked."""
    bare = points(around_the_pick()["branches"])["disparity"]
    assert bare.fps > pick().fps
    assert bare not in found().front


def test_other_runtimes_are_those_that_the_question_admits() -> None:
    only = sensitivity(question(precisions=("fp32",)), PUBLISHED, pick(), SPACE)
    assert [v.value for v in only[-1].variations] == ["fp32 on PyTorch", "fp32 on TensorRT"]


def test_measured_accuracies_are_known_of_the_named_alone() -> None:
    table = MeasuredRows.model_validate(
        {
            "schema": "rts2.accuracy/1",
            "rows": [{"arch": {"c": c}, "d1_all": d1} for c, d1 in ((8, 3.0), (4, 3.5))],
        }
    )
    known = search(question(target_fps=6.0), Measured(table), SPACE)
    assert known.selected is not None
    first, *_ = sensitivity(question(target_fps=6.0), Measured(table), known.selected, SPACE)
    assert {each.value: each.point.d1_all for each in first.variations} == {
        "1": None,
        "4": 3.5,
        "8": 3.0,
        "16": None,
    }


def test_several_runtimes_tell_their_own_speed(two_runtimes: Profile) -> None:
    asked = question(two_runtimes, target_fps=40.0)
    known = search(asked, PUBLISHED, SPACE)
    assert known.selected is not None
    executors = sensitivity(asked, PUBLISHED, known.selected, SPACE)[-1]
    assert len({round(each.point.fps, 6) for each in executors.variations}) == 3
    assert executors.base == known.selected
