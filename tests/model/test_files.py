"""The door to the disk: whole or not at all, and nobody else's files are touched."""

import errno
import hashlib
import os
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import BaseModel, ConfigDict

from rts2.model.errors import Rts2Error, UsageError
from rts2.model.files import (
    existing_file,
    filling_folder,
    output_folder,
    read_json,
    remove,
    remove_empty,
    replacing,
    sha256,
    write_bytes,
    write_json,
)

MARKER = "deployment.json"


class Pair(BaseModel):
    model_config = ConfigDict(extra="forbid")

    left: int
    right: int


@pytest.fixture
def umask() -> Iterator[None]:
    """A mask that no default has: files 640, folders 750."""
    before = os.umask(0o027)
    yield
    os.umask(before)


def entries(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def told(error: pytest.ExceptionInfo[Rts2Error]) -> str:
    text = str(error.value)
    assert "\n" not in text
    return text


def broken_folder(path: Path) -> None:
    """Fails when the new folder is half written."""
    with filling_folder(path, MARKER) as folder:
        (folder / MARKER).write_text("half")
        raise RuntimeError("the work failed")


class Stopped(BaseException):
    """What is no `Exception`, such as Ctrl-C."""


@pytest.mark.parametrize("reason", [RuntimeError, OSError, KeyboardInterrupt, Stopped])
@pytest.mark.parametrize("before", [None, b"old"])
def test_a_failed_write_leaves_what_was_there_and_nothing_else(
    tmp_path: Path, reason: type[BaseException], before: bytes | None
) -> None:
    path = tmp_path / "file.json"
    if before is not None:
        path.write_bytes(before)

    def work() -> None:
        with replacing(path) as temporary:
            temporary.write_bytes(b"half")
            assert temporary.parent == tmp_path
            raise reason

    with pytest.raises((reason, Rts2Error)):
        work()
    assert entries(tmp_path) == ([] if before is None else ["file.json"])
    assert before is None or path.read_bytes() == before


def test_until_the_block_ends_readers_see_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "weights.safetensors"
    path.write_bytes(b"old")
    with replacing(path) as temporary:
        temporary.write_bytes(b"new")
        assert temporary.suffix == ".safetensors"
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    assert entries(tmp_path) == [path.name]


def test_a_process_that_dies_while_it_writes_leaves_the_old_file_whole(tmp_path: Path) -> None:
    path = tmp_path / "front.json"
    path.write_text("old")
    script = (
        "import os, sys, pathlib\n"
        "from rts2.model.files import replacing\n"
        "with replacing(pathlib.Path(sys.argv[1])) as temporary:\n"
        "    temporary.write_text('half')\n"
        "    os.kill(os.getpid(), 9)\n"
    )
    died = subprocess.run([sys.executable, "-c", script, str(path)], check=False)
    assert died.returncode == -9
    assert path.read_text() == "old"


@pytest.mark.usefixtures("umask")
def test_permissions_follow_the_umask_and_it_stays_as_it_was(tmp_path: Path) -> None:
    write_bytes(tmp_path / "file", b"x")
    with filling_folder(tmp_path / "folder", MARKER) as folder:
        write_bytes(folder / MARKER, b"x")
    assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == 0o640
    assert stat.S_IMODE((tmp_path / "folder").stat().st_mode) == 0o750
    assert stat.S_IMODE((tmp_path / "folder" / MARKER).stat().st_mode) == 0o640
    assert os.umask(0o027) == 0o027


def test_a_file_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "missing" / "x.json", tmp_path / "folder"):
        with pytest.raises(Rts2Error, match="choose another --out") as error:
            write_bytes(path, b"x")
        assert str(path) in told(error)
        assert error.value.exit_code == 1
    assert entries(tmp_path) == ["folder"]
    assert entries(tmp_path / "folder") == []


def test_json_is_utf8_with_a_last_line_break(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    write_json(path, {"left": 1, "right": 2})
    assert path.read_text(encoding="utf-8").endswith("}\n")
    assert read_json(path, Pair, "a pair") == Pair(left=1, right=2)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_json_has_no_nan_and_a_refusal_keeps_the_old_file(tmp_path: Path, value: float) -> None:
    path = tmp_path / "x.json"
    path.write_text("old")
    with pytest.raises(ValueError, match="JSON"):
        write_json(path, {"fps": value})
    assert path.read_text() == "old"
    assert entries(tmp_path) == ["x.json"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "JSON"),
        ("{", "JSON"),
        ("[1]", "the document"),
        ('{"left": 1}', "right"),
        ('{"left": 1, "right": "x\\ny"}', "right"),
        ('{"left": 1, "right": 2, "middle": 3}', "middle"),
        ('{"left": "a", "right": "b"}', "and 1 more fault"),
    ],
)
def test_what_does_not_fit_the_schema_is_named_in_one_line(
    tmp_path: Path, text: str, said: str
) -> None:
    path = tmp_path / "pair.json"
    path.write_text(text)
    with pytest.raises(Rts2Error, match=said) as error:
        read_json(path, Pair, "a pair")
    assert "a pair" in told(error)
    assert str(path) in told(error)
    assert error.value.exit_code == 1


def test_bytes_that_are_no_text_are_a_broken_file(tmp_path: Path) -> None:
    path = tmp_path / "pair.json"
    path.write_bytes(b"\xff\xfe{}")
    with pytest.raises(Rts2Error, match="cannot be read") as error:
        read_json(path, Pair, "a pair")
    assert error.value.exit_code == 1


def test_a_missing_file_and_a_folder_are_wrong_use(tmp_path: Path) -> None:
    for path, said in ((tmp_path / "x", "no such file"), (tmp_path, "it is a folder")):
        with pytest.raises(UsageError, match=said) as error:
            existing_file(path, "a pair")
        assert "a pair must be a file" in told(error)


def test_removing_is_done_once_or_not_needed(tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.touch()
    remove(path)
    remove(path)
    assert entries(tmp_path) == []
    with pytest.raises(Rts2Error, match="cannot write"):
        remove(tmp_path)


def test_an_output_folder_is_made_with_its_parents_and_stays_empty(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b"
    assert output_folder(path) == path
    assert output_folder(path) == path
    assert entries(path) == []
    (tmp_path / "file").touch()
    for wrong in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(Rts2Error, match="cannot write"):
            output_folder(wrong)


def test_a_hash_is_that_of_the_bytes(tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.write_bytes(b"abc")  # the example of FIPS 180-2
    assert sha256(path) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert sha256(path) == hashlib.sha256(b"abc").hexdigest()


@pytest.mark.parametrize("before", ["missing", "empty", "earlier"])
def test_a_folder_is_filled_with_what_the_block_leaves(tmp_path: Path, before: str) -> None:
    path = tmp_path / "deep" / "bundle" if before == "missing" else tmp_path / "bundle"
    if before != "missing":
        path.mkdir()
    if before == "earlier":
        for name in (MARKER, "model.onnx"):
            (path / name).write_text("old")
    with filling_folder(path, MARKER) as folder:
        assert entries(folder) == []
        for name in (MARKER, "model.onnx", "z"):
            (folder / name).write_text("new")
    assert entries(path) == [MARKER, "model.onnx", "z"]
    assert {file.read_text() for file in path.iterdir()} == {"new"}
    assert entries(path.parent) == ["bundle"]


def test_what_is_somebody_elses_stays(tmp_path: Path) -> None:
    path = tmp_path / "bundle"
    (path / "chapters").mkdir(parents=True)
    (path / "thesis.tex").write_text("mine")
    with filling_folder(path, MARKER) as folder:
        (folder / MARKER).write_text("new")
    assert entries(path) == ["chapters", MARKER, "thesis.tex"]
    assert (path / "thesis.tex").read_text() == "mine"


def test_folders_within_are_filled_file_by_file(tmp_path: Path) -> None:
    path = tmp_path / "bundle"
    (path / "triton").mkdir(parents=True)
    (path / "triton" / "mine").write_text("mine")
    for text in ("old", "new"):
        with filling_folder(path, MARKER) as folder:
            (folder / "triton" / "1").mkdir(parents=True)
            (folder / "triton" / "1" / "model.onnx").write_text(text)
            (folder / MARKER).write_text(text)
    assert entries(path) == [MARKER, "triton"]
    assert entries(path / "triton") == ["1", "mine"]
    assert (path / "triton" / "1" / "model.onnx").read_text() == "new"
    assert (path / "triton" / "mine").read_text() == "mine"


def test_folders_that_are_empty_go_and_others_stay(tmp_path: Path) -> None:
    deep = tmp_path / "a" / "b" / "c"
    deep.mkdir(parents=True)
    (tmp_path / "a" / "mine").touch()
    remove_empty(deep, tmp_path)
    assert entries(tmp_path) == ["a"]
    assert entries(tmp_path / "a") == ["mine"]
    remove_empty(deep, tmp_path)
    (tmp_path / "a" / "mine").unlink()
    remove_empty(tmp_path / "a", tmp_path)
    assert entries(tmp_path) == []


def filled(path: Path) -> None:
    with filling_folder(path, MARKER) as folder:
        for name in (MARKER, "model.onnx", "z"):
            (folder / name).write_text("new")


@pytest.mark.parametrize("kind", ["file", "below a file", "a folder of that name"])
def test_a_folder_that_cannot_be_filled_is_one_line(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "bundle"
    if kind == "a folder of that name":
        (path / MARKER).mkdir(parents=True)
        (path / MARKER / "mine").touch()
    else:
        path.write_text("mine")
    with pytest.raises(Rts2Error, match="cannot write") as error:
        filled(path / "deeper" if kind == "below a file" else path)
    assert "choose another --out" in told(error)
    assert entries(tmp_path) == ["bundle"]
    kept = entries(path / MARKER) == ["mine"] if path.is_dir() else path.read_text() == "mine"
    assert kept


@pytest.mark.parametrize("before", ["missing", "earlier"])
def test_a_failed_block_keeps_the_earlier_files_and_leaves_nothing_behind(
    tmp_path: Path, before: str
) -> None:
    path = tmp_path / "bundle"
    if before == "earlier":
        path.mkdir()
        (path / MARKER).write_text("old")
    with pytest.raises(RuntimeError, match="the work failed"):
        broken_folder(path)
    assert entries(tmp_path) in ([], ["bundle"])
    assert not path.exists() or entries(path) == ([] if before == "missing" else [MARKER])
    assert before == "missing" or (path / MARKER).read_text() == "old"


def test_the_last_file_comes_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk is full at the third file: the old marker still tells that the new is not there."""
    path = tmp_path / "bundle"
    path.mkdir()
    (path / MARKER).write_text("old")
    moved = Path.replace

    def fails_at_z(self: Path, target: Path) -> Path:
        if self.name == "z":
            raise OSError(errno.ENOSPC, "No space left on device")
        return moved(self, target)

    monkeypatch.setattr(Path, "replace", fails_at_z)
    with pytest.raises(Rts2Error, match="No space left on device"):
        filled(path)
    assert (path / MARKER).read_text() == "old"
    assert not [name for name in entries(path) if name.startswith(".")]


def test_the_folder_that_one_stands_in_is_filled_like_any_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine").touch()
    monkeypatch.chdir(tmp_path)
    filled(Path())
    assert entries(tmp_path) == [MARKER, "mine", "model.onnx", "z"]


def test_a_link_is_followed_and_a_pipe_is_refused(tmp_path: Path) -> None:
    (tmp_path / "far").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "far" / "file")
    write_bytes(tmp_path / "link", b"x")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "far" / "file").read_bytes() == b"x"
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(Rts2Error, match="cannot write"):
        write_bytes(tmp_path / "pipe", b"x")
    assert (tmp_path / "pipe").is_fifo()
    assert entries(tmp_path) == ["far", "link", "pipe"]
