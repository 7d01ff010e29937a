"""Videos and cameras as streams of stereo pairs, and videos that are written.

A stream is one source whose frames hold both images side by side, the left one at the left, or two
sources, one an image. What OpenCV says of a file goes nowhere: what is wrong is raised.
"""

from __future__ import annotations

import logging
import os
import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, Final

from .errors import Rts2Error, UsageError
from .files import existing_file, replacing
from .pairs import require_large_enough

if TYPE_CHECKING:
    from .data.images import Bytes

VIDEOS: Final = (".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".webm", ".wmv")
"""How the names of videos end."""

Source = Path | int
"""A video file, or the index of a camera."""

USUAL_FPS: Final = 25.0
"""What a source is taken to run at that does not tell."""

FASTEST_FPS: Final = 1000.0
"""Above this a source tells a time base, and no frame rate."""

RECENT: Final = 30
"""Frames whose rate is shown."""

QUIET: Final = {"OPENCV_FFMPEG_LOGLEVEL": "-8", "OPENCV_VIDEOIO_PRIORITY_CV_MJPEG": "0"}
"""FFmpeg says nothing, and what reads a broken .avi after it, and cannot be silenced, does not."""

LEAVING: Final = frozenset((27, ord("q")))
"""Keys that end a view: Escape and q."""


def is_video(path: Path) -> bool:
    """Whether a file is a video, by its name."""
    return path.suffix.lower() in VIDEOS


class Stream:
    """Stereo pairs one after the other, from one source or two. `size` is asked of a camera.

    Raises:
        UsageError: there is no such file, two sources differ in size, or two halves would.
        Rts2Error: OpenCV reads no frame from a source.
    """

    def __init__(self, sources: Sequence[Source], size: tuple[int, int] | None = None) -> None:
        self._reels = [_Reel(source, size) for source in sources]
        first = self._reels[0]
        self.live: bool = any(isinstance(source, int) for source in sources)
        self.name: str = first.name
        self.fps: float = first.fps
        """As the source says."""
        self.count: int | None = first.count
        """How many pairs there are, as far as the source says."""
        self.size: tuple[int, int] = self._halves() if len(sources) == 1 else self._common()
        """Width and height of one image."""
        require_large_enough(self.size, first.title)

    def pairs(self) -> Iterator[tuple[Bytes, Bytes]]:
        """Every pair, (H, W, 3) RGB each, until a source ends."""
        # Both cameras take their picture before either is decoded.
        while all(there := [reel.grab() for reel in self._reels]):
            frames = [reel.frame() for reel in self._reels]
            width = self.size[0]
            yield (frames[0][:, :width], frames[-1][:, -width:])
        if any(there):
            ended, other = sorted(self._reels, key=lambda reel: there[self._reels.index(reel)])
            note = "%s ends before %s: what is left of it has no partner"
            logging.getLogger(__name__).warning(note, ended.title, other.title)

    def _halves(self) -> tuple[int, int]:
        (width, height), title = self._reels[0].size, self._reels[0].title
        if width % 2:
            raise UsageError(
                f"one source must hold both images side by side, of equal width: {title} is "
                f"{width} pixels wide; give LEFT and RIGHT where each has its own"
            )
        return width // 2, height

    def _common(self) -> tuple[int, int]:
        one, other = self._reels
        if one.size != other.size:
            listed = ", ".join("{} is {}x{}".format(reel.title, *reel.size) for reel in self._reels)
            raise UsageError(f"a stereo pair must have one size: {listed}; give a rectified pair")
        return one.size


class _Reel:
    """One source of frames. The first is read at once: what it is, is what all will be."""

    def __init__(self, source: Source, size: tuple[int, int] | None) -> None:
        cv2 = _opencv()
        self._cv2 = cv2
        if isinstance(source, Path):
            self.name = source.stem
            self.title = str(existing_file(source, "a video"))
            self._video = cv2.VideoCapture(self.title)
        else:
            self.name, self.title = f"camera{source}", f"camera {source}"
            self._video = cv2.VideoCapture(source)
            self._ask(size)
        there, first = self._video.read()
        if not there:
            raise Rts2Error(
                f"{self.title} gives no frame that OpenCV reads; give a whole video, or the index "
                "of a camera that no other program holds"
            )
        self._first: Any = first
        self.size: tuple[int, int] = (first.shape[1], first.shape[0])
        told = self._video.get(cv2.CAP_PROP_FPS)
        self.fps: float = told if 0 < told < FASTEST_FPS else USUAL_FPS
        count = self._video.get(cv2.CAP_PROP_FRAME_COUNT)
        self.count: int | None = int(count) if count > 0 else None

    def grab(self) -> bool:
        """Goes on to the next frame; False behind the last."""
        return self._first is not None or self._video.grab()

    def frame(self) -> Bytes:
        """The frame at hand, (H, W, 3) RGB."""
        frame, self._first = self._first, None
        if frame is None:
            frame = self._video.retrieve()[1]
        rgb: Bytes = self._cv2.cvtColor(frame, self._cv2.COLOR_BGR2RGB)
        return rgb

    def _ask(self, size: tuple[int, int] | None) -> None:
        """A camera should give its newest frame, and the size that was asked for."""
        self._video.set(self._cv2.CAP_PROP_BUFFERSIZE, 1)
        if size is not None:
            self._video.set(self._cv2.CAP_PROP_FRAME_WIDTH, size[0])
            self._video.set(self._cv2.CAP_PROP_FRAME_HEIGHT, size[1])


@contextmanager
def film(path: Path, size: tuple[int, int], fps: float) -> Iterator[Callable[[Bytes], None]]:
    """Yields what writes one more frame, (H, W, 3) RGB, of a video at `path`, whole or not at all.

    The codec (MPEG-4, part 2) is in every build of OpenCV; of an odd height or width it leaves out
    the last line.
    """
    cv2 = _opencv()
    with replacing(path) as temporary:
        code = cv2.VideoWriter.fourcc(*"mp4v")
        writer = cv2.VideoWriter(str(temporary), code, fps, size)
        if not writer.isOpened():
            raise Rts2Error(f"cannot write {path}: this OpenCV encodes no MPEG-4 video")
        try:
            yield lambda frame: writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
        finally:
            writer.release()


class Window:
    """A view of what is seen, if one is wanted, this OpenCV has windows and there is a screen."""

    def __init__(self, title: str, wanted: bool = True) -> None:
        self._title = title
        self._cv2 = _opencv()
        self.open: bool = wanted and has_screen() and self._opened()

    def show(self, picture: Bytes) -> bool:
        """Shows a picture, (H, W, 3) RGB; False once the user wants to leave."""
        if not self.open:
            return True
        self._cv2.imshow(self._title, self._cv2.cvtColor(picture, self._cv2.COLOR_RGB2BGR))
        return self._cv2.waitKey(1) & 0xFF not in LEAVING

    def _opened(self) -> bool:
        try:
            self._cv2.namedWindow(self._title, self._cv2.WINDOW_NORMAL)
        except self._cv2.error:  # a build without windows
            return False
        return True


def has_screen() -> bool:
    """Whether windows have a place; OpenCV would end the process where they have none."""
    anywhere = sys.platform in ("darwin", "win32")
    return anywhere or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


class Rate:
    """Frames a second, over the last `RECENT` of them."""

    def __init__(self, clock: Callable[[], float] = perf_counter) -> None:
        self._clock = clock
        self._times: deque[float] = deque([clock()], maxlen=RECENT + 1)

    def tick(self) -> float:
        """One more frame is done; what the rate is now."""
        self._times.append(self._clock())
        return (len(self._times) - 1) / max(self._times[-1] - self._times[0], 1e-9)


@cache
def _opencv() -> Any:
    """OpenCV, silent: it asks the environment when it is first used."""
    for name, value in QUIET.items():
        os.environ.setdefault(name, value)
    import cv2

    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    return cv2
