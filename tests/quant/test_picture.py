"""The picture of a kernel audit, read back from the figure."""

from pathlib import Path
from typing import Any

import pytest
from matplotlib.axes import Axes
from PIL import Image

from rts2.quant.picture import DPI, FRAME_IN, ROW_IN, WIDTH_IN, draw, save_audit

from .reports import LAYERS, REPORT, UNKNOWN


def drawn(report: dict[str, Any] = REPORT) -> tuple[Axes, Axes]:
    times, noise = draw(report).axes
    return times, noise


def test_a_layer_has_two_bars_and_the_first_is_on_top() -> None:
    times, _ = drawn()
    plain, lowered = ([bar.get_width() for bar in bars] for bars in times.containers)
    assert (plain, lowered) == ([2.5, 0.4, 10], [1.5, 0.6, 5])
    assert [label.get_text() for label in times.get_yticklabels()] == [
        row["layer"] for row in LAYERS
    ]
    bottom, top = times.get_ylim()
    assert bottom > top


def test_a_dot_is_at_the_end_of_what_was_chosen() -> None:
    times, _ = drawn()
    dots = {line.get_label(): list(line.get_xdata()) for line in times.lines}
    assert dots == {"int8 chosen": [1.5, 5], "stays float": [0.4]}


def test_noise_is_beside_the_times_and_a_dash_where_nobody_knows() -> None:
    times, noise = drawn()
    assert noise.get_shared_y_axes().joined(times, noise)
    dots = [line for line in noise.lines if line.get_marker() == "o"]
    assert [(*line.get_xdata(), *line.get_ydata()) for line in dots] == [(40, 0), (40, 1), (40, 3)]
    assert [text.get_text() for text in noise.texts] == ["40.0", "40.0", "–", "40.0"]


def test_the_title_tells_what_is_seen() -> None:
    title = draw(REPORT).get_suptitle()
    assert title.startswith(REPORT["network"])
    assert "3 of 4 layers in int8, int8 delivered" in title
    assert draw(UNKNOWN).get_suptitle().endswith("not timed")


def test_what_is_not_known_is_said() -> None:
    for report in (UNKNOWN, REPORT | {"layers": []}):
        times, noise = drawn(report)
        assert not times.containers
        assert [text.get_text() for text in times.texts] == ["no layer was timed"]
        assert [text.get_text() for text in noise.texts] == ["no layer was judged alone"]


@pytest.mark.parametrize("count", [10, 46])
def test_the_picture_is_written_as_png_and_grows_with_its_layers(
    tmp_path: Path, count: int
) -> None:
    layers = [LAYERS[0] | {"layer": f"encoder.{n}/Conv"} for n in range(count)]
    save_audit(REPORT | {"layers": layers}, tmp_path / "audit.png")
    with Image.open(tmp_path / "audit.png") as image:
        assert image.format == "PNG"
        assert image.width == WIDTH_IN * DPI
        assert image.height == pytest.approx((FRAME_IN + ROW_IN * count) * DPI, abs=1)
    assert [path.name for path in tmp_path.iterdir()] == ["audit.png"]


def test_names_are_no_formulas_and_long_ones_lose_their_middle(tmp_path: Path) -> None:
    layers = [LAYERS[0] | {"layer": name} for name in ("$x^", "立体", "a" * 60 + "b" * 60)]
    save_audit(REPORT | {"network": "$5^ 立体", "layers": layers}, tmp_path / "audit.png")
    times, _ = drawn(REPORT | {"layers": layers})
    names = [label.get_text() for label in times.get_yticklabels()]
    assert names == ["$x^", "立体", "a" * 21 + "…" + "b" * 21]
