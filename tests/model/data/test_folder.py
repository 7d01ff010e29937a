"""Anybody's own folder of pairs."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rts2.model.data.folder import open_all
from rts2.model.errors import Rts2Error, UsageError

SHAPE = (2, 3)
Put = Callable[..., Path]


@pytest.fixture
def pairs(tmp_path: Path, put: Put) -> Path:
    for i, name in enumerate(("a", "b.1")):
        put(tmp_path / "left" / f"{name}.png", np.full((*SHAPE, 3), i, np.uint8))
        put(tmp_path / "right" / f"{name}.jpg", np.full((*SHAPE, 3), 9, np.uint8))
    (tmp_path / "left" / "notes.txt").touch()
    return tmp_path


def test_pairs_without_truth(pairs: Path) -> None:
    first, second = open_all(pairs)
    assert (first.name, second.name) == ("a", "b.1")
    scene = second.read()
    assert (scene.left == 1).all()
    assert np.isnan(scene.truth).all()
    assert scene.truth.shape == SHAPE
    assert scene.semantic is scene.foreground is scene.instances is None


def test_disparity_in_three_formats(pairs: Path, put: Put, put_pfm: Put) -> None:
    folder = pairs / "disparity"
    put(folder / "a.png", np.array([[0, 256, 512]] * 2, np.uint16))
    put_pfm(folder / "b.1.pfm", np.array([[np.inf, 1, 2]] * 2))
    expected = np.array([[np.nan, 1, 2]] * 2, np.float32)
    for frame in open_all(pairs):
        np.testing.assert_array_equal(frame.read().truth, expected)
    (folder / "a.png").unlink()
    np.save(folder / "a.npy", np.array([[-np.inf, 1, 2]] * 2))
    truth = open_all(pairs)[0].read().truth
    assert truth.dtype == np.float32
    np.testing.assert_array_equal(truth, expected)


@pytest.mark.parametrize(
    ("array", "said"),
    [
        (np.zeros((2, 3, 1)), "must hold numbers of shape"),
        (np.array([["a"]]), "must hold numbers of shape"),
        (np.array([{}]), "no NumPy array"),
        (np.array([[0.0, -1.5]]), r"0 or more.* holds -1\.500"),
        (np.zeros((3, 2)), "one size"),
    ],
)
def test_array_of_something_else_is_one_line(pairs: Path, array: np.ndarray, said: str) -> None:
    (pairs / "disparity").mkdir()
    for name in ("a", "b.1"):
        np.save(pairs / "disparity" / f"{name}.npy", array)
    with pytest.raises(Rts2Error, match=said):
        open_all(pairs)[0].read()


def test_truncated_array_is_one_line(pairs: Path) -> None:
    (pairs / "disparity").mkdir()
    for name in ("a", "b.1"):
        np.save(pairs / "disparity" / f"{name}.npy", np.zeros(SHAPE))
    path = pairs / "disparity" / "a.npy"
    data = path.read_bytes()
    for kept in (0, 5, 50, len(data) - 1):
        path.write_bytes(data[:kept])
        with pytest.raises(Rts2Error, match=r"a\.npy is truncated or no NumPy array"):
            open_all(pairs)[0].read()


def test_semantics_are_train_ids(pairs: Path, put: Put) -> None:
    good = np.array([[0, 18, 255]] * 2, np.uint8)
    for name in ("a", "b.1"):
        put(pairs / "semantic" / f"{name}.png", good)
    semantic = open_all(pairs)[0].read().semantic
    assert semantic is not None
    assert semantic.dtype == np.uint8
    np.testing.assert_array_equal(semantic, good)
    put(pairs / "semantic" / "a.png", np.array([[0, 19, 26]] * 2, np.uint8))
    with pytest.raises(Rts2Error, match=r"train ids 0 to 18.*a\.png holds 19 in 4 pixels"):
        open_all(pairs)[0].read()


def test_missing_folders_and_files_are_named(pairs: Path, put: Put) -> None:
    with pytest.raises(UsageError, match=r"left/ and right/: .*no such folder"):
        open_all(pairs / "none")
    with pytest.raises(UsageError, match=r"left, right not there; found a\.png, b\.1\.png, notes"):
        open_all(pairs / "left")
    put(pairs / "disparity" / "a.png", np.ones(SHAPE, np.uint16))
    with pytest.raises(Rts2Error, match=r"disparity has 1 of 2 files .*first missing b\.1"):
        open_all(pairs)
    (pairs / "right" / "a.jpg").unlink()
    with pytest.raises(Rts2Error, match=r"right has 1 of 2 files .*first missing a"):
        open_all(pairs)


def test_two_files_of_one_name_are_refused(pairs: Path, put: Put) -> None:
    put(pairs / "left" / "a.jpg", np.zeros((*SHAPE, 3), np.uint8))
    with pytest.raises(UsageError, match=r"before the suffix: .*a\.png and a\.jpg"):
        open_all(pairs)


def test_empty_folders_are_refused(tmp_path: Path) -> None:
    for name in ("left", "right"):
        (tmp_path / name).mkdir()
    with pytest.raises(UsageError, match=r"needs images .*left; none is there, found nothing"):
        open_all(tmp_path)


def test_an_empty_array_is_a_map_of_another_size(pairs: Path) -> None:
    (pairs / "disparity").mkdir()
    for name in ("a", "b.1"):
        np.save(pairs / "disparity" / f"{name}.npy", np.zeros((0, 0), np.float32))
    with pytest.raises(Rts2Error, match="truth 0x0"):
        open_all(pairs)[0].read()
