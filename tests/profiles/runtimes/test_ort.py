"""ONNX Runtime's own profile of a real network, traced to the nodes of its file."""

from pathlib import Path

import onnx
import pytest
from onnx import TensorProto, helper

from rts2.profiles.runtimes.ort import Session, _by_run


def test_every_kernel_counts_for_a_node_of_the_file(graph: Path) -> None:
    """The sum over nodes is the sum over kernels, and every convolution has a time."""
    found = Session(graph, 1).kernels(3)
    nodes = {node.name: node.op_type for node in onnx.load_model(graph).graph.node}
    assert {kernel.origin.node for kernel in found} <= nodes.keys()
    convolutions = {name for name, kind in nodes.items() if kind == "Conv"}
    assert convolutions <= {kernel.origin.node for kernel in found}
    assert {kernel.origin.how for kernel in found} >= {"named", "inserted"}
    for kernel in found:
        if kernel.origin.how == "inserted":
            assert kernel.name.startswith("Reorder"), kernel


def test_node_times_are_the_kernels_of_each_node(graph: Path) -> None:
    session = Session(graph, 1)
    times = session.node_times_ms(3)
    assert times.keys() == {kernel.origin.node for kernel in session.kernels(1)}
    assert all(value >= 0 for value in times.values())
    assert sum(times.values()) > 0


def test_kernels_are_cut_at_the_runs_that_they_belong_to() -> None:
    """Two runs; a kernel that runs twice in one adds up, and what is outside counts nowhere."""

    def event(cat: str, name: str, ts: int, dur: int) -> dict[str, object]:
        return {"cat": cat, "name": name, "ts": ts, "dur": dur}

    events = [
        event("Session", "session_initialization", 0, 9000),
        event("Node", "a_kernel_time", 9500, 100),
        event("Session", "model_run", 10000, 5000),
        event("Node", "a_kernel_time", 10100, 1000),
        event("Node", "b_kernel_time", 11200, 2000),
        event("Node", "a_kernel_time", 13300, 500),
        event("Session", "model_run", 20000, 5000),
        event("Node", "b_kernel_time", 22000, 2500),
        event("Node", "a_kernel_time", 20100, 1250),
    ]
    found = list(_by_run(events))
    assert found == [{"a": 1.5, "b": 2.0}, {"a": 1.25, "b": 2.5}]
    assert list(found[1]) == ["a", "b"]


def test_nodes_without_names_are_keyed_by_their_output(tmp_path: Path) -> None:
    body = [helper.make_node("Sin", ["x"], ["u"]), helper.make_node("Cos", ["u"], ["v"])]
    x, v = (helper.make_tensor_value_info(n, TensorProto.FLOAT, [64]) for n in "xv")
    model = helper.make_model(
        helper.make_graph(body, "g", [x], [v]),
        opset_imports=[helper.make_opsetid("", 13)],
        ir_version=8,
    )
    path = tmp_path / "nameless.onnx"
    onnx.save(model, path)
    assert Session(path, 1).node_times_ms(1).keys() == {"u", "v"}


@pytest.mark.parametrize("threads", [1, 2])
def test_a_session_runs(graph: Path, threads: int) -> None:
    session = Session(graph, threads)
    session.run()
    session.run()
