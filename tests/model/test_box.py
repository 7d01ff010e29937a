"""A name means the network in the box, wherever the command runs; a path means itself."""

from pathlib import Path

import pytest

from rts2.model.arch import Arch
from rts2.model.box import DEFAULT, SHIPPED, holding, in_box, judged, named_model, names
from rts2.model.checkpoint import build, save
from rts2.model.errors import Rts2Error, UsageError


@pytest.fixture
def box(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A box of two networks, and an empty folder to work in."""
    folder = tmp_path / "weights"
    folder.mkdir()
    for name in ("c1.safetensors", "c8.safetensors", "c8.json"):
        (folder / name).touch()
    monkeypatch.setattr("rts2.model.box._folder", lambda: folder)
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    return folder


def test_a_name_is_the_network_in_the_box(box: Path) -> None:
    assert named_model("c8") == box / "c8.safetensors"
    assert names() == ("c1", "c8")


def test_the_box_comes_before_a_file_of_its_name(box: Path) -> None:
    Path("c8").touch()
    assert named_model("c8") == box / "c8.safetensors"
    assert named_model("./c8") == Path("c8")


@pytest.mark.parametrize("text", ["model.onnx", "sub/c8", "/c8", "c8.safetensors", ".", ".."])
def test_a_path_is_itself(box: Path, text: str) -> None:
    assert named_model(text) == Path(text)


def test_a_word_may_be_a_file(box: Path) -> None:
    Path("mine").touch()
    assert named_model("mine") == Path("mine")


def test_an_unknown_word_lists_the_box(box: Path) -> None:
    with pytest.raises(UsageError, match="c9 is neither; the box holds c1, c8"):
        named_model("c9")


def test_a_box_that_is_not_there(box: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rts2.model.box._folder", lambda: box / "none")
    with pytest.raises(UsageError, match="the box of this version is empty, give a file"):
        named_model(DEFAULT)


def test_an_arch_is_found_in_the_network_that_holds_it(box: Path) -> None:
    for c in (1, 8):
        save(build(Arch(c=c)), box / f"c{c}.safetensors", "trained on nothing")
    assert holding(Arch(c=8, stages=2)) == box / "c8.safetensors"
    assert holding(Arch(c=1, semantic=False)) == box / "c1.safetensors"
    assert holding(Arch(c=2)) is None


def test_the_record_of_a_broken_box_is_one_line(box: Path) -> None:
    save(build(Arch(c=8)), box / "c8.safetensors", "trained on nothing")
    with pytest.raises(Rts2Error, match=r"the record of a network in the box .*c8\.json: "):
        judged(box / "c8.safetensors", Arch(c=8))


@pytest.mark.parametrize("name", SHIPPED)
def test_what_is_shipped_was_judged_after_every_stage(name: str) -> None:
    path = named_model(name)
    assert in_box(path)
    whole = Arch(c=int(name[1:]))
    found = [judged(path, whole.up_to(stages)) for stages in (1, 2, 3)]
    assert [each and each[0].stage for each in found] == [1, 2, 3]
    assert judged(path, Arch(c=whole.c, refinement=False)) is None


def test_the_default_is_shipped() -> None:
    assert DEFAULT in SHIPPED
