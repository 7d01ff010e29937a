"""A network that is loaded once and answers pair after pair, in the stages that there is time for.

    session = StereoSession("c8", resolution=(1242, 375))
    estimate = session.predict(left, right, budget_ms=30)
    estimate.disparity, estimate.semantic, estimate.stage

Every number of stages is a graph of its own, cut out of one file in memory: handing the values of
one stage to a session of the next takes 5% longer than a graph that runs through.
"""

from __future__ import annotations

from collections import deque
from math import inf
from pathlib import Path
from threading import Lock
from time import perf_counter
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from .box import named_model
from .early import stopped, stops
from .errors import UsageError
from .graph import GraphHeader, found_header, load_graph
from .kept import exported
from .predictor import Estimate, OnnxPredictor, is_graph, model_file

if TYPE_CHECKING:
    from onnx import ModelProto

    from .arch import Arch
    from .data.images import Bytes

TIMED: Final = 2
"""Runs of each number of stages that are timed at the start, after one that is not."""

REMEMBERED: Final = 20
"""Calls whose times tell what the next one will take."""

OPEN: Final = 2
"""Sessions that are open at a time, where images differ in size."""

EXPECTED: Final = 90
"""The percentile of these times that must fit into a budget."""


class StereoSession:
    """A network on the CPU, in ONNX Runtime, ready for pairs of one size; any thread may call it.

    `model` is a bundle, an ONNX file, a checkpoint, or the name of a network in the box. A graph
    has its size; a checkpoint needs the `resolution` (width, height) of the images, and is exported
    the first time (see `kept`). The session runs at most `stages` stages, by default all; without
    `early` it always runs as many, and holds no graph that stops before.

    Raises:
        UsageError: there is no such model, it has not so many stages, or it is for another size.
        Rts2Error: the file is broken, or holds no network that takes a stereo pair.
    """

    def __init__(
        self,
        model: str | Path,
        resolution: tuple[int, int] | None = None,
        stages: int | None = None,
        early: bool = True,
    ) -> None:
        self.path = model_file(named_model(model) if isinstance(model, str) else model)
        graph = _graph(self.path, resolution)
        header = found_header(graph, self.path)
        self._predictors = [
            OnnxPredictor.of(cut, self.path)
            for cut in _cuts(graph, header, self.path, stages, early)
        ]
        if resolution is not None:
            self._predictors[-1].require_fits(resolution)
        self._times = [Times() for _ in self._predictors]
        self.arch: Arch | None = None if header is None else header.arch
        """The network's, whole; None for a graph that does not name it."""
        self.origin: str | None = None if header is None else header.origin
        """How the weights came to be; None where the file does not say."""
        self._warm_up()

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) that images are padded to; those that pad to another are refused."""
        return self._predictors[-1].size

    def fits(self, resolution: tuple[int, int]) -> bool:
        """Whether images of this width and height pad to `size`."""
        return self._predictors[-1].fits(resolution)

    @property
    def expected_ms(self) -> dict[int | None, float]:
        """What a call is expected to take, by its number of stages; None stands for that of a
        graph that does not tell.
        """
        rows = zip(self._predictors, self._times, strict=True)
        return {predictor.stages: times.expected_ms for predictor, times in rows}

    def predict(
        self,
        left: Bytes,
        right: Bytes,
        stages: int | None = None,
        budget_ms: float | None = None,
    ) -> Estimate:
        """The disparity and the classes of a pair, (H, W) each, from images (H, W, 3), RGB, uint8.

        It runs `stages` stages, by default all that the session has; with a budget for the whole
        call as many of them as are expected to fit, going by what calls took lately, and the first
        in any case.

        Raises:
            UsageError: the images are no such arrays or of another size, the session does not stop
                after so many stages, or the first one never held the budget.
        """
        _require_pair(left, right)
        last = self._index(stages)
        chosen = last if budget_ms is None else self._fitting(last, budget_ms)
        return self._timed(chosen, left, right)

    def _timed(self, index: int, left: Bytes, right: Bytes) -> Estimate:
        started = perf_counter()
        estimate = self._predictors[index].predict(left, right)
        self._times[index].add(1000 * (perf_counter() - started))
        return estimate

    def _index(self, stages: int | None) -> int:
        """Which predictor runs so many stages."""
        known = [predictor.stages for predictor in self._predictors]
        if stages is None:
            return len(known) - 1
        if stages not in known:
            raise _cannot_stop(self.path, known, stages)
        return known.index(stages)

    def _fitting(self, last: int, budget_ms: float) -> int:
        """The last predictor up to `last` that is expected to fit into a budget, else the first:
        what it once held it may hold again.
        """
        expected = [times.expected_ms for times in self._times[: last + 1]]
        fitting = [index for index, ms in enumerate(expected) if ms <= budget_ms]
        if not fitting:
            self._require_enough(budget_ms)
        chosen = max(fitting, default=0)
        for times in self._times[chosen + 1 : last + 1]:
            times.forget_slowest()
        return chosen

    def _require_enough(self, budget_ms: float) -> None:
        """Raises `UsageError` for a budget that the first stage never held, and does not now."""
        first = self._times[0]
        if not first.least_ms <= budget_ms:
            self._timed(0, *self._blank())
        if not first.least_ms <= budget_ms:
            raise UsageError(
                f"a budget must hold the first stage, which takes {first.least_ms:.1f} ms here; it "
                f"is {budget_ms:g} ms: allow more, or take a smaller network"
            )

    def _warm_up(self) -> None:
        """Times every number of stages, after a first run, which takes longer."""
        for index, predictor in enumerate(self._predictors):
            predictor.predict(*self._blank())
            for _ in range(TIMED):
                self._timed(index, *self._blank())

    def _blank(self) -> tuple[Bytes, Bytes]:
        width, height = self.size
        image = np.zeros((height, width, 3), np.uint8)
        return image, image


class Sessions:
    """The sessions of one model for images of any size, opened as they are asked for.

    The arguments are those of `StereoSession`. The last `OPEN` stay open.
    """

    def __init__(self, model: str | Path, stages: int | None = None, early: bool = True) -> None:
        self._arguments = (stages, early)
        self._model = model
        self._open: list[StereoSession] = []

    def of(self, resolution: tuple[int, int]) -> StereoSession:
        """The session for images of this width and height; raises as `StereoSession` does."""
        for session in self._open:
            if session.fits(resolution):
                self._open.remove(session)
                break
        else:
            del self._open[: 1 - OPEN]
            session = StereoSession(self._model, resolution, *self._arguments)
        self._open.append(session)
        return session


class Times:
    """What calls took lately, in ms; many threads may tell and ask."""

    def __init__(self) -> None:
        self._lately: deque[float] = deque(maxlen=REMEMBERED)
        self._lock = Lock()
        self.least_ms = inf
        """The fastest call of all."""

    def add(self, ms: float) -> None:
        """One more call; the oldest that is remembered makes room for it."""
        with self._lock:
            self._lately.append(ms)
            self.least_ms = min(self.least_ms, ms)

    def forget_slowest(self) -> None:
        """For a call that did not come because of these times, of which the last stays.

        What was slow on a busy machine would else count for ever, as nothing newer comes in.
        """
        with self._lock:
            if len(self._lately) > 1:
                self._lately.remove(max(self._lately))

    @property
    def expected_ms(self) -> float:
        """What nine of ten calls do not exceed."""
        with self._lock:
            return float(np.percentile(self._lately, EXPECTED))


def _graph(path: Path, resolution: tuple[int, int] | None) -> ModelProto:
    """The whole graph of a model."""
    if is_graph(path):
        return load_graph(path)
    if resolution is None:
        raise UsageError(
            f"a checkpoint needs the size of the images, (width, height): {path} was opened "
            "without; give the session a resolution"
        )
    return exported(path, resolution)


def _cuts(
    graph: ModelProto, header: GraphHeader | None, path: Path, stages: int | None, early: bool
) -> list[ModelProto]:
    """The graphs of a session, from few stages to many."""
    if header is None:
        if stages is not None:
            raise _cannot_stop(path, [None], stages)
        return [graph]
    last = header.arch.up_to(stages).stages
    known = stops(graph, header)
    if last not in known:
        raise _cannot_stop(path, known, last)
    return [stopped(graph, header, k) for k in known if k == last or (early and k < last)]


def _cannot_stop(path: Path, known: Any, stages: int) -> UsageError:
    can = " or ".join("its own number of" if k is None else str(k) for k in known)
    return UsageError(
        f"{path} runs {can} stages here, not {stages}; leave the stages out, or give the checkpoint"
    )


def _require_pair(left: Any, right: Any) -> None:
    """Raises `UsageError` for what is not two images of one size."""
    for side, image in (("left", left), ("right", right)):
        told = f"{type(image).__name__}"
        if isinstance(image, np.ndarray):
            if image.dtype == np.uint8 and image.ndim == 3 and image.shape[2] == 3:
                continue
            told = f"{image.dtype} {image.shape}"
        raise UsageError(
            f"an image must be a NumPy array (height, width, 3), RGB, of uint8; {side} is {told}"
        )
    if left.shape != right.shape:
        sizes = " and ".join(f"{image.shape[1]}x{image.shape[0]}" for image in (left, right))
        raise UsageError(f"a stereo pair must have one size: it is {sizes}; give a rectified pair")
