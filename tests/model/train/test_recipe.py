"""Recipes: the paper's runs, rates, lengths, and what makes two runs different."""

import pytest

from rts2.model.arch import Arch
from rts2.model.data.catalog import DATASETS
from rts2.model.errors import UsageError
from rts2.model.train.recipe import PRESETS, Augmentation, Recipe, recipe_from


def recipe(**values: object) -> Recipe:
    return recipe_from({"dataset": "folder", "steps": 100} | values)


def test_defaults_are_the_paper_s() -> None:
    found = recipe()
    assert (found.batch, found.crop, found.lr, found.betas) == (6, (256, 512), 5e-4, (0.9, 0.999))
    assert not any((found.augmentation.gain, found.augmentation.noise, found.augmentation.flip))


@pytest.mark.parametrize(
    ("preset", "dataset", "epochs", "schedule"),
    [
        ("cityscapes-coarse", "cityscapes-coarse", 60, "constant"),
        ("cityscapes-fine", "cityscapes", 75, "constant"),
        ("kitti", "kitti2015", 800, "halved"),
        ("sceneflow-short", "sceneflow", 10, "constant"),
        ("sceneflow", "sceneflow", 40, "constant"),
        ("kitti-short", "kitti2015", 300, "halved"),
    ],
)
def test_the_paper_s_runs(preset: str, dataset: str, epochs: int, schedule: str) -> None:
    found = recipe_from(PRESETS[preset])
    assert (found.dataset, found.epochs, found.schedule) == (dataset, epochs, schedule)
    assert (found.lr, found.halve_every) == (5e-4, 200)
    assert (found.batch, found.accumulate, found.crop) == (6, 1, (256, 512))
    assert (found.betas, found.steps, found.count) == ((0.9, 0.999), None, None)
    assert found.coarse_gamma == (0.1 if preset == "cityscapes-coarse" else 0)
    assert found.arch == Arch(c=8, semantic=dataset != "sceneflow")
    assert found.augmentation == Augmentation()
    assert DATASETS[dataset].k == (2 if dataset == "kitti2015" else 1.12)


@pytest.mark.parametrize(
    ("preset", "count", "epochs", "steps"),
    [("streets", 4800, 5, 4000), ("streets-long", 20_000, 20, 66_667)],
)
def test_our_runs(preset: str, count: int, epochs: int, steps: int) -> None:
    found = recipe_from(PRESETS[preset])
    assert (found.dataset, found.count, found.epochs) == ("streets", count, epochs)
    assert (found.lr, found.schedule, found.batch, found.arch) == (1e-3, "cosine", 6, Arch(c=8))
    assert found.total_steps(count) == steps
    colours = Augmentation(gain=0.2, gamma=0.2, colour=0.1, noise=4)
    assert found.augmentation == colours


def test_every_preset_is_a_recipe_of_a_data_set() -> None:
    for row in PRESETS.values():
        assert recipe_from(row).dataset in DATASETS


def test_rate_is_halved_every_200_epochs() -> None:
    found = recipe(steps=None, epochs=800, schedule="halved")
    samples = 160  # KITTI's training part: an epoch is 26⅔ steps
    epochs = [found.epoch(step, samples) for step in (0, 5333, 5334, 10667, 16000, 21333)]
    assert epochs == [0, 199, 200, 400, 600, 799]
    rates = [found.rate(step, samples) for step in (0, 5333, 5334, 10667, 16000, 21333)]
    assert rates == [5e-4, 5e-4, 2.5e-4, 1.25e-4, 6.25e-5, 6.25e-5]
    assert found.total_steps(samples) == 21334


def test_rate_falls_along_a_cosine() -> None:
    found = recipe(schedule="cosine", lr=1e-3)
    assert [found.rate(step, 7) for step in (0, 50)] == pytest.approx([1e-3, 5e-4])
    third = 1e-3 * (1 + 0.5) / 2  # cos 60° = ½; 100 steps of 180°
    assert recipe(steps=99, schedule="cosine", lr=1e-3).rate(33, 7) == pytest.approx(third)
    assert 0 < found.rate(99, 7) < 1e-6


def test_constant_rate_stays() -> None:
    assert {recipe().rate(step, 7) for step in (0, 50, 99)} == {5e-4}


def test_length_is_in_steps_or_in_epochs() -> None:
    assert recipe().total_steps(7) == 100
    assert recipe(steps=None, epochs=3).total_steps(7) == 4  # 21 samples, 6 at a time
    with pytest.raises(UsageError, match="either epochs or steps"):
        recipe(epochs=3)
    with pytest.raises(UsageError, match="either epochs or steps"):
        recipe(steps=None)


@pytest.mark.parametrize(
    ("values", "rule"),
    [
        ({"batch": 6, "accumulate": 4}, "a batch of 6 does not divide into 4 micro-batches"),
        ({"crop": (250, 512)}, "multiples of 32, not 512x250"),
        ({"lr": 0}, "lr: .* greater than 0"),
        ({"k": 1}, "k: .* greater than 1"),
        ({"augmentation": {"gain": 1}}, "augmentation.gain: .* less than 1"),
        ({"rate": 1}, "rate: "),
        ({"k": float("inf")}, "k: .* finite number"),
        ({"coarse_gamma": float("nan")}, "coarse_gamma: .* finite number"),
    ],
)
def test_wrong_recipes_are_one_line(values: dict[str, object], rule: str) -> None:
    with pytest.raises(UsageError, match=rule) as caught:
        recipe(**values)
    assert "\n" not in str(caught.value)


def test_differences_name_the_field_and_both_values() -> None:
    mine, other = recipe(), recipe(lr=1e-3, arch={"c": 4}, augmentation={"flip": True})
    assert mine.differences(other) == [
        "arch.c is 4 there, 8 here",
        "augmentation.flip is True there, False here",
        "lr is 0.001 there, 0.0005 here",
    ]
    assert mine.differences(recipe()) == []


def test_a_supernet_s_steps_train_the_smallest_and_random_networks() -> None:
    given = recipe_from({"dataset": "folder", "steps": 9, "arch": {"c": 4}, "supernet": 2})
    assert len(given.beside(0)) == 3
    assert given.beside(0) == given.beside(0) != given.beside(1)
    assert given.beside(0)[0].c == 1
    assert not recipe_from({"dataset": "folder", "steps": 9}).beside(0)
    with pytest.raises(UsageError, match="a supernet is of the rts2net family"):
        recipe_from({"dataset": "folder", "steps": 9, "arch": {"family": "anynet"}, "supernet": 2})
