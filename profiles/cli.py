"""The command that knows devices: rts2-profile."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator, Sequence
from functools import cache
from itertools import islice
from pathlib import Path
from statistics import median
from time import monotonic
from typing import TYPE_CHECKING, Any, get_args

from ..model.arch import Precision
from ..model.box import SHIPPED, named_model
from ..model.console import (
    KITTI,
    add_output,
    command,
    parser,
    positive,
    print_json,
    progress,
    resolution,
    screen,
    seed,
)
from ..model.errors import UsageError
from ..model.files import output_file, output_folder, write_json
from .conformal import half_width
from .kit import cli as kit_cli
from .parts import PartModel
from .profile import Profile, Runtime, load, names
from .runtimes import RUNTIMES
from .several import FITTED, apart, joined, others, titled

if TYPE_CHECKING:
    from .check import Benches, Comparison
    from .latency import LatencyModel
    from .plan import Job

CONFIDENCE = 0.9

BUSY_SHARE = 1 / 3
"""A fit with more timings of a busy machine than this is told to be one."""

RESERVE_S, FITTING_S = 5.0, 0.12
"""What of a fit's budget is kept for the last network and the tables, and for each one's error."""


@command
def profile(arguments: Sequence[str] | None = None) -> int:
    """Lists, shows, checks and fits device profiles."""
    options = _parser().parse_args(arguments)
    run = {
        "list": _list,
        "show": _show,
        "check": _check,
        "fit": _fit,
        "measure": _measure,
        "kit": kit_cli.kit,
        "import": kit_cli.import_results,
    }
    run[options.action](options)
    return 0


def _parser() -> argparse.ArgumentParser:
    described = parser(
        "rts2-profile",
        "What rts2 knows of devices: lists, shows and checks their profiles, times networks on "
        "this machine and fits a profile of it.",
        "rts2-profile fit --device cpu --budget 300 --out my-cpu.json",
    )
    actions = described.add_subparsers(dest="action", required=True, metavar="ACTION")
    known = f"{', '.join(names())}, or a profile's JSON file"

    listed = actions.add_parser("list", help="the devices that rts2 knows")
    add_output(listed, out=None)

    shown = actions.add_parser("show", help="one profile, with the source of each number")
    shown.add_argument("device", metavar="NAME", help=known)
    add_output(shown, out=None)

    checked = actions.add_parser("check", help="how well a profile predicts")
    checked.add_argument("--device", required=True, help=known)
    text = "time N random networks on this machine instead of leaving out the profile's points"
    checked.add_argument("--samples", type=_count, metavar="N", help=text)
    _add_timing(checked)
    _add_seed(checked)
    text = "folder for check.json and a picture of it, check.png (default: none is written)"
    checked.add_argument("--out", type=Path, metavar="DIR", help=text)
    add_output(checked, out=None)

    fitted = actions.add_parser("fit", help="time networks on this machine and fit its profile")
    text = (
        "what the profile starts from: cpu, or a profile of this machine, whose other runtimes "
        "are kept, or one of published points, which are fitted again"
    )
    fitted.add_argument("--device", required=True, help=text)
    text = "seconds to spend on timing (default: 300)"
    fitted.add_argument("--budget", type=positive, default=300.0, metavar="SECONDS", help=text)
    text = "what runs the networks: onnxruntime or openvino (default: onnxruntime)"
    fitted.add_argument("--runtime", choices=FITTED, default=FITTED[0], help=text)
    fitted.add_argument("--out", type=Path, required=True, metavar="FILE", help="the new profile")
    _add_timing(fitted)
    _add_seed(fitted)
    add_output(fitted, out=None)

    kit_cli.add_actions(actions, known)

    measured = actions.add_parser("measure", help="time models on this machine")
    text = (
        f"{', '.join(SHIPPED)} in the box, a checkpoint, an ONNX file, "
        "or a bundle (the folder of rts2-deploy)"
    )
    measured.add_argument("models", nargs="+", type=named_model, metavar="MODEL", help=text)
    text = f"what runs them: {', '.join(RUNTIMES)} (default: onnxruntime)"
    measured.add_argument(
        "--runtime", choices=RUNTIMES, default="onnxruntime", metavar="RUNTIME", help=text
    )
    text = "fp32, bf16, fp16 or int8, where the runtime has it (default: as the model is stored)"
    measured.add_argument("--precision", choices=get_args(Precision), help=text)
    _add_timing(measured)
    text = "of the images that a checkpoint is timed with (default: {}x{})".format(*KITTI)
    measured.add_argument("--resolution", type=resolution, metavar="WxH", help=text)
    text = "stop a checkpoint after this many stages (default: all)"
    measured.add_argument("--stages", type=_count, metavar="K", help=text)
    add_output(measured, out=None)
    return described


def _add_timing(action: argparse.ArgumentParser) -> None:
    text = "threads to run on (default: every core)"
    action.add_argument("--threads", type=_count, metavar="N", help=text)


def _add_seed(action: argparse.ArgumentParser) -> None:
    text = "which random networks are drawn (default: 0)"
    action.add_argument("--seed", type=seed, default=0, help=text)


def _count(text: str) -> int:
    if not (text.isascii() and text.isdigit() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"must be a whole number above 0, not {text!r}")
    return int(text)


def _list(options: argparse.Namespace) -> None:
    profiles = [load(name) for name in names()]
    if options.json:
        print_json({"schema": "rts2.profiles/1", "devices": [_brief(known) for known in profiles]})
        return
    table = _table("name", "device", "precisions", "runtimes", "timings", "evidence")
    for known in profiles:
        brief = _brief(known)
        runs, can = ", ".join(brief["runtimes"]), ", ".join(brief["precisions"])
        told = ", ".join(brief["evidence"])
        table.add_row(known.name, known.title, can, runs, str(len(known.points)), told)
    _print(table)


def _brief(known: Profile) -> dict[str, Any]:
    return {
        "name": known.name,
        "title": known.title,
        "precisions": [p.precision for p in known.precisions if p.supported],
        "runtimes": [runtime.runtime for runtime in known.runtimes],
        "points": len(known.points),
        "evidence": sorted({point.evidence for point in known.points}),
    }


def _show(options: argparse.Namespace) -> None:
    known = load(options.device)
    if options.json:
        print_json(known.model_dump(mode="json", by_alias=True))
        return
    _print(f"{known.title} ({known.name})\n")
    facts = _table("", "value", "source")
    for fact in known.hardware:
        facts.add_row(fact.name, fact.value, fact.source)
    for support in known.precisions:
        verdict = "yes" if support.supported else "no"
        facts.add_row(support.precision, f"{verdict}: {support.reason}", support.source)
    for runtime in known.runtimes:
        limit = f", ONNX opset {runtime.opset} at most" if runtime.opset else ""
        facts.add_row(runtime.runtime, runtime.version + limit, runtime.source)
    _print(facts)
    _print(_coefficients(known))


def _coefficients(known: Profile) -> Any:
    """Every latency model: fitted ones with their held-out error, scaled ones with their ratios."""
    from .calibrate import summary
    from .heldout import errors_told

    table = _table("runtime", "precision", "latency model, in ms", "held-out error", "source")
    for fitted in known.calibrations:
        model = _model_told(fitted.model)
        error = summary(fitted.residuals)
        width = half_width(fitted.residuals, CONFIDENCE)
        told = (
            f"{error['mape']:.1%} mean, {error['max_ape']:.1%} worst; "
            f"{CONFIDENCE:.0%} interval ±{width:.1%}"
        )
        if fitted.held_out is not None:
            told += f"\na family left out: {errors_told(fitted.held_out.family)}"
            told += f"\na stage count left out: {errors_told(fitted.held_out.stages)}"
        table.add_row(fitted.runtime, fitted.precision, model, told, fitted.source)
    for derived in known.derivations:
        ratios = [f"{name} × {factor:g}" for name, factor in derived.factors.items()]
        folded = [f"no {kind}" for kind in derived.folded]
        model = f"{' '.join(derived.base)}, {', '.join([*ratios, *folded]) or 'unchanged'}"
        table.add_row(derived.runtime, derived.precision, model, "extrapolated", derived.source)
    return table


def _model_told(model: LatencyModel | PartModel) -> str:
    """Coefficients, or how many places the tables of parts have."""
    if isinstance(model, PartModel):
        places = sum(len(row) for table in model.tables.values() for row in table.ms)
        sizes = ", ".join(f"{pixels / 1e6:.2f}" for pixels in model.pixels)
        return f"{len(model.tables)} parts, {places} places in their tables, at {sizes} megapixels"
    per = [f"{ms:.3g} per {name}" for name, ms in model.ms_per.items()]
    terms = [f"{model.start_ms:.3g} per start ({model.starts})", *per]
    joint = " + " if model.combine == "sum" else " or, if longer, "
    return terms[0] + joint + " + ".join(terms[1:])


def _check(options: argparse.Namespace) -> None:
    from .calibrate import recalibrated
    from .check import groups_held_out, held_out, report

    known = load(options.device)
    if options.samples is None:
        known = recalibrated(known)
        comparisons = held_out(known)
        result = report(known, comparisons) | {"held_out": groups_held_out(known)}
    else:
        comparisons, result = _timed_now(options, known)
    if options.out is not None:
        _write_check(options.out, known, comparisons, result)
    if options.json:
        print_json(result)
        return
    _print(_compared(comparisons))
    _print(_summary(comparisons, result, fresh=options.samples is not None))
    if options.out is not None:
        _print(f"written   {options.out}/  check.json  check.png")
    _print_groups(result.get("held_out", []))


def _timed_now(
    options: argparse.Namespace, known: Profile
) -> tuple[list[Comparison], dict[str, Any]]:
    """Networks that no fit has seen, timed on this machine."""
    from .check import coverage, executors_here, fresh, report

    benches = _benches(options, known)
    if options.out is not None:
        output_folder(options.out)  # before minutes are spent on timing
    executors, skipped = executors_here(known, benches)
    for reason in skipped:
        _warn(f"not timed: {reason}")
    comparisons = fresh(known, benches, executors, options.samples, options.seed)
    reliable = [comparison for comparison in comparisons if comparison.reliable]
    result = report(known, comparisons)
    return comparisons, result | {"coverage": coverage(known, reliable, CONFIDENCE)}


def _compared(comparisons: Sequence[Comparison]) -> Any:
    table = _table(
        "network", "resolution", "precision", "runtime", "FPS", "predicted", "latency error"
    )
    for comparison in comparisons:
        error = comparison.fps_predicted / comparison.fps_true - 1
        width, height = comparison.resolution
        table.add_row(
            comparison.arch.label(),
            f"{width}×{height}",
            comparison.precision,
            comparison.runtime,
            f"{comparison.fps_true:.2f}",
            f"{comparison.fps_predicted:.2f}",
            f"{error:+.1%}" + ("" if comparison.reliable else " !"),
        )
    return table


def _summary(comparisons: Sequence[Comparison], result: dict[str, Any], fresh: bool) -> str:
    how = "left out in turn"
    if fresh:
        drift = median(comparison.drift for comparison in comparisons)
        how = f"timed now, at {drift:.2f} × the latency of the profile's day, which is divided out"
    rank = "" if result["spearman"] is None else f", Spearman {result['spearman']:.3f}"
    lines = [
        f"\n{result['n']} networks {how}: mean error {result['mape']:.1%}, "
        f"worst {result['max_ape']:.1%}, {result['within_5']:.0%} within 5%, "
        f"{result['within_10']:.0%} within 10%{rank}"
    ]
    if fresh:
        lines.append(f"{result['coverage']:.0%} of them within the {CONFIDENCE:.0%} interval")
    if result["unreliable"]:
        lines.append(f"! {result['unreliable']} unreliable: the machine was busy; not counted")
    return "\n".join(lines)


def _print_groups(entries: list[dict[str, Any]]) -> None:
    """A line for each grouping of each calibration's points."""
    from .heldout import errors_told
    from .profile import HoldOut

    for entry in entries:
        for group, name in (("family", "a family"), ("stages", "a stage count")):
            errors = errors_told(HoldOut.model_validate(entry[group]))
            _print(f"{entry['precision']} on {entry['runtime']}, {name} left out: {errors}")


def _write_check(
    out: Path, known: Profile, comparisons: Sequence[Comparison], result: dict[str, Any]
) -> None:
    """The check as JSON and as a picture."""
    from .check import half_widths
    from .plot import save

    folder = output_folder(out)
    reliable = [comparison for comparison in comparisons if comparison.reliable]
    write_json(folder / "check.json", result)
    save(reliable, known.title, half_widths(known, CONFIDENCE), folder / "check.png")


def _benches(options: argparse.Namespace, known: Profile) -> Benches:
    """A bench for each runtime on this machine, if the profile is one of a machine at hand."""
    from .here import differences
    from .measure import Bench

    if known.machine is None:
        raise UsageError(
            f"{known.title} is not this machine; without --samples its points are left out in turn"
        )
    threads = options.threads or known.machine.threads
    for difference in differences(known.machine, threads):
        _warn(difference)
    return cache(lambda runtime: Bench(runtime, threads))


def _warn(text: str) -> None:
    from rich.console import Console

    Console(stderr=True, markup=False).print(f"note: {text}", highlight=False, soft_wrap=True)


def _fit(options: argparse.Namespace) -> None:
    from .calibrate import recalibrated, summary

    template = load(options.device)
    path = output_file(options.out)
    if template.machine is None:
        fitted = recalibrated(template)
    else:
        fitted = _fit_here(options, template, path)
    write_json(path, fitted.model_dump(mode="json", by_alias=True, exclude_none=True))
    rows = [
        {
            "runtime": known.runtime,
            "precision": known.precision,
            "n": len(known.residuals),
            **summary(known.residuals),
        }
        for known in fitted.calibrations
    ]
    kept = others(fitted, options.runtime) if template.machine is not None else ()
    now = [row for row in rows if row["runtime"] not in kept]
    if options.json:
        first = {name: now[0][name] for name in ("n", "mape", "max_ape", "within_5", "within_10")}
        result = {"schema": "rts2.profile-fit/1", "file": str(path), **first, "calibrations": rows}
        print_json(result)
        return
    for row in now:
        _print(
            f"{fitted.title}, {row['precision']} on {row['runtime']}: "
            f"{row['n']} timings, each left out in turn: "
            f"mean error {row['mape']:.1%}, worst {row['max_ape']:.1%}"
        )
    for runtime in kept:
        _print(f"kept      what {template.name} tells of {titled(runtime)}")
    _print(f"written   {path}")


def _fit_here(options: argparse.Namespace, template: Profile, path: Path) -> Profile:
    """Times networks until the budget is spent, going on where an earlier run stopped."""
    from ..model.machine import cores
    from .measure import Bench, extend, in_hindsight, journal_path, open_journal, profile_of
    from .plan import jobs

    deadline = monotonic() + options.budget - RESERVE_S
    threads = options.threads or cores()
    timings = journal_path(path, options.runtime)
    journal = open_journal(timings, options.runtime, threads, options.seed)
    beside = _beside(template, options.runtime, threads)
    bench = Bench(options.runtime, threads)
    before = len(journal.samples)
    remaining = islice(jobs(options.seed, bench.precisions), before, None)
    for job in _until(deadline, remaining, before):
        journal = extend(journal, timings, bench.harvest(job))
    journal = in_hindsight(journal, timings, before, bench.own_ms)
    busy = sum(not sample.reliable for sample in journal.samples)
    if busy > BUSY_SHARE * len(journal.samples):
        _warn(
            f"{busy} of {len(journal.samples)} networks were timed while the machine was busy and "
            "tell little; close what else runs here, delete the timings and fit again"
        )
    name = re.sub("[^a-z0-9._-]+", "-", path.stem.lower()).strip("._-") or template.name
    if beside is None:
        return profile_of(journal, template, name)
    assert beside.machine is not None
    return joined(profile_of(journal, template, name, beside.machine.reference_ms), beside)


def _beside(template: Profile, runtime: Runtime, threads: int) -> Profile | None:
    """`template`, if it is of this machine and of other runtimes too: those are kept."""
    kept = others(template, runtime)
    if not kept:
        return None
    reason = apart(template, threads)
    if reason is None:
        return template
    known = " and ".join(map(titled, kept))
    _warn(f"what {template.name} tells of {known} is not kept: {reason}")
    return None


def _until(deadline: float, items: Iterator[Job], timed: int) -> Iterator[Job]:
    """Jobs until the deadline, with a bar of the seconds spent on a terminal."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    started = monotonic()
    with Progress(console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("timing networks", total=deadline - started)
        for count, item in enumerate(items, timed + 1):
            if monotonic() + count * FITTING_S >= deadline:
                return
            text = f"timing network {count}: {item.arch.label()}"
            bar.update(task, completed=monotonic() - started, description=text)
            yield item


def _measure(options: argparse.Namespace) -> None:
    from ..model.machine import cores
    from .timed import BOUNDARY, REFERENCE_TOLD, Clock, given
    from .timing import MAX_ERROR

    threads = options.threads or cores()
    models = [given(path, options.resolution, options.stages) for path in options.models]
    clock = Clock(options.runtime, threads)
    asked = [clock.precision(model, options.precision) for model in models]
    pairs = list(zip(models, asked, strict=True))
    rows = [clock.time(*pair) for pair in progress(pairs, "timing", len(pairs))]
    if options.json:
        print_json(
            {
                "schema": "rts2.profile-measure/1",
                "machine": clock.machine.model_dump(mode="json", exclude_none=True),
                "runtime": options.runtime,
                "boundary": BOUNDARY,
                "reference": REFERENCE_TOLD.format(clock.reference),
                "models": [row.to_json() for row in rows],
            }
        )
        return
    table = _table(
        "model", "size", "precision", "median ms", "p95 ms", "spread", "FPS", "runs", "× reference"
    )
    for row in rows:
        timing = row.timing
        table.add_row(
            row.name,
            row.size or "–",
            row.precision,
            f"{timing.median_ms:.2f}",
            f"{timing.p95_ms:.2f}",
            f"{timing.spread:.1%}",
            f"{1000 / timing.median_ms:.1f}",
            str(timing.runs),
            f"{timing.ratio:.3f} ±{timing.error:.1%}" + ("" if timing.reliable else " !"),
        )
    _print(table)
    notes = [clock.told(), BOUNDARY, f"reference: {REFERENCE_TOLD.format(clock.reference)}"]
    if not all(row.timing.reliable for row in rows):
        notes.append(
            f"! unreliable: the machine was busy, or the ratio is not known to {MAX_ERROR:.0%}; "
            "close what else runs on this machine and measure again"
        )
    _print("")
    for note in notes:
        screen().print(note, soft_wrap=True)


def _table(*columns: str) -> Any:
    from rich.table import Table

    table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 2, 0, 0))
    for column in columns:
        table.add_column(column, overflow="fold")
    return table


def _print(what: Any) -> None:
    screen().print(what)
