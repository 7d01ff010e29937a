"""Timing on a machine that others use too: warm, repeated, and beside a reference."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from time import perf_counter

import numpy as np

WARM_UP_S = 0.2
MIN_RUNS = 10
MIN_SECONDS = 0.5


@dataclass(frozen=True)
class Timing:
    """How long one pair takes: batch 1, the network alone."""

    median_ms: float
    p95_ms: float
    runs: int
    reference_ms: float
    """The median of the reference network, timed in between the runs."""

    @property
    def spread(self) -> float:
        """How much slower the 95th percentile is than the median, as a fraction."""
        return self.p95_ms / self.median_ms - 1


def measure(run: Callable[[], None], reference: Callable[[], None]) -> Timing:
    """Times `run`, with `reference` interleaved so that a drift of the machine shows in both."""
    _warm_up(run)
    _warm_up(reference)
    times: list[float] = []
    references: list[float] = []
    started = perf_counter()
    while len(times) < MIN_RUNS or perf_counter() - started < MIN_SECONDS:
        times.append(_once_ms(run))
        references.append(_once_ms(reference))
    return Timing(median(times), float(np.percentile(times, 95)), len(times), median(references))


def _warm_up(run: Callable[[], None]) -> None:
    started = perf_counter()
    while perf_counter() - started < WARM_UP_S:
        run()


def _once_ms(run: Callable[[], None]) -> float:
    started = perf_counter()
    run()
    return 1000 * (perf_counter() - started)
