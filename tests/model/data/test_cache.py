"""A cached scene is the scene, bit by bit; whatever is wrong with its file, it is made again."""

import errno
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from rts2.model import files
from rts2.model.data.cache import Cached, pack, unpack
from rts2.model.data.images import write_image
from rts2.model.data.scene import Foreground, Scene
from rts2.model.errors import Rts2Error

KEY = "0" * 32


def scene(name: str = "s", shape: tuple[int, int] = (5, 7), full: bool = True) -> Scene:
    rng = np.random.default_rng(0)
    left, right = (rng.integers(0, 256, (*shape, 3), np.uint8) for _ in range(2))
    truth = rng.normal(0, 50, shape).astype(np.float32)
    truth[0, 0] = np.nan
    if not full:
        return Scene(name, left, right, truth)
    return Scene(
        name,
        left,
        right,
        truth,
        foreground=rng.random(shape) > 0.5,
        semantic=rng.integers(0, 19, shape, np.uint8),
        visible=rng.random(shape) > 0.5,
        instances=rng.integers(0, 300, shape, np.int32),
    )


def same(found: Scene | None, wanted: Scene) -> bool:
    """Whether two scenes have the same fields, types and bits."""
    if found is None or found.name != wanted.name or {*found.arrays()} != {*wanted.arrays()}:
        return False
    pairs = ((array, found.arrays()[name]) for name, array in wanted.arrays().items())
    return all(
        a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes() for a, b in pairs
    )


@dataclass
class Made:
    """A sample that counts how often it is made."""

    name: str = "s"
    fingerprint: str | None = "1"
    reads: list[str] = field(default_factory=list)
    size: tuple[int, int] = (7, 5)
    foreground: Foreground | None = "instance"

    def read(self) -> Scene:
        self.reads.append(self.name)
        return scene(self.name)


@pytest.mark.parametrize("full", [True, False])
@pytest.mark.parametrize("most", [0, 255, 256, 65535, 65536, 2**31 - 1, -1])
def test_scene_returns_bit_by_bit(full: bool, most: int) -> None:
    kept = scene(full=full)
    if kept.instances is not None:
        kept.instances[1, 2] = most
    found = unpack(bytearray(pack(kept, KEY)), KEY)
    assert same(found, kept)
    assert found is not None
    for array in found.arrays().values():
        array[0, 0] = 1  # what a loader may do


def test_file_is_as_small_as_its_bits() -> None:
    size = 96 * 128
    kept = scene(shape=(96, 128))
    # Two images, float32 truth, labels, two masks of bits, numbers below 2^16.
    wanted = size * (3 + 3 + 4 + 1 + 2) + 2 * size // 8
    assert wanted <= len(pack(kept, KEY)) < wanted + 2048


def test_second_read_makes_nothing(tmp_path: Path) -> None:
    made = Made()
    cached = Cached([made], tmp_path / "new" / "cache")
    sample = cached[0]
    assert (sample.name, sample.size, sample.foreground) == ("s", (7, 5), "instance")
    assert same(sample.read(), scene())
    assert same(Cached([made], tmp_path / "new" / "cache")[0].read(), scene())
    assert made.reads == ["s"]


def test_it_is_a_sequence(tmp_path: Path) -> None:
    cached = Cached([Made("a"), Made("b"), Made("c")], tmp_path)
    assert len(cached) == 3
    assert cached[-1].name == "c"
    assert [sample.name for sample in cached[1:]] == ["b", "c"]
    assert [sample.name for sample in cached] == ["a", "b", "c"]
    with pytest.raises(IndexError):
        _ = cached[3]


def test_whatever_changes_is_made_again(tmp_path: Path) -> None:
    made = Made()
    Cached([made], tmp_path)[0].read()
    for other in (Made(fingerprint="2"), Made(name="t")):
        read = Cached([other], tmp_path)[0].read()
        assert read.name == other.name
        assert other.reads == [other.name]
    # The old scenes are still those of their samples.
    Cached([Made("x"), made], tmp_path)[1].read()
    assert made.reads == ["s"]


def test_data_set_as_a_whole_may_have_the_fingerprint(tmp_path: Path) -> None:
    class Whole(list):  # type: ignore[type-arg]
        fingerprint = "seed 1"

    samples = Whole([Made(fingerprint=None), Made(fingerprint=None)])
    for _ in range(2):
        for sample in Cached(samples, tmp_path):
            sample.read()
    # Two places of one data set are two scenes, whatever their names.
    assert [sample.reads for sample in samples] == [["s"], ["s"]]
    samples.fingerprint = "seed 2"
    Cached(samples, tmp_path)[0].read()
    assert samples[0].reads == ["s", "s"]


def test_without_fingerprint_nothing_is_cached(tmp_path: Path) -> None:
    with pytest.raises(Rts2Error, match="needs a fingerprint to be cached: s"):
        Cached([Made(fingerprint=None)], tmp_path)[0].read()


def broken(data: bytes) -> Iterator[bytes]:
    """Truncated files, foreign files, files that lie about their arrays."""
    yield from (data[:size] for size in (0, 5, 13, 16, 40, 200, len(data) // 2, len(data) - 64))
    yield b"\x89PNG" + data[4:]
    yield data.replace(b"rts2 scene 1", b"rts2 scene 2", 1)
    yield pack(scene("s"), "1" * 32)
    yield data.replace(b'"left"', b'"down"', 1)
    yield data.replace(b'"shape":[5,7]', b'"shape":[7,7]', 1)
    yield data.replace(b'"shape":[5,7]', b'"shape":[7,5]', 1)
    yield data.replace(b'"dtype":"bits"', b'"dtype":"<f4" ', 1)
    yield data.replace(b'"shape":[5,7]', b'"shape":[5,-7]', 1)
    yield data.replace(b'"dtype":"<f4"', b'"dtype":"<u2"', 1)
    yield data + bytes(64)
    yield data.replace(b'"left"', b'"le\xfft"', 1)


def test_broken_files_are_made_again(tmp_path: Path) -> None:
    made = Made()
    sample = Cached([made], tmp_path)[0]
    sample.read()
    data = sample.path.read_bytes()
    for number, bad in enumerate(broken(data), start=2):
        assert bad != data
        sample.path.write_bytes(bad)
        assert same(sample.read(), scene())
        assert len(made.reads) == number
        assert sample.path.read_bytes() == data


def test_folder_that_cannot_be_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(Rts2Error, match=r"the cache cannot be kept in .*name another folder"):
        Cached([Made()], tmp_path / "file")


def test_full_disk_is_one_line_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(Rts2Error, match="cannot keep s: No space left on device; free space in"):
        Cached([Made()], tmp_path)[0].read()
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_cache_that_went_away_is_made_again(tmp_path: Path) -> None:
    made = Made()
    sample = Cached([made], tmp_path)[0]
    sample.read()
    shutil.rmtree(tmp_path)
    assert same(sample.read(), scene())
    assert len(made.reads) == 2


READ_ALL = """
import sys
from pathlib import Path
from rts2.model.data.cache import Cached
from rts2.model.data.catalog import open_dataset

data, cache = map(Path, sys.argv[1:])
pairs = open_dataset("folder", data)
for cached, sample in zip(Cached(pairs, cache), pairs, strict=True):
    assert (cached.read().left == sample.read().left).all()
"""


def test_many_processes_share_a_folder(tmp_path: Path) -> None:
    for side in ("left", "right"):
        for i in range(20):
            (tmp_path / side).mkdir(exist_ok=True)
            write_image(tmp_path / side / f"{i}.png", np.full((64, 96, 3), i, np.uint8))
    run = [sys.executable, "-c", READ_ALL, str(tmp_path), str(tmp_path / "cache")]
    running = [subprocess.Popen(run) for _ in range(3)]
    assert [process.wait(60) for process in running] == [0, 0, 0]
    kept = [path for path in (tmp_path / "cache").rglob("*") if path.is_file()]
    # One file a sample, and none that a writer left behind.
    assert len(kept) == 20
    assert {path.suffix for path in kept} == {".scene"}
