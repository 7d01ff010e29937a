"""What a run learns from: its samples, and how often each class occurs in them."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset

from ..data.cache import Cached
from ..data.catalog import DATASETS, STREETS, open_dataset
from ..data.scene import Sample, fingerprint
from ..errors import Rts2Error, UsageError
from ..metrics import IGNORED
from .distributed import World
from .loader import Fault, ended, fault, require_labels, staff
from .recipe import Recipe

Shown = Callable[[Iterable[Any], str, int], Iterable[Any]]
"""Passes items on and shows how far they are: (items, title, total)."""


def digest(samples: Sequence[Sample]) -> str:
    """The SHA-256 of all names in their order, after the generator's fingerprint."""
    lines = [fingerprint(samples) or "", *(sample.name for sample in samples)]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


class LabelCounts(Dataset[Any]):
    """How many pixels of a sample each class has."""

    def __init__(self, samples: Sequence[Sample], chosen: Sequence[int], classes: int) -> None:
        self.samples, self.chosen, self.classes = samples, chosen, classes

    def __len__(self) -> int:
        return len(self.chosen)

    def __getitem__(self, place: int) -> NDArray[np.int64] | Fault:
        sample = self.samples[self.chosen[place]]
        try:
            labels = require_labels(sample.read(), self.classes)
        except (Rts2Error, OSError, MemoryError) as error:
            return fault(error, sample.name)
        return np.bincount(labels[labels != IGNORED], minlength=self.classes).astype(np.int64)


def class_shares(
    samples: Sequence[Sample], recipe: Recipe, workers: int, world: World, shown: Shown
) -> NDArray[np.float64]:
    """Each class's share of the labelled pixels, counted on evenly spaced samples.

    Raises `Rts2Error` where a sample has no labels or wrong ones.
    """
    wanted = min(recipe.counted, len(samples))
    chosen = [place * len(samples) // wanted for place in range(wanted)]
    mine = LabelCounts(samples, chosen[world.rank :: world.size], recipe.arch.classes)
    own = world.together(lambda: _counted(mine, workers, shown))
    pixels = np.array(world.total(own.tolist()))
    if not pixels.any():
        raise world.everywhere(
            Rts2Error(
                f"the semantic branch learns from labels: {wanted} samples have no labelled "
                "pixel; train --branches disparity"
            )
        )
    shares: NDArray[np.float64] = pixels / pixels.sum()
    return shares


def _counted(counts: LabelCounts, workers: int, shown: Shown) -> NDArray[np.int64]:
    """The pixels of each class in all of the samples."""
    loader = DataLoader(counts, batch_size=None, **staff(workers))
    pixels = np.zeros(counts.classes, np.int64)
    try:
        for found in shown(loader, "counting classes", len(counts)):
            if isinstance(found, Fault):
                raise found.error()
            pixels += np.asarray(found)
    except RuntimeError as error:
        raise ended(error).error() from error
    return pixels


def open_samples(recipe: Recipe, folder: Path | None) -> Sequence[Sample]:
    """The training samples of a recipe; generated ones are of the size of a crop.

    Raises `UsageError` for an unknown data set, folder or split.
    """
    height, width = recipe.crop
    split = recipe.split
    if split is None and recipe.dataset in DATASETS:
        split = DATASETS[recipe.dataset].trained
    if recipe.dataset == STREETS and split == DATASETS[STREETS].judged:
        raise UsageError(f"the {STREETS} of {split} judge, and never train; leave --split out")
    return open_dataset(
        recipe.dataset,
        folder,
        split,
        count=recipe.count,
        size=(width, height),
        seed=recipe.data_seed,
        rectification_px=recipe.rectification_px,
    )


def cached(samples: Sequence[Sample], folder: Path | None) -> Sequence[Sample]:
    """The same samples, each read once and kept in `folder`."""
    return samples if folder is None else Cached(samples, folder)
