"""A stream of stereo pairs through a session: filmed, shown and summed up."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from itertools import chain, islice
from statistics import median
from time import perf_counter
from typing import TYPE_CHECKING, Any, Final

from .console import progress
from .files import output_folder
from .pictures import brightest_px, captioned, coloured, overlay
from .video import Rate, Stream, Window, film

if TYPE_CHECKING:
    from .data.images import Bytes
    from .predictor import Estimate
    from .results import Results
    from .session import StereoSession

EASING: Final = 0.1
"""How far the end of a film's colours moves to that of each map: with every map's own, it flickers.
"""


@dataclass
class Summary:
    """What a stream came to."""

    seconds: float = 0.0
    """From its first pair to its last, with all that was done to them."""
    network_ms: list[float] = field(default_factory=list)
    """The network alone, pair by pair."""
    stages: Counter[int | None] = field(default_factory=Counter)
    """How many pairs were answered in how many stages."""
    files: list[str] = field(default_factory=list)
    """The films: of disparity, and of classes where there are any."""
    rows: list[dict[str, Any]] = field(default_factory=list)
    """What the report says of each pair whose own files were written."""

    @property
    def frames(self) -> int:
        return len(self.network_ms)

    @property
    def fps(self) -> float:
        return self.frames / max(self.seconds, 1e-9)

    @property
    def median_ms(self) -> float | None:
        return median(self.network_ms) if self.network_ms else None


class Watch:
    """One stream, a session of its size, and where the results go.

    `every` also writes the files of every pair, as of two images. The colours of the film end at
    `results.highest_px`, or else follow where those of its maps end.
    """

    def __init__(
        self,
        stream: Stream,
        session: StereoSession,
        results: Results,
        budget_ms: float | None = None,
        every: bool = False,
    ) -> None:
        self._stream, self._session, self._results = stream, session, results
        self._budget_ms, self._every = budget_ms, every
        self._end_px: float | None = None
        self._told = ""
        self._summary = Summary()

    def run(self, limit: int | None = None) -> Summary:
        """Goes through the stream, or its first `limit` pairs.

        What cameras see ends when the window is left, or with an interrupt, which is no failure.
        Raises as `StereoSession.predict` does; for the first pair before anything is written.
        """
        pairs = islice(self._stream.pairs(), limit)
        first = next(pairs)
        fps = self._first(*first)
        output_folder(self._results.folder)
        known = [count for count in (self._stream.count, limit) if count is not None]
        shown = progress(
            chain([first], pairs), lambda: self._told or "frames", min(known, default=None)
        )
        ending = [KeyboardInterrupt] if self._stream.live else []
        with ExitStack() as films, suppress(*ending):
            names = self._summary.files
            opened = (film(self._results.folder / name, self._stream.size, fps) for name in names)
            self._follow(shown, [films.enter_context(each) for each in opened])
        return self._summary

    def _first(self, left: Bytes, right: Bytes) -> float:
        """A first answer, which does not count, names the films; returns their frame rate.

        A camera gives no more frames than are asked for.
        """
        started = perf_counter()
        pictures = self._pictures(left, self._answer(left, right))
        here = 1 / max(perf_counter() - started, 1e-9)
        name, kinds = self._stream.name, ("color", "overlay")
        self._summary.files += [f"{name}_{kind}.mp4" for kind in kinds[: len(pictures)]]
        return min(self._stream.fps, here) if self._stream.live else self._stream.fps

    def _follow(
        self, pairs: Iterable[tuple[Bytes, Bytes]], films: Sequence[Callable[[Bytes], None]]
    ) -> None:
        window, rate = Window(self._stream.name, self._stream.live), Rate()
        started = perf_counter()
        for left, right in pairs:
            estimate = self._answer(left, right)
            pictures = self._pictures(left, estimate)
            for write, picture in zip(films, pictures, strict=True):
                write(picture)
            self._add(left, estimate, rate)
            self._summary.seconds = perf_counter() - started
            if not window.show(pictures[0]):
                break

    def _answer(self, left: Bytes, right: Bytes) -> Estimate:
        return self._session.predict(left, right, budget_ms=self._budget_ms)

    def _pictures(self, left: Bytes, estimate: Estimate) -> list[Bytes]:
        """The coloured disparity with the frame rate in it, and the classes where there are any."""
        own = brightest_px(estimate.disparity)
        before = own if self._end_px is None else self._end_px
        self._end_px = before + EASING * (own - before)
        end = self._results.highest_px or self._end_px
        found = [captioned(coloured(estimate.disparity, end), self._told)]
        return found if estimate.semantic is None else [*found, overlay(left, estimate.semantic)]

    def _add(self, left: Bytes, estimate: Estimate, rate: Rate) -> None:
        """Counts one more pair, and tells how it goes."""
        summary = self._summary
        if self._every:
            name = f"{self._stream.name}_{summary.frames:06}"
            summary.rows.append(self._results.write(name, left, estimate))
        summary.network_ms.append(1000 * estimate.seconds)
        summary.stages[estimate.stage] += 1
        stage = "" if estimate.stage is None else f"  stage {estimate.stage}"
        self._told = f"{rate.tick():.1f} FPS  network {summary.network_ms[-1]:.0f} ms{stage}"
