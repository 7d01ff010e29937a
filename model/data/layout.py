"""What official layouts have in common: folders that must be there, and files that go together."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Final

from ..errors import Rts2Error, UsageError
from ..files import existing_file
from .frame import Frame

SHOWN = 8
"""How many entries of a folder an error names."""


IMAGES: Final = (".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp")
"""What counts as an image in a folder of the user's."""


@dataclass(frozen=True)
class Column:
    """The files that fill one field of every frame, by the frames' names."""

    folder: Path
    pattern: str
    """What was looked for: the frame's name stands for the last star."""
    files: Mapping[str, Path]

    @property
    def tail(self) -> str:
        """What follows a frame's name in its file's name."""
        return self.pattern.rpartition("*")[2]


def images_of(folder: Path, suffixes: Sequence[str] = IMAGES) -> dict[str, Path]:
    """The files of a folder with one of these suffixes, by stem.

    Raises `UsageError` where two have one stem: it is what a pair's files have in common.
    """
    files: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in suffixes and path.is_file() and not path.name.startswith("."):
            if path.stem in files:
                raise UsageError(
                    f"names must differ before the suffix: {path} and {files[path.stem].name}"
                )
            files[path.stem] = path
    return files


def column(folder: Path, pattern: str) -> Column:
    """The files of a folder that fit the pattern, such as `*_10.png` or `*/*_disparity.png`."""
    tail = pattern.rpartition("*")[2]
    files = {path.name.removesuffix(tail): path for path in folder.glob(pattern)}
    return Column(folder, pattern, files)


def require_folder(folder: Path, title: str, holds: str) -> None:
    """Raises `UsageError` unless `folder` is one; `holds` says what a user looks for in it."""
    if not folder.is_dir():
        found = "it is a file" if folder.exists() else "there is no such folder"
        raise UsageError(f"{title} must be a folder that holds {holds}: {folder}: {found}")


def require_folders(root: Path, names: Sequence[str], title: str) -> None:
    """Raises `UsageError` unless `root` holds all these folders."""
    missing = [name for name in names if not (root / name).is_dir()]
    if missing:
        raise UsageError(
            f"{title} needs the folders {', '.join(names)} in {root}: "
            f"{', '.join(missing)} not there; found {entries(root)}"
        )


def entries(folder: Path) -> str:
    """What a folder holds, for an error."""
    names = sorted(path.name for path in folder.iterdir())
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(names[:SHOWN]) + more if names else "nothing"


def rows(columns: Mapping[str, Column], title: str) -> list[tuple[str, dict[str, Path]]]:
    """The files of each frame by field, in the order of the frames' names.

    Raises:
        UsageError: there is no file at all.
        Rts2Error: a frame lacks one of its files.
    """
    names = sorted(set().union(*(column.files for column in columns.values())))
    if not names:
        first = next(iter(columns.values()))
        raise UsageError(
            f"{title} needs images {first.pattern} in {first.folder}; none is there, "
            f"found {entries(first.folder)}"
        )
    for column in columns.values():
        _require_complete(column, names)
    fields = columns.items()
    return [(name, {field: each.files[name] for field, each in fields}) for name in names]


def read_names(path: Path) -> tuple[str, ...]:
    """The frames that a list file names, one a line; blank lines and those with # do not count."""
    try:
        text = existing_file(path, "a list of frames").read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise Rts2Error(
            f"a list of frames must be text, one name a line: {path}: {error}"
        ) from None
    lines = (line.strip() for line in text.splitlines())
    names = tuple(line for line in lines if line and not line.startswith("#"))
    if not names:
        raise UsageError(f"a list of frames must name one a line; {path} names none")
    return names


def chosen(
    frames: Sequence[Frame], names: Iterable[str], source: str, place: Path
) -> tuple[Frame, ...]:
    """The frames of these names, in their order; errors name the list's `source`, and the `place`.

    A frame of KITTI or Cityscapes may also be named by the file of its left image.
    """
    wanted = tuple(names)
    known = {_bare(frame.name): frame for frame in frames}
    known |= {frame.name: frame for frame in frames}
    lacking = [name for name in wanted if name not in known and _bare(name) not in known]
    if lacking:
        raise UsageError(
            f"every listed frame must be there: {source} lists {len(wanted)}, {len(lacking)} of "
            f"them are not among the {len(frames)} in {place}; first missing {lacking[0]}"
        )
    picked = tuple(known[name] if name in known else known[_bare(name)] for name in wanted)
    _require_once(picked, source)
    return picked


def _bare(name: str) -> str:
    """A frame's name without folders, suffix, and what layouts add to it."""
    path = PurePath(name)
    stem = path.stem if path.suffix.lower() in (".png", ".jpg", ".pfm") else path.name
    return stem.removesuffix("_10").removesuffix("_leftImg8bit")


def _require_once(frames: Sequence[Frame], source: str) -> None:
    seen: set[str] = set()
    for frame in frames:
        if frame.name in seen:
            raise UsageError(f"a list must name a frame once: {source} repeats {frame.name}")
        seen.add(frame.name)


def _require_complete(column: Column, names: Sequence[str]) -> None:
    """A folder must hold every frame; the first that it does not is named with both counts."""
    lacking = [name for name in names if name not in column.files]
    if lacking:
        raise Rts2Error(
            f"every frame needs its file in every folder: {column.folder} has "
            f"{len(column.files)} of {len(names)} files {column.pattern}, "
            f"first missing {lacking[0]}{column.tail}"
        )
