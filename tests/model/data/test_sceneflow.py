"""SceneFlow's three parts are found as released, apart or together."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rts2.model.data.images import write_image
from rts2.model.data.scene import Scene
from rts2.model.data.sceneflow import open_clean, open_final
from rts2.model.errors import Rts2Error, UsageError

SCENES = {
    "FlyingThings3D": ("TRAIN/A/0000", "TEST/B/0001"),
    "Driving": ("15mm_focallength/scene_forwards/fast",),
    "Monkaa": ("a_rain_of_stones_x2",),
}
NAMES = {
    "train": [
        "15mm_focallength-scene_forwards-fast-0006",
        "TRAIN-A-0000-0006",
        "a_rain_of_stones_x2-0006",
    ],
    "test": ["TEST-B-0001-0006"],
}


def fill(part: Path, scene: str, put_pfm: Callable[..., Path]) -> None:
    """One frame of one scene; the passes differ in their grey, the sides in one step of it."""
    for images, grey in (("frames_cleanpass", 10), ("frames_finalpass", 20)):
        for side, more in (("left", 0), ("right", 1)):
            path = part / images / scene / side / "0006.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_image(path, np.full((2, 3, 3), grey + more, np.uint8))
    for side, sign in (("left", 1), ("right", -1)):
        path = part / "disparity" / scene / side / "0006.pfm"
        put_pfm(path, sign * np.array([[1, 2, 3], [4, np.inf, 6]]))


@pytest.fixture
def root(tmp_path: Path, put_pfm: Callable[..., Path]) -> Path:
    for part, scenes in SCENES.items():
        for scene in scenes:
            fill(tmp_path / part, scene, put_pfm)
    (tmp_path / "README.txt").touch()
    return tmp_path


def names(folder: Path, split: str) -> list[str]:
    return sorted(frame.name for frame in open_clean(folder, split))


def test_parts_make_the_splits(root: Path) -> None:
    assert {split: names(root, split) for split in NAMES} == NAMES
    assert names(root, "all") == sorted(NAMES["train"] + NAMES["test"])


def test_parts_are_found_in_any_letters_or_alone(root: Path) -> None:
    (root / "FlyingThings3D").rename(root / "flyingthings3d")
    assert names(root, "train") == NAMES["train"]
    assert names(root / "flyingthings3d", "test") == NAMES["test"]
    assert names(root / "Monkaa", "train") == ["a_rain_of_stones_x2-0006"]
    with pytest.raises(UsageError, match=r"no frames of test in .*Monkaa: no TEST/"):
        names(root / "Monkaa", "test")


def test_parts_unpacked_into_one_folder(root: Path, tmp_path: Path) -> None:
    for part in SCENES:
        shutil.copytree(root / part, tmp_path / "one", dirs_exist_ok=True)
    assert {split: names(tmp_path / "one", split) for split in NAMES} == NAMES


def test_scene_holds_the_left_disparity_of_its_pass(root: Path) -> None:
    for opened, grey in ((open_clean, 10), (open_final, 20)):
        scene = opened(root, "test")[0].read()
        assert (scene.left == grey).all()
        assert (scene.right == grey + 1).all()
        np.testing.assert_array_equal(scene.truth, [[1, 2, 3], [4, np.nan, 6]])
        assert scene.semantic is scene.foreground is None


def test_missing_folder_is_named(root: Path) -> None:
    with pytest.raises(UsageError, match=r"Driving, Monkaa: .*no such folder"):
        open_clean(root / "none", "train")
    shutil.rmtree(root / "Monkaa" / "disparity")
    with pytest.raises(UsageError, match="disparity not there; found frames_clean") as caught:
        open_clean(root, "train")
    assert str(root / "Monkaa") in str(caught.value)
    (root / "other").mkdir()
    with pytest.raises(UsageError, match=r"needs FlyingThings3D, .*found nothing"):
        open_clean(root / "other", "train")


@pytest.mark.parametrize(
    "lost", ["frames_cleanpass/{}/right/0006.png", "disparity/{}/left/0006.pfm"]
)
def test_missing_file_is_named_with_both_counts(
    root: Path, put_pfm: Callable[..., Path], lost: str
) -> None:
    part, scene = root / "Driving", SCENES["Driving"][0]
    gone = part / lost.format(scene)
    gone.unlink()
    with pytest.raises(Rts2Error, match=f"has 0 of 1 files .*first missing {gone.name}") as caught:
        open_clean(root, "train")
    assert str(gone.parent) in str(caught.value)


def test_real_frame_as_released(
    real_data: Path, tmp_path: Path, unexplained: Callable[[Scene], float]
) -> None:
    """The sample is FlyingThings3D's TRAIN/A/0032, frame 0006; here it stands there again."""
    for images, suffix in (("frames_cleanpass", "png"), ("disparity", "pfm")):
        for side in ("left", "right"):
            place = tmp_path / "FlyingThings3D" / images / "TRAIN" / "A" / "0032" / side
            place.mkdir(parents=True)
            source = real_data / "sceneflow" / images / side / f"A-0032-0006.{suffix}"
            (place / f"0006.{suffix}").symlink_to(source)
    (frame,) = open_clean(tmp_path, "train")
    scene = frame.read()
    assert frame.name == "TRAIN-A-0032-0006"
    assert scene.size == (960, 540)
    assert np.isfinite(scene.truth).all()
    assert unexplained(scene) < 0.5


def test_loose_frames_are_in_every_split(real_data: Path) -> None:
    assert names(real_data / "sceneflow", "train") == ["A-0032-0006"]
    assert names(real_data / "sceneflow", "test") == ["A-0032-0006"]
