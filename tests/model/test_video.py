"""Videos and cameras as pairs, and videos that are written."""

import logging
from collections.abc import Callable, Iterator, Sequence
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rts2.model.errors import Rts2Error, UsageError
from rts2.model.video import RECENT, USUAL_FPS, Rate, Stream, Window, _opencv, film, is_video

cv2 = _opencv()  # silent before anything uses it


def frame(left: int, right: int | None = None, size: tuple[int, int] = (96, 64)) -> np.ndarray:
    """An even picture; with `right` two of them side by side."""
    shades = [left] if right is None else [left, right]
    halves = [np.full((size[1], size[0], 3), shade, np.uint8) for shade in shades]
    return np.concatenate(halves, axis=1)


def put(path: Path, frames: Sequence[np.ndarray], fps: float = 8, codec: str = "MJPG") -> Path:
    """A video of these pictures, RGB."""
    size = frames[0].shape[1::-1]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), fps, size)
    assert writer.isOpened()
    for picture in frames:
        writer.write(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    writer.release()
    return path


def shades(stream: Stream) -> list[tuple[int, int]]:
    """What the pairs of a stream show, in steps of 10: no codec keeps a shade as it was."""
    return [
        (round(left.mean() / 10) * 10, round(right.mean() / 10) * 10)
        for left, right in stream.pairs()
    ]


PAIRS = [(10, 200), (60, 150), (110, 20)]


class Camera:
    """What stands in for a camera; it shows `PAIRS` side by side, again and again."""

    opened: list["Camera"]

    def __init__(self, index: int, wide: bool = True, frames: int = 10**6) -> None:
        self.index, self.wide, self.left_over = index, wide, frames
        self.asked: dict[int, float] = {}
        self.taken = -1
        Camera.opened.append(self)

    def grab(self) -> bool:
        self.taken += 1
        self.left_over -= 1
        return self.left_over >= 0

    def retrieve(self) -> tuple[bool, np.ndarray]:
        left, right = PAIRS[self.taken % len(PAIRS)]
        return True, frame(left, right) if self.wide else frame((left, right)[self.index])

    def read(self) -> tuple[bool, np.ndarray | None]:
        return self.retrieve() if self.grab() else (False, None)

    def get(self, what: int) -> float:
        return {cv2.CAP_PROP_FPS: 30.0, cv2.CAP_PROP_FRAME_COUNT: -1.0}[what]

    def set(self, what: int, value: float) -> bool:
        self.asked[what] = value
        return True


@pytest.fixture
def cameras(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Puts cameras in the place of OpenCV's."""
    Camera.opened = []

    def stand_in(**options: Any) -> None:
        monkeypatch.setattr(cv2, "VideoCapture", lambda index: Camera(index, **options))

    return stand_in


@pytest.mark.parametrize(
    ("name", "wanted"), [("a.mp4", True), ("a.AVI", True), ("a.png", False), ("mp4", False)]
)
def test_videos_are_told_by_their_names(name: str, wanted: bool) -> None:
    assert is_video(Path(name)) == wanted


def test_one_video_holds_both_images_side_by_side(tmp_path: Path) -> None:
    stream = Stream([put(tmp_path / "both.avi", [frame(*pair) for pair in PAIRS])])
    assert (stream.name, stream.size, stream.fps, stream.count) == ("both", (96, 64), 8.0, 3)
    assert not stream.live
    assert shades(stream) == PAIRS


@pytest.mark.parametrize(("suffix", "codec"), [(".avi", "MJPG"), (".mp4", "mp4v")])
def test_two_videos_hold_one_image_each(tmp_path: Path, suffix: str, codec: str) -> None:
    left = put(tmp_path / f"l{suffix}", [frame(pair[0]) for pair in PAIRS], codec=codec)
    right = put(tmp_path / "r.avi", [frame(pair[1]) for pair in PAIRS])
    stream = Stream([left, right])
    assert (stream.name, stream.size) == ("l", (96, 64))
    assert shades(stream) == PAIRS


def test_colours_are_rgb(tmp_path: Path) -> None:
    red = np.zeros((64, 192, 3), np.uint8)
    red[..., 0] = 250
    ((left, right),) = Stream([put(tmp_path / "red.avi", [red])]).pairs()
    for image in (left, right):
        assert image.shape == (64, 96, 3)
        assert image[..., 0].mean() > 200
        assert image[..., 1:].mean() < 50


@pytest.mark.parametrize(("lengths", "ended"), [((3, 1), "r.avi"), ((1, 3), "l.avi")])
def test_what_has_no_partner_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, lengths: tuple[int, int], ended: str
) -> None:
    files = [
        put(tmp_path / name, [frame(9)] * length)
        for name, length in zip(("l.avi", "r.avi"), lengths, strict=True)
    ]
    assert len(list(Stream(files).pairs())) == 1
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert record.getMessage().startswith(f"{tmp_path / ended} ends before")


def test_videos_of_one_length_end_quietly(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    files = [put(tmp_path / name, [frame(9)] * 2) for name in ("l.avi", "r.avi")]
    assert len(list(Stream(files).pairs())) == 2
    assert caplog.records == []


def test_one_camera_gives_both_images(cameras: Callable[..., None]) -> None:
    cameras()
    stream = Stream([3], size=(192, 64))
    assert (stream.name, stream.size, stream.fps, stream.count) == ("camera3", (96, 64), 30, None)
    assert stream.live
    (camera,) = Camera.opened
    assert camera.asked[cv2.CAP_PROP_FRAME_WIDTH] == 192
    assert camera.asked[cv2.CAP_PROP_FRAME_HEIGHT] == 64
    assert camera.asked[cv2.CAP_PROP_BUFFERSIZE] == 1, "the newest frame, not those in between"
    pairs = stream.pairs()
    found = [tuple(int(image.mean()) for image in next(pairs)) for _ in range(4)]
    assert found == [*PAIRS, PAIRS[0]]


def test_two_cameras_are_a_pair(cameras: Callable[..., None]) -> None:
    cameras(wide=False, frames=3)
    assert shades(Stream([0, 1])) == PAIRS
    assert all(cv2.CAP_PROP_FRAME_WIDTH not in camera.asked for camera in Camera.opened)


def test_a_source_that_tells_no_frame_rate_has_the_usual_one(
    cameras: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    cameras()
    for told in (0.0, -1.0, float("nan"), 90_000.0):
        monkeypatch.setattr(Camera, "get", lambda self, what, told=told: told)
        assert Stream([0]).fps == USUAL_FPS


def refusals(folder: Path) -> dict[str, tuple[list[Path | int], type[Rts2Error], str]]:
    whole = put(folder / "whole.avi", [frame(9, 9)])
    other = put(folder / "other.avi", [frame(9, size=(96, 96))])
    tiny = put(folder / "tiny.avi", [frame(9, 9, size=(16, 64))])
    (folder / "text.avi").write_text("hello")
    (folder / "half.avi").write_bytes(whole.read_bytes()[:300])
    return {
        "missing": ([folder / "none.avi"], UsageError, "there is no such file"),
        "text": ([folder / "text.avi"], Rts2Error, "text.avi gives no frame"),
        "half": ([folder / "half.avi"], Rts2Error, "half.avi gives no frame"),
        "sizes": ([whole, other], UsageError, r"whole.avi is 192x64, .*other.avi is 96x96"),
        "tiny": ([tiny], UsageError, "32 pixels or more: .*tiny.avi is 16x64"),
        "camera": ([77], Rts2Error, "camera 77 gives no frame"),
    }


@pytest.mark.parametrize("fault", ["missing", "text", "half", "sizes", "tiny", "camera"])
def test_what_is_no_stream(tmp_path: Path, capfd: pytest.CaptureFixture[str], fault: str) -> None:
    sources, kind, words = refusals(tmp_path)[fault]
    capfd.readouterr()
    with pytest.raises(kind, match=words) as error:
        Stream(sources)
    assert type(error.value) is kind
    assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", ""), "OpenCV itself stays quiet"


def test_halves_of_an_odd_width_are_none(
    cameras: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    cameras()
    monkeypatch.setattr(Camera, "retrieve", lambda self: (True, frame(9, size=(97, 64))))
    with pytest.raises(UsageError, match="camera 0 is 97 pixels wide; give LEFT and RIGHT"):
        Stream([0])


def test_a_film_is_a_video_of_its_frames(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    with film(path, (192, 64), 12.0) as write:
        for pair in PAIRS:
            write(frame(*pair))
        assert not path.exists(), "it is there when it is whole"
    stream = Stream([path])
    assert (stream.fps, stream.count) == (12.0, 3)
    assert shades(stream) == PAIRS
    assert list(tmp_path.iterdir()) == [path]


def test_a_film_that_fails_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    path.write_bytes(b"mine")

    def fail() -> None:
        with film(path, (192, 64), 12.0) as write:
            write(frame(1, 2))
            raise Rts2Error("a fault")

    with pytest.raises(Rts2Error, match="a fault"):
        fail()
    assert path.read_bytes() == b"mine"
    assert list(tmp_path.iterdir()) == [path]


def test_an_opencv_that_writes_no_video_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cv2.VideoWriter, "isOpened", lambda self: False)
    with pytest.raises(Rts2Error, match="encodes no MPEG-4"), film(tmp_path / "a.mp4", (8, 8), 1):
        raise AssertionError("nothing can be written")
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, Any]]:
    """An OpenCV with windows, and a screen: what is shown, and the key that is pressed."""
    seen: dict[str, Any] = {"shown": [], "key": -1}
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(cv2, "namedWindow", lambda *_: None)
    monkeypatch.setattr(cv2, "imshow", lambda title, picture: seen["shown"].append(picture))
    monkeypatch.setattr(cv2, "waitKey", lambda _: seen["key"])
    return iter([seen])


def test_a_window_shows_bgr_until_somebody_leaves(windows: Iterator[dict[str, Any]]) -> None:
    seen = next(windows)
    window = Window("a view")
    red = np.zeros((4, 4, 3), np.uint8)
    red[..., 0] = 255
    assert window.open
    assert window.show(red)
    assert seen["shown"][0][0, 0].tolist() == [0, 0, 255]
    for key, wanted in ((ord("x"), True), (27, False), (ord("q"), False)):
        seen["key"] = key
        assert window.show(red) == wanted


def test_a_window_that_nobody_wants_is_not_opened(windows: Iterator[dict[str, Any]]) -> None:
    window = Window("a view", wanted=False)
    assert not window.open
    assert window.show(frame(1))
    assert next(windows)["shown"] == []


@pytest.mark.parametrize("lacking", ["screen", "windows"])
def test_without_windows_nothing_is_shown(
    windows: Iterator[dict[str, Any]], monkeypatch: pytest.MonkeyPatch, lacking: str
) -> None:
    def headless(*_: object) -> None:
        raise cv2.error("The function is not implemented")

    if lacking == "screen":
        monkeypatch.setattr("sys.platform", "linux")
        for name in ("DISPLAY", "WAYLAND_DISPLAY"):
            monkeypatch.delenv(name, raising=False)
    else:
        monkeypatch.setattr(cv2, "namedWindow", headless)
    window = Window("a view")
    assert not window.open
    assert window.show(frame(1))
    assert next(windows)["shown"] == []


def test_the_rate_is_that_of_the_last_frames() -> None:
    ticks = count(0, 0.5)
    rate = Rate(lambda: next(ticks))
    assert [rate.tick() for _ in range(3)] == [2.0, 2.0, 2.0]
    pause = iter([11.5, *(11.5 + 0.1 * index for index in range(1, RECENT + 1))])
    rate._clock = lambda: next(pause)
    found = [rate.tick() for _ in range(RECENT + 1)]
    assert found[0] == pytest.approx(4 / 11.5)
    assert found[-1] == pytest.approx(10.0), "the pause is forgotten"
