"""The log of a run: a line per step, each exactly once, whatever was killed when."""

from __future__ import annotations

import csv
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from ..errors import Rts2Error
from ..files import write_bytes

FIRST: Final = ("step", "epoch", "lr", "loss")
LAST: Final = ("images_per_s", "wait_share", "seconds")
"""The columns around those of the objective's terms. `seconds` is what the step took, and
`wait_share` the part of it that was spent waiting for the loader."""

Row = dict[str, float]


class Log:
    """An open log. Close it, or what was written last may be lost."""

    def __init__(self, path: Path, terms: Sequence[str], done: int) -> None:
        """Continues the log after `done` steps: what a run wrote after its checkpoint goes.

        Raises `Rts2Error` where the log lacks a step that the checkpoint has.
        """
        self.path = path
        self.columns = (*FIRST, *terms, *LAST)
        kept = _kept(path, done) if done else []
        write_bytes(path, "".join(f"{line}\n" for line in [",".join(self.columns), *kept]).encode())
        self.file = path.open("a", encoding="ascii", newline="")

    def write(self, row: Mapping[str, float]) -> None:
        """Adds a step's line."""
        self.file.write(",".join(_text(row[name]) for name in self.columns) + "\n")
        self.file.flush()

    def sync(self) -> None:
        """Returns once every line is on the disk."""
        self.file.flush()
        os.fsync(self.file.fileno())

    def close(self) -> None:
        self.file.close()


def read_log(path: Path) -> list[Row]:
    """The lines of a log, by column."""
    with path.open(encoding="ascii", newline="") as file:
        return [{k: float(v) for k, v in row.items()} for row in csv.DictReader(file)]


def _kept(path: Path, done: int) -> list[str]:
    """The lines of steps 1 … done."""
    lines = path.read_text("ascii", "replace").split("\n")[1:] if path.is_file() else []
    kept = lines[:done]
    numbers = [line.partition(",")[0] for line in kept]
    if numbers != [str(step) for step in range(1, done + 1)]:
        lost = next((s for s, n in enumerate(numbers, 1) if n != str(s)), len(numbers) + 1)
        raise Rts2Error(
            f"{path} must hold a line for each of the {done} steps of the checkpoint beside it; "
            f"that of step {lost} is not there; bring the file back, or start in another --out"
        )
    return kept


def _text(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.9g}"
