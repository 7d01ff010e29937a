"""The stopwatch, held against a clock that the test turns."""

from collections.abc import Callable

import numpy as np
import pytest

from rts2.profiles import timing
from rts2.profiles.timing import (
    MAX_SPREAD,
    MIN_RUNS,
    MIN_SECONDS,
    WARM_UP_S,
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


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    known = Clock()
    monkeypatch.setattr(timing, "perf_counter", known)
    return known


def test_a_slow_network_runs_the_least_number_of_times(clock: Clock) -> None:
    """Half a second each: one run warms it up, and the ten that count take five seconds."""
    found = measure(clock.network("a", lambda _: 0.5), clock.network("r", lambda _: 0.25))
    assert (found.median_ms, found.p95_ms, found.reference_ms) == (500.0, 500.0, 250.0)
    assert found.runs == MIN_RUNS
    assert found.ratios == (2.0,) * MIN_RUNS
    assert (found.ratio, found.spread, found.reliable) == (2.0, 0.0, True)
    assert clock.calls == ["a", "r", "r", *["a", "r"] * MIN_RUNS]


def test_a_fast_network_runs_for_the_least_time(clock: Clock) -> None:
    """1/64 and 1/64 of a second, exact in binary: 16 pairs fill half a second."""
    found = measure(clock.network("a", lambda _: 1 / 64), clock.network("r", lambda _: 1 / 64))
    assert found.runs == MIN_SECONDS * 32
    assert found.median_ms == found.reference_ms == 1000 / 64
    warm = -(-WARM_UP_S // (1 / 64))
    assert clock.calls.count("a") == warm + found.runs
    assert clock.calls.count("r") == warm + found.runs + 1


def test_the_warm_up_is_not_counted(clock: Clock) -> None:
    """Cold caches: the first run takes a hundred times as long."""
    found = measure(
        clock.network("a", lambda n: 10.0 if n == 0 else 0.1),
        clock.network("r", lambda n: 10.0 if n == 0 else 0.2),
    )
    assert found.p95_ms == pytest.approx(100)
    assert found.reference_ms == pytest.approx(200)


def test_a_hiccup_moves_the_95th_percentile_and_neither_median_nor_spread(clock: Clock) -> None:
    """One run is warm-up, ten count: nine of 500 ms and one of 5 s."""
    found = measure(
        clock.network("a", lambda n: 5.0 if n == 4 else 0.5), clock.network("r", lambda _: 0.5)
    )
    times = [500.0] * 9 + [5000.0]
    assert found.median_ms == pytest.approx(500)
    assert found.p95_ms == pytest.approx(np.percentile(times, 95))
    assert (found.ratio, found.spread, found.reliable) == (1.0, 0.0, True)


def test_a_drift_of_the_machine_cancels_pair_by_pair(clock: Clock) -> None:
    """Everything takes three times as long from the middle on: only the pair that sees the
    change has another ratio than 4."""
    start = clock.now

    def drifting(seconds: float) -> Callable[[int], float]:
        return lambda _: seconds * (3 if clock.now - start > 2.0 else 1)

    found = measure(clock.network("a", drifting(0.4)), clock.network("r", drifting(0.1)))
    assert found.ratio == pytest.approx(4)
    assert found.spread == pytest.approx(0)
    assert sum(ratio == pytest.approx(4) for ratio in found.ratios) >= found.runs - 1
    assert max(found.ratios) / min(found.ratios) > 1.4


def test_a_machine_that_slows_down_steadily_leaves_the_ratio(clock: Clock) -> None:
    """1% a run, of both: the run's share lies between those of its neighbours."""
    found = measure(
        clock.network("a", lambda n: 0.5 * 1.01**n), clock.network("r", lambda n: 0.25 * 1.01**n)
    )
    assert found.ratio == pytest.approx(2, rel=0.02)
    assert found.spread < 1e-9


def two_speeds(disturbed: int) -> Callable[[int], float]:
    """Half a second, and half as much again in every second of the first runs that count."""
    return lambda n: 0.75 if 0 < n <= disturbed and n % 2 else 0.5


def test_a_spread_that_is_too_wide_is_measured_again_for_twice_as_long(clock: Clock) -> None:
    """The disturbance ends with the first measurement: the second one is clean, and it alone
    counts."""
    found = measure(
        clock.network("a", two_speeds(MIN_RUNS)), clock.network("r", lambda _: 0.5), attempts=3
    )
    assert found.runs == 2 * MIN_RUNS
    assert (found.median_ms, found.ratio, found.spread, found.reliable) == (500.0, 1.0, 0.0, True)
    assert clock.calls.count("a") == 1 + MIN_RUNS + 2 * MIN_RUNS


def test_what_stays_wide_is_told_to_be_unreliable(clock: Clock) -> None:
    """Two speeds to the end: 1 and 1.5 in turn, quartiles at both, of which no mean is made."""
    found = measure(clock.network("a", two_speeds(10**6)), clock.network("r", lambda _: 0.5))
    assert not found.reliable
    assert found.spread == pytest.approx(0.5 / 1.25)
    assert clock.calls.count("a") == 1 + (1 + 2 + 4) * MIN_RUNS
    assert found.runs in (MIN_RUNS, 2 * MIN_RUNS, 4 * MIN_RUNS)


def test_of_unreliable_measurements_the_narrowest_is_kept(clock: Clock) -> None:
    """Ten runs between 1 and 1.2, then all between 1 and 1.5."""

    def worse(n: int) -> float:
        return 0.5 if n % 2 == 0 else 0.6 if n <= MIN_RUNS else 0.75

    found = measure(clock.network("a", worse), clock.network("r", lambda _: 0.5))
    assert found.runs == MIN_RUNS
    assert MAX_SPREAD < found.spread == pytest.approx(0.2 / 1.1)


def test_attempts_bound_what_a_measurement_costs(clock: Clock) -> None:
    network = clock.network("a", two_speeds(10**6))
    found = measure(network, clock.network("r", lambda _: 0.5), attempts=1)
    assert found.runs == MIN_RUNS
    assert clock.calls.count("a") == 1 + MIN_RUNS


def test_the_bound_on_the_spread_tells_a_ratio_of_ten_runs_within_five_percent() -> None:
    """The claim of its docstring, by simulation: normal ratios with just that spread."""
    chance = np.random.default_rng(0)
    sigma = MAX_SPREAD / 1.349  # a normal's interquartile range in standard deviations
    medians = np.median(chance.normal(1, sigma, (20_000, MIN_RUNS)), axis=1)
    assert np.mean(abs(medians - 1) < 0.05) >= 0.9


def test_a_timing_without_its_pairs_has_the_ratio_of_its_medians() -> None:
    found = Timing(10.0, 11.0, 10, 4.0)
    assert (found.ratio, found.spread, found.reliable) == (2.5, 0.0, True)
