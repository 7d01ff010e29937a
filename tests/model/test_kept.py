"""Graphs of checkpoints: exported once, never mistaken for another's."""

import os
from pathlib import Path

import pytest

from rts2.model import kept
from rts2.model.arch import Arch
from rts2.model.checkpoint import build, save
from rts2.model.errors import Rts2Error
from rts2.model.graph import header_of

RESOLUTION = (90, 60)


@pytest.fixture
def checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A small network, and an empty folder for its graphs."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    save(build(Arch(c=1, stages=1)), tmp_path / "a.safetensors", "a test")
    return tmp_path / "a.safetensors"


@pytest.fixture
def exports(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Grows by one with every export."""
    done: list[Path] = []
    export = kept._export

    def counted(path: Path, resolution: tuple[int, int]) -> bytes:
        done.append(path)
        return export(path, resolution)

    monkeypatch.setattr(kept, "_export", counted)
    return done


def graphs() -> list[Path]:
    return sorted(kept.folder().glob("*"))


def test_it_is_exported_once(checkpoint: Path, exports: list[Path]) -> None:
    first, again = (kept.exported(checkpoint, RESOLUTION) for _ in range(2))
    assert first == again
    assert len(exports) == len(graphs()) == 1
    header = header_of(first, checkpoint)
    assert (header.resolution, header.origin) == (RESOLUTION, "a test")


def test_another_size_is_another_graph(checkpoint: Path, exports: list[Path]) -> None:
    for resolution in (RESOLUTION, (64, 64), RESOLUTION):
        found = header_of(kept.exported(checkpoint, resolution), checkpoint)
        assert found.resolution == resolution
    assert len(exports) == len(graphs()) == 2


def test_other_weights_are_another_graph(checkpoint: Path, exports: list[Path]) -> None:
    first = kept.exported(checkpoint, RESOLUTION)
    save(build(Arch(c=1, stages=1)), checkpoint, "a test")
    assert kept.exported(checkpoint, RESOLUTION) != first
    assert len(exports) == 2


def test_other_code_is_another_graph(
    checkpoint: Path, exports: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    kept.exported(checkpoint, RESOLUTION)
    source = checkpoint.with_name("code.py")
    for text in ("a", "b"):
        source.write_text(text)
        monkeypatch.setattr(kept, "_sources", lambda: [source])
        kept.exported(checkpoint, RESOLUTION)
    assert len(exports) == 3


def test_the_code_of_the_networks_and_their_forms_counts() -> None:
    names = {path.name for path in kept._sources()}
    assert {"rts2net.py", "anynet.py", "export.py", "matching.py"} <= names


@pytest.mark.parametrize("content", [b"", b"junk", b"\x08"])
def test_a_broken_file_is_replaced(checkpoint: Path, exports: list[Path], content: bytes) -> None:
    first = kept.exported(checkpoint, RESOLUTION)
    (path,) = graphs()
    path.write_bytes(content)
    assert kept.exported(checkpoint, RESOLUTION) == first
    assert path.read_bytes() != content
    assert len(exports) == 2


def test_without_a_place_it_is_exported_every_time(
    checkpoint: Path, exports: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    in_the_way = checkpoint.with_name("file")
    in_the_way.write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(in_the_way))
    first, again = (kept.exported(checkpoint, RESOLUTION) for _ in range(2))
    assert first == again
    assert len(exports) == 2


def test_what_was_not_used_for_the_longest_time_goes(
    checkpoint: Path, exports: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kept, "MOST", 2)
    kept.exported(checkpoint, (64, 64))
    (first,) = graphs()
    kept.exported(checkpoint, (64, 96))
    (second,) = set(graphs()) - {first}
    os.utime(first, (1, 1))
    os.utime(second, (2, 2))
    kept.exported(checkpoint, (64, 64))
    kept.exported(checkpoint, (96, 64))
    assert len(exports) == 3
    assert first in graphs()
    assert second not in graphs()


def test_a_broken_checkpoint_is_told(checkpoint: Path) -> None:
    checkpoint.write_bytes(b"junk")
    with pytest.raises(Rts2Error, match="truncated or no safetensors"):
        kept.exported(checkpoint, RESOLUTION)
    assert graphs() == []
