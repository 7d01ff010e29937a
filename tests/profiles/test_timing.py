"""The stopwatch, held against a clock that the test turns."""

from collections.abc import Callable

import numpy as np
import pytest

from rts2.profiles import timing
from rts2.profiles.timing import MIN_RUNS, MIN_SECONDS, WARM_UP_S, Timing, measure


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
    assert found == Timing(median_ms=500.0, p95_ms=500.0, runs=MIN_RUNS, reference_ms=250.0)
    assert clock.calls == ["a", "r", *["a", "r"] * MIN_RUNS]


def test_a_fast_network_runs_for_the_least_time(clock: Clock) -> None:
    """1/64 and 1/64 of a second, exact in binary: 16 pairs fill half a second."""
    found = measure(clock.network("a", lambda _: 1 / 64), clock.network("r", lambda _: 1 / 64))
    assert found.runs == MIN_SECONDS * 32
    assert found.median_ms == found.reference_ms == 1000 / 64
    warm = -(-WARM_UP_S // (1 / 64))
    assert clock.calls.count("a") == clock.calls.count("r") == warm + found.runs


def test_the_warm_up_is_not_counted(clock: Clock) -> None:
    """Cold caches: the first run takes a hundred times as long."""
    found = measure(
        clock.network("a", lambda n: 10.0 if n == 0 else 0.1),
        clock.network("r", lambda n: 10.0 if n == 0 else 0.2),
    )
    assert found.p95_ms == pytest.approx(100)
    assert found.reference_ms == pytest.approx(200)


def test_a_hiccup_moves_the_95th_percentile_and_not_the_median(clock: Clock) -> None:
    """One run is warm-up, ten count: nine of 500 ms and one of 5 s."""
    found = measure(
        clock.network("a", lambda n: 5.0 if n == 4 else 0.5), clock.network("r", lambda _: 0.5)
    )
    times = [500.0] * 9 + [5000.0]
    assert found.median_ms == pytest.approx(500)
    assert found.p95_ms == pytest.approx(np.percentile(times, 95))
    assert found.spread == pytest.approx(np.percentile(times, 95) / 500 - 1)


def test_a_drift_of_the_machine_shows_in_both(clock: Clock) -> None:
    """Everything takes three times as long from the middle on; the ratio stays 4."""
    start = clock.now

    def drifting(seconds: float) -> Callable[[int], float]:
        return lambda _: seconds * (3 if clock.now - start > 2.0 else 1)

    found = measure(
        clock.network("a", drifting(0.4)),
        clock.network("r", drifting(0.1)),
    )
    assert found.median_ms / found.reference_ms == pytest.approx(4)
