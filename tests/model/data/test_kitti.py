"""KITTI's layout is found where it is, and what lacks is named with its place."""

import random
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rts2.model.data.images import read_disparity
from rts2.model.data.kitti import open_2012, open_2015, paper_split
from rts2.model.data.labels import WITH_INSTANCES, train_ids
from rts2.model.errors import Rts2Error, UsageError

SHAPE = (4, 6)
Put = Callable[..., Path]
Add = Callable[[str, np.ndarray], None]


@pytest.fixture
def kitti(tmp_path: Path, put: Put) -> Path:
    """Two frames with everything that is required, and the `_11` images beside them."""
    for frame in range(2):
        for folder in ("image_2", "image_3"):
            for moment in (10, 11):
                colour = np.full((*SHAPE, 3), frame, np.uint8)
                put(tmp_path / "training" / folder / f"{frame:06}_{moment}.png", colour)
        truth = np.full(SHAPE, 256 * (frame + 1), np.uint16)
        put(tmp_path / "training" / "disp_occ_0" / f"{frame:06}_10.png", truth)
    return tmp_path


@pytest.fixture
def add(kitti: Path, put: Put) -> Add:
    """Fills one more folder of `training` with the same values for both frames."""

    def fill(folder: str, values: np.ndarray) -> None:
        for frame in range(2):
            put(kitti / "training" / folder / f"{frame:06}_10.png", values)

    return fill


def test_frames_are_found_by_name_from_both_folders(kitti: Path) -> None:
    found = open_2015(kitti)
    assert [sample.name for sample in found] == ["000000_10", "000001_10"]
    assert found == open_2015(kitti / "training")
    assert found[0].visible is None
    assert found[0].foreground is None


def test_scene_holds_what_the_files_hold(kitti: Path) -> None:
    scene = open_2015(kitti)[1].read()
    assert scene.name == "000001_10"
    assert scene.left.shape == (*SHAPE, 3)
    assert (scene.right == 1).all()
    assert (scene.truth == 2).all()
    assert scene.foreground is None
    assert scene.semantic is None


def test_foreground_is_the_object_map_before_the_instances(kitti: Path, add: Add) -> None:
    # 26 · 256 is the car label without a number: a crowd far away, no object of its own.
    numbered = np.array([[26 * 256, 26 * 256 + 1, 7 * 256]] * 4, np.uint16).repeat(2, axis=1)
    add("instance", numbered)
    sample = open_2015(kitti)[0]
    assert sample.foreground == "instance"
    mask = sample.read().foreground
    assert mask is not None
    assert mask[0].tolist() == [False, False, True, True, False, False]

    add("obj_map", np.array([[0, 1, 2, 0, 0, 0]] * 4, np.uint8))
    sample = open_2015(kitti)[0]
    assert sample.foreground == "obj_map"
    mask = sample.read().foreground
    assert mask is not None
    assert mask[0].tolist() == [False, True, True, False, False, False]


def test_semantics_are_read_as_train_ids(kitti: Path, add: Add) -> None:
    add("semantic", np.array([[0, 7, 8, 26, 33, 29]] * 4, np.uint8))
    semantic = open_2015(kitti)[0].read().semantic
    assert semantic is not None
    assert semantic[0].tolist() == [255, 0, 1, 13, 18, 255]


def test_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such folder"):
        open_2015(tmp_path / "none")
    (tmp_path / "other").mkdir()
    with pytest.raises(UsageError, match=r"disp_occ_0 not there; found other") as caught:
        open_2015(tmp_path)
    assert str(tmp_path) in str(caught.value)


def test_folder_without_images_is_refused(kitti: Path) -> None:
    for image in (kitti / "training").rglob("*_10.png"):
        image.unlink()
    with pytest.raises(UsageError, match=r"needs images \*_10.png"):
        open_2015(kitti)


@pytest.mark.parametrize("folder", ["image_2", "image_3", "disp_occ_0"])
def test_missing_file_is_named_with_both_counts(kitti: Path, folder: str) -> None:
    (kitti / "training" / folder / "000001_10.png").unlink()
    with pytest.raises(Rts2Error, match=f"{folder} has 1 of 2 files .* missing 000001_10.png"):
        open_2015(kitti)


def test_optional_folder_must_be_whole(kitti: Path, put: Put) -> None:
    put(kitti / "training" / "semantic" / "000000_10.png", np.zeros(SHAPE, np.uint8))
    with pytest.raises(Rts2Error, match="semantic has 1 of 2 files"):
        open_2015(kitti)


def test_truth_of_another_size_is_refused(kitti: Path, put: Put) -> None:
    put(kitti / "training" / "disp_occ_0" / "000000_10.png", np.ones((4, 5), np.uint16))
    with pytest.raises(Rts2Error, match="truth 5x4"):
        open_2015(kitti)[0].read()


def test_visible_is_where_both_images_see(kitti: Path, add: Add) -> None:
    add("disp_noc_0", np.array([[0, 256, 300, 0, 0, 1]] * 4, np.uint16))
    scene = open_2015(kitti)[0].read()
    assert scene.visible is not None
    assert scene.visible[0].tolist() == [False, True, True, False, False, True]
    assert (scene.truth == 1).all()


def test_instances_are_numbered_across_classes(kitti: Path, add: Add) -> None:
    # The first car and the first person are two; cars without a number are none.
    codes = np.array([[26 * 256, 26 * 256 + 1, 24 * 256 + 1]] * 4, np.uint16).repeat(2, axis=1)
    add("instance", codes)
    instances = open_2015(kitti)[0].read().instances
    assert instances is not None
    assert instances.dtype == np.int32
    assert instances[0].tolist() == [0, 0, 6657, 6657, 6145, 6145]


def test_written_split_is_the_one_that_its_seed_draws() -> None:
    split = paper_split()
    val = sorted(random.Random(split.seed).sample(range(200), 40))
    assert split.val == tuple(f"{i:06}" for i in val)
    assert split.train == tuple(f"{i:06}" for i in range(200) if i not in val)
    assert (len(split.train), len(split.val)) == (160, 40)


def test_splits_take_their_frames(tmp_path: Path, put: Put) -> None:
    for i in range(200):
        source = tmp_path / "training" / "image_2" / f"{i:06}_10.png"
        if i == 0:
            put(source, np.zeros(SHAPE, np.uint8))
        else:
            source.hardlink_to(tmp_path / "training" / "image_2" / "000000_10.png")
    for folder in ("image_3", "disp_occ_0"):
        (tmp_path / "training" / folder).symlink_to("image_2")
    train, val = (open_2015(tmp_path, split) for split in ("train", "val"))
    assert [frame.name[:6] for frame in val] == list(paper_split().val)
    assert {*train, *val} == {*open_2015(tmp_path)}
    assert (len(train), len(val)) == (160, 40)


def test_split_of_frames_that_are_not_there_is_wrong_use(kitti: Path) -> None:
    with pytest.raises(UsageError, match=r"lists 40, .* among the 2 in .*first missing 0000"):
        open_2015(kitti, "val")


def test_frames_to_submit_have_no_truth(kitti: Path, put: Put) -> None:
    with pytest.raises(UsageError, match=r"needs the folder testing .*found training"):
        open_2015(kitti, "test")
    with pytest.raises(UsageError, match="needs the folder testing"):
        open_2015(kitti / "training", "test")
    for folder in ("image_2", "image_3"):
        put(kitti / "testing" / folder / "000007_10.png", np.zeros((*SHAPE, 3), np.uint8))
    (frame,) = open_2015(kitti, "test")
    assert (frame,) == open_2015(kitti / "testing", "test")
    scene = frame.read()
    assert scene.name == "000007_10"
    assert scene.truth.shape == SHAPE
    assert np.isnan(scene.truth).all()
    assert scene.semantic is None


@pytest.mark.parametrize("images", [("colored_0", "colored_1"), ("image_0", "image_1")])
def test_kitti_2012_in_colour_or_grey(tmp_path: Path, put: Put, images: tuple[str, str]) -> None:
    root = tmp_path / "training"
    for i, folder in enumerate(images):
        put(root / folder / "000003_10.png", np.full(SHAPE, i, np.uint8))
        put(root / folder / "000003_11.png", np.full(SHAPE, i, np.uint8))
    put(root / "disp_occ" / "000003_10.png", np.full(SHAPE, 512, np.uint16))
    put(root / "disp_noc" / "000003_10.png", np.array([[0, 512] * 3] * 4, np.uint16))
    (frame,) = open_2012(tmp_path)
    scene = frame.read()
    assert (frame.left.parent.name, frame.right.parent.name) == images
    assert (scene.right == 1).all()
    assert (scene.truth == 2).all()
    assert scene.visible is not None
    assert scene.visible[0].tolist() == [False, True] * 3
    with pytest.raises(UsageError, match="KITTI 2012 needs the folder testing"):
        open_2012(tmp_path, "test")


def test_kitti_2012_prefers_colour_and_names_what_lacks(tmp_path: Path, put: Put) -> None:
    with pytest.raises(UsageError, match="colored_0, colored_1, disp_occ not there; found nothing"):
        open_2012(tmp_path)
    for folder in ("colored_0", "colored_1", "image_0", "image_1", "disp_occ"):
        put(tmp_path / folder / "000000_10.png", np.ones(SHAPE, np.uint16))
    assert open_2012(tmp_path)[0].left.parent.name == "colored_0"


def test_fingerprint_tells_changed_files(kitti: Path, put: Put) -> None:
    frame, other = open_2015(kitti)
    before = frame.fingerprint
    assert before == open_2015(kitti)[0].fingerprint != other.fingerprint
    put(frame.right, np.full((*SHAPE, 3), 9, np.uint8))
    assert frame.fingerprint != before
    frame.right.unlink()
    with pytest.raises(UsageError, match="no such file"):
        _ = frame.fingerprint


def test_real_frames_fit_together(real_data: Path, unexplained: Callable[..., float]) -> None:
    found = open_2015(real_data / "kitti2015")
    assert [sample.name for sample in found] == ["000000_10", "000001_10", "000002_10"]
    for frame in found:
        scene = frame.read()
        assert scene.left.shape == (375, 1242, 3)
        assert frame.truth is not None
        np.testing.assert_array_equal(scene.truth, read_disparity(frame.truth))
        assert unexplained(scene) < 0.6


def test_real_instances_are_of_classes_that_have_them(real_data: Path) -> None:
    counts = []
    for frame in open_2015(real_data / "kitti2015"):
        scene = frame.read()
        assert scene.instances is not None
        assert scene.semantic is not None
        own = scene.instances > 0
        np.testing.assert_array_equal(own, scene.foreground)
        assert {*np.unique(scene.semantic[own])} <= {*WITH_INSTANCES}
        np.testing.assert_array_equal(train_ids(scene.instances[own] // 256), scene.semantic[own])
        counts.append(len(np.unique(scene.instances)) - 1)
    # Codes with a number other than 0, counted by hand in each file's list of values.
    assert counts == [26, 15, 11]
