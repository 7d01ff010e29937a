"""Any network runs on numpy images in one way, and says what the network itself says."""

import json
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
import torch.nn.functional as F
from onnx import TensorProto, helper

from rts2.model.arch import Arch
from rts2.model.checkpoint import build, load, save
from rts2.model.errors import Rts2Error, UsageError
from rts2.model.files import sha256
from rts2.model.predictor import (
    OnnxPredictor,
    TorchPredictor,
    open_model,
    prepared,
)

FULL = Arch(c=1, d_max=4)
HEIGHT, WIDTH = 50, 70
"""No multiple of 32: every answer must have been padded and cut back."""


def pair(height: int = HEIGHT, width: int = WIDTH) -> tuple[np.ndarray, np.ndarray]:
    images = np.random.default_rng(0).integers(0, 256, (2, height, width, 3), dtype=np.uint8)
    return images[0], images[1]


def graph(path: Path, shape: tuple[object, ...] = (1, 3, 64, 96), **changes: object) -> Path:
    """An ONNX file whose disparity is left less right, summed over the colours."""
    names = changes.get("inputs", ("left", "right"))
    assert isinstance(names, tuple)
    size = [1, *shape[2:]]
    axes = helper.make_tensor("axes", TensorProto.INT64, [1], [1])
    nodes = [
        helper.make_node("Sub", names[:2], ["difference"]),
        helper.make_node("ReduceSum", ["difference", "axes"], ["disparity"], keepdims=0),
        helper.make_node("Cast", ["disparity"], ["semantic"], to=TensorProto.INT32),
    ]
    outputs = [
        helper.make_tensor_value_info("disparity", TensorProto.FLOAT, size),
        helper.make_tensor_value_info("semantic", TensorProto.INT32, size),
    ]
    found = changes.get("outputs", 1)
    assert isinstance(found, int)
    inputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name in names]
    unused = helper.make_tensor("unused", TensorProto.FLOAT, [1], [1.0])
    body = helper.make_graph(nodes[: 1 + found], "g", inputs, outputs[:found], [axes, unused])
    model = helper.make_model(body, opset_imports=[helper.make_opsetid("", 13)])
    model.ir_version = 8
    onnx.save(model, path)
    return path


def test_images_are_normalised_then_padded() -> None:
    image = np.array([[[255, 0, 51]]], np.uint8)
    tensor = prepared(image, 4)
    assert tensor.shape == (1, 3, 4, 4)
    assert tensor.dtype == np.float32
    wanted = [(1 - 0.485) / 0.229, -0.456 / 0.224, (0.2 - 0.406) / 0.225]
    np.testing.assert_allclose(tensor[0, :, 0, 0], wanted, rtol=1e-5)
    tensor[0, :, 0, 0] = 0
    assert not tensor.any(), "the padding is zero after the normalisation"


@pytest.mark.parametrize(
    ("size", "multiple", "padded"),
    [((375, 1242), 32, (384, 1248)), ((368, 1232), 16, (368, 1232)), ((1, 33), 32, (32, 64))],
)
def test_sides_become_the_next_multiple(
    size: tuple[int, int], multiple: int, padded: tuple[int, int]
) -> None:
    assert prepared(np.zeros((*size, 3), np.uint8), multiple).shape[-2:] == padded


@pytest.mark.parametrize("stages", [1, 2, 3, None])
def test_estimate_is_the_networks_own_answer_enlarged(stages: int | None) -> None:
    left, right = pair()
    network = build(FULL)
    estimate = TorchPredictor(network).predict(left, right, stages)
    with torch.inference_mode():
        inputs = [torch.from_numpy(prepared(image, 32)) for image in (left, right)]
        stage = network(*inputs)[(stages or 3) - 1]
        factor = {1: 16, 2: 8, 3: 4}[stages or 3]
        disparity = F.interpolate(stage.best, scale_factor=factor, mode="bilinear")
        scores = F.interpolate(stage.scores, scale_factor=factor, mode="bilinear")
    assert estimate.stage == (stages or 3)
    assert estimate.disparity.shape == (HEIGHT, WIDTH)
    expected = disparity[0, 0, :HEIGHT, :WIDTH].numpy()
    np.testing.assert_allclose(estimate.disparity, expected, rtol=1e-4)
    assert estimate.semantic is not None
    assert estimate.semantic.dtype == np.uint8
    labels = scores.argmax(1)[0, :HEIGHT, :WIDTH].numpy()
    assert (estimate.semantic == labels).mean() > 0.999
    assert estimate.seconds > 0


def test_anynet_comes_at_full_size() -> None:
    left, right = pair()
    network = build(Arch(family="anynet", c=1))
    estimate = TorchPredictor(network).predict(left, right)
    with torch.inference_mode():
        inputs = [torch.from_numpy(prepared(image, 16)) for image in (left, right)]
        expected = network(*inputs)[-1].disparity[0, 0, :HEIGHT, :WIDTH].numpy()
    np.testing.assert_allclose(estimate.disparity, expected, rtol=1e-4)
    assert estimate.semantic is None


def test_every_stage_is_what_stopping_there_gives() -> None:
    predictor = TorchPredictor(build(FULL))
    left, right = pair()
    shown = predictor.predict_stages(left, right)
    assert [estimate.stage for estimate in shown] == [1, 2, 3]
    for estimate in shown:
        alone = predictor.predict(left, right, estimate.stage)
        np.testing.assert_allclose(estimate.disparity, alone.disparity, rtol=1e-5)
    assert len(predictor.predict_stages(left, right, 2)) == 2


@pytest.mark.parametrize("stages", [0, 4, -1])
def test_stages_that_there_are_not(stages: int) -> None:
    with pytest.raises(UsageError, match="stages must be 1 to 3"):
        TorchPredictor(build(FULL)).predict(*pair(), stages)


def test_checkpoint_opens_by_its_content(tmp_path: Path) -> None:
    network = build(FULL)
    save(network, tmp_path / "model.bin", "a test")
    predictor = open_model(tmp_path / "model.bin")
    assert predictor.arch == FULL
    assert predictor.origin == "a test"
    expected = TorchPredictor(network).predict(*pair()).disparity
    np.testing.assert_array_equal(predictor.predict(*pair()).disparity, expected)


def test_released_checkpoint_opens(real_data: Path) -> None:
    predictor = open_model(real_data / "anynet_official" / "kitti2015.tar")
    assert predictor.arch == load(real_data / "anynet_official" / "kitti2015.tar")[0].arch
    assert predictor.predict(*pair()).disparity.shape == (HEIGHT, WIDTH)


def test_graph_gets_prepared_images_and_is_cut_back(tmp_path: Path) -> None:
    left, right = pair()
    estimate = open_model(graph(tmp_path / "m.onnx", outputs=2)).predict(left, right)
    std = np.array([0.229, 0.224, 0.225])
    expected = ((left.astype(float) - right) / 255 / std).sum(axis=-1)
    np.testing.assert_allclose(estimate.disparity, expected, atol=1e-4)
    assert estimate.semantic is not None
    positive = expected > 1
    np.testing.assert_array_equal(
        estimate.semantic[positive], estimate.disparity[positive].astype(np.uint8)
    )
    assert estimate.stage is None


def test_graph_without_semantics(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    predictor = open_model(graph(tmp_path / "m.onnx"))
    assert (predictor.arch, predictor.origin) == (None, None)
    (estimate,) = predictor.predict_stages(*pair())
    assert estimate.semantic is None
    assert capfd.readouterr().err == "", "the runtime keeps its remark on the unused tensor"


def test_exported_graph_says_what_the_checkpoint_says(tmp_path: Path) -> None:
    from rts2.model.export import export

    network = build(FULL)
    export(network, tmp_path / "m.onnx", (WIDTH, HEIGHT), "a test", stages=2)
    predictor = open_model(tmp_path / "m.onnx")
    assert predictor.arch == FULL.up_to(2)
    assert predictor.origin == "a test"
    found = predictor.predict(*pair(), 2)
    expected = TorchPredictor(network).predict(*pair(), 2)
    assert found.stage == expected.stage == 2
    np.testing.assert_allclose(found.disparity, expected.disparity, atol=1e-3)
    assert found.semantic is not None
    assert (found.semantic == expected.semantic).mean() > 0.999
    with pytest.raises(UsageError, match="always runs 2 stages, not 3"):
        predictor.predict(*pair(), 3)


def test_a_bundle_opens_as_its_graph(tmp_path: Path) -> None:
    path = graph(tmp_path / "model.onnx")
    described = {"name": path.name, "sha256": sha256(path)}
    known = {"schema": "rts2.deployment/1", "files": [described]}
    (tmp_path / "deployment.json").write_text(json.dumps(known))
    expected = open_model(path).predict(*pair()).disparity
    assert np.array_equal(open_model(tmp_path).predict(*pair()).disparity, expected)


def test_nameless_graph_has_no_stages_to_choose(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="its own number of stages, not 1"):
        open_model(graph(tmp_path / "m.onnx")).predict(*pair(), 1)


def test_graph_of_another_size_names_both(tmp_path: Path) -> None:
    predictor = open_model(graph(tmp_path / "m.onnx"))
    with pytest.raises(
        UsageError, match=r"pad to 96x64, and 97x50 pads to 128x64; export .* 97x50"
    ):
        predictor.predict(*pair(50, 97))


@pytest.mark.parametrize(
    "changes",
    [
        {"inputs": ("left", "rechts")},
        {"inputs": ("left", "right", "more")},
        {"shape": (1, 3, "height", 96)},
        {"shape": (2, 3, 64, 96)},
    ],
    ids=["names", "more", "dynamic", "batch"],
)
def test_graph_with_other_inputs_is_refused(tmp_path: Path, changes: dict[str, object]) -> None:
    names = changes.get("inputs", ("left", "right"))
    path = graph(tmp_path / "m.onnx", **changes)  # type: ignore[arg-type]
    with pytest.raises(Rts2Error, match="must take the inputs left and right") as caught:
        OnnxPredictor(path)
    assert isinstance(names, tuple)
    assert all(name in str(caught.value).split("it takes")[1] for name in names)


def test_graph_with_other_outputs_is_refused(tmp_path: Path) -> None:
    path = graph(tmp_path / "m.onnx")
    model = onnx.load(path)
    model.graph.output[0].name = model.graph.node[1].output[0] = "depth"
    onnx.save(model, path)
    with pytest.raises(Rts2Error, match=r"must give the outputs disparity.* it gives depth"):
        OnnxPredictor(path)


def test_header_that_is_none_is_refused(tmp_path: Path) -> None:
    path = graph(tmp_path / "m.onnx")
    model = onnx.load(path)
    helper.set_model_props(model, {"rts2": '{"arch": {"c": 1000}}'})
    onnx.save(model, path)
    with pytest.raises(Rts2Error, match="the header of"):
        OnnxPredictor(path)


@pytest.mark.parametrize("kept", [0, 40, 200])
def test_corrupt_graph_is_one_line(
    tmp_path: Path, kept: int, capfd: pytest.CaptureFixture[str]
) -> None:
    path = graph(tmp_path / "m.onnx")
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(Rts2Error, match=r"m\.onnx"):
        open_model(path)
    assert capfd.readouterr() == ("", ""), "the runtime itself stays quiet"


def test_missing_model_is_wrong_use(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="a checkpoint or an ONNX file"):
        open_model(tmp_path / "none.onnx")
