"""The front timed on the device: predictions give way, and a pick that misses is demoted."""

from dataclasses import replace

import numpy as np
import pytest

from rts2.model.arch import Arch
from rts2.model.errors import UsageError
from rts2.model.metrics import Errors, Score
from rts2.profiles.profile import Profile, load
from rts2.profiles.timing import Timing
from rts2.search.exhaustive import Question, search
from rts2.search.plot import draw
from rts2.search.report import _cost
from rts2.search.result import Found, Point, PointEvidence
from rts2.search.sources import Measured, MeasuredRows
from rts2.search.tried import Tried
from rts2.search.verify import verified

from .standin import standin_row

SLOWER = 1.5


def asked(profile: Profile) -> tuple[Question, Found]:
    """A front of which the pick just meets its target, by prediction."""
    rows = tuple(standin_row(Arch(c=c)) for c in (2, 4, 8, 16))
    table = Measured(MeasuredRows(schema="rts2.accuracy/1", rows=rows))
    first = search(Question(profile, 1.0), table)
    target = sorted(point.fps for point in first.front)[1] / 1.01
    question = Question(profile, target)
    return question, search(question, table)


def taking(factor: float, point: Point, score: Score | None = None) -> Tried:
    """A quiet machine on which the reference takes 10 ms, and the point `factor` its prediction."""
    return Tried(Timing((factor * point.latency_ms,) * 20, (10.0,) * 21, 10.0), score)


def test_a_pick_that_misses_its_target_is_demoted(by_parts: Profile) -> None:
    question, found = asked(by_parts)
    told = verified(found, question, lambda point: taking(SLOWER, point))
    assert found.selected is not None
    assert told.verified is not None
    assert told.verified.timed == len(found.front) == len(told.front)
    assert told.verified.demoted is not None
    assert told.verified.demoted.arch == found.selected.arch
    assert told.verified.demoted.fps == pytest.approx(found.selected.fps / SLOWER)
    assert told.selected is not None
    assert told.selected.fps >= question.target_fps
    assert told.selected.arch.c < found.selected.arch.c
    assert {point.evidence.latency for point in told.front} == {"measured"}
    labels = [label for label, _ in _cost(told)]
    assert labels == ["verified", "demoted"]
    legend = draw(told, "a CPU").axes[0].get_legend()
    assert legend is not None
    assert any("demoted, misses" in text.get_text() for text in legend.get_texts())


def test_what_holds_stays_the_pick_and_what_cannot_be_timed_keeps_its_prediction(
    by_parts: Profile,
) -> None:
    question, found = asked(by_parts)
    assert found.selected is not None
    pick = found.selected
    told = verified(found, question, lambda point: taking(1.0, point) if point == pick else None)
    assert told.verified is not None
    assert (told.verified.timed, told.verified.demoted) == (1, None)
    assert told.verified.predicted == len(found.front) - 1
    assert told.selected is not None
    assert told.selected.arch == pick.arch
    assert told.selected.evidence.latency == "measured"
    others = [point for point in told.front if point.arch != pick.arch]
    assert all(point in found.front for point in others)


def test_a_busy_machine_tells_nothing_of_a_latency(by_parts: Profile) -> None:
    """The reference never runs at its own speed: predictions stay, and are counted."""
    question, found = asked(by_parts)
    worse = Score(everything=Errors(pixels=1000, outliers=180, total_px=2500.0))

    def busy(point: Point) -> Tried:
        quiet = taking(SLOWER, point, worse)
        return replace(quiet, timing=replace(quiet.timing, own_ms=5.0))

    told = verified(found, question, busy)
    assert told.verified is not None
    assert (told.verified.timed, told.verified.unreliable) == (0, len(found.front))
    assert told.verified.demoted is None
    assert told.selected is not None
    assert found.selected is not None
    (same,) = (point for point in found.front if point.arch == told.selected.arch)
    assert told.selected.fps == same.fps
    assert told.selected.d1_all == 18.0
    assert "while it was busy" in dict(_cost(told))["verified"]


def test_the_lower_bound_must_hold_where_the_question_asks_for_it(by_parts: Profile) -> None:
    """Timed as fast as promised, but not surely so: the pick is demoted, as a search would."""
    question, found = asked(by_parts)
    strict = replace(question, at_lower_bound=True)
    assert found.selected is not None

    def unsure(point: Point) -> Tried:
        quiet = taking(1.0, point)
        spread = np.linspace(0.95, 1.05, 20) * point.latency_ms
        return replace(quiet, timing=replace(quiet.timing, times_ms=tuple(spread)))

    told = verified(found, strict, unsure)
    assert told.verified is not None
    assert told.verified.demoted is not None
    assert told.verified.demoted.fps_low < question.target_fps <= told.verified.demoted.fps
    assert told.selected is not None
    assert told.selected.fps_low >= question.target_fps
    assert verified(found, question, unsure).verified == told.verified.model_copy(
        update={"demoted": None}
    )


def never(point: Point) -> Tried:
    raise AssertionError(f"{point.arch.label()} is tried elsewhere than on the device")


def test_what_a_precision_says_is_judged_anew(by_parts: Profile) -> None:
    question, found = asked(by_parts)
    worse = Score(everything=Errors(pixels=1000, outliers=180, total_px=2500.0))
    told = verified(found, question, lambda point: taking(1.0, point, worse))
    assert told.selected is not None
    assert (told.selected.d1_all, told.selected.epe, told.selected.miou) == (18.0, 2.5, None)
    assert told.selected.evidence == PointEvidence(latency="measured", accuracy="measured")


def test_only_the_device_itself_verifies(by_parts: Profile) -> None:
    question, found = asked(by_parts)
    with pytest.raises(UsageError, match="Jetson TX2 is not this machine"):
        verified(found, replace(question, profile=load("tx2")), never)
    assert by_parts.machine is not None
    other = by_parts.machine.model_copy(update={"processor": "another"})
    elsewhere = by_parts.model_copy(update={"machine": other})
    with pytest.raises(UsageError, match="the profile is of another; this is"):
        verified(found, replace(question, profile=elsewhere), never)


def test_every_point_is_one_of_the_same_question_again(by_parts: Profile) -> None:
    """What was written is read again, with what was timed."""
    question, found = asked(by_parts)
    told = verified(found, question, lambda point: taking(SLOWER, point))
    assert Found.model_validate(told.model_dump(mode="json", by_alias=True)) == told
    assert "verified" not in found.model_dump()
