"""The command that makes a trained network smaller and faster: rts2-quantize."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Final

from ..model.arch import Precision
from ..model.box import named_model
from ..model.bundle import graph_of
from ..model.console import (
    KITTI,
    add_output,
    command,
    figure,
    parser,
    print_json,
    resolution,
    screen,
    seed,
)
from ..model.data.catalog import STREETS, open_dataset
from ..model.data.scene import Sample
from ..model.errors import UsageError
from ..model.files import existing_file, output_folder, remove, write_bytes, write_json
from ..model.machine import cores
from ..profiles.profile import Profile, load, names

if TYPE_CHECKING:
    from .budget import Budget
    from .report import Metrics, Report, Row
    from .source import Source

FLOAT, REPORT, PAGE, PICTURE = "fp32.onnx", "quantize.json", "report.html", "audit.png"
CACHE: Final = "calibration.npz"

MADE: Final = (
    "int8.onnx",
    "fp16.onnx",
    "openvino.xml",
    "openvino.bin",
    FLOAT,
    PAGE,
    PICTURE,
    REPORT,
)
"""What an earlier run may have left, and a later one with another outcome does not write."""

HERE: Final = "cpu"
"""The device of int8 and bf16 unless told: the machine at hand."""

PAIRS: Final = 32
"""How many pairs calibrate unless told."""

JUDGED: Final = 20
"""How many streets judge."""

SHOWN: Final = 3
"""How many frames the page shows."""

TARGET: Final = (
    "rounded to fp16 after every operator, as a target with fp16 units does; fp16.onnx is for "
    "TensorRT and CUDA: ONNX Runtime on a CPU runs it through casts, no faster than fp32"
)
BY_RULES: Final = (
    "the profile's rules decided, nothing was timed: build and time it on the device "
    "(rts2-profile kit times networks there)"
)


@command
def quantize(arguments: Sequence[str] | None = None) -> int:
    """The command rts2-quantize: a trained network in lower precision, measured."""
    options = _parser().parse_args(arguments)
    profile = _profile(options)
    path = existing_file(graph_of(options.model), "a model (a checkpoint or an ONNX file)")
    out = output_folder(options.out)
    with TemporaryDirectory(prefix="rts2.") as folder:
        run = _Run(options, profile, path, out, Path(folder))
        report = run.done()
    if options.json:
        print_json(report.to_json())
    else:
        _show(report, out)
    return 0


def _parser() -> argparse.ArgumentParser:
    described = parser(
        "rts2-quantize",
        "A trained network in lower precision: faster where it was measured to be, within what "
        "may be lost in accuracy, or else the float network as it was.",
        "rts2-quantize c8 --precision int8 --calib KITTI --eval KITTI --out c8-int8",
    )
    add = described.add_argument
    text = "a checkpoint (rts2's .safetensors, AnyNet's released .tar) or an .onnx file of rts2"
    text = f"{text}, a bundle, or the name of a network in the box"
    add("model", type=named_model, metavar="MODEL", help=text)
    add("--precision", required=True, choices=("fp16", "bf16", "int8"))
    text = (
        f"{', '.join(names())}, or a profile's JSON file. On the machine at hand (default for int8 "
        "and bf16) layers are timed; for others the profile's rules decide; fp16 without a device "
        "is for TensorRT and CUDA"
    )
    add("--device", metavar="NAME|FILE", help=text)
    text = (
        "pairs that calibrate int8: KITTI 2015 (the folder that holds training/), any pairs "
        f"(left/, right/), or generated {STREETS} (default)"
    )
    add("--calib", type=Path, default=Path(STREETS), metavar=f"DIR|{STREETS}", help=text)
    text = f"how many of them, the first ones (default: {PAIRS})"
    add("--pairs", type=_count, default=PAIRS, metavar="N", help=text)
    text = "how ranges are told from what was seen (default: percentile)"
    add("--method", choices=("minmax", "percentile", "entropy"), default="percentile", help=text)
    text = (
        "pairs with a truth that judge: a folder as for --calib with disparity/ and perhaps "
        f"semantic/, or generated {STREETS} (default)"
    )
    add("--eval", type=Path, default=Path(STREETS), metavar=f"DIR|{STREETS}", help=text)
    text = "points that D1-all may rise (default: 0.3 for int8, 0.05 for fp16 and bf16)"
    add("--max-d1-drop", type=_points, metavar="POINTS", help=text)
    text = "points that mIoU may fall (default: 0.5 for int8, 0.1 for fp16 and bf16)"
    add("--max-miou-drop", type=_points, metavar="POINTS", help=text)
    text = "of the images, for a checkpoint (default: {}x{})".format(*KITTI)
    add("--resolution", type=resolution, metavar="WxH", help=text)
    add("--stages", type=int, metavar="K", help="for a checkpoint: stop after this many stages")
    text = "for a checkpoint: ONNX operator set (TensorRT 8.2 needs 13)"
    add("--opset", type=int, metavar="N", help=text)
    add("--threads", type=_count, metavar="N", help="of the machine at hand (default: all cores)")
    add("--seed", type=seed, default=0, help=f"of the {STREETS} that calibrate (default: 0)")
    add_output(described)
    return described


def _count(text: str) -> int:
    if not (text.isascii() and text.isdigit() and 1 <= int(text) <= 100_000):
        raise argparse.ArgumentTypeError(f"must be a whole number from 1 to 100000, not {text!r}")
    return int(text)


def _points(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 0 <= value <= 100:
        raise argparse.ArgumentTypeError(f"must be from 0 to 100 points, not {text!r}")
    return value


def _profile(options: argparse.Namespace) -> Profile | None:
    """The device that the network is for; None for fp16 that any TensorRT or CUDA device takes.

    Raises `UsageError` where the device does not run the precision.
    """
    if options.device is None and options.precision == "fp16":
        return None
    profile = load(options.device or HERE)
    if profile.machine is not None:
        return profile
    refusal = profile.refusal(options.precision)
    if refusal is not None:
        raise UsageError(f"{profile.title} does not run {options.precision}: {refusal.reason}")
    return profile


class _Run:
    """One quantization, from the options to the files; `folder` holds what lies in between."""

    def __init__(
        self,
        options: argparse.Namespace,
        profile: Profile | None,
        path: Path,
        out: Path,
        folder: Path,
    ) -> None:
        from .source import Asked, Source

        self.options, self.profile, self.out, self.folder = options, profile, out, folder
        asked = Asked(options.resolution, options.stages, self._opset(options, profile))
        self.source: Source = Source(path, asked, folder)
        self.precision: Precision = options.precision
        self.frames = _opened(options.eval, self.source.resolution, "val", JUDGED, 0)
        """What judges; streets come at the network's own size."""
        self.threads = options.threads or cores()

    @staticmethod
    def _opset(options: argparse.Namespace, profile: Profile | None) -> int | None:
        """What the device's importer reads, where the device is not at hand."""
        if options.opset is not None or profile is None or profile.machine is not None:
            given: int | None = options.opset
            return given
        told = [known.opset for known in profile.runtimes if known.opset is not None]
        return min(told) if told and options.model.suffix.lower() != ".onnx" else None

    def done(self) -> Report:
        """Quantizes, judges, writes."""
        here = self.profile is not None and self.profile.machine is not None
        if self.precision == "int8":
            return self._integers_here() if here else self._integers_by_rules()
        return self._half_here() if here else self._half_for_target()

    @property
    def budget(self) -> Budget:
        from .budget import HALF, INT8, Budget

        usual = INT8 if self.precision == "int8" else HALF
        given = self.options.max_d1_drop, self.options.max_miou_drop
        return Budget(
            usual.max_d1_drop if given[0] is None else given[0],
            usual.max_miou_drop if given[1] is None else given[1],
        )

    def _integers_here(self) -> Report:
        from .ptq import Setting, quantize
        from .report import calibrated, in_forms, rows, trial

        setting = Setting(
            self.pairs,
            self.frames,
            self.budget,
            self.options.method,
            self.threads,
            self.out / CACHE,
            self.folder,
        )
        found = quantize(self.source, setting)
        own = self.folder / "int8.onnx"
        self._save(found.model, found.header, own)
        report = self._timed(found, own, "ONNX Runtime", "fp32")
        return self._written(
            _with(
                report,
                layers=rows(found),
                calibration=calibrated(found.calibration, setting.method, str(self.options.calib)),
                forms=in_forms(found.float_forms, found.header.forms),
                trials=tuple(map(trial, found.trials)),
            ),
            {FLOAT: found.parent, "int8.onnx": own} if found.delivered else {FLOAT: found.parent},
        )

    def _half_here(self) -> Report:
        from .half import quantize
        from .report import in_forms

        found = quantize(self.source, self.precision, self.frames, self.budget, self.threads)
        weights = found.graph.with_suffix(".bin")
        report = self._timed(found, weights, "OpenVINO", "fp32 in ONNX Runtime")
        files = {FLOAT: found.parent}
        if found.delivered:
            files |= {"openvino.xml": found.graph, "openvino.bin": found.graph.with_suffix(".bin")}
        forms = in_forms(found.float_forms, found.header.forms)
        return self._written(_with(report, forms=forms), files)

    def _integers_by_rules(self) -> Report:
        from .report import Report, calibrated, metrics, named, rows_by_rules
        from .rules import quantize

        assert self.profile is not None, "int8 is for a device"
        found = quantize(
            self.source,
            self.pairs,
            self.frames,
            self.budget,
            self.options.method,
            self.out / CACHE,
        )
        own = self.folder / "int8.onnx"
        self._save(found.model, found.header, own)
        names = sorted({*found.kept, *found.chosen})
        files = {FLOAT: found.parent, "int8.onnx": own} if found.within else {FLOAT: found.parent}
        report = Report(
            network=named(found.header),
            precision=self.precision,
            outcome="int8" if found.within else "fp32",
            why=BY_RULES if found.within else "no choice of layers keeps the accuracy budget",
            device=self.profile.name,
            runtime="tensorrt",
            evidence="rules",
            machine=None,
            measured_on=self.judged_on,
            reference=metrics(found.measured.reference, found.parent.stat().st_size),
            quantized=metrics(found.measured.other, own.stat().st_size, found.measured.sqnr_db),
            budget=self.budget,
            layers=rows_by_rules(names, found.kept, found.effects),
            calibration=calibrated(found.calibration, self.options.method, str(self.options.calib)),
        )
        return self._written(report, files)

    def _half_for_target(self) -> Report:
        from .budget import drops
        from .fp16 import emulated, kept_float, to_fp16
        from .parity import measure
        from .report import Report, Row, metrics, named
        from .source import opened

        if self.precision == "bf16":
            raise UsageError("bf16 is for CPUs, through OpenVINO: give --device cpu, or fp16")
        parent = self.source.graph(next(iter(self.source.forms), None))
        model, header = opened(parent)
        lowered = to_fp16(model)
        header = header.model_copy(update={"precision": "fp16"})
        own, rounded = self.folder / "fp16.onnx", self.folder / "emulated.onnx"
        self._save(lowered, header, own)
        self._save(emulated(lowered), header, rounded)
        from ..model.predictor import OnnxPredictor

        found = measure(OnnxPredictor(parent), OnnxPredictor(rounded), self._scenes())
        drops(found)
        within = self.budget.holds(found)
        convs = [node.name for node in model.graph.node if node.op_type == "Conv"]
        files = {FLOAT: parent, "fp16.onnx": own} if within else {FLOAT: parent}
        report = Report(
            network=named(header),
            precision=self.precision,
            outcome="fp16" if within else "fp32",
            why=TARGET if within else "fp16 leaves the accuracy budget: fp32 is delivered",
            device=None if self.profile is None else self.profile.name,
            runtime="tensorrt",
            evidence="rules",
            machine=None,
            measured_on=self.judged_on,
            reference=metrics(found.reference, parent.stat().st_size),
            quantized=metrics(found.other, own.stat().st_size, found.sqnr_db),
            budget=self.budget,
            layers=(
                *(Row(name, "fp16", None) for name in convs),
                *(Row(kept.layer, "fp32", kept.reason) for kept in kept_float(model)),
            ),
        )
        return self._written(report, files)

    def _timed(self, found: Any, own: Path, title: str, parent: str) -> Report:
        """What a duel on this machine came to."""
        from .report import Report, latencies, metrics, named, sentence

        assert self.profile is not None, "what is timed is timed on a device"
        measured, duel = found.measured, found.duel
        before, after = latencies(duel)
        return Report(
            network=named(found.header),
            precision=self.precision,
            outcome=self.precision if found.delivered else "fp32",
            why=sentence(found.delivered, self.precision, duel, found.within, parent),
            device=self.profile.name,
            runtime="onnxruntime" if title == "ONNX Runtime" else "openvino",
            evidence="measured",
            machine=self._machine(title),
            measured_on=self.judged_on,
            reference=metrics(measured.reference, found.parent.stat().st_size, latency_ms=before),
            quantized=metrics(measured.other, own.stat().st_size, measured.sqnr_db, after),
            budget=self.budget,
            speedup=1 / duel.ratio,
            speedup_error=duel.timing.error,
        )

    def _machine(self, title: str) -> str:
        from ..profiles.here import this_machine

        runtime = "onnxruntime" if title == "ONNX Runtime" else "openvino"
        known = this_machine(runtime, self.threads)
        return (
            f"{known.processor}, {self.threads} threads, {title} {known.versions[runtime]}, "
            f"{known.date}"
        )

    @cached_property
    def pairs(self) -> Sequence[Sample]:
        """What calibrates."""
        options = self.options
        return _opened(options.calib, self.source.resolution, "train", options.pairs, options.seed)[
            : options.pairs
        ]

    @property
    def judged_on(self) -> str:
        """What judges, in words."""
        return f"{len(self.frames)} frames of {self.options.eval}"

    def _scenes(self) -> Iterator[Any]:
        from ..model.console import progress

        frames = self.frames
        return (frame.read() for frame in progress(frames, "judging", len(frames)))

    @staticmethod
    def _save(model: Any, header: Any, path: Path) -> None:
        from ..model.graph import save_graph

        save_graph(model, header, path)

    def _written(self, report: Report, files: dict[str, Path]) -> Report:
        """The report with its files, all of them in the output folder."""
        given = self.source.given
        kept = {name: path for name, path in files.items() if not (given and name == FLOAT)}
        for name, path in kept.items():
            write_bytes(self.out / name, path.read_bytes())
        for name in MADE:
            if name not in kept:
                remove(self.out / name)
        complete = report.with_files([*kept, REPORT])
        write_json(self.out / REPORT, complete.to_json())
        return complete


def _with(report: Report, **values: Any) -> Report:
    from dataclasses import replace

    return replace(report, **values)


def _opened(
    folder: Path, size: tuple[int, int], split: str, streets: int, seed: int
) -> Sequence[Sample]:
    """The pairs of a folder in any layout; for the streets their size, split, number and seed."""
    if str(folder) == STREETS:
        return open_dataset(STREETS, split=split, count=streets, size=size, seed=seed)
    layout = "folder" if (folder / "left").is_dir() else "kitti2015"
    return open_dataset(layout, folder)


def _show(report: Report, out: Path) -> None:
    console = screen()
    console.print(report.network, markup=False)
    if any(row.float_ms is not None for row in report.layers):
        console.print(_audit(report.layers))
        console.print("")
    console.print(_metrics(report))
    counts = Counter(_kind(row.reason) for row in report.kept if row.reason)
    for line in (
        f"outcome     {report.outcome}: {report.why}",
        f"judged on   {report.measured_on}",
        *(f"kept float  {count} layers, {reason}" for reason, count in counts.items()),
        *([f"timed on    {report.machine}"] if report.machine else []),
        f"written     {out}/  {'  '.join(report.files)}",
    ):
        console.print(line, markup=False, soft_wrap=True)


def _kind(reason: str) -> str:
    """A reason without the figures of one layer."""
    return reason.split(": ", 1)[0].split(" (", 1)[0]


def _metrics(report: Report) -> Any:
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for index, column in enumerate(("", "ms", "D1-all %", "EPE px", "mIoU %", "kB", "SQNR dB")):
        table.add_column(column, justify="right" if index else "left")
    table.add_row("fp32", *_row(report.reference))
    table.add_row(report.precision, *_row(report.quantized))
    return table


def _row(metrics: Metrics) -> list[str]:
    size = None if metrics.size_bytes is None else metrics.size_bytes / 1000
    figures = (
        (metrics.latency_ms, 1),
        (metrics.d1_all, 2),
        (metrics.epe, 3),
        (metrics.miou, 2),
        (size, 0),
        (metrics.sqnr_db, 1),
    )
    return [figure(value, digits) for value, digits in figures]


def _audit(rows: Sequence[Row]) -> Any:
    """The kernel audit: a row a layer."""
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    columns = ("layer", "runs in", "fp32 ms", "int8 ms", "SQNR dB", "D1 +", "EPE +", "kernels")
    for column in columns:
        table.add_column(column, justify="left" if column in ("layer", "kernels") else "right")
    for row in rows:
        kernels = row.quantized_kernels if row.precision == "int8" else row.float_kernels
        figures = (
            (row.float_ms, 2),
            (row.quantized_ms, 2),
            (row.sqnr_db, 1),
            (row.d1_change, 3),
            (row.epe_change, 4),
        )
        told = [figure(value, digits) for value, digits in figures]
        table.add_row(row.layer, row.precision, *told, " ".join(kernels))
    return table
