"""Exported graphs say what their networks say, and hold what a runtime can take."""

import json
import subprocess
import sys
from collections.abc import Callable
from copy import deepcopy
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from rts2.model.arch import MEAN, STD, Arch
from rts2.model.checkpoint import UNTRAINED, Network, build, load
from rts2.model.data.images import read_rgb
from rts2.model.errors import Rts2Error, UsageError
from rts2.model.export import OPSETS, Deployed, export, parity
from rts2.model.graph import load_graph, read_header
from rts2.model.predictor import prepared
from rts2.profiles.runtimes.ov import Session

Lively = Callable[[Network], Network]

BRANCHES = ({"semantic": False}, {"refinement": False}, {})
ARCHS = [
    *(Arch(c=2, d_max=5, **branches) for branches in BRANCHES),
    Arch(c=1, d_max=3, conv3d=(3, 1, 2), classes=5),
    Arch(family="anynet", c=2, d_max=5),
]
RESOLUTION = (90, 50)
"""No multiple of 16: pads to 96x64, for both families."""


def textured(width: int, height: int, shift: int = 7) -> tuple[Tensor, Tensor]:
    """A smooth random texture, and the same `shift` pixels further left."""
    coarse = torch.randn(1, 3, height // 4 + 1, (width + shift) // 4 + 2)
    texture = F.interpolate(coarse, scale_factor=4, mode="bicubic")
    return (
        texture[..., :height, :width].contiguous(),
        texture[..., :height, shift : width + shift].contiguous(),
    )


@pytest.mark.parametrize("stages", [1, 2, 3])
@pytest.mark.parametrize("arch", ARCHS, ids=Arch.label)
def test_graph_and_network_agree(lively: Lively, arch: Arch, stages: int, tmp_path: Path) -> None:
    network = lively(build(arch))
    path = tmp_path / "a.onnx"
    export(network, path, RESOLUTION, UNTRAINED, opset=13, stages=stages)
    left, right = textured(96, 64)
    assert np.ptp(run(path, left, right)["disparity"]) > 1  # else agreeing would be no feat
    found = parity(path, network, left, right)
    assert found.disparity_px <= 1e-3
    assert found.semantic_share == (0 if arch.semantic else None)
    check_constants_are_folded(load_graph(path))


@pytest.mark.parametrize("stages", [1, 2, 3])
@pytest.mark.parametrize("arch", ARCHS, ids=Arch.label)
def test_a_graph_for_openvino_says_the_same_in_every_runtime(
    lively: Lively, arch: Arch, stages: int, tmp_path: Path
) -> None:
    network = lively(build(arch))
    path = tmp_path / "a.onnx"
    export(network, path, RESOLUTION, UNTRAINED, opset=13, stages=stages, runtime="openvino")
    check_suits_openvino(load_graph(path))
    left, right = textured(96, 64)
    assert np.ptp(run(path, left, right)["disparity"]) > 1
    found = parity(path, network, left, right)
    assert found.disparity_px <= 1e-3
    assert found.semantic_share == (0 if arch.semantic else None)
    in_openvino(path, network, left, right)


def check_suits_openvino(model: onnx.ModelProto) -> None:
    """It takes no argmax, and the answer is enlarged by a product."""
    assert "ArgMax" not in {node.op_type for node in model.graph.node}
    shapes = {
        value.name: [side.dim_value for side in value.type.tensor_type.shape.dim]
        for value in [*model.graph.value_info, *model.graph.output]
    }
    enlarging = [node for node in model.graph.node if node.op_type == "Resize"]
    assert (64, 96) not in {tuple(shapes[node.output[0]][2:]) for node in enlarging}


def in_openvino(path: Path, network: Network, left: Tensor, right: Tensor) -> None:
    """Where OpenVINO is installed it is asked, too."""
    if find_spec("openvino") is None:
        return
    session = Session(path, "fp32", 1)
    names = ["disparity", "semantic"] if network.arch.semantic else ["disparity"]
    found = session.answer(names, {"left": left.numpy(), "right": right.numpy()})
    with torch.inference_mode():
        wanted = Deployed(network, read_header(path).stages)(left, right)
    assert np.abs(found[0] - wanted[0].numpy()).max() <= 1e-3
    for ids, expected in zip(found[1:], wanted[1:], strict=True):
        assert np.array_equal(ids, expected.numpy())


def run(path: Path, left: Tensor, right: Tensor) -> dict[str, np.ndarray]:
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    found = session.run(None, {"left": left.numpy(), "right": right.numpy()})
    return dict(zip([output.name for output in session.get_outputs()], found, strict=True))


def check_constants_are_folded(model: onnx.ModelProto) -> None:
    """No operator computes what is known beforehand, and every one is ONNX's own."""
    onnx.checker.check_model(model, full_check=True)
    weights = {tensor.name for tensor in model.graph.initializer}
    for node in model.graph.node:
        assert node.domain == ""
        assert node.op_type not in {"Constant", "ConstantOfShape", "Shape", "Where", "Range", "If"}
        assert set(node.input) - weights - {""}, f"{node.name} has no input but constants"
    assert {entry.domain for entry in model.opset_import} == {""}


@pytest.mark.parametrize("opset", [13, 17, OPSETS[-1]])
def test_the_opset_is_the_one_asked_for(opset: int, tmp_path: Path) -> None:
    network = build(Arch(c=1))
    path = tmp_path / "a.onnx"
    export(network, path, RESOLUTION, UNTRAINED, opset)
    assert [entry.version for entry in load_graph(path).opset_import] == [opset]
    assert parity(path, network, *textured(96, 64)).disparity_px <= 1e-3


@pytest.mark.parametrize("opset", [12, 21])
def test_other_opsets_are_wrong_use(opset: int, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=f"opset must be 13 to 20, not {opset}"):
        export(build(Arch(c=1)), tmp_path / "a.onnx", RESOLUTION, UNTRAINED, opset)
    assert list(tmp_path.iterdir()) == []


def test_stages_that_are_not_there_are_wrong_use(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="stages must be 1 to 2"):
        export(build(Arch(c=1, stages=2)), tmp_path / "a.onnx", RESOLUTION, UNTRAINED, stages=3)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("arch", [Arch(c=1, classes=5), Arch(family="anynet", c=1)], ids=Arch.label)
def test_inputs_outputs_and_values_have_fixed_shapes(arch: Arch, tmp_path: Path) -> None:
    export(build(arch), tmp_path / "a.onnx", RESOLUTION, UNTRAINED)
    graph = load_graph(tmp_path / "a.onnx").graph
    shapes = {
        value.name: (value.type.tensor_type.elem_type, sides(value))
        for value in [*graph.input, *graph.value_info, *graph.output]
    }
    assert [value.name for value in graph.input] == ["left", "right"]
    wanted = {"disparity": (onnx.TensorProto.FLOAT, [1, 64, 96])}
    if arch.semantic:
        wanted["semantic"] = (onnx.TensorProto.INT32, [1, 64, 96])
    assert {value.name: shapes[value.name] for value in graph.output} == wanted
    assert shapes["left"] == shapes["right"] == (onnx.TensorProto.FLOAT, [1, 3, 64, 96])
    for node in graph.node:
        for name in node.output:
            assert all(side > 0 for side in shapes[name][1]), name


def sides(value: onnx.ValueInfoProto) -> list[int]:
    return [side.dim_value for side in value.type.tensor_type.shape.dim]


def test_nodes_bear_the_names_of_their_modules(tmp_path: Path) -> None:
    network = build(Arch(c=1, stages=2))
    export(network, tmp_path / "a.onnx", RESOLUTION, UNTRAINED)
    graph = load_graph(tmp_path / "a.onnx").graph
    names = [node.name for node in graph.node]
    assert len(set(names)) == len(names)
    convs = {node.name.removesuffix("/Conv") for node in graph.node if node.op_type == "Conv"}
    modules = {name for name, m in network.named_modules() if isinstance(m, nn.Conv2d | nn.Conv3d)}
    assert convs == modules
    rooms = {*dict(network.named_modules()), "output"} - {""}
    for node in graph.node:
        assert node.name.split("/")[0] in rooms
        own = {f"{node.name}:{index}" for index in range(len(node.output))}
        assert set(node.output) <= own | {"disparity", "semantic"}


def test_the_header_says_what_the_file_is(tmp_path: Path) -> None:
    arch = Arch(c=2, conv3d=(5, 3, 2))
    path = tmp_path / "a.onnx"
    header = export(build(arch), path, RESOLUTION, "trained on streets", stages=2)
    assert header == read_header(path)
    assert (header.arch, header.stages) == (arch.up_to(2), 2)
    assert (header.resolution, header.size) == (RESOLUTION, (96, 64))
    assert (header.precision, header.mean, header.std) == ("fp32", MEAN, STD)
    assert header.origin == "trained on streets"


def test_the_same_network_gives_the_same_bytes(tmp_path: Path) -> None:
    """In this process and in another one."""
    code = (
        "import sys, torch; from pathlib import Path; from rts2.model.arch import MEAN, STD, Arch;"
        "from rts2.model.checkpoint import build; from rts2.model.export import export;"
        "torch.manual_seed(3);"
        "[export(build(Arch(c=1)), Path(name), (90, 50), 'x') for name in sys.argv[1:]]"
    )
    torch.manual_seed(3)
    export(build(Arch(c=1)), tmp_path / "a.onnx", RESOLUTION, "x")
    ran = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "b.onnx")], capture_output=True, text=True
    )
    assert (ran.returncode, ran.stdout, ran.stderr) == (0, "", "")
    assert (tmp_path / "a.onnx").read_bytes() == (tmp_path / "b.onnx").read_bytes()


def test_export_leaves_the_network_and_the_random_numbers_alone(tmp_path: Path) -> None:
    network = build(Arch(c=1))
    files = [tmp_path / "evaluating.onnx", tmp_path / "training.onnx"]
    for path in files:
        before, state = deepcopy(network.state_dict()), torch.get_rng_state()
        modes = [module.training for module in network.modules()]
        export(network, path, RESOLUTION, UNTRAINED)
        parity(path, network, *torch.zeros(2, 1, 3, 64, 96))
        assert modes == [module.training for module in network.modules()]
        assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())
        assert torch.equal(state, torch.get_rng_state())
        network.train()
    assert files[0].read_bytes() == files[1].read_bytes()


def test_deployed_is_the_last_stage_at_full_size(lively: Lively) -> None:
    network = lively(build(Arch(c=2)))
    left, right = textured(96, 64)
    with torch.inference_mode():
        disparity, semantic = Deployed(network, 2)(left, right)
        last = network(left, right, 2)[-1]
    assert last.refined is not None
    assert last.scores is not None
    full = {"scale_factor": 8.0, "mode": "bilinear", "align_corners": False}
    assert torch.equal(disparity, F.interpolate(last.refined, **full)[:, 0])
    assert torch.equal(semantic, F.interpolate(last.scores, **full).argmax(1).int())
    assert semantic.dtype == torch.int32


def test_parity_shows_a_difference(lively: Lively, tmp_path: Path) -> None:
    network = lively(build(Arch(c=2)))
    export(network, tmp_path / "a.onnx", RESOLUTION, UNTRAINED)
    with torch.no_grad():
        network.regularize[0].layers[0].weight.mul_(1.5)
        network.classify[2].bias[0] += 100
    found = parity(tmp_path / "a.onnx", network, *textured(96, 64))
    assert found.disparity_px > 0.1
    assert found.semantic_share is not None
    assert found.semantic_share > 0.5


@pytest.mark.parametrize("size", [0, 1, 100, 5000, -1])
def test_truncated_files_are_refused(size: int, tmp_path: Path) -> None:
    path = tmp_path / "a.onnx"
    export(build(Arch(c=1, stages=1)), path, RESOLUTION, UNTRAINED)
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(Rts2Error, match=r"a\.onnx (is truncated|holds no arch)"):
        read_header(path)


def test_foreign_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.onnx"
    path.write_bytes(b"no model at all")
    with pytest.raises(Rts2Error, match="no ONNX file"):
        read_header(path)
    onnx.save(onnx.ModelProto(ir_version=7), path)
    with pytest.raises(Rts2Error, match="holds no arch"):
        read_header(path)
    with pytest.raises(UsageError, match="it is a folder"):
        read_header(tmp_path)


def test_a_wrong_header_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.onnx"
    header = export(build(Arch(c=1, stages=1)), path, RESOLUTION, UNTRAINED)
    model = load_graph(path)
    onnx.helper.set_model_props(model, {"rts2": json.dumps(header.model_dump() | {"origin": 3})})
    onnx.save(model, path)
    with pytest.raises(Rts2Error, match=r"a\.onnx: origin: Input should be a valid string"):
        read_header(path)


def test_a_failed_export_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.onnx"
    path.write_bytes(b"mine")
    monkeypatch.setattr("os.fsync", full_disk)
    with pytest.raises(Rts2Error, match="No space left"):
        export(build(Arch(c=1, stages=1)), path, RESOLUTION, UNTRAINED)
    assert path.read_bytes() == b"mine"
    assert list(tmp_path.iterdir()) == [path]


def full_disk(_: int) -> None:
    raise OSError(28, "No space left on device")


def real_pair(real_data: Path, frame: int, multiple: int) -> tuple[Tensor, Tensor]:
    """A real pair as the networks take it, cut at the bottom right to 1232x368 or less."""
    folder = real_data / "kitti2015" / "training"
    width, height = (side // multiple * multiple for side in (1232, 368))
    images = (
        read_rgb(folder / f"image_{side}" / f"{frame:06}_10.png")[-height:, -width:]
        for side in (2, 3)
    )
    left, right = (torch.from_numpy(prepared(image, multiple)) for image in images)
    return left, right


@pytest.mark.parametrize("runtime", ["onnxruntime", "openvino"])
@pytest.mark.parametrize("stages", [1, 2, 3])
def test_parity_of_the_trained_anynet_on_a_real_pair(
    real_data: Path, tmp_path: Path, stages: int, runtime: str
) -> None:
    network, header = load(real_data / "anynet_official" / "kitti2015.tar")
    path = tmp_path / "a.onnx"
    size = (1232, 368)
    export(network, path, size, header.origin, opset=13, stages=stages, runtime=runtime)
    found = parity(path, network, *real_pair(real_data, 0, 16))
    assert found.disparity_px <= 1e-3


def test_parity_where_float_noise_is_larger_than_the_bound(real_data: Path, tmp_path: Path) -> None:
    """AnyNet trained on Scene Flow is ill-conditioned on KITTI: PyTorch itself errs by millipixels.

    There the graph has to be about as near to the network in double precision as PyTorch is.
    """
    network, header = load(real_data / "anynet_official" / "sceneflow.tar")
    path = tmp_path / "a.onnx"
    export(network, path, (1232, 368), header.origin)
    left, right = real_pair(real_data, 0, 16)
    with torch.inference_mode():
        single = Deployed(network)(left, right)[0].numpy()
        double = Deployed(deepcopy(network).double())(left.double(), right.double())[0].numpy()
    found = run(path, left, right)["disparity"]
    own, theirs = (np.abs(answer - double).max() for answer in (single, found))
    assert theirs <= max(1e-3, 4 * own)
    assert own < 0.02  # else the comparison would forgive anything


@pytest.mark.parametrize("runtime", ["onnxruntime", "openvino"])
@pytest.mark.parametrize("branches", BRANCHES)
def test_parity_of_every_variant_on_a_real_pair(
    lively: Lively, real_data: Path, tmp_path: Path, branches: dict[str, bool], runtime: str
) -> None:
    network = lively(build(Arch(c=2, **branches)))
    path = tmp_path / "a.onnx"
    export(network, path, (1216, 352), UNTRAINED, opset=13, runtime=runtime)
    found = parity(path, network, *real_pair(real_data, 1, 32))
    assert found.disparity_px <= 1e-3
    assert found.semantic_share is None or found.semantic_share <= 1e-4
