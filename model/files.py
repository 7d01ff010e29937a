"""The door to the disk: whole writes, checked reads."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from shutil import rmtree
from tempfile import NamedTemporaryFile, mkdtemp
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from .errors import Rts2Error, UsageError

Schema = TypeVar("Schema", bound=BaseModel)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yields a temporary path beside `path`; it becomes `path` only if the block succeeds.

    The temporary keeps `path`'s suffix, because many writers choose their format by it. A link is
    followed; a device or a pipe is refused.
    """
    path = path.resolve()
    _refuse_special(path)
    try:
        with NamedTemporaryFile(
            dir=path.parent, prefix=f".{path.stem}.", suffix=path.suffix, delete=False
        ) as handle:
            temporary = Path(handle.name)
    except OSError as error:
        raise _unwritable(path, error) from error
    try:
        yield temporary
        with temporary.open("rb+") as written:
            os.fsync(written.fileno())
        temporary.chmod(0o666 & ~_umask())
        temporary.replace(path)
    except OSError as error:
        raise _unwritable(path, error) from error
    finally:
        temporary.unlink(missing_ok=True)


def write_bytes(path: Path, data: bytes) -> None:
    """Writes `data` to `path` whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def write_json(path: Path, value: Any) -> None:
    """Writes `value` as indented JSON; NaN is refused, as JSON has none."""
    write_bytes(path, (json.dumps(value, indent=2, allow_nan=False) + "\n").encode())


def remove(path: Path) -> None:
    """Removes the file at `path`, if there is one."""
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise _unwritable(path, error) from error


def remove_empty(folder: Path, within: Path) -> None:
    """Removes `folder` and those above it, below `within`, as far as nothing is left in them."""
    for each in (folder, *folder.parents):
        if each == within or not each.is_dir() or any(each.iterdir()):
            return
        each.rmdir()


def output_folder(path: Path) -> Path:
    """`path`, created where missing and known to be writable."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        with NamedTemporaryFile(dir=path, prefix=".writable."):
            return path
    except OSError as error:
        raise _unwritable(path, error) from error


def output_file(path: Path) -> Path:
    """`path`, known to be a place where a file can be written."""
    _refuse_special(path)
    output_folder(path.parent)
    return path


@contextmanager
def filling_folder(path: Path, last: str) -> Iterator[Path]:
    """Yields an empty folder; what the block leaves there moves into `path` if it succeeds.

    Folders within it move file by file. Other files stay, as they may be the user's; files of the
    same names are replaced where a file named `last` tells an earlier result. It comes last: while
    it is the old one, the folder is not yet the new one.
    """
    output_folder(path)
    try:
        temporary = Path(mkdtemp(dir=path, prefix=".new."))
    except OSError as error:
        raise _unwritable(path, error) from error
    try:
        yield temporary
        files = (each for each in temporary.rglob("*") if each.is_file())
        names = sorted(
            (file.relative_to(temporary) for file in files),
            key=lambda name: (str(name) == last, name),
        )
        for name in names:
            _refuse_special(path / name)
            if (path / name).exists() and not (path / last).exists():
                raise Rts2Error(f"{path / name} stands there already; choose another --out")
        for name in names:
            (path / name).parent.mkdir(parents=True, exist_ok=True)
            (temporary / name).replace(path / name)
    except OSError as error:
        raise _unwritable(path, error) from error
    finally:
        rmtree(temporary, ignore_errors=True)


def existing_file(path: Path, what: str) -> Path:
    """`path`, if it is a file; `what` names its role in the error."""
    if not path.is_file():
        found = "it is a folder" if path.is_dir() else "there is no such file"
        raise UsageError(f"{what} must be a file: {path}: {found}")
    return path


def read_json(path: Path, schema: type[Schema], what: str) -> Schema:
    """The JSON file at `path`, validated as `schema`. Errors name the first wrong field."""
    try:
        text = existing_file(path, what).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise Rts2Error(f"{what} cannot be read: {path}: {error}") from error
    return parse_json(text, schema, f"{what} {path}")


def parse_json(text: str, schema: type[Schema], what: str) -> Schema:
    """JSON text validated as `schema`; `what` names its origin in the error."""
    try:
        return schema.model_validate_json(text)
    except ValidationError as error:
        raise Rts2Error(f"{what}: {first_fault(error)}") from error


def first_fault(error: ValidationError) -> str:
    """One line for a validation error: the field, the rule, and what was given."""
    fault = error.errors(include_url=False)[0]
    field = ".".join(str(part) for part in fault["loc"]) or "the document"
    given = repr(fault["input"])
    given = given if len(given) <= 60 else given[:57] + "..."
    message = fault["msg"].removeprefix("Value error, ")
    more = error.error_count() - 1
    return f"{field}: {message} (given: {given})" + (f", and {more} more faults" if more else "")


def sha256(path: Path) -> str:
    """The SHA-256 of a file, in hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _refuse_special(path: Path) -> None:
    """A rename would put a file in the place of a device, a pipe or a folder."""
    if path.exists() and not path.is_file():
        raise Rts2Error(f"cannot write {path}: it is no regular file; choose another --out")


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _unwritable(path: Path, error: OSError) -> Rts2Error:
    return Rts2Error(f"cannot write {path}: {error.strerror or error}; choose another --out")
