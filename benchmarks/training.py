"""Training steps a second at the paper's crop and batch, and what of a step is waiting for data."""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from statistics import median
from time import perf_counter

import torch

from rts2.model.checkpoint import build
from rts2.model.data.cache import Cached
from rts2.model.train.loader import Batch, Places, loader
from rts2.model.train.precision import Resolved, resolve
from rts2.model.train.recipe import PRESETS, Recipe, recipe_from
from rts2.model.train.source import open_samples
from rts2.model.train.trainer import Trainer
from rts2.profiles.measure import cores

STEPS = 12
WARM = 3
BAR = 0.05
"""The largest share of a step that may be spent waiting."""

RECIPE: Recipe = recipe_from(PRESETS["streets"] | {"count": 6 * (WARM + STEPS), "epochs": 1})
"""c = 8, all branches, batch 6, 256×512, as in the paper; every scene comes once."""


def scenes(cache: Path) -> Cached:
    """The recipe's samples, kept in `cache` once they were made."""
    return Cached(open_samples(RECIPE, None), cache)


def device() -> torch.device:
    """Where a run would train."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def trainer(precision: Resolved) -> Trainer:
    """A fresh network, ready to step."""
    torch.manual_seed(0)
    return Trainer(build(RECIPE.arch), RECIPE, precision, device())


def stepped(learner: Trainer, batch: Batch) -> float:
    """Seconds of one step; reading its loss waits for the device."""
    begin = perf_counter()
    learner.step([batch], RECIPE.lr)
    return perf_counter() - begin


def step_seconds(precisions: list[Resolved], batch: Batch) -> dict[Resolved, float]:
    """Median seconds of a step on a batch at hand; the precisions take turns."""
    learners = {precision: trainer(precision) for precision in precisions}
    for learner in learners.values():
        for _ in range(WARM):
            stepped(learner, batch)
    turns = [{p: stepped(learner, batch) for p, learner in learners.items()} for _ in range(STEPS)]
    return {p: median(turn[p] for turn in turns) for p in precisions}


def waiting(cache: Path, precision: Resolved, workers: int) -> tuple[float, float]:
    """(share of the time spent waiting for the loader, images/s), as in a run."""
    learner = trainer(precision)
    batches = iter(loader(scenes(cache), RECIPE, Places(RECIPE, 0, WARM + STEPS), workers))
    for _ in range(WARM):
        stepped(learner, next(batches))
    waited, begin = 0.0, perf_counter()
    for _ in range(STEPS):
        asked = perf_counter()
        batch = next(batches)
        waited += perf_counter() - asked
        stepped(learner, batch)
    took = perf_counter() - begin
    return waited / took, RECIPE.batch * STEPS / took


def main() -> None:
    """Measures and prints the table, or its ratios as JSON."""
    torch.set_num_threads(cores())
    fast = resolve("auto", device())
    workers = max(1, cores() - 1 if device().type == "cuda" else cores() // 4)
    with tempfile.TemporaryDirectory() as folder:
        generated = waiting(Path(folder), fast, workers)
        stored = waiting(Path(folder), fast, workers)
        batch = next(iter(loader(scenes(Path(folder)), RECIPE, Places(RECIPE, 0, 1), 0)))
    seconds = step_seconds(["fp32", fast] if fast != "fp32" else ["fp32"], batch)
    if "--json" in sys.argv:
        found = {"train_mixed_vs_fp32": seconds["fp32"] / seconds[fast]}
        found |= {"train_wait_share": stored[0], "train_wait_share_generating": generated[0]}
        print(json.dumps(found))
        return
    print(f"{RECIPE.arch.label()}, batch 6 of 256×512, {device().type}, {cores()} cores")
    for precision, each in seconds.items():
        ratio = seconds["fp32"] / each
        print(f"  step, {precision}   {RECIPE.batch / each:6.1f} images/s   {ratio:.2f} ×")
    print(f"streets through the loader, {fast}, {workers} workers")
    for name, (share, rate) in {"made on the way": generated, "from --cache": stored}.items():
        print(f"  {name:15} {rate:6.1f} images/s   {share:5.1%} of it waiting")
    verdict = "holds" if stored[0] < BAR else "is missed"
    print(f"waiting below {BAR:.0%} of a step: the bar {verdict}")


if __name__ == "__main__":
    main()
