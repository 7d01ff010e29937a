"""Bias correction, against what rounding does to a convolution of constant maps."""

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from rts2.model.inference import open_session
from rts2.quant.bias import corrected, shift_of
from rts2.quant.calibration import Calibration, Histogram


def conv(weight: np.ndarray, bias: np.ndarray) -> onnx.ModelProto:
    image = helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, weight.shape[1], 8, 8])
    output = helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, weight.shape[0], 6, 6])
    node = helper.make_node("Conv", ["x", "w", "b"], ["y"], name="conv")
    weights = [numpy_helper.from_array(weight, "w"), numpy_helper.from_array(bias, "b")]
    graph = helper.make_graph([node], "one conv", [image], [output], weights)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)


def known(mean: np.ndarray) -> Calibration:
    return Calibration({"x": Histogram()}, {"x": 2 * mean}, ["pair 0", "pair 1"], [])


def rounded(weight: np.ndarray) -> np.ndarray:
    scale = np.abs(weight).max((1, 2, 3), keepdims=True) / 127
    return (np.rint(weight / scale) * scale).astype(np.float32)


def answer(model: onnx.ModelProto, image: np.ndarray) -> np.ndarray:
    (found,) = open_session("a test", model=model.SerializeToString()).run(None, {"x": image})
    assert isinstance(found, np.ndarray)
    return found


def test_constant_maps_come_out_as_without_rounding() -> None:
    chance = np.random.default_rng(0)
    weight = chance.standard_normal((4, 3, 3, 3)).astype(np.float32)
    bias = chance.standard_normal(4).astype(np.float32)
    mean = np.array([0.5, -2.0, 7.0])
    image = np.broadcast_to(mean.astype(np.float32).reshape(1, 3, 1, 1), (1, 3, 8, 8)).copy()
    made = corrected(conv(weight, bias), {"conv"}, known(mean))
    biases = numpy_helper.to_array(made.graph.initializer[1])
    wanted = answer(conv(weight, bias), image)
    plain, better = (answer(conv(rounded(weight), b), image) for b in (bias, biases))
    assert np.abs(plain - wanted).max() > 1e-3
    np.testing.assert_allclose(better, wanted, atol=1e-4)


def test_only_what_is_chosen_and_known_is_corrected() -> None:
    weight = np.random.default_rng(0).standard_normal((2, 3, 3, 3)).astype(np.float32)
    model = conv(weight, np.zeros(2, np.float32))
    unknown = Calibration({}, {}, ["pair 0"], [])
    for made in (corrected(model, set(), known(np.ones(3))), corrected(model, {"conv"}, unknown)):
        np.testing.assert_array_equal(numpy_helper.to_array(made.graph.initializer[1]), 0)


def test_weights_of_zero_shift_nothing() -> None:
    np.testing.assert_array_equal(shift_of(np.zeros((2, 3, 1, 1)), np.ones(3)), 0)
