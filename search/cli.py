"""The commands that find a network and write what deploys it: rts2-search and rts2-deploy.

rts2-deploy's own half is `deploy/cli.py`.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, get_args

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
    whole_between,
)
from ..model.errors import NothingFeasible, UsageError
from ..model.files import existing_file, output_folder, remove, write_bytes, write_json
from ..model.machine import cores
from ..profiles.here import MISSING, differences, installed
from ..profiles.profile import Profile, Runtime, load, names
from ..profiles.several import others
from .accuracy import AccuracySource
from .deploy.cli import deploy
from .deploy.configuration import of_point
from .exhaustive import Question
from .exhaustive import search as search_all
from .result import Cost, Found, Point, Task
from .sources import source
from .supernet import supernet

if TYPE_CHECKING:
    from .study import Order, Progress, Shown

__all__ = ["deploy", "search"]


@command
def search(arguments: Sequence[str] | None = None) -> int:
    """Finds the most accurate network that holds a frame rate on a device."""
    options = _search_parser().parse_args(arguments)
    profile = load(options.device)
    out = output_folder(options.out)
    question = _question(options, profile)
    weights = supernet(options.accuracy)
    _require_supernet(options, weights)
    if weights is None:
        known = source(options.accuracy)
        found = search_all(question, known)
    else:
        found, known = _measured(options, question, weights)
    _warn_of_differences(profile, options.device)
    _warn_of_missing(profile, found.selected)
    written = _write(found, question, known, out)
    if options.json:
        print_json(found.model_dump(mode="json", by_alias=True))
    else:
        from .report import show

        show(found, profile, written, screen())
    if found.selected is None:
        raise NothingFeasible(_infeasible(found, profile))
    return 0


def _require_supernet(options: argparse.Namespace, weights: Path | None) -> None:
    """Raises `UsageError` for a study's options without a supernet, and for one without data."""
    given = [name for name in STUDY if getattr(options, name) not in (None, False)]
    if weights is None and given:
        if options.accuracy != "published":
            existing_file(Path(options.accuracy), "a supernet")
        option = given[0].replace("_", "-")
        raise UsageError(
            f"--{option} is for --accuracy SUPERNET, the weights that rts2-train --supernet makes; "
            f"{options.accuracy} is none"
        )
    if weights is not None and options.data is None:
        raise UsageError(f"{weights} is judged on your data; give --data DIR, or --data {STREETS}")


def _measured(
    options: argparse.Namespace, question: Question, weights: Path
) -> tuple[Found, AccuracySource]:
    """What a study of a supernet finds, and the accuracies it judged; writes the pick's weights."""
    from .storage import sqlite
    from .study import BUDGET, Order, found_by, run, source_of
    from .supernet import CACHE, Source, trained_s
    from .verify import require_here, verified

    if options.verify:
        require_here(question.profile)

    started = perf_counter()
    workers = options.workers or 1
    judge = Source(
        path=weights,
        data=options.data,
        dataset=options.dataset,
        split=options.split,
        size=options.data_size or question.resolution,
        folder=options.out / CACHE,
        threads=max(1, cores() // workers),
    )
    order = Order(
        question=question,
        judge=judge.open,
        storage=options.storage or sqlite(options.out / "study.db"),
        metrics=judge.metrics(question.objective, question.task),
        budget=options.budget or BUDGET,
    )
    try:
        with _bar(order) as shown:
            studied = run(order, workers, shown)
    except NothingFeasible:
        for name in (*RESULTS, PICK, CONFIGURATION):  # what an earlier question was told
            remove(options.out / name)
        raise
    found = found_by(order, studied)
    for reason in studied.failed:
        logging.getLogger(__name__).warning("note: an evaluation failed: %s", reason)
    cost = Cost(
        wall_s=0.0,
        evaluations=studied.evaluations,
        fresh=studied.fresh,
        cache_hits=studied.recalled,
        failed=len(studied.failed),
        workers=studied.workers,
        evaluation_s=studied.seconds,
        candidates=studied.candidates,
        training_s=trained_s(weights),
    )
    own = judge.open()
    if options.verify:
        from .tried import Trials

        found = verified(found, question, Trials(question, own))
    if found.selected is not None:
        from ..model.checkpoint import save

        arch = found.selected.arch
        origin = f"cut out of a supernet ({own.origin}), norms calibrated on {options.data}"
        save(own.network(arch), options.out / PICK, origin)
    cost = cost.model_copy(update={"wall_s": perf_counter() - started})
    return found.model_copy(update={"cost": cost}), source_of(studied)


@contextmanager
def _bar(order: Order) -> Iterator[Shown]:
    """Shows on a terminal's stderr how far a study is, and the best so far."""
    from rich.console import Console
    from rich.progress import Progress as Bar

    from .report import caption

    console = Console(stderr=True)
    with Bar(console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("chains", total=order.budget)

        def shown(at: Progress) -> None:
            told, done = caption(order.metrics[0], at.best), at.done + at.failed
            bar.update(task, completed=done, total=at.total, description=f"chains, best {told}")

        yield shown


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
        further = (
            f"; --device FILE.json --runtime {r} --out FILE.json adds it" for r in runtimes[1:]
        )
        logging.getLogger(__name__).warning(text, device, "".join(further))


def _warn_of_missing(profile: Profile, pick: Point | None) -> None:
    """That the pick runs in what is not installed, if the device is a machine at hand."""
    if profile.machine is None or pick is None or installed(pick.runtime) != MISSING:
        return
    from ..profiles.runtimes import RUNTIMES

    instead = [
        f"--runtime {name}" for name in others(profile, pick.runtime) if installed(name) != MISSING
    ]
    logging.getLogger(__name__).warning(
        "note: the pick needs what is missing here: %s%s",
        RUNTIMES[pick.runtime].missing(),
        f"; {' or '.join(instead)} searches without" if instead else "",
    )


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
    text = (
        "the paper's tables, a JSON file of measured accuracies, or a supernet's weights, which "
        "judge networks on --data"
    )
    add("--accuracy", default="published", metavar="published|PATH", help=text)
    _add_study(described)
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


STREETS = "streets"
"""The generated scenes by name; the catalog of data sets itself imports what reads images."""

STUDY = ("data", "dataset", "split", "data_size", "budget", "workers", "storage", "verify")
"""The options of a measured search."""

PAGE = "report.html"
"""All that was found, for people."""

RESULTS = ("front.json", "front.csv", "front.png", PAGE)
"""What every search writes."""

PICK = "pick.safetensors"
"""The weights of a measured search's pick."""


def _add_study(described: argparse.ArgumentParser) -> None:
    add = described.add_argument_group("when a supernet judges").add_argument
    text = f"what judges: a data set's folder, or generated {STREETS}"
    add("--data", type=Path, metavar=f"DIR|{STREETS}", help=text)
    text = "which data set the folder holds (default: told by its layout)"
    add("--dataset", metavar="NAME", help=text)
    text = "what of it judges: one of its splits, or a file that lists frames"
    add("--split", metavar="NAME|FILE", help=text)
    text = f"size of the {STREETS}, WxH (default: the search's)"
    add("--data-size", type=resolution, metavar="WxH", help=text)
    text = "how many evaluations, nine networks each (default: 200)"
    add("--budget", type=_budget, metavar="N", help=text)
    add("--workers", type=_workers, metavar="N", help="processes on this machine (default: 1)")
    text = (
        "the database that keeps the study, for workers on other machines; sqlite:///FILE or "
        "postgresql://… (default: study.db in --out)"
    )
    add("--storage", metavar="URL", help=text)
    text = "times and judges every point of the front here, where this machine is the device"
    add("--verify", action="store_true", help=text)


def _budget(text: str) -> int:
    return whole_between(text, 1, 1_000_000)


def _workers(text: str) -> int:
    return whole_between(text, 1, 256)


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


def _write(found: Found, question: Question, known: AccuracySource, out: Path) -> list[str]:
    from .page import page
    from .plot import save
    from .report import as_csv
    from .sensitivity import sensitivity

    profile, base = question.profile, found.selected or found.nearest
    write_json(out / "front.json", found.model_dump(mode="json", by_alias=True))
    write_bytes(out / "front.csv", as_csv(found).encode())
    save(found, profile.title, out / "front.png")
    dimensions = sensitivity(question, known, base) if base else ()
    write_bytes(out / PAGE, page(found, profile, dimensions).encode())
    written = [f"{out}/", *RESULTS]
    if found.cost is not None and found.selected is not None:
        written.append(PICK)
    else:
        remove(out / PICK)
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
