"""Every data set is opened by its name, its split, or a list of frames."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rts2.model.data.cache import Cached
from rts2.model.data.catalog import DATASETS, open_dataset, require_generated
from rts2.model.data.kitti import open_2015
from rts2.model.data.streets import VAL_SEED, Streets
from rts2.model.errors import UsageError


@pytest.fixture
def kitti(tmp_path: Path, put: Callable[..., Path]) -> Path:
    for i in range(3):
        for folder in ("image_2", "image_3", "disp_occ_0"):
            put(tmp_path / "training" / folder / f"{i:06}_10.png", np.ones((2, 3), np.uint16))
    return tmp_path


def test_rows_name_splits_that_they_have() -> None:
    for name, row in DATASETS.items():
        assert {row.trained, row.judged} <= {*row.splits}, name
        # A list file chooses from `all`, so whatever lies in a folder has that split.
        assert row.has_folder == ("all" in row.splits), name
    assert {name: row.k for name, row in DATASETS.items() if "kitti" in name} == {
        "kitti2015": 2,
        "kitti2012": 2,
    }
    assert DATASETS["cityscapes"].k == DATASETS["cityscapes-coarse"].k == 1.12


@pytest.mark.parametrize("name", [name for name, row in DATASETS.items() if row.has_folder])
def test_every_row_opens_every_split(name: str, tmp_path: Path) -> None:
    """An empty folder lacks what the row looks for, in any of its splits."""
    for split in DATASETS[name].splits:
        with pytest.raises(UsageError, match="found nothing"):
            open_dataset(name, tmp_path, split)


def test_split_is_that_of_the_row_unless_told(kitti: Path) -> None:
    assert open_dataset("kitti2015", kitti) == open_2015(kitti, "all")
    with pytest.raises(UsageError, match=r"the split val .* lists 40"):
        open_dataset("kitti2015", kitti, "val")


def test_list_file_chooses_frames(kitti: Path, tmp_path: Path) -> None:
    path = tmp_path / "mine.txt"
    path.write_text("000002\n000000_10\n")
    for split in (path, str(path)):
        found = open_dataset("kitti2015", kitti, split)
        assert [sample.name for sample in found] == ["000002_10", "000000_10"]
    path.write_text("000003\n")
    with pytest.raises(UsageError, match=r"mine\.txt lists 1, .* first missing 000003"):
        open_dataset("kitti2015", kitti, path)


def test_wrong_requests_are_one_line(kitti: Path) -> None:
    with pytest.raises(UsageError, match=r"one of kitti2015, .*streets, not 'kiti'"):
        open_dataset("kiti", kitti)
    with pytest.raises(UsageError, match=r"kitti2015 needs its folder .* --data DIR"):
        open_dataset("kitti2015")
    with pytest.raises(UsageError, match="kitti2012 are all, test: train is neither"):
        open_dataset("kitti2012", kitti, "train")
    with pytest.raises(UsageError, match="streets are train, val: not all"):
        open_dataset("streets", split="all")
    with pytest.raises(UsageError, match="leave out --data"):
        open_dataset("streets", kitti)


def test_an_option_of_generated_scenes_is_refused_where_nobody_makes_them() -> None:
    require_generated("streets", ["count", "data_seed"])
    require_generated("kitti2015", [])
    with pytest.raises(UsageError, match=r"--data-seed is for generated scenes .*kitti2015 lies"):
        require_generated("kitti2015", ["data_seed", "count"])


def test_streets_that_judge_are_called_so() -> None:
    judging, training = (open_dataset("streets", split=s, count=8) for s in ("val", "train"))
    assert [sample.name for sample in judging[:2]] == ["val-000000", "val-000001"]
    assert training[7].name == "0-000007"


def test_streets_that_judge_never_train() -> None:
    def told(**how: Any) -> tuple[int, int, tuple[int, int]]:
        found = open_dataset("streets", **how)
        assert isinstance(found, Streets)
        return len(found), found.seed, found.size

    size = (512, 256)
    assert told(split="train", count=7, seed=3, size=size) == (7, 3, size)
    assert told(split="val", count=7, seed=3) == (7, VAL_SEED, (1242, 375))
    assert told() == (200, VAL_SEED, (1242, 375))
    with pytest.raises(UsageError, match="belongs to the streets that judge"):
        told(split="train", seed=VAL_SEED)


@pytest.mark.parametrize("count", [0, -1, 10**20])
def test_streets_have_a_count_that_can_be_made(count: int) -> None:
    with pytest.raises(UsageError, match=f"streets may be 1 to 1000000, not {count}"):
        open_dataset("streets", count=count)


def test_streets_may_be_rectified_badly() -> None:
    found = open_dataset("streets", count=1, rectification_px=0.5)
    assert isinstance(found, Streets)
    assert found.look.rectification_px == 0.5


def test_streets_are_cached_like_the_rest(tmp_path: Path) -> None:
    size = (96, 64)
    train, val = (
        open_dataset("streets", split=split, count=2, size=size) for split in ("train", "val")
    )
    for samples in (train, val):
        scene = samples[1].read()
        cached = [Cached(samples, tmp_path)[1].read() for _ in range(2)]
        for name, array in scene.arrays().items():
            for found in cached:
                assert found.arrays()[name].dtype == array.dtype
                np.testing.assert_array_equal(found.arrays()[name], array)
    # One file each: the streets that judge are others.
    assert len(list(tmp_path.rglob("*.scene"))) == 2
