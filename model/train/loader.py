"""From samples to batches: stateless, so that a step number is the whole state.

The samples of a run form one endless line, epoch after epoch, each epoch in an order of its own.
Step s takes the places s·batch … of that line. Order, crop and colours of a place derive from the
seed, the epoch and the sample's index alone, never from what was loaded before.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from ..data.scene import Sample, Scene
from ..errors import Rts2Error, UsageError
from ..losses import Truth
from ..metrics import IGNORED
from .augment import augmented, crop
from .recipe import Recipe

PREFETCHED: Final = 4
"""How many batches a worker has ready at most."""

SMALLER: Final = "give a larger --accumulate, or a smaller --batch or --crop, in another --out"
"""What helps where memory is short."""

ORDER, SCENE = 0, 1
"""What a generator is for: its seed ends in one of these."""


@dataclass
class Batch:
    """Images and truth of some samples; images are (B, H, W, 3) RGB bytes."""

    names: list[str]
    left: Tensor
    right: Tensor
    truth: Truth

    def pin_memory(self) -> Batch:
        """DataLoader's hook: page-locked copies, which a GPU fetches on the side."""
        labels = self.truth.labels
        truth = Truth(
            self.truth.disparity.pin_memory(), None if labels is None else labels.pin_memory()
        )
        return Batch(self.names, self.left.pin_memory(), self.right.pin_memory(), truth)


@dataclass(frozen=True)
class Fault:
    """An error of a worker on its way to the process that trains."""

    text: str
    usage: bool

    def error(self) -> Rts2Error:
        return UsageError(self.text) if self.usage else Rts2Error(self.text)


@dataclass(frozen=True)
class Line:
    """The endless line of samples."""

    samples: int
    seed: int

    def at(self, place: int) -> tuple[int, int]:
        """(epoch, index) of a place of the line."""
        epoch, offset = divmod(place, self.samples)
        return epoch, int(_order(self.samples, self.seed, epoch)[offset])


@lru_cache(maxsize=4)
def _order(samples: int, seed: int, epoch: int) -> NDArray[np.int64]:
    return np.random.default_rng([seed, epoch, ORDER]).permutation(samples)


@dataclass(frozen=True)
class Places:
    """Which places of the line one process loads: a list for each micro-batch, step by step."""

    recipe: Recipe
    first: int
    last: int
    """Steps first … last−1."""
    rank: int = 0
    world: int = 1

    def __iter__(self) -> Iterator[list[int]]:
        size = self.recipe.batch // self.recipe.accumulate
        share = size // self.world
        for step in range(self.first, self.last):
            for micro in range(self.recipe.accumulate):
                start = step * self.recipe.batch + micro * size + self.rank * share
                yield list(range(start, start + share))

    def __len__(self) -> int:
        return (self.last - self.first) * self.recipe.accumulate


class Prepared(Dataset[Any]):
    """Cropped and augmented scenes by their place in the line."""

    def __init__(self, samples: Sequence[Sample], recipe: Recipe) -> None:
        self.samples = samples
        self.recipe = recipe
        self.line = Line(len(samples), recipe.seed)

    def __getitem__(self, place: int) -> Scene | Fault:
        epoch, index = self.line.at(place)
        try:
            rng = np.random.default_rng([self.recipe.seed, epoch, index, SCENE])
            scene = checked(self.samples[index].read(), self.recipe)
            return augmented(crop(scene, self.recipe.crop, rng), self.recipe.augmentation, rng)
        except (Rts2Error, OSError, MemoryError) as error:
            return fault(error, self.samples[index].name)


def fault(error: Rts2Error | OSError | MemoryError, name: str) -> Fault:
    """What kept the sample `name` from being read, in one line."""
    if isinstance(error, Rts2Error):
        return Fault(str(error), isinstance(error, UsageError))
    if isinstance(error, MemoryError):
        return Fault(f"{name} does not fit in memory; give a smaller --crop ({error})", False)
    return Fault(f"cannot read {name}: {error}", False)


def ended(error: RuntimeError | MemoryError) -> Fault:
    """What a worker's end means, in one line."""
    if isinstance(error, MemoryError):
        return Fault(f"the next batch does not fit in memory; {SMALLER} ({error})", False)
    return Fault(f"a worker of the loader ended: {error}; try --workers 0", False)


def checked(scene: Scene, recipe: Recipe) -> Scene:
    """`scene`, if the network can learn from it; else an `Rts2Error` that names it."""
    if not np.isfinite(scene.truth).any():
        raise Rts2Error(
            f"every sample needs known disparities: {scene.name} has none; "
            "give its ground truth, or leave the sample out"
        )
    if recipe.arch.semantic:
        require_labels(scene, recipe.arch.classes)
    return scene


def require_labels(scene: Scene, classes: int) -> NDArray[np.uint8]:
    """The scene's labels, known to be train ids; else an `Rts2Error` that names it."""
    labels = scene.semantic
    if labels is None:
        raise Rts2Error(
            f"the semantic branch learns from labels: {scene.name} has none; "
            "train --branches disparity, or leave the sample out"
        )
    wrong = labels[(labels >= classes) & (labels != IGNORED)]
    if wrong.size:
        raise Rts2Error(
            f"labels must be 0 to {classes - 1}, or {IGNORED} for none: {scene.name} holds "
            f"{wrong.flat[0]}; give train ids"
        )
    return labels


def collated(scenes: Sequence[Scene | Fault]) -> Batch | Fault:
    """One batch of equally large scenes; the first fault instead, if there is one."""
    for scene in scenes:
        if isinstance(scene, Fault):
            return scene
    whole = [scene for scene in scenes if isinstance(scene, Scene)]
    try:
        return _batch(whole)
    except MemoryError as error:
        return Fault(f"a batch of {len(whole)} does not fit in memory; {SMALLER} ({error})", False)


def _batch(whole: Sequence[Scene]) -> Batch:
    labels = [scene.semantic for scene in whole if scene.semantic is not None]
    return Batch(
        [scene.name for scene in whole],
        _stacked([scene.left for scene in whole]),
        _stacked([scene.right for scene in whole]),
        Truth(
            _stacked([scene.truth for scene in whole]),
            _stacked(labels) if len(labels) == len(whole) else None,
        ),
    )


def loader(
    samples: Sequence[Sample], recipe: Recipe, places: Places, workers: int, pin: bool = False
) -> DataLoader[Any]:
    """Batches (or a `Fault`), one for each micro-batch of the steps of `places`."""
    cv2.setNumThreads(0)
    return DataLoader(
        Prepared(samples, recipe),
        batch_sampler=places,
        collate_fn=collated,
        pin_memory=pin,
        prefetch_factor=PREFETCHED if workers else None,
        **staff(workers),
    )


def staff(workers: int) -> dict[str, Any]:
    """What DataLoader is told of its `workers` processes.

    On Linux they are forked off the process that trains, whatever Python's default is: a worker
    ends once its parent is gone, and one that a fork server started would outlive a killed run,
    as server and worker wait for each other. A fork copies the locks of threads; workers use none
    of the parent's, as each computes on a single thread.
    """
    return {
        "num_workers": workers,
        "multiprocessing_context": "fork" if workers and sys.platform == "linux" else None,
        "worker_init_fn": one_thread,
        "generator": torch.Generator(),  # of the workers' seeds, which nothing here uses
    }


def one_thread(_worker: int) -> None:
    """Workers are the parallelism: each computes on one thread."""
    cv2.setNumThreads(0)
    torch.set_num_threads(1)


def _stacked(arrays: Sequence[NDArray[Any]]) -> Tensor:
    return torch.from_numpy(np.stack(arrays))
