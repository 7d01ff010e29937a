"""The table of classes against the official label files, and both ways through it."""

from pathlib import Path

import numpy as np
import pytest

from rts2.model.data.images import read_whole
from rts2.model.data.labels import (
    CATEGORIES,
    CATEGORY_NAMES,
    LABEL_IDS,
    LABELS,
    WITH_INSTANCES,
    label_ids,
    require_train_ids,
    train_ids,
)
from rts2.model.errors import Rts2Error


def test_table_has_the_19_classes_and_their_groups() -> None:
    assert len(LABELS) == 19
    assert CATEGORY_NAMES == (
        "flat",
        "construction",
        "object",
        "nature",
        "sky",
        "human",
        "vehicle",
    )
    members = [sum(category == i for category in CATEGORIES) for i in range(7)]
    assert members == [2, 3, 3, 2, 1, 2, 6]
    # What moves is numbered one by one: people and vehicles.
    assert [LABELS[i].name for i in WITH_INSTANCES] == [
        label.name for label in LABELS if label.category in ("human", "vehicle")
    ]


def test_train_ids_are_those_of_the_official_label_files(real_data: Path) -> None:
    folder = real_data / "cityscapes" / "gtFine" / "val" / "frankfurt"
    name = "frankfurt_000000_000294_gtFine_{}.png"
    labels = read_whole(folder / name.format("labelIds"))
    expected = read_whole(folder / name.format("labelTrainIds"))
    # The sample was shrunk, and its two files differ at some borders: the majority decides.
    for label in np.unique(labels):
        majority = np.bincount(expected[labels == label]).argmax()
        assert train_ids(np.array([[label]]))[0, 0] == majority, f"label {label}"
    assert (train_ids(labels) == expected).mean() > 0.997


def test_labels_of_no_class_are_left_out_both_ways() -> None:
    labels = np.arange(256, dtype=np.int32)[None]
    known = train_ids(labels)
    assert [int(i) for i in labels[known != 255]] == sorted(LABEL_IDS)
    assert label_ids(known)[0].tolist() == [i if i in LABEL_IDS else 0 for i in range(256)]


@pytest.mark.parametrize("value", [300, -1])
def test_labels_beyond_a_byte_are_refused(value: int) -> None:
    with pytest.raises(Rts2Error, match=f"0 to 255, found {value}"):
        train_ids(np.array([[7, value]], np.int32))


@pytest.mark.parametrize("value", [19, 254, 300, -1])
def test_train_ids_beyond_the_classes_name_file_and_value(value: int) -> None:
    good = np.array([[0, 18, 255]], np.int32)
    assert require_train_ids(good, "s.png").tolist() == [[0, 18, 255]]
    bad = np.array([[0, value, 255]], np.int32)
    with pytest.raises(Rts2Error, match=rf"s\.png holds {value} in 1 pixels"):
        require_train_ids(bad, "s.png")
