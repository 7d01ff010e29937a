"""Both forms of a 3D conv say the same, in PyTorch and in a graph."""

import json
from collections.abc import Callable
from copy import deepcopy
from itertools import product
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from torch import Tensor, nn

from rts2.model.arch import Arch, Form
from rts2.model.checkpoint import UNTRAINED, Network, build
from rts2.model.errors import Rts2Error, UsageError
from rts2.model.export import Deployed, export, parity
from rts2.model.forms import Banded, formed
from rts2.model.graph import load_graph, read_header
from rts2.model.rts2net import Regularization

Lively = Callable[[Network], Network]

COMBINATIONS: list[tuple[Form, ...]] = list(product(("3d", "banded"), repeat=3))
RESOLUTION = (96, 64)
SMALL = Arch(c=2, d_max=5, conv3d=(3, 1, 2), classes=5)


def lively_part(width: int, stage: int, planes: int, dtype: torch.dtype) -> Regularization:
    """A regularization whose norms differ from channel to channel, in all that they hold."""
    part = Regularization(width, stage).to(dtype)
    for norm in part.layers:
        if isinstance(norm, nn.BatchNorm3d):
            norm.momentum, norm.eps = None, 0.01
            nn.init.uniform_(norm.weight, 0.5, 2)
            nn.init.uniform_(norm.bias, -0.5, 0.5)
    with torch.no_grad():
        part.train()(torch.randn(4, planes, 7, 11, dtype=dtype), None)
    return part.eval()


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
@pytest.mark.parametrize("planes", [2, 5, 24])
@pytest.mark.parametrize(("width", "stage"), [(1, 0), (3, 0), (3, 2), (8, 1)])
def test_banded_is_equal(
    width: int, stage: int, planes: int, dtype: torch.dtype, bound: float
) -> None:
    plain = lively_part(width, stage, planes, dtype)
    banded = Banded(plain, planes)
    volume = torch.randn(2, planes, 7, 11, dtype=dtype)
    around = torch.randn(2, 1, 7, 11, dtype=dtype) if stage else None
    with torch.inference_mode():
        for wanted, found in zip(plain(volume, around), banded(volume, around), strict=True):
            assert wanted.std() > 0.1  # else agreeing would be no feat
            assert (wanted.shape, wanted.dtype) == (found.shape, found.dtype)
            assert relative(wanted, found) <= bound


def relative(wanted: Tensor, found: Tensor) -> float:
    return float((wanted - found).abs().max() / wanted.abs().max())


def test_the_bands_lie_where_the_algebra_has_them() -> None:
    planes = 4
    plain = Regularization(3, 0)
    wanted = plain.layers[3].weight  # 3 → 3 channels
    found = Banded(plain, planes).layers[3].weight
    assert found.shape == (3 * planes, 3 * planes, 3, 3)
    for o, i, after, before in product(range(3), range(3), range(planes), range(planes)):
        block = found[o * planes + after, i * planes + before]
        step = before - after
        assert torch.equal(block, wanted[o, i, step + 1] if abs(step) <= 1 else block * 0)


def test_a_formed_network_is_a_copy_in_the_forms_asked_for(lively: Lively) -> None:
    network = lively(build(SMALL)).train()
    before, random = deepcopy(network.state_dict()), torch.get_rng_state()
    found = formed(network, ("banded", "3d", "banded"))
    kinds = [type(part) for part in found.regularize]
    assert kinds == [Banded, Regularization, Banded]
    assert [type(part) for part in network.regularize] == [Regularization] * 3
    assert not any(module.training for module in found.modules())
    assert all(module.training for module in network.modules())
    assert torch.equal(random, torch.get_rng_state())
    with torch.no_grad():
        for value in found.state_dict().values():
            value.zero_()
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())


@pytest.mark.parametrize("arch", [SMALL, Arch(family="anynet", c=2, d_max=5, conv3d=(3, 1, 2))])
def test_a_formed_network_says_the_same_at_every_stage(lively: Lively, arch: Arch) -> None:
    network = lively(build(arch)).double()
    left, right = torch.randn(2, 2, 3, 64, 96, dtype=torch.float64)
    with torch.inference_mode():
        answers = [net(left, right) for net in (network, formed(network, ["banded"] * 3))]
    for plain, banded in zip(*answers, strict=True):
        assert plain.best.std() > 0.1
        assert relative(plain.best, banded.best) <= 1e-10
        assert relative(plain.disparity, banded.disparity) <= 1e-10


@pytest.mark.parametrize("family", ["rts2net", "anynet"])
@pytest.mark.parametrize("forms", [None, (), []])
def test_no_forms_are_3d_for_all(family: str, forms: list[Form] | None, tmp_path: Path) -> None:
    network = build(Arch(family=family, c=1, stages=1))
    assert str(formed(network, forms)) == str(network)
    export(network, tmp_path / "a.onnx", RESOLUTION, UNTRAINED)
    export(network, tmp_path / "b.onnx", RESOLUTION, UNTRAINED, forms=forms)
    assert (tmp_path / "a.onnx").read_bytes() == (tmp_path / "b.onnx").read_bytes()


@pytest.mark.parametrize("forms", COMBINATIONS, ids="-".join)
def test_every_graph_agrees_with_the_plain_network(
    lively: Lively, forms: tuple[Form, ...], tmp_path: Path
) -> None:
    network = lively(build(SMALL))
    path = tmp_path / "a.onnx"
    header = export(network, path, RESOLUTION, UNTRAINED, opset=13, forms=forms)
    assert header == read_header(path)
    assert header.forms == (forms if "banded" in forms else None)
    left, right = torch.randn(2, 1, 3, 64, 96)
    found = run(path, left, right)
    assert np.ptp(found) > 1
    agreed = parity(path, network, left, right)
    assert agreed.disparity_px <= 1e-4 * np.abs(found).max()
    assert agreed.semantic_share == 0
    check_nodes(load_graph(path), forms)


def run(path: Path, left: Tensor, right: Tensor) -> np.ndarray:
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    found: np.ndarray = session.run(["disparity"], {"left": left.numpy(), "right": right.numpy()})[
        0
    ]
    return found


def check_nodes(model: onnx.ModelProto, forms: tuple[Form, ...]) -> None:
    """Convs of the right rank under the names of the 3D form, and no other operators."""
    onnx.checker.check_model(model, full_check=True)
    assert [(entry.domain, entry.version) for entry in model.opset_import] == [("", 13)]
    rank = {tensor.name: len(tensor.dims) for tensor in model.graph.initializer}
    names = {node.name for node in model.graph.node}
    for stage, form in enumerate(forms):
        part = f"regularize.{stage}"
        nodes = [node for node in model.graph.node if node.name.startswith(f"{part}.layers")]
        convs = {node.name: rank[node.input[1]] for node in nodes if node.op_type == "Conv"}
        wanted = 5 if form == "3d" else 4
        assert convs == {f"{part}.layers.{layer}/Conv": wanted for layer in (0, 3, 6)}
        assert {node.op_type for node in nodes} == {"Conv", "Relu"}
        # A 3D conv wants its channel added and taken away; the 2D one takes the volume as it is.
        reshapes = {f"{part}/Unsqueeze", f"{part}/Squeeze"}
        assert names & reshapes == (reshapes if form == "3d" else set())
        # What the last stage says is its refined disparity alone.
        assert (f"{part}.regression/Exp" in names) == (stage < 2)


def test_forms_are_cut_to_the_stages_that_run(lively: Lively, tmp_path: Path) -> None:
    network = lively(build(SMALL))
    path = tmp_path / "a.onnx"
    forms: list[Form] = ["3d", "banded", "banded"]
    header = export(network, path, RESOLUTION, UNTRAINED, stages=2, forms=forms)
    assert header.forms == read_header(path).forms == ("3d", "banded")
    assert Deployed(network, 1, forms).forms is None
    plain = tmp_path / "b.onnx"
    for target, given in ((path, forms), (plain, None)):
        export(network, target, RESOLUTION, UNTRAINED, stages=1, forms=given)
    assert entry(load_graph(path)) == entry(load_graph(plain))
    assert "forms" not in entry(load_graph(path))


def entry(model: onnx.ModelProto) -> dict[str, object]:
    found: dict[str, object] = json.loads(model.metadata_props[0].value)
    return found


def test_a_file_without_forms_is_one_of_before(tmp_path: Path) -> None:
    """Its keys, their order, every byte: no field but `forms` and `answers` may be unset."""
    path = tmp_path / "a.onnx"
    header = export(build(Arch(c=1, stages=1)), path, RESOLUTION, UNTRAINED)
    text = load_graph(path).metadata_props[0].value
    assert text == header.model_dump_json(exclude={"forms", "answers"})
    assert list(json.loads(text)) == [
        "arch",
        "resolution",
        "size",
        "precision",
        "mean",
        "std",
        "origin",
        "rts2",
    ]
    assert read_header(path).forms is None


@pytest.mark.parametrize(
    ("arch", "forms", "message"),
    [
        (Arch(c=1, stages=2), ["banded"], "forms: forms must be one per stage, 2 in all"),
        (Arch(c=1, stages=2), [], "forms: forms must be one per stage, 2 in all"),
        (Arch(c=1, stages=1), ["2d"], r"forms\.0: Input should be '3d' or 'banded'"),
    ],
)
def test_wrong_forms_in_a_header_are_refused(
    arch: Arch, forms: list[str], message: str, tmp_path: Path
) -> None:
    path = tmp_path / "a.onnx"
    export(build(arch), path, RESOLUTION, UNTRAINED)
    model = load_graph(path)
    onnx.helper.set_model_props(model, {"rts2": json.dumps(entry(model) | {"forms": forms})})
    onnx.save(model, path)
    with pytest.raises(Rts2Error, match=rf"a\.onnx: {message} \(given: ") as raised:
        read_header(path)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("arch", "forms", "message"),
    [
        (
            Arch(c=1),
            ["banded"],
            "forms must be one for each stage of the network, 3 in all, not 1: banded",
        ),
        (
            Arch(c=1, stages=1),
            ["3d", "banded"],
            "forms must be one for each stage of the network, 1 in all, not 2: 3d, banded",
        ),
        (Arch(c=1, stages=2), ["3d", "2d"], "a form must be 3d or banded, not 2d"),
    ],
)
def test_wrong_forms_are_wrong_use(
    arch: Arch, forms: list[Form], message: str, tmp_path: Path
) -> None:
    network = build(arch)
    with pytest.raises(UsageError) as raised:
        export(network, tmp_path / "a.onnx", RESOLUTION, UNTRAINED, forms=forms)
    assert str(raised.value) == message
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(UsageError):
        formed(network, forms)
