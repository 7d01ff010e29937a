"""Lists of frames, and folders that must agree."""

from pathlib import Path

import numpy as np
import pytest

from rts2.model.data.frame import Frame
from rts2.model.data.kitti import CODING
from rts2.model.data.layout import chosen, column, entries, read_names, rows
from rts2.model.errors import Rts2Error, UsageError


def frames(*names: str) -> list[Frame]:
    return [Frame(name, Path(name), Path(name), CODING) for name in names]


def named(found: tuple[Frame, ...]) -> list[str]:
    return [frame.name for frame in found]


def test_list_holds_one_name_a_line(tmp_path: Path) -> None:
    path = tmp_path / "list.txt"
    path.write_text("﻿# mine\n000002_10\r\n\n  000000 \n", "utf-8")
    assert read_names(path) == ("000002_10", "000000")


@pytest.mark.parametrize(
    ("data", "said"),
    [(b"", "names none"), (b"# nothing\n\n", "names none"), (b"\xff\xfe\x00", "must be text")],
)
def test_list_of_nothing_is_refused(tmp_path: Path, data: bytes, said: str) -> None:
    path = tmp_path / "list.txt"
    path.write_bytes(data)
    with pytest.raises(Rts2Error, match=said):
        read_names(path)


def test_frames_are_chosen_in_the_order_of_the_list() -> None:
    there = frames("000000_10", "000001_10", "000002_10")
    listed = ["training/image_2/000002_10.png", "000000", "000001_10"]
    assert named(chosen(there, listed, "l", Path())) == ["000002_10", "000000_10", "000001_10"]
    city = frames("ulm_000000_000019")
    assert chosen(city, ["train/ulm/ulm_000000_000019_leftImg8bit.png"], "l", Path()) == (city[0],)
    # A name with a dot is a whole name, and comes before what is left without its end.
    dotted = frames("a", "a.png", "shot.0001")
    assert named(chosen(dotted, ["a.png", "shot.0001", "a"], "l", Path())) == [
        "a.png",
        "shot.0001",
        "a",
    ]


def test_listed_frame_that_is_not_there_is_named() -> None:
    with pytest.raises(
        UsageError, match="l lists 3, 2 of them are not among the 1 in k; first missing 000001"
    ):
        chosen(frames("000000_10"), ["000000", "000001", "x"], "l", Path("k"))


def test_listed_twice_is_refused() -> None:
    with pytest.raises(UsageError, match="l repeats 000000_10"):
        chosen(frames("000000_10"), ["000000", "000000_10"], "l", Path())


def test_rows_need_every_file(tmp_path: Path) -> None:
    for name in ("a/1_l.png", "a/2_l.png", "b/2_r.png", "b/3_r.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    left, right = column(tmp_path / "a", "*_l.png"), column(tmp_path / "b", "*_r.png")
    with pytest.raises(Rts2Error, match=r"b has 1 of 2 files \*_r\.png, first missing 1_r\.png"):
        rows({"left": left, "right": right}, "pairs")
    (tmp_path / "b" / "1_r.png").touch()
    right = column(tmp_path / "b", "*_r.png")
    found = rows({"left": left, "right": right}, "pairs")
    assert [name for name, _ in found] == ["1", "2"]
    assert found[1][1] == {
        "left": tmp_path / "a" / "2_l.png",
        "right": tmp_path / "b" / "2_r.png",
    }


def test_errors_list_what_was_found(tmp_path: Path) -> None:
    assert entries(tmp_path) == "nothing"
    for i in range(10):
        (tmp_path / f"{i}").touch()
    assert entries(tmp_path) == "0, 1, 2, 3, 4, 5, 6, 7 and 2 more"
    with pytest.raises(UsageError, match=r"pairs needs images \*\.png .*none is there, found 0, 1"):
        rows({"left": column(tmp_path, "*.png")}, "pairs")


def test_frame_without_truth_is_unknown_everywhere(tmp_path: Path) -> None:
    from rts2.model.data.images import write_image

    write_image(tmp_path / "i.png", np.zeros((2, 3, 3), np.uint8))
    frame = Frame("i", tmp_path / "i.png", tmp_path / "i.png", CODING)
    scene = frame.read()
    assert frame.size == scene.size == (3, 2)
    assert frame.foreground is None
    assert np.isnan(scene.truth).all()
    assert scene.truth.dtype == np.float32
    assert {*scene.arrays()} == {"left", "right", "truth"}
