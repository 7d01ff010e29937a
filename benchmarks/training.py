"""Training steps a second at the paper's crop and batch, and what of a step is waiting for data."""

from __future__ import annotations

import json
import sys
import tempfile
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from time import perf_counter

import torch

from rts2.model.checkpoint import build
from rts2.model.data.cache import Cached
from rts2.model.machine import cores
from rts2.model.train.loader import PREFETCHED, Batch, Places, loader, one_thread
from rts2.model.train.precision import Resolved, resolve
from rts2.model.train.recipe import PRESETS, Recipe, recipe_from
from rts2.model.train.source import open_samples
from rts2.model.train.trainer import Trainer

STEPS = 12
WARM = 3
BAR = 0.05
"""The largest share of a step that may be spent waiting."""

WANTED_PER_S = 10
"""How many pairs of 512×256 one core should generate in a second."""

MADE = 40
"""How many pairs that is measured on."""

COMPILED = 8
"""How many are made before: sunny ones among them, so that all compiled code is loaded."""


@dataclass(frozen=True)
class Plan:
    """How many workers feed how many steps."""

    workers: int

    @property
    def queue(self) -> int:
        """How many batches may be ready before anybody asks."""
        return self.workers * PREFETCHED

    @property
    def skipped(self) -> int:
        """Steps that empty the queue as it was filled before the clock ran."""
        return WARM + self.queue

    @property
    def timed(self) -> int:
        """More steps than the queue holds, so that it cannot hide a loader that is too slow."""
        return self.queue + STEPS

    @property
    def recipe(self) -> Recipe:
        """All branches, c = 8, batch 6, 256×512, as in the paper; every scene comes once."""
        steps = self.skipped + self.timed
        return recipe_from(PRESETS["streets"] | {"count": 6 * steps, "epochs": 1})


def scenes(plan: Plan, cache: Path) -> Cached:
    """The recipe's samples, kept in `cache` once they were made."""
    return Cached(open_samples(plan.recipe, None), cache)


def device() -> torch.device:
    """Where a run would train."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def trainer(recipe: Recipe, precision: Resolved) -> Trainer:
    """A fresh network, ready to step."""
    torch.manual_seed(0)
    return Trainer(build(recipe.arch), recipe, precision, device())


def stepped(learner: Trainer, batch: Batch) -> float:
    """Seconds of one step; reading its loss waits for the device."""
    begin = perf_counter()
    learner.step([batch], learner.recipe.lr)
    return perf_counter() - begin


def step_seconds(recipe: Recipe, precisions: list[Resolved], batch: Batch) -> dict[Resolved, float]:
    """Median seconds of a step on a batch at hand; the precisions take turns."""
    learners = {precision: trainer(recipe, precision) for precision in precisions}
    for learner in learners.values():
        for _ in range(WARM):
            stepped(learner, batch)
    turns = [{p: stepped(learner, batch) for p, learner in learners.items()} for _ in range(STEPS)]
    return {p: median(turn[p] for turn in turns) for p in precisions}


def waiting(plan: Plan, cache: Path, precision: Resolved) -> tuple[float, float]:
    """(share of the time spent waiting for the loader, images/s), as in a run."""
    learner = trainer(plan.recipe, precision)
    places = Places(plan.recipe, 0, plan.skipped + plan.timed)
    batches = iter(loader(scenes(plan, cache), plan.recipe, places, plan.workers))
    for _ in range(plan.skipped):
        stepped(learner, next(batches))
    waited, begin = 0.0, perf_counter()
    for _ in range(plan.timed):
        asked = perf_counter()
        batch = next(batches)
        waited += perf_counter() - asked
        stepped(learner, batch)
    took = perf_counter() - begin
    return waited / took, plan.recipe.batch * plan.timed / took


def made_per_s() -> float:
    """Pairs of 512×256 that one core generates in a second, in a process that uses one alone."""
    with get_context("spawn").Pool(1, one_thread, (0,)) as alone:
        return MADE / alone.apply(making_seconds)


def making_seconds() -> float:
    """Seconds of as many pairs, after the first ones."""
    samples = open_samples(recipe_from(PRESETS["streets"] | {"count": MADE + COMPILED}), None)
    for index in range(COMPILED):
        samples[MADE + index].read()
    begin = perf_counter()
    for index in range(MADE):
        samples[index].read()
    return perf_counter() - begin


def main() -> None:
    """Measures and prints the table, or its ratios as JSON."""
    torch.set_num_threads(cores())
    fast = resolve("auto", device())
    plan = Plan(max(1, cores() - 1 if device().type == "cuda" else cores() // 4))
    made = made_per_s()
    with tempfile.TemporaryDirectory() as folder:
        generated = waiting(plan, Path(folder), fast)
        stored = waiting(plan, Path(folder), fast)
        first = Places(plan.recipe, 0, 1)
        batch = next(iter(loader(scenes(plan, Path(folder)), plan.recipe, first, 0)))
    precisions: list[Resolved] = ["fp32"] if fast == "fp32" else ["fp32", fast]
    seconds = step_seconds(plan.recipe, precisions, batch)
    if "--json" in sys.argv:
        ratio = None if fast == "fp32" else seconds["fp32"] / seconds[fast]
        found = {"train_mixed_vs_fp32": ratio, "streets_vs_10_per_s": made / WANTED_PER_S}
        found |= {"train_wait_share": stored[0], "train_wait_share_generating": generated[0]}
        print(json.dumps(found))
        return
    print(f"{plan.recipe.arch.label()}, batch 6 of 256×512, {device().type}, {cores()} cores")
    for precision, each in seconds.items():
        ratio = seconds["fp32"] / each
        print(f"  step, {precision}   {plan.recipe.batch / each:6.1f} images/s   {ratio:.2f} ×")
    if fast == "fp32":
        print("  no mixed precision that this machine computes fast")
    enough = "enough" if made >= WANTED_PER_S else "too few"
    print(f"streets: {made:.1f} pairs/s on one core; {WANTED_PER_S} are wanted: {enough}")
    print(f"streets through the loader, {fast}, {plan.workers} workers, {plan.timed} steps")
    for name, (share, rate) in {"made on the way": generated, "from --cache": stored}.items():
        verdict = "holds" if share < BAR else "is missed"
        print(
            f"  {name:15} {rate:6.1f} images/s   {share:5.1%} of it waiting: "
            f"below {BAR:.0%} {verdict}"
        )
    print("the bar is that of --cache: scenes made on the way cost what they cost")


if __name__ == "__main__":
    main()
