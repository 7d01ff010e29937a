"""Timing on a machine that others use too: warm, repeated, and beside a reference.

Every run stands between two runs of a reference network, and what counts is the ratio of the run to
their mean, over the runs in which the machine was quiet: those whose reference, before and after,
ran about as fast as it ever does. A busy machine slows a network of many small kernels more than
one of few large ones, so that no ratio cancels what others take; waiting until they stop does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from math import hypot, inf, sqrt
from statistics import median
from time import perf_counter
from typing import Final

import numpy as np

WARM_UP_S = 0.2
MIN_RUNS = 10
MIN_SECONDS = 0.5

OWN_RUNS: Final = 100
OWN_SECONDS = 1.0
"""How long a reference runs before its own speed is told, whichever is shorter."""

OWN_PERCENTILE: Final = 10
QUIET: Final = 1.12
"""The machine is quiet while the reference takes at most this many times what it takes at its own
speed, the fastest tenth of its runs so far."""

MIN_QUIET: Final = 5
"""Quiet runs that a ratio is told from."""

BUSY_ERROR: Final = 0.05
"""What a ratio is off by on a busy machine, in addition to its standard error: ten networks of 8 to
250 ms, each timed in seven minutes between which the reference drifted by up to 70%, deviated from
their own median by 5%; in the quiet runs alone by 1.5%."""

MAX_ERROR: Final = 0.03
"""The largest standard error that a timing is trusted with."""

CAREFUL: Final = 0.012
"""The standard error that a timing strives for."""

PATIENCE: Final = 8
"""How many times as long as its least a timing may take, to become as good as it strives for."""


class Reference:
    """A network beside which others are timed, and its own speed.

    A small one settles first: it runs once for nothing, and on until `settle_s` have passed. What
    runs in between pushes its data out of the caches, which slows the first run by up to a fifth,
    as others would; and threads of PyTorch look out for more work for a while.
    """

    def __init__(self, run: Callable[[], None], settle_s: float | None = None) -> None:
        self._run, self._settle_s = run, settle_s
        self._times_ms: list[float] = []

    def warm_up(self) -> None:
        """Runs before the first that counts; in the beginning enough to tell the own speed from."""
        if self._times_ms:
            self._run()
            return
        _warm_up(self._run)
        started = perf_counter()
        while perf_counter() - started < OWN_SECONDS and len(self._times_ms) < OWN_RUNS:
            self.time_ms()

    def time_ms(self) -> float:
        """One run."""
        if self._settle_s is not None:
            started = perf_counter()
            self._run()
            while perf_counter() - started < self._settle_s:
                self._run()
        self._times_ms.append(_once_ms(self._run))
        return self._times_ms[-1]

    @property
    def own_ms(self) -> float:
        """What it takes while nothing else takes the machine from it; infinite before any run."""
        return float(np.percentile(self._times_ms, OWN_PERCENTILE)) if self._times_ms else inf


@dataclass(frozen=True)
class Timing:
    """How long one pair takes: batch 1, the network alone."""

    times_ms: tuple[float, ...]
    references_ms: tuple[float, ...]
    """The reference before the first run, between the runs, and after the last."""
    own_ms: float
    """What the reference takes on this machine while it is quiet."""

    def beside(self, own_ms: float) -> Timing:
        """The same runs, where the reference has turned out to take `own_ms` while it is quiet."""
        return replace(self, own_ms=own_ms)

    @property
    def median_ms(self) -> float:
        return median(self.times_ms)

    @property
    def p95_ms(self) -> float:
        return float(np.percentile(self.times_ms, 95))

    @property
    def runs(self) -> int:
        return len(self.times_ms)

    @cached_property
    def quiet(self) -> bool:
        """Whether the machine was quiet in enough of the runs."""
        return sum(self._quiet) >= MIN_QUIET

    @cached_property
    def ratios(self) -> tuple[float, ...]:
        """Each run that counts over the mean of the reference's runs before and after it."""
        times = np.array(self.times_ms)[self._counting]
        return tuple(float(ratio) for ratio in times / self._beside[self._counting])

    @property
    def ratio(self) -> float:
        """The median of the ratios."""
        return median(self.ratios)

    @property
    def reference_ms(self) -> float:
        """The median of the reference beside the runs that count."""
        return float(np.median(self._beside[self._counting]))

    @property
    def spread(self) -> float:
        """The interquartile range of the ratios over their median: no outlier moves it."""
        low, high = np.percentile(self.ratios, (25, 75))
        return float(high - low) / self.ratio

    @property
    def error(self) -> float:
        """The relative standard error of the ratio: that of a median, and what is busy adds to."""
        told = 0.93 * self.spread / sqrt(len(self.ratios))
        return told if self.quiet else hypot(told, BUSY_ERROR)

    @property
    def reliable(self) -> bool:
        """Whether the runs agree, on a quiet machine (see `MAX_ERROR`)."""
        return self.error <= MAX_ERROR

    @cached_property
    def _beside(self) -> np.ndarray:
        return np.array([(before + after) / 2 for before, after in pairwise(self.references_ms)])

    @cached_property
    def _quiet(self) -> tuple[bool, ...]:
        most = QUIET * self.own_ms
        return tuple(max(around) <= most for around in pairwise(self.references_ms))

    @property
    def _counting(self) -> np.ndarray:
        """The quiet runs, or else all of them."""
        return np.array(self._quiet) if self.quiet else np.ones(self.runs, bool)


def measure(
    run: Callable[[], None],
    reference: Reference,
    error: float = CAREFUL,
    patience: float = PATIENCE,
) -> Timing:
    """Times `run` with `reference` in between, until the standard error is as small as `error`.

    At least `MIN_RUNS` runs and `MIN_SECONDS`, at most `patience` times as long. What is returned
    tells by itself whether it is reliable. A GPU's work must be done when `run` returns.
    """
    _warm_up(run)
    reference.warm_up()
    times: list[float] = []
    references = [reference.time_ms()]
    started = perf_counter()
    least = inf
    while True:
        times.append(_once_ms(run))
        references.append(reference.time_ms())
        spent = perf_counter() - started
        if len(times) < MIN_RUNS or spent < MIN_SECONDS:
            continue
        least = min(least, spent)
        found = Timing(tuple(times), tuple(references), reference.own_ms)
        if found.error <= error or spent >= patience * least:
            return found


def _warm_up(run: Callable[[], None]) -> None:
    """At least two runs: what a network takes from the machine, it takes in the first."""
    started = perf_counter()
    run()
    run()
    while perf_counter() - started < WARM_UP_S:
        run()


def _once_ms(run: Callable[[], None]) -> float:
    started = perf_counter()
    run()
    return 1000 * (perf_counter() - started)
