"""The house: search → quant → profiles → model, one way only, and every room has a name."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ROOMS = ("model", "profiles", "quant", "search")
"""From the ground up: a room imports from itself and from those before it."""

SOURCES = sorted(path for room in ROOMS for path in (ROOT / room).rglob("*.py"))
NAMELESS = {"utils", "util", "common", "helpers", "helper", "misc"}


def imported(path: Path, text: str) -> Iterator[str]:
    """The modules that a source imports anywhere in it, by their full names under `rts2`."""
    package = ("rts2", *path.relative_to(ROOT).parent.parts)
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = node.module.split(".") if node.module else []
            base = package[: len(package) - node.level + 1] if node.level else ()
            names = [[]] if module else [[alias.name] for alias in node.names]
            yield from (".".join((*base, *module, *name)) for name in names)


def faults(path: Path, text: str) -> list[str]:
    """What a source imports against the rules."""
    own = ROOMS.index(path.relative_to(ROOT).parts[0])
    found = []
    for name in imported(path, text):
        head, *rest = name.split(".")
        if head == "rts2" and rest and rest[0] in ROOMS and ROOMS.index(rest[0]) <= own:
            continue
        if head == "rts2" or head in ROOMS:
            found.append(name)
    return found


def absolute(text: str) -> list[str]:
    """Imports of rts2, or of a bare room, that are not relative."""
    found = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and not node.level:
            names = [node.module or ""]
        else:
            continue
        found += [name for name in names if name.split(".")[0] in ("rts2", *ROOMS)]
    return found


def told(path: Path) -> str:
    return str(path.relative_to(ROOT))


def test_imports_run_one_way() -> None:
    found = {told(path): faults(path, path.read_text("utf-8")) for path in SOURCES}
    assert {path: names for path, names in found.items() if names} == {}


def test_imports_inside_the_house_are_relative() -> None:
    found = {told(path): absolute(path.read_text("utf-8")) for path in SOURCES}
    assert {path: names for path, names in found.items() if names} == {}


def test_every_module_has_a_name_of_its_own() -> None:
    nameless = [path for path in SOURCES if NAMELESS & {path.stem, *Path(told(path)).parts[:-1]}]
    assert nameless == []


def test_every_room_is_read() -> None:
    assert {path.relative_to(ROOT).parts[0] for path in SOURCES} == set(ROOMS)
    reached = {name for path in SOURCES for name in imported(path, path.read_text("utf-8"))}
    assert {"rts2.model.arch", "rts2.profiles.profile", "rts2.search.result"} <= reached


@pytest.mark.parametrize(
    ("place", "line", "reached"),
    [
        ("profiles/cli.py", "from ..search.front import pick", "rts2.search.front"),
        ("profiles/cli.py", "from .. import quant", "rts2.quant"),
        ("model/data/kitti.py", "from ...profiles import profile", "rts2.profiles"),
        (
            "model/ops.py",
            "def f():\n    from ..profiles.latency import Steps",
            "rts2.profiles.latency",
        ),
        ("quant/ptq.py", "import rts2.search", "rts2.search"),
        ("quant/ptq.py", "import search.front", "search.front"),
        ("search/cli.py", "from model.arch import Arch", "model.arch"),
    ],
)
def test_what_is_forbidden_is_seen(place: str, line: str, reached: str) -> None:
    assert list(imported(ROOT / place, line)) == [reached]
    assert faults(ROOT / place, line) == [reached]
    assert bool(absolute(line)) == line.startswith(("import", "from model"))


@pytest.mark.parametrize(
    ("place", "line"),
    [
        ("search/deploy/bundle.py", "from ...model.arch import Arch"),
        ("search/cli.py", "from .result import Found"),
        ("quant/ptq.py", "from ..profiles.profile import load"),
        ("model/cli.py", "import numpy\nfrom onnx import helper"),
    ],
)
def test_what_is_allowed_is_left_alone(place: str, line: str) -> None:
    assert faults(ROOT / place, line) == []
    assert absolute(line) == []
