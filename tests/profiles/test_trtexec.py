"""The flags of `trtexec`, by version."""

import pytest

from rts2.model.arch import Precision
from rts2.model.errors import UsageError
from rts2.profiles.trtexec import (
    GENERATIONS,
    build_flags,
    generation,
    keeps_layers,
    release,
    rest,
    stored,
)

SINCE_8_6 = "--memPoolSize=workspace:1024", "--builderOptimizationLevel=5"


@pytest.mark.parametrize(
    ("version", "expected"),
    [
        ("8.2.1", (8, 2)),
        ("8.2 to 8.6", (8, 2)),
        ("10.3.0", (10, 3)),
        ("TensorRT 8.4", (8, 4)),
        ("10", (10, 0)),
    ],
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
        ("8.6", "fp32", (*SINCE_8_6,)),
        ("10.3.0", "fp16", (*SINCE_8_6, "--fp16")),
        ("11.0", "fp32", (*SINCE_8_6,)),
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


@pytest.mark.parametrize(
    ("version", "expected"),
    [("8.2.1", "8.2"), ("8.4.3", "8.2"), ("8.6.1", "8.6"), ("9.0", "8.6"), ("10.16", "10")]
    + [(each, each) for each in GENERATIONS],
)
def test_a_version_belongs_to_the_newest_generation_before_it(version: str, expected: str) -> None:
    assert generation(version) == expected


def test_what_is_older_than_all_generations_is_refused() -> None:
    with pytest.raises(UsageError, match=r"8\.2 or newer, not 7\.1"):
        generation("7.1.3")


@pytest.mark.parametrize(
    ("version", "graphs", "beside", "single"),
    [
        ("8.2", ("fp32", "fp32", "int8"), "fp16", False),
        ("8.6", ("fp32", "fp32", "int8"), "fp16", True),
        ("10", ("fp32", "fp32", "int8"), "fp16", True),
        ("11", ("fp32", "fp16", "int8"), "fp32", False),
    ],
)
def test_what_flags_cannot_say_the_graph_must(
    version: str, graphs: tuple[Precision, ...], beside: Precision, single: bool
) -> None:
    assert tuple(stored(version, precision) for precision in PRECISIONS) == graphs
    assert (rest(version), keeps_layers(version)) == (beside, single)


PRECISIONS: tuple[Precision, ...] = "fp32", "fp16", "int8"


def test_pairs_of_qdq_are_built_as_such_until_the_graph_alone_decides() -> None:
    assert build_flags("8.2.1", "int8", "int8")[1:] == ("--int8", "--fp16")
    assert build_flags("10", "int8", "int8")[2:] == ("--int8", "--fp16")
    assert build_flags("11", "int8", "int8") == SINCE_8_6
    assert build_flags("11", "fp16", "fp16") == SINCE_8_6


def test_single_layers_stay_fp32_where_flags_can_say_so() -> None:
    kept = "head/Div", "warp/Sub"
    asked = "--precisionConstraints=prefer", "--layerPrecisions=head/Div:fp32,warp/Sub:fp32"
    for version in ("8.4", "8.6", "10"):
        assert build_flags(version, "fp16", kept=kept)[-2:] == asked
        assert build_flags(version, "fp32", kept=kept) == build_flags(version, "fp32")
    assert build_flags("8.2", "fp16", kept=kept) == build_flags("8.2", "fp16")
    assert build_flags("11", "fp16", "fp16", kept) == SINCE_8_6


@pytest.mark.parametrize("version", GENERATIONS)
def test_a_graph_in_other_types_than_the_version_asks_for_is_refused(version: str) -> None:
    with pytest.raises(UsageError, match="makes no int8 engine of a float graph"):
        build_flags(version, "int8")
    with pytest.raises(UsageError, match="makes no fp32 engine of an int8 graph"):
        build_flags(version, "fp32", "int8")
    with pytest.raises(UsageError, match="makes no bf16 engine"):
        build_flags(version, "bf16", "bf16")
