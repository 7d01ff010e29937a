"""Steps of a made-up runtime, traced back to a file's nodes by hand."""

import pytest
from onnx import TensorProto, helper

from rts2.profiles.runtimes.attribution import (
    Kernel,
    Node,
    Origin,
    Step,
    Tracer,
    distinctly_named,
    kernels,
    node_times_ms,
    nodes_of,
)


def node(name: str, kind: str, inputs: str, outputs: str) -> Node:
    return Node(name, kind, tuple(inputs.split()), tuple(outputs.split()))


def step(name: str, inputs: str, outputs: str, told: str = "", moves: bool = False) -> Step:
    return Step(node(name, "?", inputs, outputs), tuple(told.split()), moves)


FILE = [
    node("a/Conv", "Conv", "x w", "a"),
    node("a/Relu", "Relu", "a", "b"),
    node("c/Slice", "Slice", "b", "c"),
    node("d/ArgMax", "ArgMax", "c", "d"),
    node("e/Cast", "Cast", "d", "y"),
]
"""x → Conv → Relu → Slice → ArgMax → Cast → y."""


def traced(*steps: Step) -> dict[str, tuple[str, str]]:
    return {
        name: (found.node, found.how) for name, found in Tracer(FILE, list(steps)).origins().items()
    }


def test_a_step_is_the_node_that_it_is_named_after() -> None:
    found = traced(step("a/Conv", "x", "a", "a/Conv"), step("relu", "a", "b", "b"))
    assert found == {"a/Conv": ("a/Conv", "named"), "relu": ("a/Relu", "named")}


def test_a_suffix_behind_a_slash_is_the_runtimes_own() -> None:
    assert traced(step("1", "x", "1", "a/Conv/WithoutBiases"))["1"] == ("a/Conv", "named")


def test_an_unnamed_step_is_known_by_the_value_that_it_gives() -> None:
    found = traced(step("1", "x", "b"), step("2", "b", "c"))
    assert found == {"1": ("a/Conv", "fused"), "2": ("c/Slice", "named")}


def test_a_convolution_takes_the_time_of_what_is_fused_with_it() -> None:
    assert traced(step("1", "x", "1", "a/Conv a/Relu"))["1"] == ("a/Conv", "named")
    assert traced(step("1", "x", "1", "a/Relu"))["1"] == ("a/Conv", "fused")


def test_what_lies_between_two_named_steps_is_the_unnamed_one_there() -> None:
    """A runtime's TopK in the place of the ArgMax, and no name of it anywhere."""
    found = traced(
        step("conv", "x", "1", "a/Conv a/Relu"),
        step("slice", "1", "2", "c/Slice"),
        step("TopK", "2", "3"),
        step("cast", "3", "4", "e/Cast"),
        step("result", "4", "", "y"),
    )
    assert found["TopK"] == ("d/ArgMax", "traced")
    assert found["cast"] == found["result"] == ("e/Cast", "named")


def test_an_inserted_step_belongs_to_the_one_that_wanted_it() -> None:
    found = traced(
        step("conv", "x", "1", "a/Conv a/Relu"),
        step("reorder", "1", "b", moves=True),
        step("slice", "b", "c", "c/Slice"),
    )
    assert found["reorder"] == ("c/Slice", "inserted")


def test_an_inserted_step_that_several_take_from_belongs_to_its_producer() -> None:
    nodes = [*FILE[:2], node("s/Sin", "Sin", "b", "s"), node("t/Tan", "Tan", "b", "t")]
    steps = [
        step("conv", "x", "1", "a/Conv a/Relu"),
        step("reorder", "1", "2", moves=True),
        step("again", "2", "b", moves=True),
        step("sin", "b", "s", "s/Sin"),
        step("tan", "b", "t", "t/Tan"),
        step("out", "t", "z", moves=True),
    ]
    found = Tracer(nodes, steps).origins()
    assert found["reorder"] == found["again"] == Origin("a/Conv", "inserted")
    assert found["out"] == Origin("t/Tan", "inserted")


def test_the_fastest_times_add_up_whatever_ran() -> None:
    """Three runs of four steps, one of which is in no graph: it counts for what ran next."""
    steps = [
        step("conv", "x", "1", "a/Conv a/Relu"),
        step("reorder", "1", "2", moves=True),
        step("slice", "2", "c", "c/Slice"),
    ]
    runs = [
        {"conv": 1.0, "copy": 0.25, "reorder": 0.5, "slice": 2.0},
        {"conv": 9.0, "copy": 0.25, "reorder": 0.5, "slice": 2.0},
        {"conv": 4.0, "copy": 0.25, "slice": 2.0},
    ]
    found = kernels(runs, FILE, steps)
    assert [(k.name, k.origin.node, k.ms) for k in found] == [
        ("conv", "a/Conv", 1.0),
        ("copy", "c/Slice", 0.25),
        ("reorder", "c/Slice", 0.5),
        ("slice", "c/Slice", 2.0),
    ]
    assert node_times_ms(found) == {"a/Conv": 1.0, "c/Slice": 2.75}


def test_what_runs_behind_everything_is_not_lost() -> None:
    assert node_times_ms(kernels([{"conv": 1.0, "end": 2.0}], FILE, [])) == {"e/Cast": 3.0}
    assert node_times_ms([Kernel("k", Origin("n", "named"), 1.5)] * 2) == {"n": 3.0}


@pytest.mark.parametrize(
    ("names", "expected"),
    [(("a", "b"), ("a", "b")), (("", "a"), ("u", "a")), (("a", "a"), ("a", "v"))],
)
def test_nodes_without_a_name_of_their_own_are_named_after_their_output(
    names: tuple[str, str], expected: tuple[str, str]
) -> None:
    body = [
        helper.make_node("Neg", ["x"], ["u"], name=names[0]),
        helper.make_node("Neg", ["u"], ["v"], name=names[1]),
    ]
    x, v = (helper.make_tensor_value_info(n, TensorProto.FLOAT, [2]) for n in "xv")
    model = helper.make_model(helper.make_graph(body, "g", [x], [v]))
    assert distinctly_named(model) == (names != expected)
    assert tuple(each.name for each in nodes_of(model)) == expected
