"""The command that makes a trained network smaller and faster: rts2-quantize."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Final

from ..model.box import named_model
from ..model.console import (
    KITTI,
    add_output,
    command,
    figure,
    parser,
    print_json,
    progress,
    resolution,
    screen,
)
from ..model.data.catalog import STREETS, open_dataset
from ..model.data.scene import Sample
from ..model.errors import UsageError
from ..model.files import existing_file, output_folder, write_bytes, write_json

if TYPE_CHECKING:
    from onnx import ModelProto

    from ..model.graph import GraphHeader
    from .parity import Measured
    from .report import Metrics, Report

FLOAT, QUANTIZED, REPORT = "fp32.onnx", "fp16.onnx", "quantize.json"

STREETS_JUDGED: Final = 20
"""How many streets --eval takes."""

EXPORT = ("resolution", "stages", "opset")
"""The options that shape the export of a checkpoint."""

NOTE = (
    "rounded to fp16 after every operator, as a target with fp16 units does; fp16.onnx is for "
    "TensorRT and CUDA: ONNX Runtime on a CPU runs it through casts, no faster than fp32"
)


@command
def quantize(arguments: Sequence[str] | None = None) -> int:
    """The command rts2-quantize: a trained network in lower precision, measured."""
    options = _parser().parse_args(arguments)
    if options.precision == "int8":
        raise UsageError("int8 is not built yet in this version, fp16 is: --precision fp16")
    existing_file(options.model, "a model (a checkpoint or an ONNX file)")
    frames = _frames(options)
    out = output_folder(options.out)
    with TemporaryDirectory() as folder:
        report = _quantized(options, frames, Path(folder), out)
    write_json(out / REPORT, report.to_json())
    if options.json:
        print_json(report.to_json())
    else:
        _show(report, out)
    return 0


def _parser() -> argparse.ArgumentParser:
    command = parser(
        "rts2-quantize",
        "A trained network in lower precision, with what it costs in accuracy.",
        "rts2-quantize kitti2015.tar --precision fp16 --eval KITTI --out kitti2015-fp16",
    )
    text = "a checkpoint (rts2's .safetensors, AnyNet's released .tar) or an .onnx file of rts2"
    text = f"{text}, or the name of a network in the box"
    command.add_argument("model", type=named_model, metavar="MODEL", help=text)
    command.add_argument("--precision", required=True, choices=("fp16", "int8"))
    text = (
        "D1, EPE and mIoU before and after: on KITTI 2015 (the folder that holds training/), on "
        f"any pairs (left/, right/, disparity/), or on generated {STREETS}"
    )
    command.add_argument("--eval", type=Path, metavar=f"DIR|{STREETS}", help=text)
    text = "of the images, for a checkpoint (default: {}x{})".format(*KITTI)
    command.add_argument("--resolution", type=resolution, metavar="WxH", help=text)
    text = "for a checkpoint: stop after this many stages"
    command.add_argument("--stages", type=int, metavar="K", help=text)
    text = "for a checkpoint: ONNX operator set (TensorRT 8.2 needs 13)"
    command.add_argument("--opset", type=int, metavar="N", help=text)
    add_output(command)
    return command


def _frames(options: argparse.Namespace) -> Sequence[Sample]:
    """What --eval names; streets come at the network's own size."""
    folder: Path | None = options.eval
    if folder is None:
        return ()
    if str(folder) == STREETS:
        return open_dataset(STREETS, count=STREETS_JUDGED, size=_resolution(options))
    layout = "folder" if (folder / "left").is_dir() else "kitti2015"
    return open_dataset(layout, folder)


def _resolution(options: argparse.Namespace) -> tuple[int, int]:
    """Width and height of the images that the network is for."""
    if options.model.suffix.lower() != ".onnx":
        return options.resolution or KITTI
    from ..model.graph import read_header

    return read_header(options.model).resolution


def _quantized(
    options: argparse.Namespace, frames: Sequence[Sample], folder: Path, out: Path
) -> Report:
    """Quantizes and measures in `folder`; what passed is written to `out`."""
    from ..model.graph import header_of, load_graph, save_graph
    from .fp16 import emulated, kept_float, to_fp16
    from .report import Report, metrics

    source = _float_graph(options, folder)
    model = load_graph(source)
    header = header_of(model, source)
    if header.precision != "fp32":
        raise UsageError(f"a float graph is needed: {source} is {header.precision} already")
    lowered = to_fp16(model)
    header = header.model_copy(update={"precision": "fp16"})
    save_graph(lowered, header, folder / QUANTIZED)
    save_graph(emulated(lowered), header, folder / "emulated.onnx")
    measured = _measured(source, folder / "emulated.onnx", frames, header)
    names = [QUANTIZED, FLOAT] if source.parent == folder else [QUANTIZED]
    for name in names:
        write_bytes(out / name, (folder / name).read_bytes())
    scenes = f"{len(frames)} frames of {options.eval}" if frames else "one synthetic pair"
    return Report(
        network=_named(header),
        precision=header.precision,
        scenes=scenes,
        reference=metrics(measured.reference, source.stat().st_size),
        quantized=metrics(measured.other, (folder / QUANTIZED).stat().st_size, measured.sqnr_db),
        kept=tuple(kept_float(model)),
        layers=_convolutions(model),
        files=(*names, REPORT),
    )


def _float_graph(options: argparse.Namespace, folder: Path) -> Path:
    """The ONNX file given, or the export of the checkpoint given."""
    source: Path = options.model
    given = [name for name in EXPORT if getattr(options, name) is not None]
    if source.suffix.lower() == ".onnx":
        if given:
            raise UsageError(f"--{given[0]} is for checkpoints; {source} is exported already")
        return source
    from ..model.checkpoint import load
    from ..model.export import OPSET, export

    network, header = load(source)
    size, opset = _resolution(options), options.opset or OPSET
    export(network, folder / FLOAT, size, header.origin, opset, options.stages)
    return folder / FLOAT


def _measured(
    reference: Path, other: Path, frames: Sequence[Sample], header: GraphHeader
) -> Measured:
    from ..model.predictor import open_model
    from .parity import measure, synthetic_scene

    models = open_model(reference), open_model(other)
    if not frames:
        return measure(*models, [synthetic_scene(header.resolution)])
    shown = progress(frames, "images", len(frames))
    return measure(*models, (frame.read() for frame in shown))


def _named(header: GraphHeader) -> str:
    width, height = header.resolution
    return f"{header.arch.label()} · {width}×{height} · {header.origin}"


def _convolutions(model: ModelProto) -> tuple[str, ...]:
    return tuple(node.name for node in model.graph.node if node.op_type == "Conv")


def _show(report: Report, out: Path) -> None:
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for index, column in enumerate(("", "D1-all %", "EPE px", "mIoU %", "kB", "SQNR dB")):
        table.add_column(column, justify="right" if index else "left")
    table.add_row("fp32", *_row(report.reference))
    table.add_row(report.precision, *_row(report.quantized))
    counts = Counter(kept.reason for kept in report.kept)
    console = screen()
    console.print(report.network, markup=False)
    console.print(table)
    for line in (
        f"measured on {report.scenes}, {NOTE}",
        *(f"kept float  {count} operators, {reason}" for reason, count in counts.items()),
        f"written     {out}/  {'  '.join(report.files)}",
    ):
        console.print(line, markup=False, soft_wrap=True)


def _row(metrics: Metrics) -> list[str]:
    figures = ((metrics.d1_all, 2), (metrics.epe, 3), (metrics.miou, 2))
    texts = [figure(value, digits) for value, digits in figures]
    return [*texts, figure(metrics.size_bytes / 1000, 0), figure(metrics.sqnr_db, 1)]
