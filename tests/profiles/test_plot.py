"""The picture of a check: what is drawn, read back from the figure."""

from math import exp
from pathlib import Path

import pytest
from matplotlib.axes import Axes
from PIL import Image

from rts2.model.arch import Arch, Precision
from rts2.profiles.check import Comparison, Executor
from rts2.profiles.plot import draw, save
from rts2.profiles.profile import Runtime

KITTI, QUARTER = (1242, 375), (640, 192)


def compared(
    precision: Precision,
    size: tuple[int, int],
    true: float,
    error: float,
    runtime: Runtime = "openvino",
) -> Comparison:
    """A network of `true` milliseconds, predicted `error` percent too slow."""
    fps = 1000 / true
    return Comparison(Arch(c=1), precision, runtime, size, fps, fps / (1 + error / 100))


FOUND = [
    compared("fp32", KITTI, 40, 3),
    compared("bf16", KITTI, 20, -4),
    compared("fp32", QUARTER, 10, 12),
    compared("fp32", KITTI, 80, 0),
]
WIDTHS: dict[Executor, float] = {
    ("openvino", "fp32"): 0.07,
    ("openvino", "bf16"): 0.2,
    ("onnxruntime", "fp32"): 0.1,
}
"""Of the intervals, in natural logarithm."""


def test_left_is_predicted_against_measured_and_right_is_what_is_left() -> None:
    both, errors = draw(FOUND, "My PC", WIDTHS).axes
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


def legend(axes: Axes) -> list[str]:
    found = axes.get_legend()
    assert found is not None
    return [text.get_text() for text in found.get_texts()]


def test_each_precision_and_size_is_named() -> None:
    both, errors = draw(FOUND, "My PC", WIDTHS).axes
    assert legend(both) == ["fp32, 1242×375", "bf16, 1242×375", "fp32, 640×192"]
    assert legend(errors) == ["90% interval, fp32", "90% interval, bf16"]


def test_a_precision_of_two_runtimes_is_named_with_them() -> None:
    found = [compared("fp32", KITTI, 90, 1, "onnxruntime"), *FOUND]
    both, errors = draw(found, "My PC", WIDTHS).axes
    names = "fp32 on ONNX Runtime", "fp32 on OpenVINO", "bf16 on OpenVINO"
    assert legend(errors) == [f"90% interval, {name}" for name in names]
    assert [text.split(", ")[0] for text in legend(both)] == [*names, names[1]]


def test_a_colour_is_a_runtime_and_precision_and_a_marker_a_size() -> None:
    both, _ = draw(FOUND, "My PC", WIDTHS).axes
    first, half, quarter = both.collections
    colours = [tuple(dots.get_facecolor()[0]) for dots in (first, half, quarter)]
    assert colours[0] == colours[2] != colours[1]
    shapes = [dots.get_paths()[0].vertices.tolist() for dots in (first, half, quarter)]
    assert shapes[0] == shapes[1] != shapes[2]


def bands(found: list[Comparison], widths: dict[Executor, float]) -> list[tuple[float, float]]:
    """The low and the high end of each interval that is drawn, in percent."""
    _, errors = draw(found, "My PC", widths).axes
    inverted = errors.transData.inverted()
    extents = [patch.get_extents().transformed(inverted) for patch in errors.patches]
    return [(float(box.intervaly[0]), float(box.intervaly[1])) for box in extents]


def test_the_band_is_the_interval_of_each_runtime_and_precision() -> None:
    """A half width in natural logarithm is not the same in percent on both sides."""
    single = [pair for pair in FOUND if pair.precision == "fp32"]
    for found, widths in ((single, [0.07]), (FOUND, [0.07, 0.2])):
        wanted = [(100 * (exp(-width) - 1), 100 * (exp(width) - 1)) for width in widths]
        assert bands(found, WIDTHS) == [pytest.approx(ends) for ends in wanted]


def test_the_picture_is_written_as_png(tmp_path: Path) -> None:
    save(FOUND, "My [red]PC $5^$ 立体", WIDTHS, tmp_path / "check.png")
    with Image.open(tmp_path / "check.png") as image:
        assert image.format == "PNG"
        assert min(image.size) > 400
    assert [path.name for path in tmp_path.iterdir()] == ["check.png"]
