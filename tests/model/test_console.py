"""What every command shares: exit codes, one line for an error, options that parse or refuse."""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from rts2.model.console import (
    Parser,
    add_output,
    command,
    one_line,
    parser,
    positive,
    print_json,
    progress,
    resolution,
    screen,
    seed,
)
from rts2.model.errors import NothingFeasible, Rts2Error, UsageError


def ending_with(error: BaseException) -> int:
    """The exit code of a command that raises `error`."""

    @command
    def run(arguments: Sequence[str] | None = None) -> int:
        raise error

    return run([])


@pytest.mark.parametrize(
    ("error", "code"),
    [(Rts2Error, 1), (UsageError, 2), (NothingFeasible, 3)],
)
def test_errors_are_one_line_and_an_exit_code(
    error: type[Rts2Error],
    code: int,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "argv", ["/usr/bin/rts2-profile"])
    assert ending_with(error("the rule;\n  the value\n\n  the remedy")) == code
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err == "rts2-profile: the rule; the value the remedy\n"


def test_ctrl_c_ends_with_130(capsys: pytest.CaptureFixture[str]) -> None:
    assert ending_with(KeyboardInterrupt()) == 130
    assert capsys.readouterr().err.endswith("interrupted\n")


def test_a_file_that_cannot_be_read_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert ending_with(PermissionError(13, "Permission denied", "/data/left.png")) == 1
    told = capsys.readouterr().err
    assert told.endswith(": cannot read or write /data/left.png: Permission denied\n")


def test_a_full_stdout_is_told_as_such() -> None:
    script = (
        "from rts2.model.console import command\n"
        "@command\n"
        "def run(arguments=None):\n"
        "    print('x' * 100_000)\n"
        "    return 0\n"
        "raise SystemExit(run([]))\n"
    )
    with Path("/dev/full").open("wb") as full:
        ended = subprocess.run(
            [sys.executable, "-c", script], stdout=full, stderr=subprocess.PIPE, text=True
        )
    assert ended.returncode == 1
    assert ended.stderr.endswith("cannot write the result: No space left on device\n")
    assert ended.stderr.count("\n") == 1


def test_a_mistake_of_ours_is_not_hidden() -> None:
    with pytest.raises(ZeroDivisionError):
        ending_with(ZeroDivisionError())


def test_a_command_returns_what_its_body_returns() -> None:
    assert command(lambda arguments: len(arguments or ()))(["a", "b"]) == 2


PRINTS = {
    "one short line": "print_json({'schema': 'x'})",
    "many lines": "[print('x' * 100) for _ in range(10_000)]",
    "a table": "[screen().print('x' * 100) for _ in range(1_000)]",
    "the help": "parser('x', 'what', 'x --y').parse_args(['--help'])",
}


@pytest.mark.parametrize("what", PRINTS)
def test_a_reader_that_left_is_no_failure(what: str) -> None:
    """The pipe is closed before the first byte; nothing hides in a buffer until the exit."""
    script = (
        "import sys\n"
        "from rts2.model.console import command, parser, print_json, screen\n"
        "@command\n"
        "def run(arguments=None):\n"
        f"    {PRINTS[what]}\n"
        "    return 0\n"
        "sys.exit(run([]))\n"
    )
    closed, end = os.pipe()
    os.close(closed)
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    with os.fdopen(end, "wb") as pipe:
        ended = subprocess.run(
            [sys.executable, "-c", script],
            stdout=pipe,
            stderr=subprocess.PIPE,
            text=True,
            env=buffered,
            check=False,
        )
    assert (ended.returncode, ended.stderr) == (0, "")


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("1242x375", (1242, 375)),
        ("640X192", (640, 192)),
        ("32x32", (32, 32)),
        ("16384x16384", (16384, 16384)),
        ("0640x0192", (640, 192)),
    ],
)
def test_a_resolution_is_width_and_height(text: str, size: tuple[int, int]) -> None:
    assert resolution(text) == size


@pytest.mark.parametrize(
    "text",
    [
        *("", "x", "640", "640x", "x192", "640x192x3", "640 x 192", "-640x192", "640.0x192"),
        *("31x192", "640x31", "0x0", "16385x192", "1e3x192", "²x192", "٣٢x64", "640*192"),
    ],
)
def test_another_resolution_is_refused_with_the_rule(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="must be WxH") as error:
        resolution(text)
    assert repr(text) in str(error.value)


@pytest.mark.parametrize(
    ("text", "value"), [("10", 10.0), ("0.5", 0.5), ("1e-6", 1e-6), ("1e6", 1e6)]
)
def test_a_positive_number(text: str, value: float) -> None:
    assert positive(text) == value


@pytest.mark.parametrize(
    "text", ["", "0", "-0.0", "-1", "9e-7", "1000001", "nan", "inf", "1e999", "ten", "1,5"]
)
def test_another_number_is_refused_with_the_rule(text: str) -> None:
    with pytest.raises(
        argparse.ArgumentTypeError, match="from 1e-6 to 1e6, a finite number above 0"
    ) as error:
        positive(text)
    assert repr(text) in str(error.value)


@pytest.mark.parametrize(("text", "value"), [("0", 0), ("007", 7), ("4294967295", 2**32 - 1)])
def test_a_seed_has_32_bits(text: str, value: int) -> None:
    assert seed(text) == value


@pytest.mark.parametrize("text", ["", "-1", "1.0", "4294967296", "²", "9" * 30])
def test_another_seed_is_refused_with_the_rule(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="whole number") as error:
        seed(text)
    assert repr(text) in str(error.value)


def example() -> Parser:
    described = parser("rts2-example", "What it does.", "rts2-example --fps 10")
    described.add_argument("--fps", type=positive)
    described.add_argument("--size", type=resolution)
    add_output(described)
    return described


@pytest.mark.parametrize(
    "arguments",
    [["--fps", "0"], ["--size", "9" * 5000 + "x1"], ["--unknown"], ["--js"], ["--fps"]],
)
def test_a_wrong_option_is_wrong_use_and_points_to_the_help(arguments: list[str]) -> None:
    with pytest.raises(UsageError, match="see rts2-example --help") as error:
        example().parse_args(arguments)
    assert "\n" not in str(error.value)


def test_every_command_has_json_and_a_folder_unless_it_writes_nothing() -> None:
    assert vars(example().parse_args([])) == {
        "fps": None,
        "size": None,
        "json": False,
        "out": Path("rts2-out"),
    }
    silent = parser("x", "y", "z")
    add_output(silent, out=None)
    assert vars(silent.parse_args(["--json"])) == {"json": True}


def test_the_help_has_an_example() -> None:
    assert "rts2-example --fps 10" in example().format_help()


def test_json_is_one_object_and_has_no_nan(capsys: pytest.CaptureFixture[str]) -> None:
    print_json({"fps": 10.5, "nothing": None})
    printed = capsys.readouterr().out
    assert printed.count("\n") == 1
    assert json.loads(printed) == {"fps": 10.5, "nothing": None}
    with pytest.raises(ValueError, match="JSON"):
        print_json({"fps": float("nan")})


def test_progress_gives_every_item_and_is_quiet_where_stderr_is_no_terminal(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert list(progress(iter("abc"), "working", 3)) == ["a", "b", "c"]
    assert capsys.readouterr() == ("", "")


def test_tables_are_wide_enough_where_stdout_is_no_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "20")
    screen().print("word " * 20)
    assert capsys.readouterr().out.rstrip() == ("word " * 20).rstrip()


def test_one_line_has_no_line_breaks() -> None:
    assert one_line(ValueError("a\n\tb\r\nc  d")) == "a b c d"
