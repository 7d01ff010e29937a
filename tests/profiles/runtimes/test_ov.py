"""OpenVINO: the precision that was asked for, and its counters traced to the file's nodes."""

from pathlib import Path

import onnx
import pytest

from rts2.model.errors import Rts2Error
from rts2.profiles.runtimes import ov

openvino = pytest.importorskip(
    "openvino", reason="needs OpenVINO: pip install 'rts2[openvino]' brings it"
)


def test_every_step_counts_for_a_node_of_the_file(graph: Path) -> None:
    found = ov.Session(graph, "fp32", 1).kernels(3)
    nodes = {node.name: node.op_type for node in onnx.load_model(graph).graph.node}
    assert {kernel.origin.node for kernel in found} <= nodes.keys()
    convolutions = {name for name, kind in nodes.items() if kind == "Conv"}
    assert convolutions <= {kernel.origin.node for kernel in found}
    named = [kernel for kernel in found if kernel.origin.how == "named"]
    assert len(named) > len(found) / 2
    argmax = [name for name, kind in nodes.items() if kind == "ArgMax"]
    assert set(argmax) <= {kernel.origin.node for kernel in found}


def test_node_times_are_the_kernels_of_each_node(graph: Path) -> None:
    times = ov.Session(graph, "fp32", 1).node_times_ms(3)
    assert all(value >= 0 for value in times.values())
    assert sum(times.values()) > 0


def test_every_offered_precision_is_what_is_computed(graph: Path) -> None:
    """Offered is what the processor has: OpenVINO itself checks each when it compiles."""
    offered = ov.precisions("fp32")
    assert offered[0] == "fp32"
    for precision in offered:
        ov.Session(graph, precision, 1).run()


def test_a_precision_that_is_silently_replaced_is_refused(
    graph: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the processor has fp16, asking for a hint that turns into another stands in for it."""
    if "fp16" in ov.precisions("fp32"):
        pytest.skip("this processor computes fp16, so nothing replaces it")
    with pytest.raises(Rts2Error, match=r"computes in \w+ on this processor, not in f16"):
        ov.Session(graph, "fp16", 1)


@pytest.mark.parametrize(
    ("able", "known", "offered"),
    [
        (["FP32", "BF16"], {"avx512_bf16"}, ("fp32", "bf16")),
        (["FP32", "BF16"], {"avx512f"}, ("fp32",)),
        (["FP32", "BF16", "FP16"], {"amx_bf16", "avx512_fp16"}, ("fp32", "bf16", "fp16")),
        (["FP32"], {"avx512_fp16"}, ("fp32",)),
        (["FP32", "FP16"], set(), ("fp32", "fp16")),
    ],
)
def test_only_what_the_processor_has_is_offered(
    monkeypatch: pytest.MonkeyPatch, able: list[str], known: set[str], offered: tuple[str, ...]
) -> None:
    class Core:
        def get_property(self, device: str, name: str) -> list[str]:
            assert (device, name) == ("CPU", "OPTIMIZATION_CAPABILITIES")
            return able

    monkeypatch.setattr(openvino, "Core", Core)
    monkeypatch.setattr(ov, "features", lambda: frozenset(known))
    assert ov.precisions("fp32") == offered
    assert ov.precisions("int8") == ("int8",)
    assert ov.hint("int8") == ("bf16" if "bf16" in offered else "f32")
    assert ov.hint("fp32") == "f32"


def test_the_version_is_the_packages() -> None:
    from importlib.metadata import version

    assert ov.versions() == {"openvino": version("openvino")}
    assert ov.missing() is None


def test_a_broken_file_is_one_error(tmp_path: Path) -> None:
    path = tmp_path / "x.onnx"
    path.write_bytes(b"junk")
    with pytest.raises(Rts2Error, match=r"x\.onnx"):
        ov.Session(path, "fp32", 1)
