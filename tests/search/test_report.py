"""The table and the spreadsheet: the pick is marked, nothing is cut, numbers read back."""

import csv
import io
import re
from functools import cache
from typing import Any

import pytest
from rich.console import Console

from rts2.model.arch import Arch
from rts2.model.console import WIDTH
from rts2.profiles.profile import Profile, load
from rts2.search.accuracy import METRICS, Metric
from rts2.search.exhaustive import Question, search
from rts2.search.report import ROWS, as_csv, caption, headline, name_of, number, show
from rts2.search.result import Found, Point
from rts2.search.sources import source


@cache
def found(**asked: Any) -> Found:
    """A search of the whole space for a TX2, at 10 frames a second where not asked otherwise."""
    question: dict[str, Any] = {"profile": load("tx2"), "target_fps": 10.0}
    return search(Question(**{**question, **asked}), source("published"))


def printed(result: Found, profile: Profile | None = None, width: int = WIDTH) -> str:
    text = io.StringIO()
    show(result, profile or load("tx2"), ["out/", "front.json"], Console(file=text, width=width))
    return text.getvalue()


def rows(text: str) -> list[str]:
    """The lines of the table, its header first."""
    lines = text.splitlines()
    start = next(at for at, line in enumerate(lines) if "branches" in line)
    ends = ("all with", "pick", "…")
    stop = next(at for at, line in enumerate(lines) if at > start and line.startswith(ends))
    return lines[start:stop]


@pytest.mark.parametrize("task", ["semantic-stereo", "stereo"])
@pytest.mark.parametrize("target", [4.0, 10.0, 27.0])
def test_the_pick_is_marked_and_nothing_else(task: str, target: float) -> None:
    result = found(task=task, target_fps=target)
    assert result.selected is not None
    (marked,) = (line for line in printed(result).splitlines() if "▶" in line)
    assert f" {result.selected.arch.c} " in marked
    assert f" {result.selected.arch.stages} " in marked
    assert f" {result.selected.fps:.1f} " in marked
    assert f"{result.selected.d1_all:.2f}%" in marked


@pytest.mark.parametrize("resolution", [(1242, 375), (640, 480)])
def test_a_pick_on_extrapolated_numbers_is_marked_too(resolution: tuple[int, int]) -> None:
    result = found(allow_extrapolated=True, resolution=resolution)
    assert result.selected is not None
    assert not result.selected.proven
    (marked,) = (line for line in printed(result).splitlines() if "▶" in line)
    assert f" {result.selected.fps:.1f} " in marked
    assert marked.split()[-2:] == ["x", "i"]


def test_without_a_pick_nothing_is_marked_and_the_fastest_is_named() -> None:
    result = found(target_fps=1000.0)
    text = printed(result)
    assert result.nearest is not None
    assert "▶" not in text
    assert "none holds 1000 FPS" in " ".join(text.split())
    assert f"{result.nearest.fps:.1f} FPS" in text


@pytest.mark.parametrize("width", [80, 100, WIDTH, 200])
@pytest.mark.parametrize("task", ["semantic-stereo", "stereo"])
def test_no_cell_is_cut(width: int, task: str) -> None:
    """A terminal of 80 columns is the usual one."""
    text = printed(found(task=task), width=width)
    assert "…" not in text
    assert sum("▶" in line for line in text.splitlines()) == 1
    assert all(len(line) <= width for line in text.splitlines())


def test_rows_fall_in_frames_per_second_and_stay_few() -> None:
    result = found()
    _, *lines = rows(printed(result))
    assert len(lines) <= ROWS < len(result.front)
    rates = [float(line.split("–")[0].split()[-2]) for line in lines]
    assert rates == sorted(rates, reverse=True)
    assert f"{len(result.front) - len(lines)} more points" in printed(result)


def test_a_line_says_what_the_point_is() -> None:
    """The paper's c=8 stopped after two stages, its interval from the worst residual."""
    (marked,) = (line for line in printed(found()).splitlines() if "▶" in line)
    for cell in (" 8 ", " 2 ", " full ", " 16/4 ", " 10.9 10.4–11.4 ", " 4.70% ", " p p"):
        assert cell in marked
    assert marked.split().count("–") == 2  # neither EPE nor mIoU was published for two stages


def test_the_lines_below_the_table() -> None:
    text = " ".join(printed(found()).split())
    assert "Jetson TX2 · 1242×375 · semantic stereo · 1,882,368 candidates" in text
    assert "pick c=8, 2 stages, full, fp32 on PyTorch · 10.9 FPS · D1-all 4.70%" in text
    assert "fp16 on TensorRT" in text
    assert "--allow-extrapolated" in text
    for entry in found().left_out:
        assert f"{entry.count:,} candidates: {entry.reason}" in text
    assert "int8 is not offered on Jetson TX2" in text
    assert "written out/ front.json" in text


def test_at_another_resolution_the_note_says_what_is_known() -> None:
    text = " ".join(printed(found(resolution=(640, 480))).split())
    assert "known at 1242×375" in text
    assert "known at 1242×375" not in printed(found())


@pytest.mark.parametrize("title", ["Box [v2]", "Box [/v2] [bold]", "my [red]box[/red]"])
def test_a_title_is_text_and_not_markup(title: str) -> None:
    profile = load("tx2").model_copy(update={"title": title})
    assert f"RTS²Net on {title} · 1242×375" in printed(found(), profile)


def test_a_front_of_nothing_prints() -> None:
    empty = found(min_disparity=1e6)
    assert empty.front == ()
    text = printed(empty)
    assert "none" in text
    assert "d_max cannot see" in " ".join(text.split())


@pytest.mark.parametrize(
    ("objective", "told"),
    [("d1_all", "D1-all {:.2f}%"), ("epe", "EPE {:.2f} px"), ("miou", "mIoU {:.2f}%")],
)
def test_the_pick_is_told_in_its_objective(objective: Metric, told: str) -> None:
    result = found(objective=objective, target_fps=6.0)
    assert result.selected is not None
    accuracy = told.format(result.selected.metric(objective))
    text = " ".join(printed(result).split())
    assert f"pick {name_of(result.selected)} · {result.selected.fps:.1f} FPS · {accuracy}" in text


def test_words_by_hand() -> None:
    point = found().selected
    assert point is not None
    assert name_of(point) == "c=8, 2 stages, full, fp32 on PyTorch"
    assert number("d1_all", 4.7) == "4.70%"
    assert number("epe", 0.9) == "0.90 px"
    assert number("miou", None) == "–"
    assert caption("miou", 62.216) == "mIoU 62.22%"
    assert headline(found(), "my box") == "RTS²Net on my box · 1242×375 · semantic stereo"


def test_the_spreadsheet_parses_back() -> None:
    result = found(task="stereo")
    lines = list(csv.DictReader(io.StringIO(as_csv(result))))
    assert len(lines) == len(result.front)
    assert [line["selected"] for line in lines].count("True") == 1
    for line, point in zip(lines, result.front, strict=True):
        assert read_back(line) == point
        assert line["branches"] == point.arch.branches
        assert (line["selected"] == "True") == (point == result.selected)


def read_back(line: dict[str, str]) -> Point:
    """A point of the front from its line alone."""
    arch = Arch(
        family=line["family"],
        c=int(line["c"]),
        stages=int(line["stages"]),
        d_max=int(line["d_max"]),
        conv3d=tuple(int(width) for width in line["conv3d"].split("/")),
        semantic=line["branches"] != "disparity",
        refinement=line["branches"] == "full",
    )
    values: dict[str, Any] = {
        name: line[name] for name in ("precision", "runtime", "params", "size_bytes", "macs")
    }
    values |= {name: line[name] for name in ("latency_ms", "fps", "fps_low", "fps_high")}
    values |= {metric: line[metric] or None for metric in METRICS}
    told = {"latency": line["latency_evidence"], "accuracy": line["accuracy_evidence"]}
    ranges = {
        metric: (line[f"{metric}_low"], line[f"{metric}_high"])
        for metric in METRICS
        if line[f"{metric}_low"]
    }
    return Point.model_validate(
        {"arch": arch, "evidence": told, "ranges": ranges or None, **values}
    )


def test_the_spreadsheet_of_an_empty_front_is_its_header() -> None:
    (line,) = as_csv(found(min_disparity=1e6)).splitlines()
    assert line.startswith("family,c,stages,d_max,conv3d,branches,precision,runtime,latency_ms,fps")


def test_what_is_untried_tells_an_interval_where_one_is_known() -> None:
    """Class scores see no 3D width, so that the mIoU is in no doubt by it."""
    device = load("cpu")
    by_miou = search(Question(device, 10.0, objective="miou"), source("published"))
    told = printed(by_miou, device, 200)
    (line,) = (line for line in told.splitlines() if line.startswith("untried"))
    assert "(extrapolated)" in line
    d1 = printed(search(Question(device, 10.0), source("published")), device, 200)
    assert re.search(r"untried .* \(\d+\.\d+%–\d+\.\d+%, extrapolated\)", d1)
