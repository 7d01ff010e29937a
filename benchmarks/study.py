"""How near a budget of evaluations comes to the front of all chains, by who chooses them.

    python benchmarks/study.py [TABLE] [--budget 200] [--target-fps 5] [--picture FILE.png] [--json]

TABLE is a file of accuracies (rts2.accuracy/1) that has every network of a grid of chains, the one
that benchmarks/grid.py made unless told. Every sampler judges chains: what a network holds is known
with it.
The volume below the front is in latency on a Jetson TX2, D1-all and mIoU, up to the target, as a
share of what all chains of the table have; means and extremes of five seeds.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from statistics import mean

import moocore
import numpy as np
import optuna
from optuna.samplers import BaseSampler, NSGAIISampler, RandomSampler, TPESampler

from rts2.model.arch import LARGEST, Arch
from rts2.model.files import read_json
from rts2.profiles.profile import load
from rts2.search.accuracy import Row
from rts2.search.exhaustive import Question
from rts2.search.landscape import Chains, Landscape
from rts2.search.sampler import FrontSampler, as_stored
from rts2.search.sources import MeasuredRows
from rts2.search.space import Space

SEEDS = 5
BAR = 0.98
METRICS = ("d1_all", "miou")
REFERENCE = Path(__file__).with_name("reference.json")

Points = dict[int, list[tuple[float, ...]]]


@dataclass(frozen=True)
class Grid:
    """A table as a space of its own, and where each chain's networks lie."""

    landscape: Landscape
    rows: dict[int, tuple[Row, ...]]

    @classmethod
    def of(cls, table: MeasuredRows, question: Question) -> Grid:
        """Raises `KeyError` where the table lacks a network of its grid."""
        known = {row.arch: row for row in table.rows}
        whole = [arch for arch in known if arch.stages == LARGEST.stages]
        space = Space(
            c=_values([arch.c for arch in whole]),
            d_max=_values([arch.d_max for arch in whole]),
            conv3d=tuple(_values([arch.conv3d[s] for arch in whole]) for s in range(3)),
        )
        chains = Chains.of(LARGEST, space)
        rows = {
            chain: tuple(known[part] for part in _held(chains.arch(chains.values(chain))))
            for chain in range(chains.size)
        }
        return cls(Landscape.of(question, chains, METRICS), rows)

    def points(self, chain: int) -> list[tuple[float, ...]]:
        """Latency, D1-all and negative mIoU of the networks that meet the target."""
        return [
            (latency, row.d1_all, -row.miou)
            for row in self.rows[chain]
            if row.d1_all is not None and row.miou is not None
            if (latency := self.landscape.latency_ms(row.arch)) <= self.landscape.target_ms
        ]


def _values(every: list[int]) -> tuple[int, ...]:
    return tuple(sorted(set(every)))


def _held(arch: Arch) -> list[Arch]:
    """The networks of fewer stages or branches that come with a whole one."""
    branches = ((False, False), (True, False), (True, True))
    return [
        arch.up_to(stages).model_copy(update={"semantic": semantic, "refinement": refinement})
        for stages, (semantic, refinement) in product((1, 2, 3), branches)
    ]


def judged(grid: Grid, sampler: BaseSampler, budget: int) -> list[int]:
    """The chains that a sampler has judged, in order; a chain judged again is no evaluation.

    A sampler that asks for nothing new in many trials has used up what it knows.
    """
    study = optuna.create_study(sampler=sampler, directions=["minimize", "minimize", "maximize"])
    chains, found = grid.landscape.chains, list[int]()
    ours = isinstance(sampler, FrontSampler)
    for _ in range(20 * budget):
        if len(found) == min(budget, len(grid.landscape.admitted)):
            break
        trial = study.ask(sampler.dimensions() if isinstance(sampler, FrontSampler) else None)
        values = dict(trial.params) if ours else _asked(trial, chains)
        chain = chains.number(values)
        points = grid.points(chain)
        if ours:
            trial.set_user_attr("rows", as_stored(grid.rows[chain]))
        if points and chain not in found:
            found.append(chain)
        best = min(points, key=lambda point: point[1], default=(1e6, 100.0, 0.0))
        trial.set_constraint("latency", best[0] / grid.landscape.target_ms - 1)
        study.tell(trial, [best[0], best[1], -best[2]])
    return found


def _asked(trial: optuna.Trial, chains: Chains) -> dict[str, int]:
    """A chain from a sampler of Optuna's, which is told that the dimensions are ordered."""
    return {
        name: axis[trial.suggest_int(name, 0, len(axis) - 1)] for name, axis in chains.axes.items()
    }


def curves(grid: Grid, budget: int) -> dict[str, list[list[float]]]:
    """By sampler and seed: the share of the volume after each evaluation."""
    middle = grid.landscape.chains.nearest(Arch())
    samplers: dict[str, Callable[[int], BaseSampler]] = {
        "ours": lambda seed: FrontSampler(
            grid.landscape, METRICS, [middle, *_random(grid, seed, 3)]
        ),
        "NSGA-II": lambda seed: NSGAIISampler(seed=seed, population_size=20),
        "TPE": lambda seed: TPESampler(seed=seed),
        "random": lambda seed: RandomSampler(seed=seed),
    }
    every = np.array([point for chain in grid.rows for point in grid.points(chain)])
    reference = every.max(0)
    whole = moocore.hypervolume(every, ref=reference)

    def shares(chains: list[int]) -> list[float]:
        known, found = np.empty((0, 3)), []
        for chain in chains:
            known = np.vstack([known, grid.points(chain)])
            known = known[moocore.is_nondominated(known)]
            found.append(float(moocore.hypervolume(known, ref=reference) / whole))
        return found

    return {
        name: [shares(judged(grid, make(seed), budget)) for seed in range(SEEDS)]
        for name, make in samplers.items()
    }


def _random(grid: Grid, seed: int, count: int) -> list[int]:
    chance = np.random.default_rng(seed)
    return [int(chain) for chain in chance.choice(grid.landscape.admitted, count, replace=False)]


def draw(found: dict[str, list[list[float]]], path: Path) -> None:
    """The shares against evaluations: a line for the mean of each sampler, a band for its seeds."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.add_subplot()
    for name, runs in found.items():
        length = min(map(len, runs))
        values = np.array([run[:length] for run in runs])
        steps = np.arange(1, length + 1)
        (line,) = axes.plot(steps, values.mean(0), label=name)
        axes.fill_between(steps, values.min(0), values.max(0), alpha=0.2, color=line.get_color())
    axes.axhline(BAR, color="#9aa5b1", linestyle="--", linewidth=1)
    axes.set(xlabel="evaluations", ylabel="share of the exhaustive front's hypervolume")
    axes.set_ylim(0.85, 1.002)
    axes.legend()
    figure.savefig(path, dpi=110)


def main() -> None:
    """Prints the table, or its shares as JSON."""
    options = _options()
    optuna.logging.set_verbosity(optuna.logging.CRITICAL)
    question = Question(load("tx2"), options.target_fps, allow_extrapolated=True)
    grid = Grid.of(read_json(options.table, MeasuredRows, "a table of accuracies"), question)
    found = curves(grid, options.budget)
    if options.picture:
        draw(found, options.picture)
    last = {name: [run[-1] for run in runs] for name, runs in found.items()}
    if options.json:
        print(json.dumps({name: mean(shares) for name, shares in last.items()}))
        return
    admitted = len(grid.landscape.admitted)
    print(f"{options.budget} evaluations of {admitted} chains, {SEEDS} seeds (bar: {BAR:.0%})")
    for name, shares in last.items():
        print(f"  {name:8} {mean(shares):7.2%}   {min(shares):7.2%} … {max(shares):7.2%}")


def _options() -> argparse.Namespace:
    asked = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    asked.add_argument("table", type=Path, nargs="?", default=REFERENCE)
    asked.add_argument("--budget", type=int, default=200)
    asked.add_argument("--target-fps", type=float, default=5.0)
    asked.add_argument("--picture", type=Path)
    asked.add_argument("--json", action="store_true")
    return asked.parse_args()


if __name__ == "__main__":
    main()
