"""The commands that use and judge a network: rts2-infer and rts2-eval."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

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
)
from .data.images import (
    LARGEST_PX,
    image_size,
    read_rgb,
    require_same_size,
    write_disparity,
    write_image,
    write_indexed,
)
from .data.kitti import samples
from .data.scene import Sample, require_crop_fits
from .errors import UsageError
from .files import output_folder
from .metrics import Score
from .pictures import PALETTE, coloured, overlay

if TYPE_CHECKING:
    from rich.table import Table

    from .data.images import Bytes
    from .predictor import Estimate, Predictor

DATASETS: dict[str, Callable[[Path], tuple[Sample, ...]]] = {"kitti2015": samples}
"""What rts2-eval can read, by the name that --dataset takes."""

SUFFIXES = (".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp")
"""What counts as an image in a folder."""

MODEL = "a checkpoint (rts2's .safetensors, AnyNet's released .tar) or an .onnx file of rts2"

FOREGROUND = {
    "obj_map": "the data set's object map",
    "instance": "the numbered instances, as there is no obj_map",
}
"""What D1-fg and D1-bg rest on, in words."""

SMALLEST_PX = 32
"""Below this an image has no feature at 1/32."""

Scores = dict[int | None, Score]


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
    if options.model is None:
        raise UsageError(f"--model is required: {MODEL}")
    calibration = _calibration(options)
    pairs = _pairs(options.left, options.right)
    if calibration is not None:
        for pair in pairs:
            calibration.require_fits(pair.size)
    predictor = _open(options.model)
    _warm(predictor, pairs, options.stages)
    folder = output_folder(options.out)
    results = []
    for pair in progress(pairs, "pairs", len(pairs)):
        left, right = read_rgb(pair.left), read_rgb(pair.right)
        estimate = predictor.predict(left, right, options.stages)
        files = _write(folder, pair.name, left, estimate, calibration, options.max_disparity)
        results.append(_summary(pair, estimate, files))
    if options.json:
        print_json({"schema": "rts2.infer/1", **_about(options.model, predictor), "pairs": results})
    else:
        _show_pairs(results, options.model, predictor, folder)
    return 0


@command
def evaluate(arguments: Sequence[str] | None = None) -> int:
    """The command rts2-eval: a network's errors on a data set, per image and per stage."""
    options = _evaluate_parser().parse_args(arguments)
    frames = DATASETS[options.dataset](options.data)
    for frame in frames if options.crop else ():
        require_crop_fits(options.crop, frame.size, frame.name)
    predictor = _open(options.model)
    scores = {
        frame.name: evaluate_frame(predictor, frame, options.stages, options.crop)
        for frame in progress(frames, "images", len(frames))
    }
    total = overall(list(scores.values()))
    if options.json:
        about = _about(options.model, predictor) | {"dataset": options.dataset}
        about |= {"crop": options.crop, "foreground": frames[0].foreground}
        print_json({"schema": "rts2.eval/1", **about, **_report(scores, total)})
    else:
        _show_scores(scores, total, f"{_title(options.model, predictor)} · {options.dataset}")
        if frames[0].foreground is not None:
            print(f"foreground: {FOREGROUND[frames[0].foreground]}")
    return 0


def evaluate_frame(
    predictor: Predictor, frame: Sample, stages: int | None, crop: tuple[int, int] | None
) -> Scores:
    """One frame's score by stage, on the bottom-right crop (width, height) if one is given."""
    from .predictor import judge

    scene = frame.read()
    return judge(predictor, scene if crop is None else scene.bottom_right(*crop), stages)


def overall(scores: Sequence[Scores]) -> Scores:
    """The scores over all pixels of all frames, by stage."""
    return {stage: sum((each[stage] for each in scores), Score()) for stage in scores[0]}


def _infer_parser() -> argparse.ArgumentParser:
    command = parser(
        "rts2-infer",
        "Disparity, semantics and metric points of stereo pairs. LEFT and RIGHT are two rectified "
        "images, or two folders of equally named ones.",
        "rts2-infer left.png right.png --model kitti2015.tar --focal 721.5 --baseline 0.54",
    )
    command.add_argument("left", type=Path, metavar="LEFT")
    command.add_argument("right", type=Path, metavar="RIGHT")
    command.add_argument("--model", type=Path, metavar="FILE", help=f"required: {MODEL}")
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
    command.add_argument("model", type=Path, metavar="MODEL", help=MODEL)
    command.add_argument("--dataset", required=True, choices=sorted(DATASETS))
    command.add_argument(
        "--data", type=Path, required=True, metavar="DIR", help="the folder that holds training/"
    )
    command.add_argument("--stages", type=int, metavar="K", help="stop after this many stages")
    command.add_argument(
        "--crop",
        type=resolution,
        metavar="WxH",
        help="judge the bottom-right corner alone (AnyNet's protocol: 1232x368)",
    )
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
    found = [_images(folder) for folder in (left, right)]
    for folder, images, others in ((right, found[1], found[0]), (left, found[0], found[1])):
        lacking = sorted(others.keys() - images.keys())
        if lacking:
            raise UsageError(
                f"every image needs a partner of its name: {folder} has no {lacking[0]} "
                f"({len(others)} images against {len(images)})"
            )
    if not found[0]:
        raise UsageError(f"a folder must hold images ({', '.join(SUFFIXES)}); {left} holds none")
    return [(found[0][stem], found[1][stem]) for stem in sorted(found[0])]


def _images(folder: Path) -> dict[str, Path]:
    """The images of a folder by stem, which must be unique: it names the results."""
    images: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in SUFFIXES and path.is_file():
            if path.stem in images:
                raise UsageError(
                    f"names must differ before the suffix: {path} and {images[path.stem].name}"
                )
            images[path.stem] = path
    return images


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
    """One pair's line of the report; a map without a finite disparity has no range."""
    known = estimate.disparity[np.isfinite(estimate.disparity)]
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


def _report(scores: dict[str, Scores], total: Scores) -> dict[str, Any]:
    """The figures of rts2.eval/1; what nobody knows is null."""
    return {
        "stages": [
            {
                "stage": stage,
                "d1_all": score.d1_all,
                "d1_bg": score.d1_bg,
                "d1_fg": score.d1_fg,
                "epe": score.epe,
                "miou": score.miou,
                "iiou": None,
                "pacc": score.pacc,
                "pixels": score.everything.pixels,
                "missing": score.missing,
            }
            for stage, score in total.items()
        ],
        "images": [
            {"name": name, "stage": stage, "d1_all": score.d1_all, "epe": score.epe}
            for name, stages in scores.items()
            for stage, score in stages.items()
        ],
    }


def _show_pairs(
    results: list[dict[str, Any]], model: Path, predictor: Predictor, folder: Path
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
    console.print(_title(model, predictor))
    console.print(table)
    console.print("network ms: one run each, the first of each size after a warm-up")
    console.print(f"written   {folder}/  NAME_…")


def _show_scores(scores: dict[str, Scores], total: Scores, title: str) -> None:
    columns = ("D1-all %", "D1-bg %", "D1-fg %", "EPE px", "mIoU %", "pAcc %")
    table = _table("image", "stage", *columns)
    rows = [*scores.items(), ("all pixels", total)]
    for name, stages in rows:
        for stage, score in stages.items():
            figures = (score.d1_all, score.d1_bg, score.d1_fg, score.epe, score.miou, score.pacc)
            table.add_row(name, figure(stage, 0), *(figure(value, 2) for value in figures))
        table.add_section()
    console = screen()
    console.print(title)
    console.print(table)
    missing = max(score.missing for score in total.values())
    if missing:
        console.print(f"{missing} pixels had no estimate and were filled from the background")


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
