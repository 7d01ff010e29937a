"""The picture of a check: what is drawn, read back from the figure."""

from math import exp
from pathlib import Path

import pytest
from PIL import Image

from rts2.model.arch import Arch, Precision
from rts2.profiles.check import Comparison
from rts2.profiles.plot import draw, save

KITTI, QUARTER = (1242, 375), (640, 192)


def compared(precision: Precision, size: tuple[int, int], true: float, error: float) -> Comparison:
    """A network of `true` milliseconds, predicted `error` percent too slow."""
    fps = 1000 / true
    return Comparison(Arch(c=1), precision, "openvino", size, fps, fps / (1 + error / 100))


FOUND = [
    compared("fp32", KITTI, 40, 3),
    compared("bf16", KITTI, 20, -4),
    compared("fp32", QUARTER, 10, 12),
    compared("fp32", KITTI, 80, 0),
]


def test_left_is_predicted_against_measured_and_right_is_what_is_left() -> None:
    both, errors = draw(FOUND, "My PC", 0.07).axes
    assert both.get_title() == "My PC"
    assert (both.get_xlabel(), both.get_ylabel()) == ("measured, ms", "predicted, ms")
    assert (errors.get_xlabel(), errors.get_ylabel()) == (
        "measured, ms",
        "predicted − measured, %",
    )
    assert (both.get_xscale(), both.get_yscale()) == ("log", "log")
    drawn = [tuple(at) for dots in both.collections for at in dots.get_offsets()]
    left = [(40, 41.2), (80, 80), (20, 19.2), (10, 11.2)]
    assert drawn == [pytest.approx(at) for at in left]
    drawn = [tuple(at) for dots in errors.collections for at in dots.get_offsets()]
    right = [(40, 3), (80, 0), (20, -4), (10, 12)]
    assert drawn == [pytest.approx(at, abs=1e-9) for at in right]


def test_each_precision_and_size_is_named() -> None:
    both, _ = draw(FOUND, "My PC", 0.07).axes
    legend = both.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == [
        "fp32, 1242×375",
        "bf16, 1242×375",
        "fp32, 640×192",
    ]


def test_the_band_is_the_interval() -> None:
    """A half width in natural logarithm is not the same in percent on both sides."""
    _, errors = draw(FOUND, "My PC", 0.07).axes
    (band,) = errors.patches
    low, high = band.get_extents().transformed(errors.transData.inverted()).intervaly
    assert low == pytest.approx(100 * (exp(-0.07) - 1))
    assert high == pytest.approx(100 * (exp(0.07) - 1))


def test_the_picture_is_written_as_png(tmp_path: Path) -> None:
    save(FOUND, "My [red]PC $5^$ 立体", 0.07, tmp_path / "check.png")
    with Image.open(tmp_path / "check.png") as image:
        assert image.format == "PNG"
        assert min(image.size) > 400
    assert [path.name for path in tmp_path.iterdir()] == ["check.png"]
