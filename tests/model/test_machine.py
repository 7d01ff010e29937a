"""What the machine says of itself."""

import ctypes
import os
import platform
from typing import Any

import pytest

from rts2.model.machine import cores, features, processor, release_memory


def test_cores_are_those_that_the_process_may_use(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _process: {3, 5, 8}, raising=False)
    assert cores() == 3
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: 7)
    assert cores() == 7
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert cores() == 1


TOLD = {
    "all": (
        "cpu family\t: 6\nmodel\t\t: 85\nmodel name\t: A CPU\nmodel name\t: B\n",
        "A CPU, family 6, model 85",
    ),
    "the name alone": ("model name : A CPU\n", "A CPU"),
    "nothing": ("processor : 0\n", "what the system says"),
}


@pytest.mark.parametrize("what", TOLD)
def test_a_processor_is_named(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    text, name = TOLD[what]
    monkeypatch.setattr("pathlib.Path.exists", lambda _path: True)
    monkeypatch.setattr("pathlib.Path.read_text", lambda _path, encoding: text)
    monkeypatch.setattr(platform, "processor", lambda: "what the system says")
    assert processor() == name


@pytest.mark.parametrize(
    ("text", "known"),
    [
        ("model name : A\nflags\t\t: fpu avx512_bf16\nflags : other\n", {"fpu", "avx512_bf16"}),
        ("Features : fp asimdhp\n", {"fp", "asimdhp"}),
        ("processor : 0\n", set()),
    ],
)
def test_features_are_those_that_the_system_tells(
    monkeypatch: pytest.MonkeyPatch, text: str, known: set[str]
) -> None:
    monkeypatch.setattr("pathlib.Path.exists", lambda _path: True)
    monkeypatch.setattr("pathlib.Path.read_text", lambda _path, encoding: text)
    assert features() == known
    monkeypatch.setattr("pathlib.Path.exists", lambda _path: False)
    assert features() == set()


def test_memory_is_given_back_where_the_c_library_can(monkeypatch: pytest.MonkeyPatch) -> None:
    """And nothing happens where it cannot: musl has no `malloc_trim`, macOS no glibc."""
    asked: list[int] = []

    class Library:
        def malloc_trim(self, pad: Any) -> None:
            asked.append(pad.value)

    for system, library, count in (
        ("Linux", Library(), 1),
        ("Linux", object(), 0),
        ("Darwin", Library(), 0),
    ):
        asked.clear()
        monkeypatch.setattr(platform, "system", lambda system=system: system)
        monkeypatch.setattr(ctypes, "CDLL", lambda name, library=library: library)
        release_memory()
        assert asked == [0] * count
    monkeypatch.undo()
    release_memory()
