"""The accuracy budget, and which layers go back to float for it."""

import numpy as np
import pytest

from rts2.model.errors import UsageError
from rts2.model.metrics import Score, disparity_score
from rts2.model.qdq import Flow
from rts2.quant.budget import Budget, dearer, drops, first_within
from rts2.quant.parity import Measured
from rts2.quant.selection import Cost

TRUTH = np.full((10, 10), 50.0, np.float32)


def scored(wrong: int, miou: float | None = None) -> Score:
    """A score of `wrong` pixels in a hundred whose disparity is off by 10 px."""
    estimate = TRUTH.copy()
    estimate.reshape(-1)[:wrong] += 10
    found = disparity_score(estimate, TRUTH)
    if miou is None:
        return found
    labels = np.zeros((19, 19), np.int64)
    right = round(miou)
    labels[0, 0], labels[0, 1] = right, 100 - right  # class 1 is never right: IoU 0
    return Score(found.everything, labels=labels)


def measured(before: tuple[int, float | None], after: tuple[int, float | None]) -> Measured:
    return Measured(scored(*before), scored(*after), 30.0)


def test_d1_may_rise_and_miou_may_fall_by_so_much() -> None:
    budget = Budget(max_d1_drop=1.0, max_miou_drop=2.0)
    assert drops(measured((10, 80), (11, 76))) == (pytest.approx(1), pytest.approx(2))
    assert budget.holds(measured((10, None), (11, None)))
    assert not budget.holds(measured((10, None), (12, None)))
    assert budget.holds(measured((10, 80), (11, 76)))
    assert not budget.holds(measured((10, 80), (11, 75)))
    assert budget.holds(measured((12, 70), (3, 90)))  # better is never too much


def test_nothing_to_judge_by() -> None:
    nothing = Measured(Score(), Score(), 30.0)
    with pytest.raises(UsageError, match="what judges needs a disparity truth, and has none"):
        Budget(1, 1).holds(nothing)


def test_ever_fewer_layers_the_worst_per_millisecond_first() -> None:
    costs = [Cost(name, 2.0, 1.0) for name in "abcd"]
    errors = {"a": 8.0, "b": 2.0, "c": 0.5, "d": 0.0}
    found = list(dearer(costs, [], 0.0, errors, frozenset("abcd")))
    assert found == [frozenset("bcd"), frozenset("cd"), frozenset("d")]


def test_only_what_is_chosen_can_be_restored() -> None:
    costs = [Cost(name, 2.0, 1.0) for name in "abc"]
    flows = [Flow("a", "b", 1), Flow("b", "c", 1)]
    found = list(dearer(costs, flows, 0.0, {"a": 9.0, "b": 1.0, "c": 9.0}, frozenset("ab")))
    assert found[0] == frozenset("b")
    assert all(choice < frozenset("ab") for choice in found)


def test_the_first_choice_within_the_budget_is_taken() -> None:
    wrong = {frozenset("abc"): 20, frozenset("ab"): 12, frozenset("a"): 10}
    judged: list[frozenset[str]] = []

    def judge(choice: frozenset[str]) -> Measured:
        judged.append(choice)
        return measured((10, None), (wrong[choice], None))

    chosen, found, within = first_within(Budget(2.0, 0.5), list(wrong), judge)
    assert (chosen, within, found.other.d1_all) == (frozenset("ab"), True, 12)
    assert judged == [frozenset("abc"), frozenset("ab")]
    chosen, _, within = first_within(Budget(0.0, 0.5), list(wrong)[:2], judge)
    assert (chosen, within) == (frozenset("ab"), False)
