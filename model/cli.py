"""The commands that use and judge a network: rts2-infer and rts2-eval."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from . import evaluation
from .box import DEFAULT, SHIPPED, named_model
from .cloud import Calibration, cloud, read_calibration, write_cloud
from .console import (
    add_output,
    command,
    figure,
    parser,
    positive,
    print_json,
    progress,
    resolution,
    screen,
    seed,
)
from .data.catalog import DATASETS, STREETS, open_dataset, require_generated
from .data.images import (
    LARGEST_PX,
    image_size,
    read_rgb,
    require_same_size,
    storable,
    write_disparity,
    write_image,
    write_indexed,
)
from .data.layout import IMAGES, images_of
from .data.scene import Sample, fingerprint, require_crop_fits
from .errors import UsageError
from .files import output_folder
from .pictures import PALETTE, coloured, legend, overlay
from .submission import Part, finish, new_folder, write_frame

if TYPE_CHECKING:
    from rich.table import Table

    from .data.images import Bytes
    from .predictor import Estimate, Predictor

MODEL = (
    f"{', '.join(SHIPPED)} in the box, a checkpoint (rts2's .safetensors, AnyNet's released .tar), "
    "or an .onnx file of rts2"
)

FOREGROUND = {
    "obj_map": "the data set's object map",
    "instance": "the numbered instances, as there is no obj_map",
}
"""What D1-fg and D1-bg rest on, in words."""

OBJECT_SIZES = {
    "published": "the data set's own evaluation",
    "data set": "the very images judged, as the data set publishes none",
}
"""Whose average object sizes iIoU rests on, in words."""

TITLES = {
    "d1_all": "D1-all %",
    "d1_bg": "D1-bg %",
    "d1_fg": "D1-fg %",
    "d1_noc": "D1-noc %",
    "epe": "EPE px",
    "miou": "mIoU %",
    "miou_category": "mIoU cat. %",
    "iiou": "iIoU %",
    "iiou_category": "iIoU cat. %",
    "pacc": "pAcc %",
}
"""The columns of rts2-eval's table, by figure."""

LEGEND = "classes.png"
"""Which colour of a picture is which class, once for all pairs of a folder."""

SHOWN_IMAGES = 20
"""With more images than this the table has the totals alone."""

SUBMITTED = "kitti2015"
"""The data set whose servers take a submission."""

SMALLEST_PX = 32
"""Below this an image has no feature at 1/32."""


@dataclass(frozen=True)
class Pair:
    """Two image files of one size."""

    name: str
    left: Path
    right: Path
    size: tuple[int, int]


@command
def infer(arguments: Sequence[str] | None = None) -> int:
    """The command rts2-infer: disparity, semantics and points of pairs or folders of pairs."""
    options = _infer_parser().parse_args(arguments)
    calibration = _calibration(options)
    pairs = _pairs(options.left, options.right)
    if calibration is not None:
        for pair in pairs:
            calibration.require_fits(pair.size)
    predictor = _open(options.model)
    _warm(predictor, pairs, options.stages)
    folder = output_folder(options.out)
    results, legend_file = [], None
    for pair in progress(pairs, "pairs", len(pairs)):
        left, right = read_rgb(pair.left), read_rgb(pair.right)
        estimate = predictor.predict(left, right, options.stages)
        files = _write(folder, pair.name, left, estimate, calibration, options.max_disparity)
        results.append(_summary(pair, estimate, files))
        if estimate.semantic is not None and legend_file is None:
            legend_file = LEGEND
            write_image(folder / LEGEND, legend())
    if options.json:
        print_json(
            {
                "schema": "rts2.infer/1",
                **_about(options.model, predictor),
                "legend": legend_file,
                "pairs": results,
            }
        )
    else:
        _show_pairs(results, legend_file, _title(options.model, predictor), folder)
    return 0


@command
def evaluate(arguments: Sequence[str] | None = None) -> int:
    """The command rts2-eval: a network's errors on a data set, per image and per stage."""
    options = _evaluate_parser().parse_args(arguments)
    options.split = options.split or DATASETS[options.dataset].judged
    samples = _samples(options)
    folder = None if options.submission is None else _submission_folder(options)
    predictor = _open(options.model)
    scores = _judged(predictor, samples, options, folder)
    parts = () if folder is None else finish(folder, {each.name: each.size for each in samples})
    report = {
        "schema": "rts2.eval/1",
        **_about(options.model, predictor),
        "dataset": options.dataset,
        "split": options.split,
        "samples": len(samples),
        "data": fingerprint(samples),
        "crop": options.crop,
        "foreground": samples[0].foreground,
        **evaluation.report(scores, options.dataset),
        "submission": None if folder is None else _submitted(folder, parts),
    }
    if options.json:
        print_json(report)
    else:
        _show_scores(report, f"{_title(options.model, predictor)} · {options.dataset}", parts)
    return 0


def _judged(
    predictor: Predictor,
    samples: Sequence[Sample],
    options: argparse.Namespace,
    folder: Path | None,
) -> list[tuple[str, evaluation.Scores]]:
    """Every image's name and scores; its maps go into `folder`, if there is one."""
    scores = []
    judged = evaluation.evaluate(predictor, samples, options.stages, options.crop)
    for image in progress(judged, "images", len(samples)):
        scores.append((image.name, image.scores))
        if folder is not None:
            write_frame(folder, image.name, image.estimates[-1])
    return scores


def _samples(options: argparse.Namespace) -> Sequence[Sample]:
    """The data set that the options name; what cannot be judged shows before a network runs."""
    generated = ("count", "size", "seed")
    given = (name for name in generated if getattr(options, name) is not None)
    require_generated(options.dataset, given)
    if options.seed is not None and options.split != "train":
        raise UsageError("the streets that judge have one seed; --seed is for --split train")
    samples = open_dataset(
        options.dataset,
        options.data,
        options.split,
        count=options.count,
        size=options.size,
        seed=options.seed or 0,
    )
    for sample in samples if options.crop else ():
        require_crop_fits(options.crop, sample.size, sample.name)
    return samples


def _submission_folder(options: argparse.Namespace) -> Path:
    """The new folder for a submission, where the options allow one."""
    if options.dataset != SUBMITTED:
        raise UsageError(f"--submission is for --dataset {SUBMITTED}, not {options.dataset}")
    if options.crop is not None:
        raise UsageError("a submission needs whole images; leave --crop out")
    return new_folder(options.submission)


def _infer_parser() -> argparse.ArgumentParser:
    command = parser(
        "rts2-infer",
        "Disparity, semantics and metric points of stereo pairs. LEFT and RIGHT are two rectified "
        "images, or two folders of equally named ones.",
        "rts2-infer left.png right.png --focal 721.5 --baseline 0.54",
    )
    command.add_argument("left", type=Path, metavar="LEFT")
    command.add_argument("right", type=Path, metavar="RIGHT")
    text = f"{MODEL} (default: {DEFAULT})"
    command.add_argument("--model", type=named_model, default=DEFAULT, metavar="MODEL", help=text)
    command.add_argument("--stages", type=int, metavar="K", help="stop after this many stages")
    command.add_argument(
        "--focal", type=positive, metavar="PX", help="focal length in pixels, for a point cloud"
    )
    command.add_argument(
        "--baseline", type=positive, metavar="M", help="distance of the cameras in metres"
    )
    command.add_argument(
        "--calib", type=Path, metavar="FILE", help="Middlebury's calib.txt or a KITTI calibration"
    )
    command.add_argument(
        "--max-disparity",
        type=positive,
        metavar="PX",
        help="where the colours end (default: each map's 98th percentile)",
    )
    add_output(command)
    return command


def _evaluate_parser() -> argparse.ArgumentParser:
    command = parser(
        "rts2-eval",
        "A network's errors on a data set: per stage over all pixels, and per image.",
        "rts2-eval kitti2015.tar --dataset kitti2015 --data KITTI --crop 1232x368",
    )
    add = command.add_argument
    add("model", type=named_model, metavar="MODEL", help=MODEL)
    add("--dataset", required=True, choices=DATASETS)
    add("--data", type=Path, metavar="DIR", help=f"its folder; {STREETS} has none")
    text = "one of the data set's splits, or a file that lists frames (default: what judges)"
    add("--split", metavar="NAME", help=text)
    add("--stages", type=int, metavar="K", help="stop after this many stages")
    text = "judge the bottom-right corner alone (AnyNet's protocol: 1232x368)"
    add("--crop", type=resolution, metavar="WxH", help=text)
    text = "also write what KITTI's servers take (--split test) into this new folder"
    add("--submission", type=Path, metavar="DIR", help=text)
    add("--count", type=int, metavar="N", help=f"{STREETS}: how many (default: 200)")
    add("--size", type=resolution, metavar="WxH", help=f"{STREETS}: of the images")
    add("--seed", type=seed, metavar="S", help=f"{STREETS}, --split train: which (default: 0)")
    add_output(command, out=None)
    return command


def _open(path: Path) -> Predictor:
    from .predictor import open_model

    return open_model(path)


def _calibration(options: argparse.Namespace) -> Calibration | None:
    loose = (options.focal, options.baseline)
    if options.calib is not None:
        if loose != (None, None):
            raise UsageError("--calib holds focal length and baseline; leave the others out")
        return read_calibration(options.calib)
    if loose == (None, None):
        return None
    if None in loose:
        raise UsageError("a point cloud needs both --focal PX and --baseline M, or --calib FILE")
    return Calibration(*loose)


def _pairs(left: Path, right: Path) -> list[Pair]:
    """The pairs that two images or two folders make, each of one size."""
    if left.is_dir() != right.is_dir():
        folder, other = (left, right) if left.is_dir() else (right, left)
        raise UsageError(
            f"LEFT and RIGHT must be two images or two folders: {folder} is a folder, "
            f"{other} is not"
        )
    names = [(left, right)] if not left.is_dir() else _partners(left, right)
    return [_pair(a, b) for a, b in names]


def _pair(left: Path, right: Path) -> Pair:
    size = require_same_size({left: image_size(left), right: image_size(right)})
    if min(size) < SMALLEST_PX:
        given = "{}x{}".format(*size)
        raise UsageError(f"images need sides of {SMALLEST_PX} pixels or more: {left} is {given}")
    return Pair(left.stem, left, right, size)


def _partners(left: Path, right: Path) -> list[tuple[Path, Path]]:
    """The equally named images of two folders; one without partner is an error."""
    found = [images_of(folder) for folder in (left, right)]
    for folder, images, others in ((right, found[1], found[0]), (left, found[0], found[1])):
        lacking = sorted(others.keys() - images.keys())
        if lacking:
            raise UsageError(
                f"every image needs a partner of its name: {folder} has no {lacking[0]} "
                f"({len(others)} images against {len(images)})"
            )
    if not found[0]:
        raise UsageError(f"a folder must hold images ({', '.join(IMAGES)}); {left} holds none")
    return [(found[0][stem], found[1][stem]) for stem in sorted(found[0])]


def _warm(predictor: Predictor, pairs: list[Pair], stages: int | None) -> None:
    """Runs one pair of each size: what does not fit shows before anything is written or timed."""
    for pair in {pair.size: pair for pair in reversed(pairs)}.values():
        predictor.predict(read_rgb(pair.left), read_rgb(pair.right), stages)


def _write(
    folder: Path,
    name: str,
    image: Bytes,
    estimate: Estimate,
    calibration: Calibration | None,
    highest_px: float | None,
) -> list[str]:
    """Writes everything that one estimate gives; returns the names of the files."""
    files: list[Path] = []

    def named(what: str) -> Path:
        files.append(folder / f"{name}_{what}")
        return files[-1]

    saturated = write_disparity(named("disparity.png"), estimate.disparity)
    if saturated:
        note = "%s: %d pixels exceed %.3f px, the most that the format holds"
        logging.getLogger(__name__).warning(note, files[0], saturated, LARGEST_PX)
    write_image(named("color.png"), coloured(estimate.disparity, highest_px))
    if estimate.semantic is not None:
        write_indexed(named("semantic.png"), estimate.semantic, PALETTE)
        write_image(named("overlay.png"), overlay(image, estimate.semantic))
    if calibration is not None:
        write_cloud(named("cloud.ply"), cloud(estimate.disparity, image, calibration))
    return [path.name for path in files]


def _summary(pair: Pair, estimate: Estimate, files: list[str]) -> dict[str, Any]:
    """One pair's line of the report; its range is that of the file, none without a known pixel.

    A network's residuals may lead below 0, where no disparity lies and no file holds one.
    """
    known = storable(estimate.disparity)
    known = known[np.isfinite(known)]
    return {
        "name": pair.name,
        "size": pair.size,
        "stage": estimate.stage,
        "disparity_px": [float(known.min()), float(known.max())] if known.size else None,
        "network_ms": 1000 * estimate.seconds,
        "files": files,
    }


def _about(path: Path, predictor: Predictor) -> dict[str, Any]:
    """What a report says of its model."""
    arch = None if predictor.arch is None else predictor.arch.model_dump(mode="json")
    return {"model": str(path), "arch": arch, "origin": predictor.origin}


def _submitted(folder: Path, parts: Sequence[Part]) -> dict[str, Any]:
    """What a report says of a submission."""
    return {"folder": str(folder), "parts": [part.to_json() for part in parts]}


def _show_pairs(
    results: list[dict[str, Any]], legend_file: str | None, title: str, folder: Path
) -> None:
    table = _table("pair", "size", "disparity px", "network ms", "files")
    for result in results:
        low, high = result["disparity_px"] or (None, None)
        table.add_row(
            result["name"],
            "{}x{}".format(*result["size"]),
            f"{figure(low, 1)} – {figure(high, 1)}",
            figure(result["network_ms"], 0),
            " ".join(name.removeprefix(f"{result['name']}_") for name in result["files"]),
        )
    console = screen()
    console.print(title)
    console.print(table)
    console.print("network ms: one run each, the first of each size after a warm-up")
    console.print(f"written   {folder}/  NAME_…  {legend_file or ''}".rstrip(), soft_wrap=True)


def _show_scores(report: dict[str, Any], title: str, parts: Sequence[Part]) -> None:
    count = len({image["name"] for image in report["images"]})
    images = report["images"] if count <= SHOWN_IMAGES else []
    rows = [*images, *({"name": "all pixels"} | stage for stage in report["stages"])]
    known = [name for name in TITLES if any(row[name] is not None for row in rows)]
    console = screen()
    console.print(title)
    if known:
        console.print(_figures_table(rows, known))
    else:
        console.print(f"{count} images, of which no truth is known: nothing to judge")
    notes = (*_notes(report), *(f"submission: {part.told()}" for part in parts))
    for line in notes:
        console.print(line, soft_wrap=True)


def _figures_table(rows: Sequence[dict[str, Any]], known: Sequence[str]) -> Table:
    """One row an image and stage; columns that nobody knows are left out."""
    table = _table("image", "stage", *(TITLES[name] for name in known))
    for index, row in enumerate(rows):
        figures = (figure(row[name], 2) for name in known)
        last = index + 1 == len(rows) or rows[index + 1]["name"] != row["name"]
        table.add_row(row["name"], figure(row["stage"], 0), *figures, end_section=last)
    return table


def _notes(report: dict[str, Any]) -> list[str]:
    """What the figures rest on, in words."""
    count = len({image["name"] for image in report["images"]})
    missing = max(stage["missing"] for stage in report["stages"])
    notes = [f"{count} images, one by one in --json"] if count > SHOWN_IMAGES else []
    if missing:
        notes.append(f"{missing} pixels had no estimate and were filled from the background")
    if report["foreground"] is not None:
        notes.append(f"foreground: {FOREGROUND[report['foreground']]}")
    if report["object_sizes"] is not None:
        notes.append(f"iIoU: average object sizes of {OBJECT_SIZES[report['object_sizes']]}")
    if report["submission"] is not None and report["split"] != "test":
        notes.append("submission: these are training frames; the servers take --split test")
    return notes


def _table(*columns: str) -> Table:
    """A table of figures behind one column of names."""
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for index, column in enumerate(columns):
        table.add_column(column, justify="right" if index and column != "files" else "left")
    return table


def _title(model: Path, predictor: Predictor) -> str:
    """The file, its network, and how its weights came to be."""
    label = "an ONNX graph" if predictor.arch is None else predictor.arch.label()
    named = f"{model.name} · {label}"
    return named if predictor.origin is None else f"{named} · {predictor.origin}"
