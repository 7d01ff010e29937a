"""Points of a front tried out on this machine, as they would be deployed: each is timed, and judged
where its precision changes what the network says.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from ..model.arch import Arch, Form
from ..model.checkpoint import build
from ..model.data.scene import Sample, Scene
from ..model.evaluation import score
from ..model.export import export
from ..model.graph import save_graph
from ..model.machine import cores
from ..model.metrics import Score
from ..model.ops import Size, padded
from ..model.predictor import OnnxPredictor, Predictor
from ..model.qdq import Ranges, integers, usual
from ..model.rts2net import RTS2Net
from ..profiles.measure import MADE, REFERENCE
from ..profiles.profile import Resolution
from ..profiles.runtimes import RUNTIMES, Sized, available, open_session, precisions
from ..profiles.timing import Reference, Timing, measure
from ..quant.calibration import calibrate
from ..quant.half import OpenVinoPredictor
from ..quant.intermediate import to_ir
from ..quant.source import opened
from .deploy.configuration import forms_of
from .exhaustive import Question
from .inherited import Inherited
from .result import Point

PAIRS: Final = 16
"""Training images that calibrate a network in integers."""

METHOD: Final = "percentile"

RETRIES: Final = 2
"""How often a point is timed again while its timing is unreliable."""


@dataclass(frozen=True)
class Tried:
    """What came of one point."""

    timing: Timing
    score: Score | None
    """How its answers in its precision are judged; None in fp32, where its weights' are known."""


class Trials:
    """Tries points whose weights a supernet holds, on the images that judged the supernet."""

    def __init__(self, question: Question, judge: Inherited) -> None:
        self.question, self.judge, self.threads = question, judge, cores()

    def __call__(self, point: Point) -> Tried | None:
        """None where this machine cannot run the point as it is meant."""
        if point.runtime not in available():
            return None
        made = point.precision in MADE.get(point.runtime, ())
        if not made and point.precision not in precisions(point.runtime):
            return None
        network = self.judge.network(point.arch)
        if RUNTIMES[point.runtime].takes == "network":
            return self._eager(point, network)
        with TemporaryDirectory(prefix="rts2.") as folder:
            graphs = _Graphs(point, network, self, Path(folder))
            path = graphs.lowered(self.question.resolution) if made else None
            path = path or graphs.float(self.question.resolution)
            session = open_session(point.runtime, path, point.precision, self.threads)
            timing = self._timed(session.run)
            del session
            return Tried(timing, None if point.precision == "fp32" else self._judged(graphs))

    def _eager(self, point: Point, network: RTS2Net) -> Tried | None:
        """A network as PyTorch runs it; of its lower precisions nothing is known."""
        if point.precision != "fp32":
            return None
        sized = Sized(network, self.question.resolution, point.arch.stages)
        session = open_session(point.runtime, sized, point.precision, self.threads)
        return Tried(self._timed(session.run), None)

    def _timed(self, run: Callable[[], None]) -> Timing:
        """The first reliable timing, or else the last."""
        timing = measure(run, self._reference)
        for _ in range(RETRIES):
            if timing.reliable:
                break
            timing = measure(run, self._reference)
        return timing

    @cached_property
    def _reference(self) -> Reference:
        arch, size = REFERENCE
        session = open_session("onnxruntime", Sized(build(arch), size), "fp32", self.threads)
        return Reference(session.run, settle_s=0.0)

    def _judged(self, graphs: _Graphs) -> Score:
        total = Score()
        ordered = sorted(self.judge.judging, key=_padded)
        for _, scenes in groupby(ordered, key=_padded):
            same = list(scenes)
            predictor = graphs.predictor(same[0].size)
            for scene in same:
                estimate = predictor.predict(scene.left, scene.right)
                total += score(estimate, scene, graphs.point.arch)
        return total


@dataclass(frozen=True)
class _Graphs:
    """The graphs of one point, of any size, in its forms."""

    point: Point
    network: RTS2Net
    trials: Trials
    folder: Path

    @cached_property
    def forms(self) -> tuple[Form, ...] | None:
        """Those that the latency was predicted in."""
        point, question = self.point, self.trials.question
        return forms_of(
            point.arch, question.profile, point.precision, point.runtime, question.resolution
        )

    def float(self, size: Resolution) -> Path:
        path = self.folder / "float-{}x{}.onnx".format(*size)
        if not path.exists():
            origin, runtime = self.trials.judge.origin, self.point.runtime
            export(self.network, path, size, origin, forms=self.forms, runtime=runtime)
        return path

    def lowered(self, size: Resolution) -> Path:
        """The graph with its usual layers in integers."""
        path = self.folder / "integers-{}x{}.onnx".format(*size)
        if path.exists():
            return path
        model, header = opened(self.float(size))
        made = integers(model, usual(model), self._ranges)
        save_graph(made, header.model_copy(update={"precision": "int8"}), path)
        return path

    def predictor(self, size: Resolution) -> Predictor:
        """What the point says of images of this size."""
        path = self.lowered(size) if self.point.precision == "int8" else self.float(size)
        if self.point.runtime != "openvino":
            return OnnxPredictor(path)
        return OpenVinoPredictor(path, to_ir(path), self.point.precision, self.trials.threads)

    @cached_property
    def _ranges(self) -> Ranges:
        """Of every value; a value bears the same name in graphs of all sizes."""
        pairs = alike(self.trials.judge.data.training)[:PAIRS]
        model, header = opened(self.float(pairs[0].size))
        return calibrate(model, header, pairs, self.folder / "calibration.npz").ranges(METHOD)


def alike(samples: Sequence[Sample]) -> list[Sample]:
    """The samples of the size that most have, once padded."""
    ((most, _),) = Counter(map(_padded, samples)).most_common(1)
    return [sample for sample in samples if _padded(sample) == most]


def _padded(image: Sample | Scene) -> Size:
    return padded(image.size, Arch().multiple)
