"""Which of several graphs is the fastest: run in turn, so that a busy machine delays them alike."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Final

import numpy as np

from ..model.arch import Precision
from ..profiles.runtimes import open_session
from ..profiles.timing import Reference, Timing, measure

ROUNDS: Final = 12
"""Runs of each graph; in a quarter of them the machine is taken to be quiet."""

QUIET_SHARE: Final = 0.25

AT_ONCE: Final = 5
"""Graphs that are open at a time, beside the first: each holds its network's memory."""

SURE: Final = 2.0
"""Standard errors by which a ratio must lie below one to count as faster."""


@dataclass(frozen=True)
class Runner:
    """A graph in a runtime, at a precision."""

    path: Path
    precision: Precision
    runtime: str = "onnxruntime"

    def opened(self, threads: int) -> Callable[[], None]:
        """One run of it, on inputs of its own."""
        if self.runtime == "openvino":
            from ..profiles.runtimes.ov import Session

            return Session(self.path, self.precision, threads).run
        return open_session(self.runtime, self.path, self.precision, threads).run


@dataclass(frozen=True)
class Duel:
    """A graph against its float parent, run by run in turn."""

    timing: Timing

    @property
    def ratio(self) -> float:
        """The latency of the graph over its parent's."""
        return self.timing.ratio

    @property
    def parent_ms(self) -> float:
        return self.timing.reference_ms

    @property
    def own_ms(self) -> float:
        """By its ratio to the parent beside it: what to compare."""
        return self.ratio * self.parent_ms

    @property
    def faster(self) -> bool:
        """Whether the graph is faster beyond what the timing may be off."""
        return self.ratio * (1 + SURE * self.timing.error) < 1


def race(runners: Sequence[Runner], threads: int) -> list[float]:
    """The latency of each graph over the first one's: a ranking, no measurement.

    What is compared is the fast quarter of the runs of each.
    """
    first = runners[0].opened(threads)
    found = [1.0]
    for start in range(1, len(runners), AT_ONCE):
        runs = [first, *(each.opened(threads) for each in runners[start : start + AT_ONCE])]
        for run in runs:
            run()
        times = np.array([[_seconds(run) for run in runs] for _ in range(ROUNDS)])
        fast = np.quantile(times, QUIET_SHARE, axis=0)
        found += list(map(float, fast[1:] / fast[0]))
    return found


def duel(own: Runner, parent: Runner, threads: int) -> Duel:
    """One graph against its float parent, as carefully as can be."""
    return Duel(measure(own.opened(threads), Reference(parent.opened(threads))))


def _seconds(run: Callable[[], None]) -> float:
    started = perf_counter()
    run()
    return perf_counter() - started
