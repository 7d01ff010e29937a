"""The picture: a valid file, the right points on it, and no warning whatever the title."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from rts2.model.errors import Rts2Error
from rts2.profiles.profile import Profile, load
from rts2.search.exhaustive import Question, search
from rts2.search.plot import MARKERS, draw, save
from rts2.search.report import executor_of
from rts2.search.result import Found
from rts2.search.sources import source
from rts2.search.space import Space

SMALL = Space(c=(1, 4, 8, 16), d_max=(10, 12), conv3d=((16,), (4,), (4,)))


@cache
def found(device: str = "tx2", **asked: Any) -> Found:
    question: dict[str, Any] = {"profile": load(device), "target_fps": 10.0}
    return search(Question(**{**question, **asked}), source("published"), SMALL)


CASES: dict[str, dict[str, Any]] = {
    "the usual": {},
    "stereo": {"task": "stereo"},
    "mIoU": {"objective": "miou", "target_fps": 6.0},
    "EPE": {"objective": "epe", "target_fps": 6.0},
    "nothing meets the target": {"target_fps": 1e5},
    "a target of hours": {"target_fps": 1e-4},
    "an empty front": {"min_disparity": 1e6},
    "extrapolated alone": {"resolution": (640, 480)},
    "the pick extrapolated": {"resolution": (640, 480), "allow_extrapolated": True},
    "one candidate": {"task": "stereo", "max_size_bytes": 30_000},
}


@pytest.mark.parametrize("name", CASES)
def test_the_picture_is_a_valid_png(name: str, tmp_path: Path) -> None:
    """Warnings are errors here, so it also comes without one."""
    path = tmp_path / "front.png"
    save(found(**CASES[name]), "Jetson TX2", path)
    with Image.open(path) as picture:
        picture.verify()
    with Image.open(path) as picture:
        assert picture.format == "PNG"
        assert picture.width > 500
        assert picture.height > 300
        colours = np.unique(np.asarray(picture.convert("L")))
    assert len(colours) > 20
    assert [entry.name for entry in tmp_path.iterdir()] == ["front.png"]


def test_every_point_of_known_accuracy_is_drawn_where_it_belongs() -> None:
    result = found()
    (axes,) = draw(result, "Jetson TX2").axes
    drawn = {
        (float(x), float(y))
        for line in axes.get_lines()
        if line.get_marker() not in ("None", "", "*")
        for x, y in line.get_xydata()
    }
    expected = {
        (point.fps, point.d1_all)
        for point in result.front
        if point.evidence.accuracy != "extrapolated"
    }
    assert drawn >= expected
    assert drawn <= {(point.fps, point.d1_all) for point in result.front}


def test_evidence_has_markers_of_its_own() -> None:
    (axes,) = draw(found(), "Jetson TX2").axes
    markers = {
        str(line.get_marker()): line.get_xydata()
        for line in axes.get_lines()
        if line.get_marker() not in ("None", "", "*")
    }
    kinds: dict[str, set[str]] = {}
    for marker, points in markers.items():
        for x, _ in points:
            (point,) = (p for p in found().front if p.fps == x)
            kinds.setdefault(point.evidence.latency, set()).add(marker)
    assert kinds.keys() == {"published", "interpolated", "extrapolated"}
    assert all(len(used) == 1 for used in kinds.values())
    assert len({next(iter(used)) for used in kinds.values()}) == 3


def test_each_runtime_and_precision_has_a_colour_and_is_named(two_runtimes: Profile) -> None:
    result = search(Question(two_runtimes, 10.0, precisions=("fp32",)), source("published"), SMALL)
    (axes,) = draw(result, "My PC").axes
    colours: dict[str, set[str]] = {}
    for line in axes.get_lines():
        for x, y in line.get_xydata() if line.get_marker() in MARKERS.values() else ():
            (point,) = (p for p in result.front if (p.fps, p.d1_all) == (x, y))
            colours.setdefault(executor_of(point), set()).add(str(line.get_color()))
    assert colours.keys() == {"fp32 on ONNX Runtime", "fp32 on OpenVINO"}
    assert [len(known) for known in colours.values()] == [1, 1]
    assert len(set.union(*colours.values())) == 2
    labels = axes.get_legend_handles_labels()[1]
    told = {(executor_of(p), p.evidence.latency) for p in result.front}
    assert {f"{executor}, {evidence}" for executor, evidence in told} <= set(labels)


def test_the_pick_and_the_prospect_are_stars() -> None:
    result = found()
    (axes,) = draw(result, "Jetson TX2").axes
    stars = {
        (float(x), float(y))
        for line in axes.get_lines()
        if line.get_marker() == "*"
        for x, y in line.get_xydata()
    }
    assert result.selected is not None
    assert result.prospect is not None
    assert stars == {(point.fps, point.d1_all) for point in (result.selected, result.prospect)}


def test_axes_say_what_they_show() -> None:
    (axes,) = draw(found(), "my box").axes
    assert "my box" in axes.get_title(loc="left")
    assert "1242×375" in axes.get_xlabel()
    assert "90% interval" in axes.get_xlabel()
    assert axes.get_ylabel() == "D1-all in percent, lower is better"
    (higher,) = draw(found(objective="miou", target_fps=6.0), "my box").axes
    assert higher.get_ylabel() == "mIoU in percent, higher is better"
    assert any("10 FPS" in text.get_text() for text in axes.texts)


@pytest.mark.parametrize("title", ["costs $5^$", "a_b ^ \\frac{", "100 % & #1 <b>", "机器人"])
def test_a_title_is_text_and_no_formula(title: str, tmp_path: Path) -> None:
    """Also where the font has no letters for it: the picture shows boxes, and nobody is warned."""
    save(found(), title, tmp_path / "front.png")
    assert (tmp_path / "front.png").stat().st_size > 10_000


def test_a_picture_that_cannot_be_written_is_one_error(tmp_path: Path) -> None:
    (tmp_path / "front.png").mkdir()
    with pytest.raises(Rts2Error, match="cannot write"):
        save(found(), "Jetson TX2", tmp_path / "front.png")
    assert [entry.name for entry in tmp_path.iterdir()] == ["front.png"]
