"""The command that makes a trained network smaller and faster: rts2-quantize."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Final

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
    whole_between,
)
from ..model.data.catalog import STREETS
from ..model.errors import UsageError
from ..model.files import existing_file, output_folder
from ..model.machine import cores
from ..profiles.profile import Profile, load, names

if TYPE_CHECKING:
    from .report import Metrics, Report, Row
    from .run import Order

HERE: Final = "cpu"
"""The device of int8 and bf16 unless told: the machine at hand."""

PAIRS: Final = 32
"""How many pairs calibrate unless told."""


@command
def quantize(arguments: Sequence[str] | None = None) -> int:
    """The command rts2-quantize: a trained network in lower precision, measured."""
    options = _parser().parse_args(arguments)
    profile = _profile(options)
    order = _order(options)
    out = output_folder(options.out)
    from .run import Run

    with TemporaryDirectory(prefix="rts2.") as folder:
        report = Run(order, profile, out, Path(folder)).done()
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
    return whole_between(text, 1, 100_000)


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


def _order(options: argparse.Namespace) -> Order:
    from .run import Order
    from .source import Asked

    return Order(
        model=existing_file(graph_of(options.model), "a model (a checkpoint or an ONNX file)"),
        precision=options.precision,
        calib=options.calib,
        pairs=options.pairs,
        method=options.method,
        judge=options.eval,
        max_d1_drop=options.max_d1_drop,
        max_miou_drop=options.max_miou_drop,
        asked=Asked(options.resolution, options.stages, options.opset),
        threads=options.threads or cores(),
        seed=options.seed,
    )


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
    figures = (
        (metrics.latency_ms, 1),
        (metrics.d1_all, 2),
        (metrics.epe, 3),
        (metrics.miou, 2),
        (metrics.size_bytes / 1000, 0),
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
