"""PFM is read as it is defined, and as the released files are."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rts2.model.data.images import read_rgb
from rts2.model.data.pfm import read_pfm, read_pfm_disparity
from rts2.model.data.scene import Scene
from rts2.model.errors import Rts2Error, UsageError

VALUES = np.array([[1, 2, 3], [4, np.inf, 6]], np.float32)
KNOWN = np.array([[1, 2, 3], [4, np.nan, 6]], np.float32)


@pytest.mark.parametrize("order", ["<", ">"])
def test_rows_come_top_first_in_either_byte_order(
    tmp_path: Path, put_pfm: Callable[..., Path], order: str
) -> None:
    # The scale's size is no factor.
    read = read_pfm(put_pfm(tmp_path / "d.pfm", VALUES, order, scale=0.5))
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, KNOWN)


def test_header_of_a_hand_made_file(tmp_path: Path) -> None:
    # Big endian by its positive scale; the second row of the file is the upper one.
    data = b"Pf\n2 2 \n1e+0\r\n" + bytes.fromhex("3f800000 40000000 40400000 40800000")
    (tmp_path / "d.pfm").write_bytes(data)
    assert read_pfm(tmp_path / "d.pfm").tolist() == [[3, 4], [1, 2]]


def test_a_first_byte_like_a_line_end_is_data(tmp_path: Path) -> None:
    value = np.frombuffer(b"\n\n\r ", "<f4")
    (tmp_path / "d.pfm").write_bytes(b"Pf\n1 1\n-1.0\n" + value.tobytes())
    assert read_pfm(tmp_path / "d.pfm")[0, 0] == value[0]


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "no PFM: its header"),
        (b"Pf\n2 1\n", "no PFM: its header"),
        (b"P5\n2 1\n255\n12", "no PFM: its header"),
        (b"Pf\n2 1\n0.0\n12345678", "a number other than 0"),
        (b"Pf\n2 1\n-1.0.0\n12345678", "a number other than 0"),
        (b"PF\n1 1\n-1\n123456789012", "one channel"),
        (b"Pf\n2 1\n-1\n1234567", "2x1 takes 8 bytes after the header, found 7"),
        (b"Pf\n2 1\n-1\n123456789", "found 9"),
        (b"Pf\n0 1\n-1\n", "truncated or no PFM"),
    ],
)
def test_what_is_no_map_is_one_line(tmp_path: Path, data: bytes, said: str) -> None:
    path = tmp_path / "d.pfm"
    path.write_bytes(data)
    with pytest.raises(Rts2Error, match=said) as caught:
        read_pfm(path)
    assert str(path) in str(caught.value)


def test_missing_file_is_wrong_use(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such file"):
        read_pfm(tmp_path / "none.pfm")


def test_negative_disparities_are_refused(tmp_path: Path, put_pfm: Callable[..., Path]) -> None:
    path = put_pfm(tmp_path / "d.pfm", -VALUES[:1])
    assert read_pfm(path).tolist() == [[-1, -2, -3]]
    with pytest.raises(Rts2Error, match=r"must be 0 or more.* holds -3\.000"):
        read_pfm_disparity(path)
    np.testing.assert_array_equal(read_pfm_disparity(put_pfm(path, VALUES)), KNOWN)
    unknown = put_pfm(path, np.full((2, 2), np.inf))
    assert np.isnan(read_pfm_disparity(unknown)).all()


def test_middlebury_fits_its_images(real_data: Path, unexplained: Callable[..., float]) -> None:
    folder = real_data / "middlebury2014" / "Motorcycle"
    left, right = (read_rgb(folder / f"im{i}.png") for i in range(2))
    truth = read_pfm_disparity(folder / "disp0GT.pfm")
    # vmin and vmax of its calib.txt, at the resolution of the file.
    assert 7 <= np.nanmin(truth) < np.nanmax(truth) <= 65
    assert unexplained(Scene("m", left, right, truth)) < 0.4
    assert unexplained(Scene("m", left, right, truth[::-1])) > 0.7
