"""The stopwatch, held against a clock that the test turns."""

from collections.abc import Callable

import numpy as np
import pytest

from rts2.profiles import timing
from rts2.profiles.timing import (
    BUSY_ERROR,
    MAX_ERROR,
    MIN_QUIET,
    MIN_RUNS,
    MIN_SECONDS,
    OWN_RUNS,
    OWN_SECONDS,
    QUIET,
    WARM_UP_S,
    Reference,
    Timing,
    measure,
)


class Clock:
    """Seconds pass only when a network runs. `calls` says which ran, in order."""

    def __init__(self) -> None:
        self.now = 0.0
        self.calls: list[str] = []

    def __call__(self) -> float:
        return self.now

    def network(self, name: str, seconds: Callable[[int], float]) -> Callable[[], None]:
        """A network whose n-th run, warm-up included, takes `seconds(n)`."""

        def run() -> None:
            self.now += seconds(self.calls.count(name))
            self.calls.append(name)

        return run

    def reference(
        self, seconds: Callable[[int], float], settle_s: float | None = None
    ) -> Reference:
        """A reference like `network`, named r."""
        return Reference(self.network("r", seconds), settle_s)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    known = Clock()
    monkeypatch.setattr(timing, "perf_counter", known)
    return known


def test_a_slow_network_runs_the_least_number_of_times(clock: Clock) -> None:
    """Half a second each: two runs warm it up, and the ten that count take five seconds."""
    found = measure(clock.network("a", lambda _: 0.5), clock.reference(lambda _: 0.25))
    assert (found.median_ms, found.p95_ms, found.reference_ms) == (500.0, 500.0, 250.0)
    assert found.runs == MIN_RUNS
    assert found.ratios == (2.0,) * MIN_RUNS
    assert (found.ratio, found.spread, found.error, found.reliable) == (2.0, 0.0, 0.0, True)
    own = int(OWN_SECONDS / 0.25)
    assert clock.calls == ["a", "a", *["r"] * (2 + own), "r", *["a", "r"] * MIN_RUNS]


def test_a_fast_network_runs_for_the_least_time(clock: Clock) -> None:
    """1/64 and 1/64 of a second, exact in binary: 16 pairs fill half a second."""
    found = measure(clock.network("a", lambda _: 1 / 64), clock.reference(lambda _: 1 / 64))
    assert found.runs == MIN_SECONDS * 32
    assert found.median_ms == found.reference_ms == 1000 / 64
    warm = -(-WARM_UP_S // (1 / 64))
    assert clock.calls.count("a") == warm + found.runs


def test_the_own_speed_of_a_reference_is_told_from_its_first_second_or_hundred_runs(
    clock: Clock,
) -> None:
    for seconds, runs in ((1 / 64, 64), (1 / 1024, OWN_RUNS)):
        clock.calls.clear()
        reference = clock.reference(lambda _, each=seconds: each)
        assert reference.own_ms == float("inf")
        reference.warm_up()
        assert clock.calls.count("r") == -(-WARM_UP_S // seconds) + runs
        assert reference.own_ms == pytest.approx(1000 * seconds)
        before = len(clock.calls)
        reference.warm_up()
        assert len(clock.calls) == before + 1


def test_the_warm_up_is_not_counted(clock: Clock) -> None:
    """Cold caches: the first run takes a hundred times as long."""
    found = measure(
        clock.network("a", lambda n: 10.0 if n == 0 else 0.1),
        clock.reference(lambda n: 10.0 if n == 0 else 0.2),
    )
    assert found.p95_ms == pytest.approx(100)
    assert found.reference_ms == pytest.approx(200)


def test_a_reference_that_settles_is_timed_once_it_has(clock: Clock) -> None:
    """The first run finds the caches as the network left them: twice as slow, yet all is quiet."""

    def cooled(_: int) -> float:
        return 1 / 32 if clock.calls[-1] == "a" else 1 / 64

    for settle_s, runs, ms in ((None, 1, 1000 / 32), (0, 2, 1000 / 64), (1 / 16, 4, 1000 / 64)):
        clock.calls.clear()
        found = measure(clock.network("a", lambda _: 1 / 32), clock.reference(cooled, settle_s))
        assert found.quiet is (settle_s is not None)
        assert found.reference_ms == ms
        assert clock.calls[-runs - 1 :] == ["a", *["r"] * runs]


def test_a_hiccup_moves_the_95th_percentile_and_neither_median_nor_spread(clock: Clock) -> None:
    """Two runs are warm-up, ten count: nine of 500 ms and one of 5 s."""
    found = measure(
        clock.network("a", lambda n: 5.0 if n == 4 else 0.5), clock.reference(lambda _: 0.5)
    )
    times = [500.0] * 9 + [5000.0]
    assert found.median_ms == pytest.approx(500)
    assert found.p95_ms == pytest.approx(np.percentile(times, 95))
    assert (found.ratio, found.spread, found.reliable) == (1.0, 0.0, True)


def test_a_drift_of_the_machine_within_what_is_quiet_cancels_pair_by_pair(clock: Clock) -> None:
    """Everything takes a tenth longer from the middle on: only the pair that sees the change has
    another ratio than 4."""
    reference = clock.reference(lambda _: 0.1 * (1.1 if clock.now > 3.5 else 1))
    found = measure(clock.network("a", lambda _: 0.4 * (1.1 if clock.now > 3.5 else 1)), reference)
    assert found.quiet
    assert found.ratio == pytest.approx(4)
    assert found.spread == pytest.approx(0)
    assert sum(ratio == pytest.approx(4) for ratio in found.ratios) >= found.runs - 1
    assert max(found.ratios) / min(found.ratios) > 1.04


def test_only_runs_between_two_quiet_references_count() -> None:
    """A busy machine slows the reference by half and the network by a fifth."""
    quiet, busy = (100.0, 10.0), (120.0, 15.0)
    states = [quiet] * 6 + [busy] * 8
    found = Timing(
        tuple(network for network, _ in states), (10.0, *(beside for _, beside in states)), 10.0
    )
    assert found.quiet
    assert found.reliable
    assert found.ratios == (10.0,) * 6
    assert found.reference_ms == 10.0
    assert found.runs == 14
    assert found.median_ms == 120.0  # what was seen stays what was seen


def test_what_counts_as_quiet_by_hand() -> None:
    """Both neighbours at most 12% above the own speed."""
    edge = QUIET * 10
    inside = Timing((20.0,) * MIN_QUIET, (edge,) * (MIN_QUIET + 1), 10.0)
    outside = Timing((20.0,) * MIN_QUIET, (edge + 0.1,) * (MIN_QUIET + 1), 10.0)
    few = Timing((20.0,) * (MIN_QUIET - 1), (10.0,) * MIN_QUIET, 10.0)
    assert [found.quiet for found in (inside, outside, few)] == [True, False, False]


def test_on_a_busy_machine_every_run_counts_and_none_is_trusted() -> None:
    found = Timing((100.0,) * 10, (20.0,) * 11, 10.0)
    assert (found.ratio, found.spread) == (5.0, 0.0)
    assert found.error == BUSY_ERROR > MAX_ERROR
    assert not found.reliable


def test_a_timing_waits_for_a_quiet_machine(clock: Clock) -> None:
    """Busy until the reference after the 15th run: it goes on until five stand between quiet ones,
    of which the 17th is the first."""
    start = 2 + int(OWN_SECONDS / 0.25)

    def busy(n: int) -> float:
        return 0.5 if start < n <= start + 15 else 0.25

    found = measure(clock.network("a", lambda _: 0.5), clock.reference(busy))
    assert found.reliable
    assert len(found.ratios) == MIN_QUIET
    assert found.ratio == pytest.approx(2)
    assert found.runs == 16 + MIN_QUIET


def test_patience_ends(clock: Clock) -> None:
    """Ten runs of 0.75 s and their references take 12.5 s at least; three times that is enough."""
    start = 2 + int(OWN_SECONDS / 0.25)
    reference = clock.reference(lambda n: 0.25 if n < start else 0.5)
    found = measure(clock.network("a", lambda _: 0.75), reference, patience=3)
    assert not found.reliable
    assert found.runs == 3 * MIN_RUNS


def test_runs_that_never_agree_are_told_to_be_unreliable(clock: Clock) -> None:
    """Two speeds to the end: 1 and 1.5 in turn, quartiles at both, of which no mean is made."""
    found = measure(
        clock.network("a", lambda n: 0.75 if n % 2 else 0.5),
        clock.reference(lambda _: 0.5),
        patience=2,
    )
    assert found.quiet
    assert not found.reliable
    assert found.spread == pytest.approx(0.5 / 1.25, rel=0.3)
    assert found.runs >= 2 * MIN_RUNS


def test_the_error_is_the_standard_error_of_a_median() -> None:
    """The claim of its docstring, by simulation: normal ratios of a known spread."""
    chance = np.random.default_rng(0)
    samples = 100 * chance.normal(1, 0.03, (2_000, 25))
    timings = [Timing(tuple(sample), (10.0,) * 26, 10.0) for sample in samples]
    told = np.median([found.error for found in timings])
    true = np.std([found.ratio for found in timings]) / 10
    assert told == pytest.approx(true, rel=0.1)


def test_a_machine_that_slows_down_steadily_leaves_the_ratio(clock: Clock) -> None:
    """0.2% a run, of both: the run's share lies between those of its neighbours."""
    found = measure(
        clock.network("a", lambda n: 0.5 * 1.002**n), clock.reference(lambda n: 0.25 * 1.002**n)
    )
    assert found.ratio == pytest.approx(2, rel=0.02)
    assert found.spread < 1e-9
