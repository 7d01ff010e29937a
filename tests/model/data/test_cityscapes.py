"""Cityscapes' layout: cities in splits, SGM disparity, fine and coarse labels."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rts2.model.data.cityscapes import open_coarse, open_fine, read_sgm
from rts2.model.data.labels import WITH_INSTANCES, train_ids
from rts2.model.errors import Rts2Error, UsageError

SHAPE = (2, 4)
Put = Callable[..., Path]

LABEL_MAP = np.array([[7, 26, 26, 0], [24, 26, 29, 3]], np.uint8)
INSTANCE_MAP = np.array([[7, 26000, 26, 0], [24000, 26001, 29000, 3]], np.uint16)
"""Two cars, a group of cars without numbers, a person, a caravan, which is no class."""

KINDS = {
    "leftImg8bit": np.zeros((*SHAPE, 3), np.uint8),
    "rightImg8bit": np.ones((*SHAPE, 3), np.uint8),
    "disparity": np.array([[0, 1, 2, 257], [513, 0, 1, 32769]], np.uint16),
}


@pytest.fixture
def city(tmp_path: Path, put: Put) -> Path:
    """Two frames of two cities to train with, one to validate, one to test, one coarse extra."""
    places = {
        "train": ("aachen_000000_000019", "bochum_000001_000019"),
        "val": ("lindau_000002_000019",),
        "test": ("bonn_000003_000019",),
        "train_extra": ("erlangen_000004_000019",),
    }
    for split, names in places.items():
        for name in names:
            for kind, pixels in KINDS.items():
                put(where(tmp_path, kind, split, name), pixels)
            for labels in (
                () if split == "test" else ("gtCoarse",) + ("gtFine",) * (split != "train_extra")
            ):
                put(where(tmp_path, labels, split, name, "_labelIds"), LABEL_MAP)
                put(where(tmp_path, labels, split, name, "_instanceIds"), INSTANCE_MAP)
    return tmp_path


def where(root: Path, kind: str, split: str, name: str, more: str = "") -> Path:
    return root / kind / split / name.split("_")[0] / f"{name}_{kind}{more}.png"


def test_splits_hold_their_cities(city: Path) -> None:
    train = ["aachen_000000_000019", "bochum_000001_000019"]
    val, extra = ["lindau_000002_000019"], ["erlangen_000004_000019"]
    fine = {split: [f.name for f in open_fine(city, split)] for split in ("train", "val", "all")}
    assert fine == {"train": train, "val": val, "all": train + val}
    splits = ("train", "train_extra", "val", "all")
    coarse = {split: [f.name for f in open_coarse(city, split)] for split in splits}
    assert coarse == {
        "train": train,
        "train_extra": extra,
        "val": val,
        "all": train + extra + val,
    }
    assert {f.semantic for f in open_fine(city, "all")} == {*city.rglob("*_gtFine_labelIds.png")}
    assert {f.semantic for f in open_coarse(city, "all")} == {
        *city.rglob("*_gtCoarse_labelIds.png")
    }


def test_scene_holds_what_the_files_hold(city: Path) -> None:
    frame = open_fine(city, "val")[0]
    scene = frame.read()
    assert scene.size == (4, 2)
    assert (scene.right == 1).all()
    nan = np.nan
    np.testing.assert_array_equal(
        scene.truth, np.array([[nan, 0, 1 / 256, 1], [2, nan, 0, 128]], np.float32)
    )
    assert scene.truth.dtype == np.float32
    assert scene.semantic is not None
    assert scene.semantic.tolist() == [[0, 13, 13, 255], [11, 13, 255, 255]]
    assert scene.instances is not None
    assert scene.instances.tolist() == [[0, 26000, 0, 0], [24000, 26001, 29000, 0]]
    assert frame.foreground == "instance"
    np.testing.assert_array_equal(scene.foreground, scene.instances > 0)
    assert scene.visible is None


def test_test_frames_have_no_labels(city: Path) -> None:
    (frame,) = open_fine(city, "test")
    scene = frame.read()
    assert scene.semantic is scene.instances is None
    assert np.nanmax(scene.truth) == 128
    shutil.rmtree(city / "disparity")
    assert np.isnan(open_fine(city, "test")[0].read().truth).all()


def test_instances_may_lack_all_but_not_some(city: Path) -> None:
    first, second = sorted((city / "gtFine" / "train").rglob("*_instanceIds.png"))
    second.unlink()
    said = r"1 of 2 files .*first missing bochum_000001_000019_gtFine_instanceIds\.png"
    with pytest.raises(Rts2Error, match=said):
        open_fine(city, "train")
    first.unlink()
    frame = open_fine(city, "train")[0]
    assert frame.foreground is frame.read().instances is None


@pytest.mark.parametrize("kind", ["rightImg8bit", "disparity", "gtFine"])
def test_missing_folder_is_named(city: Path, kind: str) -> None:
    shutil.rmtree(city / kind)
    with pytest.raises(UsageError, match=rf"{kind}/train not there; found .*leftImg8bit") as caught:
        open_fine(city, "train")
    assert str(city) in str(caught.value)


def test_folder_of_something_else_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"leftImg8bit/: .*no such folder"):
        open_fine(tmp_path / "none", "train")
    with pytest.raises(UsageError, match=r"leftImg8bit/train, leftImg8bit/val in .*found nothing"):
        open_fine(tmp_path, "all")


def test_mismatched_count_is_named(city: Path) -> None:
    next((city / "disparity" / "train").rglob("aachen*.png")).unlink()
    said = r"disparity/train has 1 of 2 files .*first missing aachen_000000_000019_disparity\.png"
    with pytest.raises(Rts2Error, match=said):
        open_fine(city, "train")


def test_disparity_of_eight_bits_is_refused(tmp_path: Path, put: Put) -> None:
    with pytest.raises(Rts2Error, match="16-bit"):
        read_sgm(put(tmp_path / "d.png", np.zeros(SHAPE, np.uint8)))


def test_real_labels_in_the_official_layout(real_data: Path, tmp_path: Path, put: Put) -> None:
    """The sample has no right image and no disparity; those are made up beside it."""
    name = "frankfurt_000000_000294"
    shutil.copytree(real_data / "cityscapes", tmp_path, dirs_exist_ok=True)
    right = where(tmp_path, "rightImg8bit", "val", name)
    right.parent.mkdir(parents=True)
    shutil.copy(where(tmp_path, "leftImg8bit", "val", name), right)
    put(where(tmp_path, "disparity", "val", name), np.full((128, 256), 257, np.uint16))
    (frame,) = open_fine(tmp_path, "val")
    scene = frame.read()
    assert (frame.name, scene.size) == (name, (256, 128))
    assert (scene.truth == 1).all()
    # Four people and three cars, as the file's codes 24000 … 24003 and 26000 … 26002 say.
    assert scene.instances is not None
    assert np.unique(scene.instances).tolist() == [0, *range(24000, 24004), *range(26000, 26003)]
    own = scene.instances > 0
    assert scene.semantic is not None
    # The maps were shrunk one by one and differ at a few borders.
    same = train_ids(scene.instances[own] // 1000) == scene.semantic[own]
    assert same.mean() > 0.97
    assert {*np.unique(scene.semantic[own][same])} <= {*WITH_INSTANCES}
