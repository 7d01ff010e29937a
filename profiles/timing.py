"""Timing on a machine that others use too: warm, repeated, and beside a reference.

Every run stands between two runs of a reference network, and what counts is the ratio of the run to
their mean: a drift of the machine shows in both and cancels, pair by pair.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from statistics import median
from time import perf_counter
from typing import Final

import numpy as np

WARM_UP_S = 0.2
MIN_RUNS = 10
MIN_SECONDS = 0.5

ATTEMPTS: Final = 3
"""How often a measurement is taken at most, each one twice as long as the one before."""

MAX_SPREAD: Final = 0.1
"""The widest spread that a measurement is trusted with. The median of n runs has a standard error
of 0.93 × (interquartile range) / √n, so at this spread ten runs tell the ratio within ±5% at 90%;
where the spread is wider, the machine had two speeds, and no median says which was its own."""


@dataclass(frozen=True)
class Timing:
    """How long one pair takes: batch 1, the network alone."""

    median_ms: float
    p95_ms: float
    runs: int
    reference_ms: float
    """The median of the reference network, timed in between the runs."""
    ratios: tuple[float, ...] = ()
    """Each run over the mean of the reference's runs before and after it."""

    @property
    def ratio(self) -> float:
        """The median of the runs' ratios to the reference, in which drift cancels."""
        return median(self.ratios) if self.ratios else self.median_ms / self.reference_ms

    @property
    def spread(self) -> float:
        """The interquartile range of the ratios over their median: no outlier moves it."""
        if not self.ratios:
            return 0.0
        low, high = np.percentile(self.ratios, (25, 75))
        return float(high - low) / self.ratio

    @property
    def reliable(self) -> bool:
        """Whether the runs agree (see `MAX_SPREAD`)."""
        return self.spread <= MAX_SPREAD


def measure(
    run: Callable[[], None], reference: Callable[[], None], attempts: int = ATTEMPTS
) -> Timing:
    """Times `run` with `reference` in between; a measurement with too wide a spread is repeated.

    Each of the `attempts` takes twice as long as the one before. What is returned is one of them,
    never a mean: the first that is reliable, or else the one of the narrowest spread, which says
    of itself that it is not. A GPU's work must be done when `run` returns.
    """
    _warm_up(run)
    _warm_up(reference)
    found: list[Timing] = []
    while not found or (len(found) < attempts and not found[-1].reliable):
        found.append(_measured(run, reference, 2 ** len(found)))
    return min(found, key=lambda timing: timing.spread)


def _measured(run: Callable[[], None], reference: Callable[[], None], length: int) -> Timing:
    """One measurement, `length` times as long as the shortest."""
    times: list[float] = []
    references = [_once_ms(reference)]
    started = perf_counter()
    while len(times) < length * MIN_RUNS or perf_counter() - started < length * MIN_SECONDS:
        times.append(_once_ms(run))
        references.append(_once_ms(reference))
    around = [(before + after) / 2 for before, after in pairwise(references)]
    ratios = tuple(time / beside for time, beside in zip(times, around, strict=True))
    p95_ms = float(np.percentile(times, 95))
    return Timing(median(times), p95_ms, len(times), median(references), ratios)


def _warm_up(run: Callable[[], None]) -> None:
    started = perf_counter()
    while perf_counter() - started < WARM_UP_S:
        run()


def _once_ms(run: Callable[[], None]) -> float:
    started = perf_counter()
    run()
    return 1000 * (perf_counter() - started)
