"""Streams through a session: what is filmed, written and summed up."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from rts2.model.cloud import Calibration
from rts2.model.data.images import read_disparity
from rts2.model.errors import UsageError
from rts2.model.pictures import coloured
from rts2.model.predictor import Estimate
from rts2.model.results import Results
from rts2.model.video import Stream
from rts2.model.watch import EASING, Watch

SIZE = (96, 64)


class Shown:
    """A stream of even images: the left one has the number of its pair for a shade."""

    name, size, fps = "shown", SIZE, 50.0

    def __init__(self, count: int, live: bool = False, interrupted: int | None = None) -> None:
        self.live = live
        self.count = None if live else count
        self._shades, self._interrupted = range(count), interrupted

    def pairs(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for shade in self._shades:
            if shade == self._interrupted:
                raise KeyboardInterrupt
            image = np.full((SIZE[1], SIZE[0], 3), shade, np.uint8)
            yield image, image


class Given:
    """A session whose disparities are the shades of the left image, in pixels."""

    def __init__(self, semantic: bool = True, stage: Callable[[int], int | None] = lambda _: 3):
        self.semantic, self.stage = semantic, stage
        self.calls: list[tuple[int, float | None]] = []

    def predict(
        self, left: np.ndarray, right: np.ndarray, budget_ms: float | None = None
    ) -> Estimate:
        shade = int(left[0, 0, 0])
        self.calls.append((shade, budget_ms))
        classes = np.full(left.shape[:2], 13, np.uint8) if self.semantic else None
        ramp = np.linspace(0, shade, left.shape[1], dtype=np.float32)
        disparity = np.tile(ramp, (left.shape[0], 1))
        return Estimate(disparity, classes, 0.02, self.stage(shade))


def watch(
    folder: Path,
    stream: Shown,
    session: Given,
    highest_px: float | None = None,
    **options: object,
) -> Watch:
    return Watch(stream, session, Results(folder, None, highest_px), **options)  # type: ignore[arg-type]


def film(path: Path) -> list[np.ndarray]:
    """A film's frames, beside each other."""
    return [np.concatenate(pair, axis=1) for pair in Stream([path]).pairs()]


def left_behind(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.rglob("*"))


def test_a_stream_becomes_two_films_and_a_summary(tmp_path: Path) -> None:
    session = Given(stage=lambda shade: 1 + shade % 2)
    found = watch(tmp_path / "out", Shown(5), session, budget_ms=40).run()
    assert left_behind(tmp_path / "out") == ["shown_color.mp4", "shown_overlay.mp4"]
    assert found.files == ["shown_color.mp4", "shown_overlay.mp4"]
    assert [len(film(tmp_path / "out" / name)) for name in found.files] == [5, 5]
    assert found.frames == 5
    assert dict(found.stages) == {1: 3, 2: 2}
    assert found.median_ms == pytest.approx(20)
    assert found.fps > 0
    assert found.rows == []
    assert session.calls == [(0, 40), *((shade, 40) for shade in range(5))], "one warm-up"


def test_without_classes_there_is_one_film(tmp_path: Path) -> None:
    found = watch(tmp_path, Shown(2), Given(semantic=False)).run()
    assert found.files == left_behind(tmp_path) == ["shown_color.mp4"]


def test_a_film_shows_disparity_in_colours_and_the_frame_rate_over_them(tmp_path: Path) -> None:
    watch(tmp_path, Shown(3), Given(), highest_px=8).run()
    frames = film(tmp_path / "shown_color.mp4")
    ramp = np.tile(np.linspace(0, 2, SIZE[0], dtype=np.float32), (SIZE[1], 1))
    below = slice(40, None)
    plain = coloured(ramp, 8)
    assert np.abs(frames[2][below].astype(int) - plain[below]).mean() < 8
    assert (frames[2][:20] > 240).all(-1).any(), "white letters"
    assert not (frames[0][:20] > 240).all(-1).any(), "of nothing before there is a rate"


def test_the_end_of_the_colours_follows_the_maps(tmp_path: Path) -> None:
    seen = watch(tmp_path, Shown(1), Given())
    ends = []
    for shade in (100, 100, 0, 0):
        ramp = np.full((64, 96), shade, np.float32)
        seen._pictures(np.zeros((64, 96, 3), np.uint8), Estimate(ramp, None, 0.0, 3))
        ends.append(seen._end_px)
    assert ends == [
        100,
        100,
        pytest.approx(100 * (1 - EASING)),
        pytest.approx(100 * (1 - EASING) ** 2),
    ]


def test_every_pair_can_have_its_files(tmp_path: Path) -> None:
    results = Results(tmp_path, Calibration(100, 0.5), None)
    found = Watch(Shown(3), Given(), results, every=True).run()  # type: ignore[arg-type]
    assert [row["name"] for row in found.rows] == [f"shown_{index:06}" for index in range(3)]
    kinds = ["cloud.ply", "color.png", "disparity.png", "overlay.png", "semantic.png"]
    assert sorted(found.rows[2]["files"]) == [f"shown_000002_{kind}" for kind in kinds]
    files = [name for row in found.rows for name in row["files"]]
    assert left_behind(tmp_path) == sorted([*files, *found.files])
    assert read_disparity(tmp_path / "shown_000002_disparity.png").max() == 2


def test_a_limit_ends_it(tmp_path: Path) -> None:
    found = watch(tmp_path, Shown(5), Given()).run(limit=2)
    assert found.frames == len(film(tmp_path / "shown_color.mp4")) == 2


def test_an_interrupt_ends_what_cameras_see(tmp_path: Path) -> None:
    found = watch(tmp_path, Shown(9, live=True, interrupted=4), Given()).run()
    assert found.frames == len(film(tmp_path / "shown_color.mp4")) == 4


def test_an_interrupt_leaves_nothing_of_a_video(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        watch(tmp_path, Shown(9, interrupted=4), Given()).run()
    assert left_behind(tmp_path) == []


def test_a_film_of_a_camera_runs_no_faster_than_its_pairs_come(tmp_path: Path) -> None:
    class Slow(Given):
        def predict(self, left: np.ndarray, *rest: object, **more: object) -> Estimate:
            from time import sleep

            sleep(0.1)
            return super().predict(left, left)

    for live in (True, False):
        watch(tmp_path, Shown(2, live=live), Slow()).run()
        fps = Stream([tmp_path / "shown_color.mp4"]).fps
        assert fps == 50 if not live else fps <= 10


def test_a_window_that_is_left_ends_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    views: list[tuple[str, bool]] = []

    class Left:
        def __init__(self, title: str, wanted: bool) -> None:
            views.append((title, wanted))

        def show(self, picture: np.ndarray) -> bool:
            return False

    monkeypatch.setattr("rts2.model.watch.Window", Left)
    found = watch(tmp_path, Shown(9, live=True), Given()).run()
    assert found.frames == len(film(tmp_path / "shown_color.mp4")) == 1
    assert views == [("shown", True)]
    watch(tmp_path, Shown(1), Given()).run()
    assert views[1:] == [("shown", False)], "videos are for the disk"


def test_what_is_refused_first_leaves_nothing(tmp_path: Path) -> None:
    class Tight(Given):
        def predict(self, *rest: object, **more: object) -> Estimate:
            raise UsageError("a budget must hold the first stage")

    with pytest.raises(UsageError):
        watch(tmp_path / "out", Shown(9), Tight()).run()
    assert not (tmp_path / "out").exists()
