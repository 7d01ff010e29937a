"""What every command shares: the option types, the errors in one line, the exit codes."""

from __future__ import annotations

import argparse
import json
import logging
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from .errors import Rts2Error, UsageError

if TYPE_CHECKING:
    from rich.console import Console

Command = Callable[[Sequence[str] | None], int]
Item = TypeVar("Item")

WIDTH = 120
"""Columns of what is piped or redirected."""

KITTI = (1242, 375)
"""Width and height of KITTI's images, the paper's resolution."""


class Parser(argparse.ArgumentParser):
    """argparse whose complaints are one line, like every other error of rts2."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message} (see {self.prog} --help)")


def parser(prog: str, description: str, example: str) -> Parser:
    """A parser with the options that every command has."""
    return Parser(
        prog=prog,
        description=description,
        epilog=f"example:\n  {example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )


def add_output(command: argparse.ArgumentParser, out: str | None = "rts2-out") -> None:
    """Adds `--json`, and `--out` unless the command writes nothing."""
    command.add_argument("--json", action="store_true", help="one JSON object on stdout, no table")
    if out is not None:
        text = f"folder for the results (default: {out})"
        command.add_argument("--out", type=Path, default=Path(out), metavar="DIR", help=text)


def command(run: Callable[[Sequence[str] | None], int]) -> Command:
    """Turns what `run` raises into one line on stderr and an exit code."""

    def guarded(arguments: Sequence[str] | None = None) -> int:
        logging.basicConfig(stream=sys.stderr, level=logging.WARNING, format="%(message)s")
        try:
            return run(arguments)
        except Rts2Error as error:
            print(f"{Path(sys.argv[0]).name}: {one_line(error)}", file=sys.stderr)
            return error.exit_code
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr)
            return 130
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0

    return guarded


def one_line(error: BaseException) -> str:
    """An error's text without line breaks."""
    return " ".join(str(error).split())


def print_json(value: Any) -> None:
    """One JSON object on stdout."""
    print(json.dumps(value, allow_nan=False))


def progress(items: Iterable[Item], title: str, total: int) -> Iterator[Item]:
    """`items`, with a progress bar on stderr where stderr is a terminal."""
    from rich.console import Console
    from rich.progress import track

    console = Console(stderr=True)
    disabled = not console.is_terminal
    return iter(track(items, title, total=total, console=console, disable=disabled))


def screen() -> Console:
    """Where tables go: stdout, wide enough for a table where it is no terminal."""
    from rich.console import Console

    class Screen(Console):
        def on_broken_pipe(self) -> None:
            raise BrokenPipeError  # the reader has seen enough, which is no failure

    return Screen(highlight=False, width=None if sys.stdout.isatty() else WIDTH)


def positive(text: str) -> float:
    """A finite number above zero, as an option type."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be a finite number above 0, not {text!r}")
    return value


def resolution(text: str) -> tuple[int, int]:
    """`WxH` in pixels, as an option type."""
    parts = text.lower().split("x")
    digits = len(parts) == 2 and all(part.isascii() and part.isdigit() for part in parts)
    size = (int(parts[0]), int(parts[1])) if digits else (0, 0)
    if not all(32 <= side <= 16384 for side in size):
        rule = "must be WxH with sides of 32 to 16384 pixels, such as 1242x375"
        raise argparse.ArgumentTypeError(f"{rule}, not {text!r}")
    return size
