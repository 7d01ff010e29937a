"""The commands that find a network and write what deploys it: rts2-search and rts2-deploy.

rts2-deploy's own half is `deploy/cli.py`.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

from ..model.arch import Precision
from ..model.bundle import CONFIGURATION
from ..model.console import (
    KITTI,
    add_output,
    command,
    parser,
    positive,
    print_json,
    resolution,
    screen,
)
from ..model.errors import NothingFeasible, UsageError
from ..model.files import output_folder, remove, write_bytes, write_json
from ..model.machine import cores
from ..profiles.here import differences
from ..profiles.profile import Profile, Runtime, load, names
from .accuracy import source
from .deploy.cli import deploy
from .deploy.configuration import of_point
from .exhaustive import Question
from .exhaustive import search as search_all
from .result import Found, Task

__all__ = ["deploy", "search"]


@command
def search(arguments: Sequence[str] | None = None) -> int:
    """Finds the most accurate network that holds a frame rate on a device."""
    options = _search_parser().parse_args(arguments)
    profile = load(options.device)
    out = output_folder(options.out)
    found = search_all(_question(options, profile), source(options.accuracy))
    _warn_of_differences(profile, options.device)
    written = _write(found, profile, out)
    if options.json:
        print_json(found.model_dump(mode="json", by_alias=True))
    else:
        from .report import show

        show(found, profile, written, screen())
    if found.selected is None:
        raise NothingFeasible(_infeasible(found, profile))
    return 0


def _warn_of_differences(profile: Profile, device: str) -> None:
    """What a profile was timed with that this machine is not, if it is of a machine at hand."""
    if profile.machine is None:
        return
    told = differences(profile.machine, cores())
    for difference in told:
        logging.getLogger(__name__).warning("note: %s", difference)
    if told:
        text = "note: rts2-profile fit --device %s --out FILE.json times this machine as it is%s"
        runtimes = list(dict.fromkeys(known.runtime for known in profile.calibrations))
        each = f", once with each --runtime: {', '.join(runtimes)}" if len(runtimes) > 1 else ""
        logging.getLogger(__name__).warning(text, device, each)


def _search_parser() -> argparse.ArgumentParser:
    described = parser(
        "rts2-search",
        "Finds the most accurate RTS²Net that holds a frame rate on a device, and the whole "
        "Pareto front of accuracy against frames per second beside it.",
        "rts2-search --device tx2 --target-fps 10",
    )
    add = described.add_argument
    add("--device", required=True, help=f"{', '.join(names())}, or a device profile's JSON file")
    add("--target-fps", required=True, type=positive, metavar="F", help="frames per second to hold")
    text = "image size, WxH (default: 1242x375, KITTI's)"
    add("--resolution", type=resolution, default=KITTI, metavar="WxH", help=text)
    text = "stereo admits networks without the semantic branch"
    add("--task", choices=get_args(Task), default="semantic-stereo", help=text)
    text = "what accuracy means (default: d1_all)"
    add("--objective", choices=("d1_all", "epe", "miou"), default="d1_all", help=text)
    text = "the paper's tables, or a JSON file of measured accuracies"
    add("--accuracy", default="published", metavar="published|PATH", help=text)
    text = "only this precision (may be repeated)"
    add("--precision", action="append", choices=get_args(Precision), default=[], help=text)
    text = "only this runtime (may be repeated)"
    add("--runtime", action="append", choices=get_args(Runtime), default=[], help=text)
    text = "meet the target at the lower bound of the interval of this confidence, such as 0.9"
    add("--confidence", type=_probability, metavar="P", help=text)
    add("--allow-extrapolated", action="store_true", help="let the pick rest on extrapolation")
    add("--max-size-mb", type=positive, metavar="MB", help="upper bound of the weights, 10⁶ bytes")
    add("--min-depth", type=positive, metavar="M", help="nearest distance to see, in metres")
    add("--focal", type=positive, metavar="PX", help="focal length, in pixels")
    add("--baseline", type=positive, metavar="M", help="distance of the cameras, in metres")
    add_output(described)
    return described


def _probability(text: str) -> float:
    value = positive(text)
    if value >= 1:
        raise argparse.ArgumentTypeError(f"must be above 0 and below 1, not {text!r}")
    return value


def _question(options: argparse.Namespace, profile: Profile) -> Question:
    megabytes = options.max_size_mb
    return Question(
        profile=profile,
        target_fps=options.target_fps,
        resolution=options.resolution,
        task=options.task,
        objective=options.objective,
        confidence=options.confidence or Question.confidence,
        at_lower_bound=options.confidence is not None,
        allow_extrapolated=options.allow_extrapolated,
        precisions=tuple(options.precision),
        runtimes=tuple(options.runtime),
        max_size_bytes=float("inf") if megabytes is None else megabytes * 1e6,
        min_disparity=_min_disparity(options),
    )


def _min_disparity(options: argparse.Namespace) -> float:
    """The disparity of the nearest point to see: focal length times baseline over depth."""
    geometry = (options.min_depth, options.focal, options.baseline)
    if all(value is None for value in geometry):
        return 0.0
    if None in geometry:
        raise UsageError("--min-depth, --focal and --baseline need one another; give all three")
    depth, focal, baseline = geometry
    return float(focal * baseline / depth)


def _write(found: Found, profile: Profile, out: Path) -> list[str]:
    from .plot import save
    from .report import as_csv

    write_json(out / "front.json", found.model_dump(mode="json", by_alias=True))
    write_bytes(out / "front.csv", as_csv(found).encode())
    save(found, profile.title, out / "front.png")
    written = [f"{out}/", "front.json", "front.csv", "front.png"]
    if found.selected is None:
        remove(out / CONFIGURATION)
        return written
    configuration = of_point(found.selected, found, profile)
    write_json(out / CONFIGURATION, configuration.model_dump(mode="json", by_alias=True))
    return [*written, CONFIGURATION]


def _infeasible(found: Found, profile: Profile) -> str:
    """Why there is no pick, in one line, and what to do."""
    asked = f"no candidate holds {found.target_fps:g} FPS on {profile.title}"
    if found.prospect is not None:
        asked += " on evidence better than extrapolation"
        point = found.prospect
        return (
            f"{asked}; the prospect has {point.fps:.1f} FPS: {point.arch.label()} "
            "(--allow-extrapolated takes it)"
        )
    if found.nearest is None:
        return f"{asked}; every candidate was left out, the most because {found.left_out[0].reason}"
    point = found.nearest
    return f"{asked}; the fastest has {point.fps:.1f} FPS: {point.arch.label()}"
