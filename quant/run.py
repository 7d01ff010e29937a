"""One run of rts2-quantize, from what was ordered to the files: one way for each kind of target."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Final

from onnx import ModelProto

from ..model.arch import Precision
from ..model.data.catalog import STREETS, open_dataset
from ..model.data.scene import Sample
from ..model.errors import UsageError
from ..model.files import remove, write_bytes, write_json
from ..model.graph import GraphHeader, save_graph
from ..model.predictor import OnnxPredictor, Predictor
from ..profiles.here import this_machine
from ..profiles.profile import Profile, Runtime
from . import half, ptq, rules
from .budget import HALF, INT8, Budget, drops
from .calibration import Method
from .fp16 import emulated, kept_float, to_fp16
from .maps import Example
from .page import EXAMPLES, page
from .parity import Measured, judge
from .picture import save_audit
from .race import Duel
from .report import (
    Report,
    Row,
    calibrated,
    in_forms,
    metrics,
    named,
    rows,
    rows_by_rules,
    sentence,
    trial,
)
from .source import Asked, Source, opened

FLOAT: Final = "fp32.onnx"
REPORT, PAGE, PICTURE = "quantize.json", "report.html", "audit.png"
CACHE: Final = "calibration.npz"

MADE: Final = ("int8.onnx", "fp16.onnx", "openvino.xml", "openvino.bin", FLOAT, PICTURE)
"""What an earlier run may have left, and a later one with another outcome does not write."""

JUDGED: Final = 20
"""How many streets judge."""

TARGET: Final = (
    "rounded to fp16 after every operator, as a target with fp16 units does; fp16.onnx is for "
    "TensorRT and CUDA: ONNX Runtime on a CPU runs it through casts, no faster than fp32"
)
BY_RULES: Final = (
    "the profile's rules decided, nothing was timed: build and time it on the device "
    "(rts2-profile kit times networks there)"
)


@dataclass(frozen=True)
class Order:
    """What is to be quantized, how, and what judges."""

    model: Path
    precision: Precision
    calib: Path
    """The folder of the pairs that calibrate, or `streets`; so is `judge`."""
    pairs: int
    method: Method
    judge: Path
    max_d1_drop: float | None
    """In points, as `max_miou_drop`; None for what is usual at the precision."""
    max_miou_drop: float | None
    asked: Asked
    """How a checkpoint is exported."""
    threads: int
    seed: int

    @property
    def budget(self) -> Budget:
        """What may be lost."""
        usual = INT8 if self.precision == "int8" else HALF
        return Budget(
            usual.max_d1_drop if self.max_d1_drop is None else self.max_d1_drop,
            usual.max_miou_drop if self.max_miou_drop is None else self.max_miou_drop,
        )


class Run:
    """One quantization; `folder` holds what lies in between, `out` gets what comes of it.

    Raises `UsageError` for an order that does not fit its model, and as the ways do in which a
    network is quantized.
    """

    def __init__(self, order: Order, profile: Profile | None, out: Path, folder: Path) -> None:
        self.order, self.profile, self.out, self.folder = order, profile, out, folder
        self.source = Source(order.model, _at_opset(order, profile), folder)
        self.frames = _samples(order.judge, self.source.resolution, "val", JUDGED, 0)
        """What judges; streets come at the network's own size."""

    def done(self) -> Report:
        """Quantizes, judges, writes."""
        here = self.profile is not None and self.profile.machine is not None
        if self.order.precision == "int8":
            return self._integers_here() if here else self._integers_by_rules()
        return self._half_here() if here else self._half_for_target()

    @cached_property
    def pairs(self) -> Sequence[Sample]:
        """What calibrates."""
        order, size = self.order, self.source.resolution
        return _samples(order.calib, size, "train", order.pairs, order.seed)[: order.pairs]

    def _integers_here(self) -> Report:
        order = self.order
        setting = ptq.Setting(
            self.pairs,
            self.frames,
            order.budget,
            order.method,
            order.threads,
            self.out / CACHE,
            self.folder,
        )
        found = ptq.quantize(self.source, setting)
        own = self._saved(found.model, found.header, "int8.onnx")
        why = sentence(found.delivered, "int8", found.duel, found.within, "fp32")
        report = self._report(found.header, found.parent, own, found.measured, why, found.delivered)
        report = replace(
            self._timed(report, found.duel, "onnxruntime"),
            layers=rows(found),
            calibration=calibrated(found.calibration, order.method, str(order.calib)),
            forms=in_forms(found.float_forms, found.header.forms),
            trials=tuple(map(trial, found.trials)),
        )
        made = {own.name: own} if found.delivered else {}
        return self._written(report, found.parent, made, OnnxPredictor(own))

    def _half_here(self) -> Report:
        order = self.order
        found = half.quantize(
            self.source, order.precision, self.frames, order.budget, order.threads
        )
        beside = "fp32 in ONNX Runtime"
        why = sentence(found.delivered, order.precision, found.duel, found.within, beside)
        weights = found.graph.with_suffix(".bin")
        report = self._report(
            found.header, found.parent, weights, found.measured, why, found.delivered
        )
        forms = in_forms(found.float_forms, found.header.forms)
        report = replace(self._timed(report, found.duel, "openvino"), forms=forms)
        files = {"openvino.xml": found.graph, "openvino.bin": weights}
        made = files if found.delivered else {}
        return self._written(report, found.parent, made, found.predictor)

    def _integers_by_rules(self) -> Report:
        order = self.order
        found = rules.quantize(
            self.source, self.pairs, self.frames, order.budget, order.method, self.out / CACHE
        )
        own = self._saved(found.model, found.header, "int8.onnx")
        why = BY_RULES if found.within else "int8 does not keep the accuracy budget"
        report = replace(
            self._report(found.header, found.parent, own, found.measured, why, found.within),
            layers=rows_by_rules(found.layers, found.kept, found.effects),
            calibration=calibrated(found.calibration, order.method, str(order.calib)),
        )
        made = {own.name: own} if found.within else {}
        return self._written(report, found.parent, made, OnnxPredictor(own))

    def _half_for_target(self) -> Report:
        if self.order.precision == "bf16":
            raise UsageError("bf16 is for CPUs, through OpenVINO: give --device cpu, or fp16")
        parent = self.source.graph(next(iter(self.source.forms), None))
        model, header = opened(parent)
        header = header.model_copy(update={"precision": "fp16"})
        lowered = to_fp16(model)
        own = self._saved(lowered, header, "fp16.onnx")
        rounded = OnnxPredictor(self._saved(emulated(lowered), header, "emulated.onnx"))
        found = judge(OnnxPredictor(parent), rounded, self.frames)
        drops(found)
        within = self.order.budget.holds(found)
        why = TARGET if within else "fp16 does not keep the accuracy budget: fp32 is delivered"
        convs = (node.name for node in model.graph.node if node.op_type == "Conv")
        report = replace(
            self._report(header, parent, own, found, why, within),
            layers=(
                *(Row(name, "fp16", None) for name in convs),
                *(Row(kept.layer, "fp32", kept.reason) for kept in kept_float(model)),
            ),
        )
        return self._written(report, parent, {own.name: own} if within else {}, rounded)

    def _report(
        self,
        header: GraphHeader,
        parent: Path,
        own: Path,
        found: Measured,
        why: str,
        delivered: bool,
    ) -> Report:
        """What every way has in common, as if nothing had been timed."""
        precision = self.order.precision
        return Report(
            network=named(header),
            precision=precision,
            outcome=precision if delivered else "fp32",
            why=why,
            device=None if self.profile is None else self.profile.name,
            runtime="tensorrt",
            evidence="rules",
            machine=None,
            measured_on=f"{len(self.frames)} frames of {self.order.judge}",
            reference=metrics(found.reference, parent.stat().st_size),
            quantized=metrics(found.other, own.stat().st_size, found.sqnr_db),
            budget=self.order.budget,
        )

    def _timed(self, report: Report, duel: Duel, runtime: Runtime) -> Report:
        """The same with what a duel on this machine came to."""
        known = this_machine(runtime, self.order.threads)
        title = {"onnxruntime": "ONNX Runtime", "openvino": "OpenVINO"}[runtime]
        version = f"{title} {known.versions[runtime]}"
        return replace(
            report,
            runtime=runtime,
            evidence="measured",
            machine=f"{known.processor}, {known.threads} threads, {version}, {known.date}",
            reference=replace(report.reference, latency_ms=duel.parent_ms),
            quantized=replace(report.quantized, latency_ms=duel.own_ms),
            speedup=1 / duel.ratio,
            speedup_error=duel.timing.error,
        )

    def _saved(self, model: ModelProto, header: GraphHeader, name: str) -> Path:
        save_graph(model, header, self.folder / name)
        return self.folder / name

    def _written(
        self, report: Report, parent: Path, made: dict[str, Path], other: Predictor
    ) -> Report:
        """The report with its files, all of them in the output folder, the report itself last."""
        files = made if self.source.given else {FLOAT: parent, **made}
        for name, path in files.items():
            write_bytes(self.out / name, path.read_bytes())
        for name in MADE:
            if name not in files:
                remove(self.out / name)
        picture = [PICTURE] if any(row.float_ms is not None for row in report.layers) else []
        complete = replace(report, files=(*files, *picture, PAGE, REPORT))
        told = complete.to_json()
        if picture:
            save_audit(told, self.out / PICTURE)
        examples = self._examples(OnnxPredictor(parent), other)
        write_bytes(self.out / PAGE, page(told, examples).encode())
        write_json(self.out / REPORT, told)
        return complete

    def _examples(self, parent: Predictor, other: Predictor) -> list[Example]:
        """The first frames, as both networks see them."""
        found = []
        for frame in self.frames[:EXAMPLES]:
            scene = frame.read()
            before, after = (each.predict(scene.left, scene.right) for each in (parent, other))
            maps = before.disparity, after.disparity
            found.append(Example(scene.name, scene.left, *maps, scene.truth))
        return found


def _at_opset(order: Order, profile: Profile | None) -> Asked:
    """What is asked, at the opset that the device's importer reads, where none is asked for."""
    told = [known.opset for known in profile.runtimes if known.opset] if profile else []
    at_hand = profile is None or profile.machine is not None
    if at_hand or not told or order.asked.opset or order.model.suffix.lower() == ".onnx":
        return order.asked
    return replace(order.asked, opset=min(told))


def _samples(
    folder: Path, size: tuple[int, int], split: str, streets: int, seed: int
) -> Sequence[Sample]:
    """The pairs of a folder in any layout; for the streets their size, split, number and seed."""
    if str(folder) == STREETS:
        return open_dataset(STREETS, split=split, count=streets, size=size, seed=seed)
    layout = "folder" if (folder / "left").is_dir() else "kitti2015"
    return open_dataset(layout, folder)
