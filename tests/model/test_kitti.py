"""KITTI's layout is found where it is, and what lacks is named with its place."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rts2.model.data.images import read_disparity, read_whole
from rts2.model.data.kitti import samples, train_ids
from rts2.model.errors import Rts2Error, UsageError

SHAPE = (4, 6)


def put(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    """Two frames with everything that is required, and the `_11` images beside them."""
    for frame in range(2):
        for folder in ("image_2", "image_3"):
            for moment in (10, 11):
                colour = np.full((*SHAPE, 3), frame, np.uint8)
                put(tmp_path / "training" / folder / f"{frame:06}_{moment}.png", colour)
        truth = np.full(SHAPE, 256 * (frame + 1), np.uint16)
        put(tmp_path / "training" / "disp_occ_0" / f"{frame:06}_10.png", truth)
    return tmp_path


def add(kitti: Path, folder: str, values: np.ndarray) -> None:
    for frame in range(2):
        put(kitti / "training" / folder / f"{frame:06}_10.png", values)


def test_frames_are_found_by_name_from_both_folders(kitti: Path) -> None:
    found = samples(kitti)
    assert [sample.name for sample in found] == ["000000_10", "000001_10"]
    assert found == samples(kitti / "training")
    assert found[0].visible is None
    assert found[0].foreground is None


def test_scene_holds_what_the_files_hold(kitti: Path) -> None:
    scene = samples(kitti)[1].read()
    assert scene.name == "000001_10"
    assert scene.left.shape == (*SHAPE, 3)
    assert (scene.right == 1).all()
    assert (scene.truth == 2).all()
    assert scene.foreground is None
    assert scene.semantic is None


def test_foreground_is_the_object_map_before_the_instances(kitti: Path) -> None:
    # 26 · 256 is the car label without a number: a crowd far away, no object of its own.
    numbered = np.array([[26 * 256, 26 * 256 + 1, 7 * 256]] * 4, np.uint16).repeat(2, axis=1)
    add(kitti, "instance", numbered)
    sample = samples(kitti)[0]
    assert sample.foreground == "instance"
    mask = sample.read().foreground
    assert mask is not None
    assert mask[0].tolist() == [False, False, True, True, False, False]

    add(kitti, "obj_map", np.array([[0, 1, 2, 0, 0, 0]] * 4, np.uint8))
    sample = samples(kitti)[0]
    assert sample.foreground == "obj_map"
    mask = sample.read().foreground
    assert mask is not None
    assert mask[0].tolist() == [False, True, True, False, False, False]


def test_semantics_are_read_as_train_ids(kitti: Path) -> None:
    add(kitti, "semantic", np.array([[0, 7, 8, 26, 33, 29]] * 4, np.uint8))
    semantic = samples(kitti)[0].read().semantic
    assert semantic is not None
    assert semantic[0].tolist() == [255, 0, 1, 13, 18, 255]


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


def test_labels_beyond_a_byte_are_refused() -> None:
    with pytest.raises(Rts2Error, match="0 to 255, found 300"):
        train_ids(np.array([[300]], np.int32))


def test_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such folder"):
        samples(tmp_path / "none")
    (tmp_path / "other").mkdir()
    with pytest.raises(UsageError, match=r"disp_occ_0 not there; found other") as caught:
        samples(tmp_path)
    assert str(tmp_path) in str(caught.value)


def test_folder_without_images_is_refused(kitti: Path) -> None:
    for image in (kitti / "training").rglob("*_10.png"):
        image.unlink()
    with pytest.raises(UsageError, match=r"needs images \*_10.png"):
        samples(kitti)


@pytest.mark.parametrize("folder", ["image_2", "image_3", "disp_occ_0"])
def test_missing_file_is_named_with_both_counts(kitti: Path, folder: str) -> None:
    (kitti / "training" / folder / "000001_10.png").unlink()
    with pytest.raises(Rts2Error, match=f"{folder} has 1 of 2 files .* missing 000001_10.png"):
        samples(kitti)


def test_optional_folder_must_be_whole(kitti: Path) -> None:
    put(kitti / "training" / "semantic" / "000000_10.png", np.zeros(SHAPE, np.uint8))
    with pytest.raises(Rts2Error, match="semantic has 1 of 2 files"):
        samples(kitti)


def test_truth_of_another_size_is_refused(kitti: Path) -> None:
    put(kitti / "training" / "disp_occ_0" / "000000_10.png", np.ones((4, 5), np.uint16))
    with pytest.raises(Rts2Error, match="truth 5x4"):
        samples(kitti)[0].read()


def test_real_frames_fit_together(real_data: Path) -> None:
    found = samples(real_data / "kitti2015")
    assert [sample.name for sample in found] == ["000000_10", "000001_10", "000002_10"]
    scene = found[0].read()
    assert scene.left.shape == (375, 1242, 3)
    np.testing.assert_array_equal(scene.truth, read_disparity(found[0].occluded))
    # The truth warps the right image onto the left one better than no shift does.
    rows, columns = np.nonzero(np.isfinite(scene.truth))
    shift = np.rint(scene.truth[rows, columns]).astype(int)
    seen = columns >= shift
    rows, columns, shift = rows[seen], columns[seen], shift[seen]
    left = scene.left[rows, columns].astype(float)
    warped, unmoved = scene.right[rows, columns - shift], scene.right[rows, columns]
    assert np.abs(left - warped).mean() < 0.6 * np.abs(left - unmoved).mean()
