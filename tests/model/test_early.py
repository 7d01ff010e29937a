"""A graph cut behind a stage says what the network says there, and computes no more."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

from rts2.model.arch import UNTRAINED, Arch, Form
from rts2.model.checkpoint import Network, build
from rts2.model.early import stopped, stops
from rts2.model.export import OPSETS, Deployed, export
from rts2.model.graph import GraphHeader, header_of, load_graph
from rts2.model.inference import open_session
from rts2.model.qdq import integers, layers, nominal

Lively = Callable[[Network], Network]

RESOLUTION = (90, 60)
SIZE = (64, 96)
"""Height and width, padded: equal for both families."""

ARCHS = {
    "full": Arch(c=1, d_max=4),
    "disparity": Arch(c=2, semantic=False),
    "no refinement": Arch(c=2, refinement=False),
    "anynet": Arch(family="anynet", c=1),
}


def pair() -> dict[str, np.ndarray]:
    images = np.random.default_rng(0).standard_normal((2, 1, 3, *SIZE), dtype=np.float32)
    return {"left": images[0], "right": images[1]}


MIXED: tuple[Form, ...] = ("3d", "banded", "banded")


def exported(
    network: Network, folder: Path, opset: int = 17, forms: tuple[Form, ...] = MIXED
) -> tuple[onnx.ModelProto, GraphHeader]:
    path = folder / "a.onnx"
    header = export(network, path, RESOLUTION, UNTRAINED, opset, forms=forms)
    return load_graph(path), header


def run(model: onnx.ModelProto) -> list[np.ndarray]:
    session = open_session(Path("a.onnx"), model=model.SerializeToString())
    found: list[np.ndarray] = session.run(None, pair())
    return found


@pytest.mark.parametrize("arch", ARCHS.values(), ids=ARCHS.keys())
@pytest.mark.parametrize("stage", [1, 2, 3])
def test_it_says_what_the_network_says_there(
    lively: Lively, tmp_path: Path, arch: Arch, stage: int
) -> None:
    network = lively(build(arch))
    model, header = exported(network, tmp_path)
    assert stops(model, header) == (1, 2, 3)
    cut = stopped(model, header, stage)
    onnx.checker.check_model(cut, full_check=True)
    with torch.inference_mode():
        wanted = Deployed(network, stage)(*(torch.from_numpy(image) for image in pair().values()))
    found = run(cut)
    assert len(found) == len(wanted)
    assert wanted[0].std() > 0.1
    np.testing.assert_allclose(found[0], wanted[0], atol=2e-3)
    if arch.semantic:
        assert found[1].dtype == np.int32
        assert np.unique(found[1]).size > 1
        assert (found[1] == wanted[1].numpy()).mean() > 0.999


@pytest.mark.parametrize("opset", [OPSETS[0], OPSETS[-1]])
def test_every_opset_has_what_it_takes(tmp_path: Path, opset: int) -> None:
    model, header = exported(build(ARCHS["full"]), tmp_path, opset)
    cut = stopped(model, header, 1)
    assert [entry.version for entry in cut.opset_import] == [opset]
    assert [answer.shape for answer in run(cut)] == [(1, *SIZE)] * 2


@pytest.mark.parametrize("arch", ARCHS.values(), ids=ARCHS.keys())
def test_nothing_of_later_stages_is_left(tmp_path: Path, arch: Arch) -> None:
    model, header = exported(build(arch), tmp_path)
    cuts = [stopped(model, header, stage) for stage in (1, 2, 3)]
    assert cuts[2] is model
    for stage, cut in enumerate(cuts[:2], 1):
        names = [node.name for node in cut.graph.node]
        later = [f"{part}.{k}" for k in range(stage, 3) for part in ("regularize", "refine")]
        assert not [name for name in names for part in later if name.startswith(part)]
        assert [name for name in names if name.startswith(f"regularize.{stage - 1}")]
        used = {value for node in cut.graph.node for value in node.input}
        assert {tensor.name for tensor in cut.graph.initializer} <= used


def test_it_says_of_itself_what_it_is(tmp_path: Path) -> None:
    model, header = exported(build(ARCHS["full"]), tmp_path)
    own = header_of(stopped(model, header, 2), tmp_path)
    assert own.arch == ARCHS["full"].up_to(2)
    assert own.forms == ("3d", "banded")
    assert (own.size, own.origin) == (header.size, header.origin)


@pytest.mark.parametrize("stage", [1, 2])
def test_a_graph_of_integers_stops_early_too(lively: Lively, tmp_path: Path, stage: int) -> None:
    """What it says there is what the whole graph has there, enlarged."""
    model, header = exported(lively(build(ARCHS["full"])), tmp_path)
    made = integers(model, [layer.name for layer in layers(model)], nominal(model))
    assert stops(made, header) == (1, 2, 3)
    assert header.answers is not None
    name = header.answers[stage - 1][0]
    shown = onnx.ModelProto()
    shown.CopyFrom(made)
    shown.graph.output.extend([onnx.helper.make_empty_tensor_value_info(name)])
    wanted = torch.from_numpy(run(shown)[-1])
    assert wanted.std() > 0.1
    full = torch.nn.functional.interpolate(wanted, size=SIZE, mode="bilinear")
    np.testing.assert_allclose(run(stopped(made, header, stage))[0], full[0], atol=1e-3)


def test_a_graph_whose_answers_have_no_names_runs_whole(tmp_path: Path) -> None:
    model, header = exported(build(ARCHS["full"]), tmp_path)
    assert stops(model, header.model_copy(update={"answers": None})) == (3,)
    others = (("none", "none"), header.answers[1] if header.answers else ())
    assert stops(model, header.model_copy(update={"answers": others})) == (2, 3)
    assert stops(model, header.model_copy(update={"answers": (("a",),) * 5})) == (3,)


def test_a_graph_of_one_stage_has_nowhere_else_to_stop(tmp_path: Path) -> None:
    model, header = exported(build(Arch(c=1, stages=1)), tmp_path, forms=("3d",))
    assert header.answers is None
    assert stops(model, header) == (1,)


def test_a_graph_of_fewer_stages_than_its_network_stops_before_them(tmp_path: Path) -> None:
    header = export(build(ARCHS["full"]), tmp_path / "a.onnx", RESOLUTION, UNTRAINED, stages=2)
    assert header.answers is not None
    assert len(header.answers) == 1
    assert stops(load_graph(tmp_path / "a.onnx"), header) == (1, 2)
