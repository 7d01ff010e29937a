"""A grid of chains judged by a supernet: what samplers are compared on, and what 3D widths do.

    python benchmarks/grid.py SUPERNET ALONE… --out FOLDER [--size 320x160] [--workers 1]

writes reference.json, accuracies as `rts2-search --accuracy FILE` takes them, and effects.json, by
which the paper's accuracies are carried over to other 3D widths and planes. ALONE are checkpoints
of networks trained alone, several of each c: they tell how far to trust effects that are inherited.
An interrupted run goes on from what FOLDER holds. Without a supernet it tells what the effects
leave unexplained of the reference table at hand, the root mean square in percent of the odds.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from collections.abc import Iterator, Sequence
from datetime import date
from functools import cache
from itertools import combinations, product
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from rts2.model.arch import CONV3D, Arch
from rts2.model.box import named_model
from rts2.model.checkpoint import load
from rts2.model.console import progress, resolution
from rts2.model.data.catalog import open_dataset
from rts2.model.evaluation import evaluate, overall
from rts2.model.files import output_folder, read_json, write_bytes
from rts2.model.machine import processor
from rts2.model.predictor import TorchPredictor
from rts2.search.accuracy import METRICS, Metric, Row, unbounded
from rts2.search.inherited import BATCH, BATCHES, Data, Inherited
from rts2.search.sources import MeasuredRows

CS = (1, 2, 3, 4, 6, 8, 11, 16)
D_MAXS = (6, 9, 12, 16, 24)
WIDTHS = ((4, 16, 32), (2, 4, 16), (2, 4, 16))
USUAL = (Arch().d_max, *CONV3D)
DIGITS = 4
REFERENCE = Path(__file__).with_name("reference.json")

Group = dict[tuple[int, ...], float]
"""One metric, unbounded, by c, d_max and 3D widths."""


def main() -> None:
    """Judges the grid and writes both files, or tells what effects leave unexplained."""
    options = _options()
    if options.supernet is None:
        _show(read_json(REFERENCE, MeasuredRows, "a table of accuracies").rows, options.json)
        return
    rows = _judged(options)
    source = rows[0].source
    folder = output_folder(options.out)
    write_bytes(folder / REFERENCE.name, _table(rows).encode())
    told = (
        f"{source}; streets at {options.size[0]}x{options.size[1]}, {processor()}, {date.today()}"
    )
    effects = {
        "schema": "rts2.effects/1",
        "protocol": told,
        "inherited": round(_distrust(options), DIGITS),
        "rows": list(_effects(rows)),
    }
    write_bytes(folder / "effects.json", _lines(effects).encode())
    _show(rows, options.json)


def _lines(effects: dict[str, Any]) -> str:
    """The file, one row a line."""
    *head, (name, rows) = effects.items()
    lines = ",\n".join(json.dumps(row) for row in rows)
    return f"{json.dumps(dict(head))[:-1]}, {json.dumps(name)}: [\n{lines}\n]}}\n"


def _judged(options: argparse.Namespace) -> list[Row]:
    """The rows of every chain, each network once."""
    archs = [Arch(c=c, d_max=d, conv3d=w) for c, d, w in product(CS, D_MAXS, product(*WIDTHS))]
    given = (options.supernet, options.size, options.count, options.out)
    context = get_context("spawn")
    with context.Pool(options.workers, initializer=_single) as pool:
        jobs = [(given, arch) for arch in archs]
        found = list(progress(pool.imap(_rows, jobs, chunksize=8), "judging", len(jobs)))
    return list({row.arch: row for rows in found for row in rows}.values())


def _single() -> None:
    """One thread a process: there are as many processes as there should be threads."""
    import torch

    torch.set_num_threads(1)


def _rows(job: tuple[tuple[Any, ...], Arch]) -> tuple[Row, ...]:
    given, arch = job
    return _judge(*given).rows(arch)


@cache
def _judge(supernet: str, size: tuple[int, int], count: int, out: Path) -> Inherited:
    return Inherited(named_model(supernet), _data(size, count), out / "judged")


def _data(size: tuple[int, int], count: int) -> Data:
    judging = open_dataset("streets", split="val", count=count, size=size)
    training = open_dataset("streets", split="train", count=BATCH * BATCHES, size=size)
    return Data.of(training, judging, count)


def _table(rows: Sequence[Row]) -> str:
    """The file, one network a line."""
    lines = (
        json.dumps(
            {
                "arch": row.arch.model_dump(mode="json", exclude_defaults=True),
                **{metric: _short(row.value(metric)) for metric in METRICS},
                "source": row.source,
            }
        )
        for row in rows
    )
    return '{"schema": "rts2.accuracy/1", "rows": [\n' + ",\n".join(lines) + "\n]}\n"


def _short(value: float | None) -> float | None:
    return None if value is None else round(value, DIGITS)


def _groups(rows: Sequence[Row]) -> dict[tuple[int, str, Metric], Group]:
    """By stages, branches and metric."""
    found: dict[tuple[int, str, Metric], Group] = defaultdict(dict)
    for row in rows:
        at = (row.arch.c, row.arch.d_max, *row.arch.conv3d)
        for metric in METRICS:
            if value := row.value(metric):
                told = float(unbounded(metric, np.array(value)))
                found[row.arch.stages, row.arch.branches, metric][at] = told
    return found


def _effects(rows: Sequence[Row]) -> Iterator[dict[str, Any]]:
    """The effects of all values of each dimension, by least squares over the grid."""
    for (stages, branches, metric), group in _groups(rows).items():
        effects, missed = _fitted(group, stages)
        curves = [
            {
                "values": values,
                "effects": [round(effects.get((axis, value), 0.0), DIGITS) for value in values],
            }
            for axis, values in enumerate(_axes(stages))
        ]
        yield {
            "stages": stages,
            "branches": branches,
            "metric": metric,
            "d_max": curves[0],
            "conv3d": curves[1:],
            "spread": round(missed, DIGITS),
        }


def _axes(stages: int) -> tuple[tuple[int, ...], ...]:
    return (D_MAXS, *WIDTHS[:stages])


def _fitted(group: Group, stages: int) -> tuple[dict[tuple[int, int], float], float]:
    """The effects by axis and value, and the root mean square of what they miss of the difference
    from the paper's widths and planes at the same c.
    """
    unusual = [
        (axis, v) for axis, values in enumerate(_axes(stages)) for v in values if v != USUAL[axis]
    ]
    base = USUAL[: 1 + stages]
    changed = [(at, value - group[(at[0], *base)]) for at, value in group.items() if at[1:] != base]
    features = np.array([[at[1 + axis] == value for axis, value in unusual] for at, _ in changed])
    changes = np.array([change for _, change in changed])
    weights = np.linalg.lstsq(features.astype(float), changes, rcond=None)[0]
    missed = float(np.sqrt(np.mean((changes - features @ weights) ** 2)))
    return dict(zip(unusual, weights.tolist(), strict=True)), missed


def _distrust(options: argparse.Namespace) -> float:
    """By how much effects on the D1-all of networks trained alone differ from those inherited: the
    root mean square over pairs of one c and every stage.
    """
    judge = _judge(options.supernet, options.size, options.count, options.out)
    apart: dict[tuple[int, int], list[float]] = defaultdict(list)
    for path in options.alone:
        network, _ = load(path)
        judged = [each.scores for each in evaluate(TorchPredictor(network), judge.data.judging)]
        own = {stage: score.d1_all for stage, score in overall(judged).items()}
        for row in judge.rows(network.arch):
            if row.arch.refinement:
                stages = row.arch.stages
                pair = np.array([own[stages], row.d1_all], float)
                apart[row.arch.c, stages].append(float(np.subtract(*unbounded("d1_all", pair))))
    differences = [a - b for group in apart.values() for a, b in combinations(group, 2)]
    return float(np.sqrt(np.mean(np.square(differences))))


def _show(rows: Sequence[Row], as_json: bool) -> None:
    """What the effects miss of D1-all, by stages and branches."""
    missed = {
        f"{stages} stages, {branches}": 100 * _fitted(group, stages)[1]
        for (stages, branches, metric), group in _groups(rows).items()
        if metric == "d1_all"
    }
    if as_json:
        print(json.dumps(missed))
        return
    print(f"{len(rows)} networks; what effects miss of D1-all, in percent of its odds")
    for name, share in missed.items():
        print(f"  {name:32} {share:5.2f}")


def _options() -> argparse.Namespace:
    asked = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    asked.add_argument("supernet", nargs="?")
    asked.add_argument("alone", nargs="*", type=Path)
    asked.add_argument("--out", type=Path, default=Path("grid"))
    asked.add_argument("--size", type=resolution, default=(320, 160))
    asked.add_argument("--count", type=int, default=32)
    asked.add_argument("--workers", type=int, default=1)
    asked.add_argument("--json", action="store_true")
    return asked.parse_args()


if __name__ == "__main__":
    main()
