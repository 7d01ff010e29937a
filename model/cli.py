"""The commands that use and judge a network: rts2-infer and rts2-eval."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import evaluation
from .box import DEFAULT, SHIPPED, named_model
from .cloud import Calibration, read_calibration
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
    whole_between,
)
from .data.catalog import DATASETS, STREETS, open_dataset, require_generated
from .data.images import read_rgb
from .data.scene import Sample, fingerprint, require_crop_fits
from .errors import UsageError
from .files import output_folder
from .pairs import Pair, pairs_of
from .results import Results
from .submission import Part, finish, new_folder, write_frame
from .video import VIDEOS, Stream, is_video

if TYPE_CHECKING:
    from rich.table import Table

    from .data.images import Bytes
    from .predictor import Estimate, Predictor
    from .session import Sessions, StereoSession

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

SHOWN_IMAGES = 20
"""With more images than this the table has the totals alone."""

SUBMITTED = "kitti2015"
"""The data set whose servers take a submission."""


@command
def infer(arguments: Sequence[str] | None = None) -> int:
    """The command rts2-infer: disparity, semantics and points of pairs, videos and cameras."""
    options = _infer_parser().parse_args(arguments)
    calibration = _calibration(options)
    stream = _stream(options)
    if stream is not None:
        _infer_stream(options, stream, calibration)
    else:
        _infer_pairs(options, calibration)
    return 0


def _infer_pairs(options: argparse.Namespace, calibration: Calibration | None) -> None:
    """Two images, or two folders of them."""
    pairs = pairs_of(options.left, options.right)
    if calibration is not None:
        for pair in pairs:
            calibration.require_fits(pair.size)
    sessions = _sessions(options)
    for pair in {pair.size: pair for pair in reversed(pairs)}.values():
        # What does not fit shows before anything is written or timed.
        session, _, _ = _answered(sessions, pair, options.budget_ms)
    results = Results(output_folder(options.out), calibration, options.max_disparity)
    rows, legend = [], None
    for pair in progress(pairs, "pairs", len(pairs)):
        _, left, estimate = _answered(sessions, pair, options.budget_ms)
        rows.append(results.write(pair.name, left, estimate))
        if estimate.semantic is not None and legend is None:
            legend = results.write_legend()
    report = {**_about(options.model, session), "legend": legend, "pairs": rows, "stream": None}
    if options.json:
        print_json({"schema": "rts2.infer/1", **report})
    else:
        _show_pairs(report, _title(options.model, session), options.out)


def _answered(
    sessions: Sessions, pair: Pair, budget_ms: float | None
) -> tuple[StereoSession, Bytes, Estimate]:
    """A pair's session, its left image and what the network says of it."""
    session = sessions.of(pair.size)
    left, right = read_rgb(pair.left), read_rgb(pair.right)
    return session, left, session.predict(left, right, budget_ms=budget_ms)


def _infer_stream(
    options: argparse.Namespace, stream: Stream, calibration: Calibration | None
) -> None:
    """Videos or cameras."""
    from .watch import Watch

    if calibration is not None:
        if not options.frames:
            raise UsageError("the points of a video are those of its frames; add --frames")
        calibration.require_fits(stream.size)
    session = _sessions(options).of(stream.size)
    results = Results(options.out, calibration, options.max_disparity)
    summary = Watch(stream, session, results, options.budget_ms, options.frames).run(options.limit)
    legend = results.write_legend() if len(summary.files) > 1 else None
    told = {
        "name": stream.name,
        "size": stream.size,
        "frames": summary.frames,
        "fps": summary.fps,
        "network_ms": summary.median_ms,
        "stages": [{"stage": k, "frames": n} for k, n in sorted(summary.stages.items())],
        "files": summary.files,
    }
    about = _about(options.model, session)
    report = {**about, "legend": legend, "pairs": summary.rows, "stream": told}
    if options.json:
        print_json({"schema": "rts2.infer/1", **report})
    else:
        _show_stream(report, _title(options.model, session), options.out)


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
        "Disparity, semantics and metric points of stereo pairs, videos and cameras. LEFT and "
        "RIGHT are two rectified images, two folders of equally named ones, or two videos; LEFT "
        "alone is a video that holds both images side by side.",
        "rts2-infer left.png right.png --focal 721.5 --baseline 0.54",
    )
    add = command.add_argument
    add("left", type=Path, nargs="?", metavar="LEFT")
    add("right", type=Path, nargs="?", metavar="RIGHT")
    text = "a camera with both images side by side, or two cameras, left and right"
    add("--camera", type=_camera, nargs="+", metavar="INDEX", help=text)
    add("--camera-size", type=resolution, metavar="WxH", help="what a camera is asked for")
    text = f"{MODEL} (default: {DEFAULT})"
    add("--model", type=named_model, default=DEFAULT, metavar="MODEL", help=text)
    add("--stages", type=int, metavar="K", help="stop after this many stages")
    text = "run as many stages as fit into this time for a pair"
    add("--budget-ms", type=positive, metavar="MS", help=text)
    add("--focal", type=positive, metavar="PX", help="focal length in pixels, for a point cloud")
    add("--baseline", type=positive, metavar="M", help="distance of the cameras in metres")
    text = "Middlebury's calib.txt or a KITTI calibration"
    add("--calib", type=Path, metavar="FILE", help=text)
    text = "where the colours end (default: the 98th percentile)"
    add("--max-disparity", type=positive, metavar="PX", help=text)
    text = "of videos and cameras also write the files of every pair"
    add("--frames", action="store_true", help=text)
    text = "of videos and cameras take the first N pairs"
    add("--limit", type=_count, metavar="N", help=text)
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


def _stream(options: argparse.Namespace) -> Stream | None:
    """The videos or cameras that the options name; None for images."""
    given = [path for path in (options.left, options.right) if path is not None]
    if options.camera is not None:
        if given or len(options.camera) > 2:
            raise UsageError("--camera takes one index or two, and no LEFT and RIGHT beside it")
        return Stream(options.camera, options.camera_size)
    if not given:
        raise UsageError("give LEFT and RIGHT, a video of both, or --camera (see --help)")
    _require_alike(given, options)
    return Stream(given) if is_video(given[0]) else None


def _require_alike(given: list[Path], options: argparse.Namespace) -> None:
    """Raises `UsageError` for a video beside an image, and options that are for one of them."""
    videos = [path for path in given if is_video(path)]
    if options.camera_size is not None:
        raise UsageError("--camera-size is for --camera")
    if videos:
        if len(videos) < len(given):
            raise UsageError(f"LEFT and RIGHT must be of one kind: {videos[0]} alone is a video")
        return
    if len(given) == 1:
        raise UsageError(
            f"RIGHT is missing: LEFT alone must be a video ({', '.join(VIDEOS)}), not {given[0]}"
        )
    if options.frames or options.limit is not None:
        raise UsageError("--frames and --limit are for videos and cameras")


def _sessions(options: argparse.Namespace) -> Sessions:
    from .session import Sessions

    return Sessions(options.model, options.stages, early=options.budget_ms is not None)


def _camera(text: str) -> int:
    return whole_between(text, 0, 99)


def _count(text: str) -> int:
    return whole_between(text, 1, 10**9)


def _about(path: Path, network: Predictor | StereoSession) -> dict[str, Any]:
    """What a report says of its model."""
    arch = None if network.arch is None else network.arch.model_dump(mode="json")
    return {"model": str(path), "arch": arch, "origin": network.origin}


def _submitted(folder: Path, parts: Sequence[Part]) -> dict[str, Any]:
    """What a report says of a submission."""
    return {"folder": str(folder), "parts": [part.to_json() for part in parts]}


def _show_pairs(report: dict[str, Any], title: str, folder: Path) -> None:
    table = _table("pair", "size", "disparity px", "network ms", "files")
    for row in report["pairs"]:
        low, high = row["disparity_px"] or (None, None)
        table.add_row(
            row["name"],
            "{}x{}".format(*row["size"]),
            f"{figure(low, 1)} – {figure(high, 1)}",
            figure(row["network_ms"], 0),
            " ".join(name.removeprefix(f"{row['name']}_") for name in row["files"]),
        )
    note = "network ms: one run each, the first of each size after a warm-up"
    written = f"{folder}/  NAME_…  {report['legend'] or ''}".rstrip()
    _show(title, table, note, f"written   {written}")


def _show_stream(report: dict[str, Any], title: str, folder: Path) -> None:
    told = report["stream"]
    table = _table("stream", "size", "pairs", "FPS", "network ms", "stages: pairs")
    stages = (f"{figure(each['stage'], 0)}: {each['frames']}" for each in told["stages"])
    table.add_row(
        told["name"],
        "{}x{}".format(*told["size"]),
        str(told["frames"]),
        figure(told["fps"], 1),
        figure(told["network_ms"], 0),
        "  ".join(stages),
    )
    note = "FPS: with reading, colours and writing; network ms: the median"
    each = f"{told['name']}_000000_…" if report["pairs"] else ""
    files = "  ".join(filter(None, (*told["files"], each, report["legend"])))
    _show(title, table, note, f"written   {folder}/  {files}")


def _show(title: str, table: Table, *notes: str) -> None:
    console = screen()
    console.print(title)
    console.print(table)
    for note in notes:
        console.print(note, soft_wrap=True)


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


def _title(model: Path, network: Predictor | StereoSession) -> str:
    """The file, its network, and how its weights came to be."""
    label = "an ONNX graph" if network.arch is None else network.arch.label()
    named = f"{model.name} · {label}"
    return named if network.origin is None else f"{named} · {network.origin}"
