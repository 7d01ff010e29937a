"""The command that knows devices: rts2-profile."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from statistics import median
from time import monotonic
from typing import TYPE_CHECKING, Any

from ..model.console import (
    add_output,
    command,
    parser,
    positive,
    print_json,
    progress,
    screen,
    seed,
)
from ..model.errors import Rts2Error, UsageError
from ..model.files import output_file, write_json
from .conformal import half_width
from .profile import Profile, load, names

if TYPE_CHECKING:
    from .measure import Bench, Journal

CONFIDENCE = 0.9


@command
def profile(arguments: Sequence[str] | None = None) -> int:
    """Lists, shows, checks and fits device profiles."""
    options = _parser().parse_args(arguments)
    run = {"list": _list, "show": _show, "check": _check, "fit": _fit, "measure": _measure}
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
    add_output(checked, out=None)

    fitted = actions.add_parser("fit", help="time networks on this machine and fit its profile")
    text = "what the profile starts from: cpu, or a profile whose own points are fitted again"
    fitted.add_argument("--device", required=True, help=text)
    text = "seconds to spend on timing (default: 300)"
    fitted.add_argument("--budget", type=positive, default=300.0, metavar="SECONDS", help=text)
    fitted.add_argument("--out", type=Path, required=True, metavar="FILE", help="the new profile")
    _add_timing(fitted)
    _add_seed(fitted)
    add_output(fitted, out=None)

    measured = actions.add_parser("measure", help="time ONNX files on this machine")
    measured.add_argument("models", nargs="+", type=Path, metavar="MODEL", help="ONNX files")
    _add_timing(measured)
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

    table = _table("runtime", "precision", "latency model, in ms", "held-out error", "source")
    for fitted in known.calibrations:
        per = [f"{ms:.3g} per {name}" for name, ms in fitted.model.ms_per.items()]
        terms = [f"{fitted.model.start_ms:.3g} per start ({fitted.model.starts})", *per]
        joint = " + " if fitted.model.combine == "sum" else " or, if longer, "
        model = terms[0] + joint + " + ".join(terms[1:])
        error = summary(fitted.residuals)
        width = half_width(fitted.residuals, CONFIDENCE)
        told = (
            f"{error['mape']:.1%} mean, {error['max_ape']:.1%} worst; "
            f"{CONFIDENCE:.0%} interval ±{width:.1%}"
        )
        table.add_row(fitted.runtime, fitted.precision, model, told, fitted.source)
    for derived in known.derivations:
        ratios = [f"{name} × {factor:g}" for name, factor in derived.factors.items()]
        folded = [f"no {kind}" for kind in derived.folded]
        model = f"{' '.join(derived.base)}, {', '.join([*ratios, *folded]) or 'unchanged'}"
        table.add_row(derived.runtime, derived.precision, model, "extrapolated", derived.source)
    return table


def _check(options: argparse.Namespace) -> None:
    from .check import fresh, held_out, report

    known = load(options.device)
    if options.samples is None:
        comparisons = held_out(known)
    else:
        bench = _bench(options, known)
        timed = fresh(known, bench, options.samples, options.seed)
        comparisons = list(progress(timed, "timing", options.samples))
    result = report(known, comparisons)
    if options.json:
        print_json(result)
        return
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
            f"{error:+.1%}",
        )
    _print(table)
    how = "left out in turn"
    if options.samples is not None:
        drift = median(comparison.drift for comparison in comparisons)
        how = f"timed now, at {drift:.2f} × the latency of the profile's day, which is divided out"
    rank = "" if result["spearman"] is None else f", Spearman {result['spearman']:.3f}"
    _print(
        f"\n{result['n']} networks {how}: mean error {result['mape']:.1%}, "
        f"worst {result['max_ape']:.1%}, {result['within_5']:.0%} within 5%, "
        f"{result['within_10']:.0%} within 10%{rank}"
    )


def _bench(options: argparse.Namespace, known: Profile) -> Bench:
    """A bench on this machine, if the profile is one of a machine at hand."""
    from ..model.machine import cores
    from .measure import Bench, this_machine

    if known.machine is None:
        raise UsageError(
            f"{known.title} is not this machine; without --samples its points are left out in turn"
        )
    threads = options.threads or known.machine.threads
    here = this_machine(threads)
    if here.processor != known.machine.processor:
        _warn(f"the profile is of {known.machine.processor}; this is {here.processor}")
    if here.versions != known.machine.versions:
        _warn(f"the profile was fitted with {known.machine.versions}, not {here.versions}")
    return Bench(min(threads, cores()))


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
    residuals = fitted.calibrations[0].residuals
    error = summary(residuals)
    if options.json:
        result = {"schema": "rts2.profile-fit/1", "file": str(path), "n": len(residuals), **error}
        print_json(result)
        return
    _print(
        f"{fitted.title}: {len(residuals)} timings, each left out in turn: "
        f"mean error {error['mape']:.1%}, worst {error['max_ape']:.1%}\nwritten   {path}"
    )


def _fit_here(options: argparse.Namespace, template: Profile, path: Path) -> Profile:
    """Times networks until the budget is spent, going on where an earlier run stopped."""
    from ..model.machine import cores
    from .calibrate import FORMS
    from .measure import Bench, candidates, extend, open_journal, profile_of

    threads = options.threads or cores()
    journal_path = path.with_name(f"{path.stem}.timings.json")
    journal = open_journal(journal_path, threads, options.seed)
    deadline = monotonic() + options.budget
    bench = Bench(threads)
    remaining = islice(candidates(options.seed), len(journal.samples), None)
    for candidate in _until(deadline, remaining, journal):
        journal = extend(journal, journal_path, bench, candidate)
    needed = 2 * (1 + len(FORMS["fused_cpu"].ms_per))
    if len(journal.samples) < needed:
        raise Rts2Error(
            f"{len(journal.samples)} networks were timed and a fit needs {needed}; "
            "the same command with a longer --budget goes on from here"
        )
    name = re.sub("[^a-z0-9._-]+", "-", path.stem.lower()).strip("._-")
    return profile_of(journal, template, name or template.name)


def _until(deadline: float, items: Any, journal: Journal) -> Any:
    """Items until the deadline, with a bar of the seconds spent on a terminal."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    started = monotonic()
    with Progress(console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("timing networks", total=deadline - started)
        for count, item in enumerate(items, len(journal.samples) + 1):
            if monotonic() >= deadline:
                return
            text = f"timing network {count}: {item[0].label()}"
            bar.update(task, completed=monotonic() - started, description=text)
            yield item


def _measure(options: argparse.Namespace) -> None:
    from ..model.files import existing_file
    from ..model.machine import cores
    from .measure import Bench, this_machine

    threads = options.threads or cores()
    paths = [existing_file(path, "an ONNX file") for path in options.models]
    bench = Bench(threads)
    timed = [(path, bench.time_file(path)) for path in progress(paths, "timing", len(paths))]
    if options.json:
        rows = [
            {
                "model": str(path),
                "latency_ms": timing.median_ms,
                "p95_ms": timing.p95_ms,
                "fps": 1000 / timing.median_ms,
                "runs": timing.runs,
                "reference_ms": timing.reference_ms,
            }
            for path, timing in timed
        ]
        here = this_machine(threads).model_dump(mode="json")
        print_json({"schema": "rts2.profile-measure/1", "machine": here, "models": rows})
        return
    table = _table("model", "median", "95th percentile", "FPS", "runs", "against reference")
    for path, timing in timed:
        ratio = timing.median_ms / timing.reference_ms
        table.add_row(
            str(path),
            f"{timing.median_ms:.2f} ms",
            f"{timing.p95_ms:.2f} ms",
            f"{1000 / timing.median_ms:.1f}",
            str(timing.runs),
            f"{ratio:.2f} ×",
        )
    _print(table)
    _print(f"\nONNX Runtime, {threads} threads, batch 1, the network alone")


def _table(*columns: str) -> Any:
    from rich.table import Table

    table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 2, 0, 0))
    for column in columns:
        table.add_column(column, overflow="fold")
    return table


def _print(what: Any) -> None:
    screen().print(what)
