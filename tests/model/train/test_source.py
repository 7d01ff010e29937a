"""How often each class occurs, counted and worked by hand."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rts2.model.data.catalog import open_dataset
from rts2.model.data.streets import Streets
from rts2.model.errors import Rts2Error, UsageError
from rts2.model.train.distributed import World
from rts2.model.train.recipe import recipe_from
from rts2.model.train.source import cached, class_shares, digest, fingerprint, open_samples


def quiet(items: Iterable[object], _title: str, _total: int) -> Iterable[object]:
    return items


def labelled(folder: Path, values: list[list[int]]) -> Path:
    """Pairs of 8×4 whose four rows have these labels."""
    for index, rows in enumerate(values):
        for name in ("left", "right", "semantic"):
            (folder / name).mkdir(exist_ok=True)
            pixels = np.zeros((4, 8, 3), np.uint8)
            if name == "semantic":
                pixels = np.repeat(np.array(rows, np.uint8)[:, None], 8, 1)
            Image.fromarray(pixels).save(folder / name / f"{index}.png")
    return folder


@pytest.mark.parametrize("workers", [0, 2])
def test_shares_are_of_the_labelled_pixels(tmp_path: Path, workers: int) -> None:
    folder = labelled(tmp_path, [[0, 0, 1, 255], [0, 2, 255, 255]])
    found = class_shares(
        open_dataset("folder", folder),
        recipe_from({"dataset": "folder", "steps": 1, "k": 2, "arch": {"c": 1, "classes": 4}}),
        workers,
        World(),
        quiet,
    )
    assert found.tolist() == [3 / 5, 1 / 5, 1 / 5, 0]


def test_counting_takes_evenly_spaced_samples(tmp_path: Path) -> None:
    folder = labelled(tmp_path, [[label] * 4 for label in (0, 1, 2, 3)])
    values = {"dataset": "folder", "steps": 1, "arch": {"c": 1, "classes": 4}, "counted": 2}
    samples = open_dataset("folder", folder)
    found = class_shares(samples, recipe_from(values), 0, World(), quiet)
    assert found.tolist() == [0.5, 0, 0.5, 0]


def test_labels_that_tell_nothing_are_refused(tmp_path: Path) -> None:
    folder = labelled(tmp_path, [[255] * 4])
    recipe = recipe_from({"dataset": "folder", "steps": 1})
    with pytest.raises(Rts2Error, match="1 samples have no labelled pixel"):
        class_shares(open_dataset("folder", folder), recipe, 0, World(), quiet)


def test_a_digest_is_of_the_names_in_order(pairs: Path) -> None:
    samples = open_dataset("folder", pairs)
    assert digest(samples) == digest(list(samples))
    assert digest(samples) != digest(samples[::-1])


def test_streets_are_as_large_as_a_crop() -> None:
    recipe = recipe_from({"dataset": "streets", "steps": 1, "count": 3, "crop": (64, 96)})
    samples = open_samples(recipe, None)
    assert len(samples) == 3
    assert samples[0].size == (96, 64)
    assert digest(samples) != digest(open_samples(recipe.model_copy(update={"data_seed": 1}), None))


def test_a_digest_tells_the_generator_where_there_is_one(
    pairs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = recipe_from({"dataset": "streets", "steps": 1, "count": 3, "crop": (64, 96)})
    streets = open_samples(recipe, None)
    before = digest(streets)
    assert fingerprint(streets) is not None
    for samples in (streets, open_dataset("folder", pairs)):
        kept = cached(samples, tmp_path)
        assert fingerprint(kept) == fingerprint(samples)
        assert digest(kept) == digest(samples)
    assert fingerprint(open_dataset("folder", pairs)) is None
    monkeypatch.setattr("rts2.model.data.streets.VERSION", 999)
    assert [sample.name for sample in open_samples(recipe, None)] == [s.name for s in streets]
    assert digest(open_samples(recipe, None)) != before


def test_an_unknown_data_set_is_refused() -> None:
    with pytest.raises(UsageError, match=r"a data set must be one of .* not 'mars'"):
        open_samples(recipe_from({"dataset": "mars", "steps": 1}), None)


def test_recipe_chooses_the_streets() -> None:
    values = {"dataset": "streets", "steps": 1, "count": 3, "data_seed": 5, "crop": (64, 96)}
    found = open_samples(recipe_from(values | {"rectification_px": 0.3}), None)
    assert isinstance(found, Streets)
    assert (len(found), found.seed, found.size) == (3, 5, (96, 64))
    assert found.look.rectification_px == 0.3
