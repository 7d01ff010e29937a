"""The endless line of samples, and what a place of it gives."""

import multiprocessing
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from rts2.model.data.catalog import open_dataset
from rts2.model.data.scene import Sample, Scene
from rts2.model.train.loader import Batch, Fault, Line, Places, loader
from rts2.model.train.recipe import Recipe, recipe_from

ARCH = {"c": 1}


def recipe(**values: object) -> Recipe:
    defaults = {"dataset": "folder", "steps": 8, "arch": ARCH, "batch": 4, "crop": (32, 64)}
    return recipe_from(defaults | {"augmentation": {"gain": 0.2, "noise": 3}} | values)


def batches(
    samples: Sequence[Sample], given: Recipe, first: int = 0, last: int = 4, workers: int = 0
) -> list[Batch]:
    found = list(loader(samples, given, Places(given, first, last), workers))
    assert all(isinstance(batch, Batch) for batch in found)
    return found


def same(one: Batch, other: Batch) -> bool:
    assert one.truth.labels is not None
    assert other.truth.labels is not None
    return (
        one.names == other.names
        and torch.equal(one.left, other.left)
        and torch.equal(one.right, other.right)
        and torch.equal(one.truth.disparity.nan_to_num(-1), other.truth.disparity.nan_to_num(-1))
        and torch.equal(one.truth.labels, other.truth.labels)
    )


def test_every_epoch_is_all_samples_in_an_order_of_its_own() -> None:
    line = Line(samples=50, seed=3)
    epochs = [[line.at(epoch * 50 + place) for place in range(50)] for epoch in range(3)]
    for number, epoch in enumerate(epochs):
        assert {found for found, _ in epoch} == {number}
        assert sorted(index for _, index in epoch) == list(range(50))
    assert epochs[0] != epochs[1]
    assert [index for _, index in epochs[1]] != [index for _, index in epochs[2]]
    assert Line(50, 4).at(0) != line.at(0) or Line(50, 4).at(1) != line.at(1)


def test_micro_batches_and_processes_cut_a_step_without_loss() -> None:
    given = recipe(batch=12, accumulate=2)
    alone = list(Places(given, 3, 5))
    assert alone == [list(range(at, at + 6)) for at in (36, 42, 48, 54)]
    shares = [list(Places(given, 3, 5, rank, 3)) for rank in range(3)]
    assert [[*a, *b, *c] for a, b, c in zip(*shares, strict=True)] == alone
    assert len(Places(given, 3, 5)) == 4


def test_workers_change_nothing(pairs: Path) -> None:
    samples = open_dataset("folder", pairs)
    alone, many = batches(samples, recipe()), batches(samples, recipe(), workers=2)
    assert all(same(a, b) for a, b in zip(alone, many, strict=True))


@dataclass(frozen=True)
class Family:
    """A sample that is named by its process's parent."""

    size: tuple[int, int] = (64, 32)
    foreground: None = None

    @property
    def name(self) -> str:
        return str(os.getppid())

    def read(self) -> Scene:
        return replace(PLAIN, name=self.name)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere forks are not safe")
def test_workers_are_children_of_the_process_that_trains() -> None:
    """They end with their parent; those of a fork server, Python 3.14's default, would stay."""
    multiprocessing.set_start_method("forkserver", force=True)
    try:
        found = batches([Family()], recipe(batch=1), workers=2)
    finally:
        multiprocessing.set_start_method(None, force=True)
    assert {name for batch in found for name in batch.names} == {str(os.getpid())}


def test_a_step_is_the_same_from_wherever_one_starts(pairs: Path) -> None:
    samples = open_dataset("folder", pairs)
    whole, rest = batches(samples, recipe()), batches(samples, recipe(), first=2)
    assert all(same(a, b) for a, b in zip(whole[2:], rest, strict=True))
    assert not same(whole[0], batches(samples, recipe(seed=1))[0])


def test_a_sample_is_cropped_and_coloured_anew_in_every_epoch(pairs: Path) -> None:
    sample = open_dataset("folder", pairs)[:1]
    lefts = [batch.left[0] for batch in batches(sample, recipe(batch=1), last=6)]
    assert not any(torch.equal(a, b) for a, b in pairwise(lefts))


def test_a_batch_has_the_scene_s_values(pairs: Path) -> None:
    samples = open_dataset("folder", pairs)[2:3]
    plain = recipe(batch=1, augmentation={})
    batch = batches(samples, plain, last=1)[0]
    scene = samples[0].read()
    assert batch.left.shape == (1, 32, 64, 3)
    assert batch.left.dtype == torch.uint8
    assert batch.truth.labels is not None
    assert scene.semantic is not None
    places = [
        (y, x)
        for y in range(scene.size[1] - 32 + 1)
        for x in range(scene.size[0] - 64 + 1)
        if np.array_equal(scene.left[y : y + 32, x : x + 64], batch.left[0].numpy())
    ]
    assert len(places) == 1
    y, x = places[0]
    part = scene.crop(x, y, 64, 32)
    np.testing.assert_array_equal(batch.right[0].numpy(), part.right)
    np.testing.assert_array_equal(batch.truth.disparity[0].numpy(), part.truth)
    np.testing.assert_array_equal(batch.truth.labels[0].numpy(), part.semantic)


@dataclass(frozen=True)
class Given:
    """A sample that reads what it was given, or fails."""

    scene: Scene | OSError | MemoryError
    name: str = "given"
    size: tuple[int, int] = (64, 32)
    foreground: None = None

    def read(self) -> Scene:
        if not isinstance(self.scene, Scene):
            raise self.scene
        return self.scene


def given(truth: float = 5, label: int | None = 3, size: tuple[int, int] = (64, 32)) -> Given:
    width, height = size
    image = np.zeros((height, width, 3), np.uint8)
    labels = None if label is None else np.full((height, width), 255, np.uint8)
    if labels is not None and label is not None:
        labels[0, 0] = label
    return Given(
        Scene("given", image, image, np.full((height, width), truth, np.float32), semantic=labels)
    )


PLAIN = given().scene

FAULTS = {
    "no truth": (given(truth=np.nan), "known disparities: given has none", False),
    "no labels": (given(label=None), "labels: given has none; train --branches disparity", False),
    "wrong label": (given(label=19), "0 to 18, or 255 for none: given holds 19", False),
    "too small": (given(size=(64, 31)), "64x32 does not fit in given of 64x31", True),
    "unreadable": (Given(OSError(5, "Input/output error")), "cannot read given: .*Input", False),
    "huge": (Given(MemoryError("9 TiB")), r"given does not fit in memory; .*--crop \(9 TiB", False),
}


@pytest.mark.parametrize("kind", FAULTS)
@pytest.mark.parametrize("workers", [0, 1])
def test_a_sample_that_cannot_be_learnt_from_is_named(kind: str, workers: int) -> None:
    sample, text, usage = FAULTS[kind]
    one = recipe(batch=1, steps=1)
    found = list(loader([sample], one, Places(one, 0, 1), workers))
    assert len(found) == 1
    assert isinstance(found[0], Fault)
    with pytest.raises(type(found[0].error()), match=text) as caught:
        raise found[0].error()
    assert caught.value.exit_code == (2 if usage else 1)


def test_a_batch_that_does_not_fit_in_memory_is_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_arrays: object) -> None:
        raise MemoryError("9 TiB")

    monkeypatch.setattr(np, "stack", full)
    one = recipe(batch=2, steps=1)
    found = list(loader([given()], one, Places(one, 0, 1), 0))
    assert [type(each) for each in found] == [Fault]
    assert found[0].text.startswith("a batch of 2 does not fit in memory; give a larger --acc")


def test_a_network_without_semantics_asks_for_no_labels() -> None:
    one = recipe(batch=1, steps=1, arch={"c": 1, "semantic": False})
    for sample in (given(label=None), given(label=19)):
        assert batches([sample], one, last=1)[0].names == ["given"]
