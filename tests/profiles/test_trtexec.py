"""The flags of `trtexec`, by version."""

import pytest

from rts2.model.arch import Precision
from rts2.model.errors import UsageError
from rts2.profiles.trtexec import build_flags, release


@pytest.mark.parametrize(
    ("version", "expected"),
    [("8.2.1", (8, 2)), ("8.2 to 8.6", (8, 2)), ("10.3.0", (10, 3)), ("TensorRT 8.4", (8, 4))],
)
def test_the_first_release_counts(version: str, expected: tuple[int, int]) -> None:
    assert release(version) == expected


@pytest.mark.parametrize(
    ("version", "precision", "expected"),
    [
        ("8.2.1", "fp32", ("--workspace=1024",)),
        ("8.2.1", "fp16", ("--workspace=1024", "--fp16")),
        ("8.2 to 8.6", "fp16", ("--workspace=1024", "--fp16")),
        ("8.4.0", "fp32", ("--memPoolSize=workspace:1024",)),
        ("10.3.0", "fp16", ("--memPoolSize=workspace:1024", "--fp16")),
        ("11.0", "fp32", ("--memPoolSize=workspace:1024",)),
    ],
)
def test_flags_move_with_the_version(
    version: str, precision: Precision, expected: tuple[str, ...]
) -> None:
    assert build_flags(version, precision) == expected


@pytest.mark.parametrize(
    ("version", "precision", "said"),
    [
        ("8.2.1", "int8", "8.2 makes no int8 engine of a float graph"),
        ("11.0", "fp16", "11.0 makes no fp16 engine of a float graph"),
        ("as in the paper", "fp32", "not 'as in the paper'"),
    ],
)
def test_what_it_does_not_do_is_refused(version: str, precision: Precision, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        build_flags(version, precision)
