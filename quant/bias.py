"""Bias correction: rounded weights shift the mean of a convolution, its bias takes it back.

With weights W rounded to Ŵ the mean of output o moves by Σ (Ŵ − W)[o, i, …] · E[x_i] over the
inputs i and the places of the kernel, as far as the mean of a channel is the same all over the map;
that is subtracted from the bias (Nagel et al. 2019, section 4.2, with E[x] as the calibration saw
it).
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import numpy_helper

from .calibration import Calibration

LARGEST = 127
"""Of a weight in 8 bits, symmetric."""


def corrected(
    model: onnx.ModelProto, chosen: Collection[str], known: Calibration
) -> onnx.ModelProto:
    """A copy of the float graph whose chosen convolutions have biases for rounded weights.

    A convolution without a bias, or whose input has no known means, stays as it is.
    """
    made = onnx.ModelProto()
    made.CopyFrom(model)
    weights = {tensor.name: tensor for tensor in made.graph.initializer}
    for node in made.graph.node:
        if node.name not in chosen or len(node.input) < 3 or node.input[0] not in known.means:
            continue
        weight = numpy_helper.to_array(weights[node.input[1]]).astype(np.float64)
        shift = shift_of(weight, known.mean(node.input[0]))
        bias = weights[node.input[2]]
        values = numpy_helper.to_array(bias) - shift.astype(np.float32)
        bias.CopyFrom(numpy_helper.from_array(values, bias.name))
    return made


def shift_of(weight: NDArray[np.float64], mean: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far rounding moves each output's mean: (outputs, inputs, …), (inputs,) → (outputs,)."""
    error = (_rounded(weight) - weight).reshape(*weight.shape[:2], -1).sum(2)
    return np.asarray(error @ mean)


def _rounded(weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """The weights as 8 bits hold them, one scale an output channel."""
    largest = np.abs(weight).reshape(len(weight), -1).max(1)
    scale = np.where(largest > 0, largest / LARGEST, 1.0)
    scale = scale.reshape(-1, *[1] * (weight.ndim - 1))
    return np.asarray(np.rint(weight / scale) * scale)
