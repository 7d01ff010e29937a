"""Calibration: what values a network's layers take on real pairs, gathered one pair at a time.

Each value keeps its extremes and a histogram whose range doubles when a number falls out of it, so
that memory does not grow with the pairs. After every pair the state is on disk: a calibration that
was interrupted goes on where it stopped, and one that is complete is not made again.
"""

from __future__ import annotations

import hashlib
import logging
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal, get_args

import numpy as np
import onnx
from numpy.typing import NDArray

from ..model.console import progress
from ..model.data.scene import Sample, Scene, fingerprint
from ..model.errors import Rts2Error, UsageError
from ..model.files import replacing
from ..model.graph import GraphHeader
from ..model.inference import open_session, session_options
from ..model.ops import padded
from ..model.predictor import prepared
from ..model.qdq import Ranges, quantized_values

Method = Literal["minmax", "percentile", "entropy"]
METHODS: Final[tuple[Method, ...]] = get_args(Method)

BINS: Final = 4096
"""Of a histogram, half of them below zero."""

SAMPLED: Final = 1 << 16
"""Numbers of a value that enter its histogram with each pair; the extremes are of all."""

PERCENTILE: Final = 99.995
"""What `percentile` keeps of a value's numbers, in percent, half of the rest lost on either side.
Depth edges are rare and matter: 99.9 already cuts into them."""

ENTROPY_BINS: Final = 128
"""Into how many levels the histogram falls whose information `entropy` compares."""

MIN_PAIRS: Final = 2
"""Fewer tell nothing of how images differ."""

OPEN_ELEMENTS: Final = 48_000_000
"""How many numbers are looked at in one run: 192 MB of them."""

FORMAT: Final = 1


@dataclass
class Histogram:
    """Where the numbers of one value lie."""

    low: float = np.inf
    high: float = -np.inf
    limit: float = 2.0**-10
    """The histogram reaches from −limit to limit."""
    counts: NDArray[np.int64] = field(default_factory=lambda: np.zeros(BINS, np.int64))

    def add(self, values: NDArray[np.float32]) -> None:
        """Takes a value as one run has it; any shape. Raises `Rts2Error` for what is not finite."""
        low, high = float(values.min()), float(values.max())
        if not (np.isfinite(low) and np.isfinite(high)):
            raise Rts2Error("is not finite")
        self.low, self.high = min(self.low, low), max(self.high, high)
        while max(-low, high) >= self.limit:
            self._double()
        step = max(1, values.size // SAMPLED)
        if step > 1:
            step |= 1  # odd, so that it falls into step with no side of the maps
        sampled = values.reshape(-1)[::step]
        places = ((sampled / self.limit + 1) * (BINS / 2)).astype(np.int64)
        self.counts += np.bincount(np.clip(places, 0, BINS - 1), minlength=BINS)

    def _double(self) -> None:
        """Twice the reach: two bins become one."""
        paired = self.counts.reshape(-1, 2).sum(1)
        self.counts = np.zeros(BINS, np.int64)
        self.counts[BINS // 4 : 3 * BINS // 4] = paired
        self.limit *= 2

    @property
    def edges(self) -> NDArray[np.float64]:
        """(BINS + 1,), where the bins begin and end."""
        return np.linspace(-self.limit, self.limit, BINS + 1)

    def range(self, method: Method) -> tuple[float, float]:
        """From where to where the integers should reach."""
        if method == "minmax":
            return self.low, self.high
        found = self._percentile() if method == "percentile" else self._entropy()
        return max(found[0], self.low), min(found[1], self.high)

    def _percentile(self) -> tuple[float, float]:
        share = np.cumsum(self.counts) / self.counts.sum()
        cut = (100 - PERCENTILE) / 200
        first, last = np.searchsorted(share, [cut, 1 - cut])
        return float(self.edges[first]), float(self.edges[last + 1])

    def _entropy(self) -> tuple[float, float]:
        """The cut that loses the least information (Migacz 2017), as ONNX Runtime finds it.

        From a histogram of fewer bins: the search is quadratic in their number.
        """
        from onnxruntime.quantization.calibrate import HistogramCollector

        coarse = 4
        counts = self.counts.reshape(-1, coarse).sum(1)
        finder = HistogramCollector("entropy", False, BINS // coarse, ENTROPY_BINS, 100.0, "same")
        edges = self.edges[::coarse].astype(np.float32)
        told = (counts, edges, np.float32(self.low), np.float32(self.high), self.limit)
        low, high = finder.get_entropy_threshold(told, ENTROPY_BINS)
        return float(low), float(high)


@dataclass
class Calibration:
    """The state of every value, and of which pairs."""

    histograms: dict[str, Histogram]
    means: dict[str, NDArray[np.float64]]
    """The sum over pairs of each channel's mean, (channels,), of values with channels."""
    pairs: list[str]
    """The names of the pairs that were seen."""
    skipped: list[str]
    """Why pairs were not, each in a line that begins with its name."""

    def ranges(self, method: Method) -> Ranges:
        """From where to where the integers of each value should reach."""
        return {name: known.range(method) for name, known in self.histograms.items()}

    def first(self, samples: Sequence[Sample], count: int) -> list[Scene]:
        """The first pairs that were seen, read again."""
        named = {sample.name: sample for sample in samples}
        return [named[name].read() for name in self.pairs[:count]]

    def mean(self, value: str) -> NDArray[np.float64]:
        """The mean of each channel of a value over all pairs."""
        return self.means[value] / len(self.pairs)


def calibrate(
    model: onnx.ModelProto, header: GraphHeader, samples: Sequence[Sample], cache: Path
) -> Calibration:
    """Runs the float graph on every pair, and gathers what its layers take and give.

    Pairs that cannot be read, or are of another size than the graph's, are skipped and told. The
    state is kept at `cache`, and what it holds of these very pairs and graph is not done again.

    Raises `UsageError` where fewer than `MIN_PAIRS` pairs are left.
    """
    key = _key(model, samples)
    state = _restored(cache, key) or _fresh(model)
    done = len(state.pairs) + len(state.skipped)
    runner = _Runner(model, list(state.histograms)) if done < len(samples) else None
    for sample in progress(samples[done:], "calibrating", len(samples) - done):
        assert runner is not None
        scene = _read(sample, header, state.skipped)
        if scene is not None:
            _gather(state, runner, scene, header)
        _keep(state, cache, key)
    for line in state.skipped:
        logging.getLogger(__name__).warning("note: skipped %s", line)
    if len(state.pairs) < MIN_PAIRS:
        width, height = header.resolution
        raise UsageError(
            f"calibration needs {MIN_PAIRS} pairs of {width}x{height} at least and has "
            f"{len(state.pairs)}; 32 are usual: give more, or --calib streets"
        )
    return state


def _read(sample: Sample, header: GraphHeader, skipped: list[str]) -> Scene | None:
    """A pair, if it can be read and fits; else why not is added to `skipped`."""
    try:
        scene = sample.read()
    except (Rts2Error, OSError) as error:
        skipped.append(f"{sample.name}: {' '.join(str(error).split())}")
        return None
    height, width = padded(scene.size, header.arch.multiple)
    if (width, height) != header.size:
        own = "{}x{}".format(*scene.size)
        skipped.append(f"{sample.name}: it is {own}, the graph is for {_size(header.resolution)}")
        return None
    return scene


def _size(resolution: tuple[int, int]) -> str:
    return "{}x{}".format(*resolution)


def _gather(state: Calibration, runner: _Runner, scene: Scene, header: GraphHeader) -> None:
    multiple = header.arch.multiple
    pair = {"left": prepared(scene.left, multiple), "right": prepared(scene.right, multiple)}
    for name, values in runner.values(pair):
        try:
            state.histograms[name].add(values)
        except Rts2Error as error:
            raise Rts2Error(
                f"{name} {error} on {scene.name}: the weights are broken or the range of fp32 is "
                "left; train again"
            ) from error
        if values.ndim >= 4:
            means = values.mean(axis=(0, *range(2, values.ndim)), dtype=np.float64)
            state.means[name] = state.means.get(name, np.zeros_like(means)) + means
    state.pairs.append(scene.name)


class _Runner:
    """The graph with its inner values shown, some at a time: their memory is what counts."""

    def __init__(self, model: onnx.ModelProto, names: Sequence[str]) -> None:
        inputs = {value.name for value in model.graph.input}
        self._given = [name for name in names if name in inputs]
        inner = [name for name in names if name not in inputs]
        elements = {
            value.name: int(np.prod([side.dim_value for side in value.type.tensor_type.shape.dim]))
            for value in (*model.graph.value_info, *model.graph.output)
        }
        self._groups = list(_groups(inner, elements))
        self._sessions = [(group, _shown(model, group)) for group in self._groups]

    def values(self, pair: dict[str, NDArray[np.float32]]) -> Iterator[tuple[str, Any]]:
        """Every value of one run, group after group."""
        for name in self._given:
            yield name, pair[name]
        for group, session in self._sessions:
            yield from zip(group, session.run(list(group), pair), strict=True)


def _groups(names: Sequence[str], elements: dict[str, int]) -> Iterator[tuple[str, ...]]:
    """The names in order, in groups that are not larger than can be looked at in one run."""
    group: list[str] = []
    size = 0
    for name in names:
        if group and size + elements[name] > OPEN_ELEMENTS:
            yield tuple(group)
            group, size = [], 0
        group.append(name)
        size += elements[name]
    if group:
        yield tuple(group)


def _shown(model: onnx.ModelProto, names: Sequence[str]) -> Any:
    """A session that gives these values too."""
    shown = onnx.ModelProto()
    shown.CopyFrom(model)
    known = {value.name: value for value in (*model.graph.value_info, *model.graph.output)}
    del shown.graph.output[:]
    shown.graph.output.extend(known[name] for name in names)
    options = session_options()
    # A pool that grows with every shape would hold several networks' worth of memory.
    options.enable_cpu_mem_arena = False
    return open_session(Path("the graph"), options, shown.SerializeToString())


def _fresh(model: onnx.ModelProto) -> Calibration:
    return Calibration({name: Histogram() for name in quantized_values(model)}, {}, [], [])


def _key(model: onnx.ModelProto, samples: Sequence[Sample]) -> str:
    """What a calibration depends on: the graph and the pairs."""
    told = hashlib.sha256(model.SerializeToString(deterministic=True))
    told.update(f"{FORMAT} {BINS} {SAMPLED}".encode())
    for sample in samples:
        told.update(f"{sample.name} {_fingerprint(sample)}\n".encode())
    return told.hexdigest()


def _fingerprint(sample: Sample) -> str | None:
    """What a pair depends on; a file that is missing is told when it is read."""
    try:
        return fingerprint(sample)
    except Rts2Error:
        return None


def _keep(state: Calibration, cache: Path, key: str) -> None:
    names = list(state.histograms)
    known = state.histograms.values()
    with replacing(cache) as path, path.open("wb") as file:
        arrays: dict[str, Any] = {
            "key": np.array(key),
            "names": np.array(names, dtype=str),
            "counts": np.stack([each.counts for each in known]),
            "bounds": np.array([[each.low, each.high, each.limit] for each in known]),
            "pairs": np.array(state.pairs, dtype=str),
            "skipped": np.array(state.skipped, dtype=str),
        }
        arrays |= {f"mean {name}": sums for name, sums in state.means.items()}
        np.savez(file, **arrays)


def _restored(cache: Path, key: str) -> Calibration | None:
    """What is kept of these pairs and this graph; None where nothing is, or something else."""
    if not cache.is_file():
        return None
    try:
        with cache.open("rb") as file, np.load(file, allow_pickle=False) as kept:
            if str(kept["key"]) != key:
                return None
            names = [str(name) for name in kept["names"]]
            rows = zip(names, kept["bounds"], kept["counts"], strict=True)
            return Calibration(
                {
                    name: Histogram(float(low), float(high), float(limit), counts.astype(np.int64))
                    for name, (low, high, limit), counts in rows
                },
                {n.removeprefix("mean "): kept[n] for n in kept.files if n.startswith("mean ")},
                [str(name) for name in kept["pairs"]],
                [str(line) for line in kept["skipped"]],
            )
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise Rts2Error(f"{cache} is no calibration of rts2: {error}; delete it") from error
