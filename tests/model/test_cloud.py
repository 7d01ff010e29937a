"""Point clouds and calibrations against hand-worked geometry and the files of data sets."""

import struct
from pathlib import Path

import numpy as np
import pytest

from rts2.model.cloud import Calibration, cloud, read_calibration, write_cloud
from rts2.model.errors import Rts2Error, UsageError

NAN = np.nan


def disparities(*values: float) -> np.ndarray:
    return np.array([values], np.float32)


def test_points_are_metric() -> None:
    image = np.arange(15, dtype=np.uint8).reshape(1, 5, 3)
    points = cloud(disparities(10, NAN, 0.5, -3, 20), image, Calibration(100.0, 0.5))
    # z = 100 · 0.5 / d; the middle of five columns is 2; what is under 1 px is left out.
    assert points["z"].tolist() == [5.0, 2.5]
    assert points["x"].tolist() == pytest.approx([(0 - 2) * 0.05, (4 - 2) * 0.025])
    assert points["y"].tolist() == [0.0, 0.0]
    assert [points[name][1] for name in ("red", "green", "blue")] == [12, 13, 14]


def test_offset_and_centre_move_the_points() -> None:
    calibration = Calibration(100.0, 0.5, centre_px=(0.0, -1.0), offset_px=10.0)
    points = cloud(disparities(0, 15), np.zeros((1, 2, 3), np.uint8), calibration)
    assert points["z"].tolist() == [5.0, 2.0]
    assert points["x"].tolist() == pytest.approx([0.0, 0.02])
    assert points["y"].tolist() == pytest.approx([0.05, 0.02])


def test_cloud_file_is_binary_ply(tmp_path: Path) -> None:
    image = np.array([[[1, 2, 3], [4, 5, 6]]], np.uint8)
    points = cloud(disparities(10, 20), image, Calibration(100.0, 0.5, (0.0, 0.0)))
    write_cloud(tmp_path / "c.ply", points)
    header, body = (tmp_path / "c.ply").read_bytes().split(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert "element vertex 2" in lines
    properties = [line.split()[1:] for line in lines if line.startswith("property")]
    floats, bytes_ = [["float", axis] for axis in "xyz"], ["red", "green", "blue"]
    assert properties == floats + [["uchar", name] for name in bytes_]
    read = list(struct.iter_unpack("<fffBBB", body))
    assert read[0] == (0.0, 0.0, 5.0, 1, 2, 3)
    assert read[1] == (pytest.approx(0.025), 0.0, 2.5, 4, 5, 6)


def test_calibration_of_middlebury(real_data: Path) -> None:
    found = read_calibration(real_data / "middlebury2014" / "Motorcycle" / "calib.txt")
    assert found == Calibration(999.421, 0.193001, (294.182, 252.932), 32.778, (741, 497))
    found.require_fits((741, 497))
    with pytest.raises(UsageError, match="it is for 741x497, they are 640x480"):
        found.require_fits((640, 480))
    with pytest.raises(UsageError, match="741x497"):
        cloud(disparities(1, 2), np.zeros((1, 2, 3), np.uint8), found)


RAW = """calib_time: 09-Jan-2012 13:57:47
S_rect_02: 1.242000e+03 3.750000e+02
P_rect_02: 7.0e+02 0 6.0e+02 4.5e+01 0 7.0e+02 1.7e+02 -3.0e-01 0 0 1 4.9e-03
P_rect_03: 7.0e+02 0 6.1e+02 -3.33e+02 0 7.0e+02 1.7e+02 2.3 0 0 1 3.2e-03
"""


@pytest.mark.parametrize(
    ("text", "size"),
    [
        (RAW, (1242, 375)),
        (RAW.replace("P_rect_0", "P").replace("S_rect_02", "S_02"), None),
    ],
    ids=["raw data", "benchmark"],
)
def test_calibration_of_kitti(tmp_path: Path, text: str, size: tuple[int, int] | None) -> None:
    (tmp_path / "calib.txt").write_text(text)
    found = read_calibration(tmp_path / "calib.txt")
    assert found.baseline_m == pytest.approx((45 + 333) / 700)
    assert (found.focal_px, found.centre_px, found.size) == (700, (600, 170), size)
    assert found.offset_px == pytest.approx(10)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("hello", "must be a Middlebury"),
        ("cam0=[1 0 2; 0 1 3]\nbaseline=100", "cam0 must be 9 finite numbers"),
        ("cam0=[9 0 2; 0 9 3; 0 0 1]", "baseline must be 1 finite numbers, not None"),
        ("cam0=[9 0 2; 0 9 3; 0 0 1]\nbaseline=nan", "baseline must be 1 finite"),
        ("cam0=[9 0 2; 0 9 3; 0 0 1]\nbaseline=-3", "must be above 0: 9 px, -0.003 m"),
        ("cam0=[9 0 x; 0 9 3; 0 0 1]\nbaseline=3", "cam0 must be 9"),
        ("P2: 0 0 0 0 0 0 0 0 0 0 0 0\nP3: 0 0 0 0 0 0 0 0 0 0 0 0", "must be above 0"),
        ("P2: 1 0 0 0 0 0 0 0 0 0 0 0", "P3 must be 12"),
    ],
)
def test_calibration_that_is_wrong(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "calib.txt").write_text(text)
    with pytest.raises(Rts2Error, match=message):
        read_calibration(tmp_path / "calib.txt")


def test_calibration_that_is_no_text(tmp_path: Path) -> None:
    (tmp_path / "calib.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(Rts2Error, match="must be text"):
        read_calibration(tmp_path / "calib.txt")
    with pytest.raises(UsageError, match="no such file"):
        read_calibration(tmp_path / "none.txt")
