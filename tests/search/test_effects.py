"""What 3D widths and planes do: sums of measured effects, in doubt where they are carried over."""

from math import exp, isnan, log

import numpy as np
import pytest
from pydantic import ValidationError

from rts2.model.arch import CONV3D, Arch
from rts2.profiles.evidence import BRANCHES
from rts2.profiles.profile import load
from rts2.search.effects import UNTRIED, Curve, EffectRows, Effects, measured_effects
from rts2.search.exhaustive import Question, search
from rts2.search.sources import source
from rts2.search.space import Space

SPACE = Space(c=(1, 8), d_max=(6, 12, 24), conv3d=((4, 16, 32), (4, 8), (4,)))


def effects(spread: float = 0.03, inherited: float = 0.04) -> Effects:
    """Of D1-all after one stage, with semantics alone."""
    row = {
        "stages": 1,
        "branches": "disparity+semantic",
        "metric": "d1_all",
        "d_max": {"values": [6, 12, 24], "effects": [0.2, 0.0, -0.1]},
        "conv3d": [{"values": [4, 16], "effects": [0.3, 0.0]}],
        "spread": spread,
    }
    table = {"schema": "rts2.effects/1", "protocol": "made up", "inherited": inherited}
    return Effects(EffectRows.model_validate({**table, "rows": [row]}))


def test_effects_add_up_and_end_where_nothing_was_measured() -> None:
    logs, doubts = effects().of(SPACE, 1, "d1_all")
    assert logs.shape == doubts.shape == (3, 1, 3, 3)
    level = BRANCHES.index("disparity+semantic")
    expected = [[0.5, 0.2, np.nan], [0.3, 0.0, np.nan], [0.2, -0.1, np.nan]]
    np.testing.assert_allclose(logs[level, 0], expected)
    assert doubts[level, 0, 0, 0] == pytest.approx(UNTRIED * 0.05)
    assert doubts[level, 0, 1, 1] == 0


def test_the_papers_own_widths_and_planes_are_certain_in_every_variant() -> None:
    for stages in (1, 2, 3):
        logs, doubts = effects().of(SPACE, stages, "miou")
        usual = (slice(None), 0, 1, *([1, 0, 0][:stages]))
        assert np.array_equal(logs[usual], np.zeros(3))
        assert np.isnan(logs).sum() == logs.size - 3
        assert not doubts.any()


def test_between_measured_values_an_effect_is_linear_in_their_logarithm() -> None:
    curve = Curve(values=(4, 16), effects=(0.4, 0.0))
    assert curve.at((4, 8, 16)) == pytest.approx([0.4, 0.2, 0.0])
    assert isnan(curve.at((2,))[0])


@pytest.mark.parametrize(
    ("values", "effects"), [((4, 16), (0.1,)), ((16, 4), (0.1, 0.0)), ((4, 4), (0.1, 0.0))]
)
def test_a_broken_curve_is_refused(values: tuple[int, ...], effects: tuple[float, ...]) -> None:
    with pytest.raises(ValidationError, match="values must rise"):
        Curve(values=values, effects=effects)


def test_a_row_has_a_curve_for_each_stage() -> None:
    row = effects().table.rows[0].model_dump()
    with pytest.raises(ValidationError, match="one curve for each of 2 stages"):
        EffectRows.model_validate(
            {
                "schema": "rts2.effects/1",
                "protocol": "",
                "inherited": 0,
                "rows": [{**row, "stages": 2}],
            }
        )


def test_published_accuracies_are_carried_over_as_extrapolations() -> None:
    """By the measured ratio, on top of the pixels that fewer planes lose."""
    space = Space()
    columns = source("published").columns(space, 3)
    (row,) = (
        row
        for row in measured_effects().table.rows
        if (row.stages, row.branches, row.metric) == (3, "full", "d1_all")
    )
    width = row.conv3d[0].values[0]
    narrow, usual = Arch(conv3d=(width, 4, 4)), Arch()
    at, base = space.position(narrow), space.position(usual)
    assert at is not None
    assert base is not None
    before, after = columns.metrics["d1_all"][base], columns.metrics["d1_all"][at]
    odds = (value / (100 - value) for value in (after, before))
    assert next(odds) / next(odds) == pytest.approx(exp(row.conv3d[0].effects[0]))
    assert columns.extrapolated[at]
    assert not columns.extrapolated[base]
    assert columns.doubt["d1_all"][at] > columns.doubt["d1_all"][base] == 0


def test_the_effects_of_the_box_are_those_of_the_whole_space() -> None:
    """Everything but the smallest and largest that nobody measured; narrower is never better."""
    table = measured_effects().table
    assert {(row.stages, row.branches) for row in table.rows if row.metric == "d1_all"} == {
        (stages, branches) for stages in (1, 2, 3) for branches in BRANCHES
    }
    for row in table.rows:
        assert dict(zip(row.d_max.values, row.d_max.effects, strict=True))[12] == 0
        for stage, curve in enumerate(row.conv3d):
            assert dict(zip(curve.values, curve.effects, strict=True))[CONV3D[stage]] == 0
    logs, _ = measured_effects().of(Space(), 3, "d1_all")
    assert not np.isnan(logs).any()


def test_points_that_were_carried_over_tell_an_interval_and_others_none() -> None:
    question = Question(load("tx2"), 10.0)
    found = search(question, source("published"))
    over = [point for point in found.front if point.ranges]
    assert over
    for point in found.front:
        usual = (point.arch.d_max, *point.arch.conv3d) == (12, *CONV3D[: point.arch.stages])
        assert bool(point.ranges) != usual
        assert not point.ranges or point.evidence.accuracy == "extrapolated"
    for point in over:
        assert point.ranges is not None
        for metric, (low, high) in point.ranges.items():
            value = point.metric(metric)
            assert value is not None
            assert low < value < high
            assert high < 100 or metric == "epe"
    wider = search(Question(load("tx2"), 10.0, confidence=0.8), source("published"))
    same = next(point for point in wider.front if point.arch == over[0].arch)
    assert over[0].ranges is not None
    assert same.ranges is not None
    widths = [log(each["d1_all"][1] / each["d1_all"][0]) for each in (over[0].ranges, same.ranges)]
    assert widths[0] > widths[1] > 0
    assert "ranges" not in found.front[[p.ranges for p in found.front].index(None)].model_dump()
