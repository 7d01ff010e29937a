"""The front against a quadratic definition, the pick and its ties by hand."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rts2.model.arch import Arch
from rts2.profiles.evidence import Evidence
from rts2.search.accuracy import Metric
from rts2.search.front import fastest, loss, nondominated, pick, unbeaten
from rts2.search.result import Point, PointEvidence


def by_definition(rows: NDArray[np.float64]) -> list[bool]:
    """A row stays unless another is nowhere worse and somewhere better, or equal and earlier."""

    def beaten(at: int) -> bool:
        return any(
            (other <= rows[at]).all() and ((other < rows[at]).any() or index < at)
            for index, other in enumerate(rows)
            if index != at
        )

    return [not beaten(at) for at in range(len(rows))]


@pytest.mark.parametrize("columns", [2, 3, 4])
@pytest.mark.parametrize("seed", range(5))
def test_the_front_is_the_definition_on_random_rows_with_ties(columns: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    coarse = random.integers(0, 6, (120, columns)).astype(float)
    fine = random.random((120, columns))
    flagged = np.column_stack([fine[:, :-1], random.integers(0, 2, 120)])
    for rows in (coarse, fine, flagged):
        kept = nondominated(rows)
        assert kept.tolist() == by_definition(rows)
        assert kept.any()


@settings(deadline=None, database=None, derandomize=True)
@given(
    st.lists(
        st.tuples(st.integers(-3, 3), st.integers(-3, 3), st.booleans(), st.booleans()), max_size=25
    )
)
def test_the_front_is_the_definition_on_small_numbers(rows: list[tuple[int, ...]]) -> None:
    table = np.array(rows, dtype=np.float64).reshape(len(rows), 4)
    assert nondominated(table).tolist() == by_definition(table)


def test_a_front_by_hand() -> None:
    rows = np.array([[1, 5], [2, 3], [2, 3], [3, 3], [2, 4], [4, 1], [0, 9.0]])
    assert nondominated(rows).tolist() == [True, True, False, False, False, True, True]


def test_of_equal_rows_the_first_stays() -> None:
    assert nondominated(np.zeros((4, 3))).tolist() == [True, False, False, False]


def test_nothing_has_no_front() -> None:
    assert nondominated(np.zeros((0, 3))).tolist() == []


def test_columns_of_a_larger_table_are_read_right() -> None:
    """A view whose rows do not lie together in memory."""
    wide = np.random.default_rng(0).random((60, 8))[:, ::2]
    assert nondominated(wide).tolist() == by_definition(wide)


def point(
    fps: float,
    d1_all: float | None = 4.0,
    latency: Evidence = "interpolated",
    accuracy: Evidence = "interpolated",
    **others: Any,
) -> Point:
    """A point whose interval is a tenth of its frame rate to both sides."""
    values: dict[str, Any] = {
        "arch": Arch(),
        "precision": "fp32",
        "runtime": "pytorch",
        "latency_ms": 1000 / fps,
        "fps": fps,
        "fps_low": 0.9 * fps,
        "fps_high": 1.1 * fps,
        "d1_all": d1_all,
        "epe": None,
        "miou": None,
        "pacc": None,
        "params": 1,
        "size_bytes": 4,
        "macs": 1,
        "evidence": PointEvidence(latency=latency, accuracy=accuracy),
    }
    return Point(**{**values, **others})


def test_the_pick_is_the_most_accurate_that_meets_the_target() -> None:
    front = [point(30, 8.0), point(20, 5.0), point(10, 3.0)]
    for target, expected in ((5, 10), (10, 10), (10.01, 20), (20, 20), (25, 30), (30, 30)):
        picked = pick(front, target, "d1_all", at_lower_bound=False)
        assert picked is not None
        assert picked.fps == expected
    assert pick(front, 30.01, "d1_all", at_lower_bound=False) is None
    assert pick([], 1, "d1_all", at_lower_bound=False) is None


def test_at_the_lower_bound_the_interval_must_meet_the_target() -> None:
    """The ends are 27, 18 and 9."""
    front = [point(30, 8.0), point(20, 5.0), point(10, 3.0)]
    for target, expected in ((9, 10), (9.01, 20), (18, 20), (18.01, 30)):
        picked = pick(front, target, "d1_all", at_lower_bound=True)
        assert picked is not None
        assert picked.fps == expected
    assert pick(front, 28, "d1_all", at_lower_bound=True) is None


def test_the_faster_one_of_equals_is_picked_wherever_it_stands() -> None:
    slow, fast, worse = point(11, 4.0), point(12, 4.0), point(40, 4.1)
    for front in ([slow, fast, worse], [worse, fast, slow], [fast, worse, slow]):
        assert pick(front, 10, "d1_all", at_lower_bound=False) == fast


@pytest.mark.parametrize(
    ("metric", "better", "worse"),
    [("d1_all", 3.0, 4.0), ("epe", 0.8, 0.9), ("miou", 70.0, 60.0), ("pacc", 90.0, 80.0)],
)
def test_every_metric_has_its_direction(metric: Metric, better: float, worse: float) -> None:
    good, bad = point(10, **{metric: better}), point(20, **{metric: worse})
    assert loss(good, metric) < loss(bad, metric)
    assert pick([bad, good], 5, metric, at_lower_bound=False) == good


def test_an_unknown_accuracy_is_never_preferred() -> None:
    unknown, known = point(30, None), point(10, 99.0)
    assert loss(unknown, "d1_all") == loss(unknown, "miou") == float("inf")
    assert pick([unknown, known], 5, "d1_all", at_lower_bound=False) == known


def test_the_fastest_rests_on_proven_numbers_where_there_are_any() -> None:
    slow, fast = point(10, latency="published"), point(20, accuracy="published")
    promised, guessed = point(40, latency="extrapolated"), point(30, accuracy="extrapolated")
    assert fastest([slow, promised, fast, guessed]) == fast
    assert fastest([guessed, promised]) == promised
    assert fastest([]) is None


@pytest.mark.parametrize(
    ("latency", "accuracy", "proven"),
    [
        ("published", "measured", True),
        ("interpolated", "interpolated", True),
        ("extrapolated", "published", False),
        ("measured", "extrapolated", False),
        ("extrapolated", "extrapolated", False),
    ],
)
def test_proven_is_neither_number_extrapolated(
    latency: Evidence, accuracy: Evidence, proven: bool
) -> None:
    assert point(10, latency=latency, accuracy=accuracy).proven is proven


@pytest.mark.parametrize("count", [0, 5, 2000])
def test_what_no_other_beats_is_the_same_in_two_steps(count: int) -> None:
    """Rounded, so that many are equal; the first of equals stays."""
    chance = np.random.default_rng(count)
    for _ in range(20):
        objectives = np.round(chance.random((count, 2)), 2)
        doubtful = chance.random((count, 2)) < 0.5
        expected = nondominated(np.column_stack([objectives, doubtful]))
        assert np.array_equal(unbeaten(objectives, doubtful), expected)
