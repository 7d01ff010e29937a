"""What every command shares: the option types, the errors in one line, the exit codes."""

from __future__ import annotations

import argparse
import io
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
    """A parser whose help ends with an example."""
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
            _open_stdout()
            code = _ended(run, arguments)
            sys.stdout.flush()
        except Rts2Error as error:
            return _failed(error, error.exit_code)
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr)
            return 130
        except BrokenPipeError:
            _silence_stdout()
            return 0
        except OSError as error:
            reason = error.strerror or error
            if error.filename is not None:
                return _failed(f"cannot read or write {error.filename}: {reason}", 1)
            _silence_stdout()
            return _failed(f"cannot write the result: {reason}", 1)
        return code

    return guarded


def _ended(run: Callable[[Sequence[str] | None], int], arguments: Sequence[str] | None) -> int:
    """The exit code; argparse exits by itself once it has printed the help."""
    try:
        return run(arguments)
    except SystemExit as done:
        return int(done.code or 0)


def _open_stdout() -> None:
    """Makes stdout take any text: one that is closed is an error, one of few letters is not."""
    if sys.stdout is None:
        raise UsageError("stdout is closed; redirect it to a file or to /dev/null")
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")


def _silence_stdout() -> None:
    """What is still buffered goes nowhere, or the interpreter would complain at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _failed(error: BaseException | str, code: int) -> int:
    print(f"{Path(sys.argv[0]).name}: {one_line(error)}", file=sys.stderr)
    return code


def one_line(error: BaseException | str) -> str:
    """An error's text without line breaks."""
    return " ".join(str(error).split())


def print_json(value: Any) -> None:
    """One JSON object on stdout."""
    print(json.dumps(value, allow_nan=False))


def figure(value: float | None, digits: int) -> str:
    """A number of a table; a dash where nobody knows."""
    return "–" if value is None else f"{value:.{digits}f}"


def progress(
    items: Iterable[Item], title: str | Callable[[], str], total: int | None
) -> Iterator[Item]:
    """`items`, with a progress bar on stderr where stderr is a terminal.

    A title that can change is asked for after every item; without a `total` the bar only moves.
    """
    from rich.console import Console
    from rich.progress import Progress

    told = title if callable(title) else lambda: title
    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal) as bars:
        bar = bars.add_task(told(), total=total)
        for item in items:
            yield item
            bars.update(bar, advance=1, description=told())


def screen() -> Console:
    """Where tables go: stdout, wide enough for a table where it is no terminal.

    Text is text: a bracket in a file's name or a profile's title is no markup.
    """
    from rich.console import Console

    class Screen(Console):
        def on_broken_pipe(self) -> None:
            raise BrokenPipeError  # the reader has seen enough, which is no failure

    return Screen(highlight=False, markup=False, width=None if sys.stdout.isatty() else WIDTH)


def positive(text: str) -> float:
    """A number from a millionth to a million, as an option type."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 1e-6 <= value <= 1e6:
        rule = "must be from 1e-6 to 1e6, a finite number above 0"
        raise argparse.ArgumentTypeError(f"{rule}, not {text!r}")
    return value


def seed(text: str) -> int:
    """A whole number of 32 bits, as an option type."""
    if not (text.isascii() and text.isdigit() and int(text) < 2**32):
        raise argparse.ArgumentTypeError(f"must be a whole number from 0 to 2³²−1, not {text!r}")
    return int(text)


def whole_between(text: str, least: int, most: int) -> int:
    """A whole number, as an option type."""
    digits = text.isascii() and text.isdigit() and len(text) <= 20
    if not (digits and least <= int(text) <= most):
        raise argparse.ArgumentTypeError(
            f"must be a whole number from {least} to {most}, not {text!r}"
        )
    return int(text)


def resolution(text: str) -> tuple[int, int]:
    """`WxH` in pixels, as an option type."""
    parts = text.lower().split("x")
    digits = len(parts) == 2 and all(part.isascii() and part.isdigit() for part in parts)
    size = (int(parts[0]), int(parts[1])) if digits else (0, 0)
    if not all(32 <= side <= 16384 for side in size):
        rule = "must be WxH with sides of 32 to 16384 pixels, such as 1242x375"
        raise argparse.ArgumentTypeError(f"{rule}, not {text!r}")
    return size
