"""Runs the sample pair in OpenVINO on the CPU. Needs numpy and openvino."""

import os
import sys
import time

import numpy as np

try:
    import openvino
except ImportError:
    sys.exit("openvino is missing: python3 -m pip install openvino brings it")

HINTS = {"fp32": "f32", "bf16": "bf16", "fp16": "f16"}


def sample(folder, deployment):
    """The runtime's name, the disparity as a flat list, and the latency of each run in ms."""
    names, files = deployment["input"]["names"], deployment["check"]["inputs"]
    inputs = {
        name: np.fromfile(os.path.join(folder, file), "<f4").reshape(deployment["input"]["shape"])
        for name, file in zip(names, files)
    }
    # Left alone, OpenVINO computes in bf16 wherever the processor can.
    wanted = HINTS[deployment["precision"]]
    settings = {
        "INFERENCE_PRECISION_HINT": wanted,
        "PERFORMANCE_HINT": "LATENCY",
        "NUM_STREAMS": 1,
    }
    path = os.path.join(folder, "model.onnx")
    compiled = openvino.Core().compile_model(path, "CPU", settings)
    taken = compiled.get_property("INFERENCE_PRECISION_HINT").get_type_name()
    if taken != wanted:
        sys.exit("OpenVINO computes in {} on this processor, not in {}".format(taken, wanted))
    request = compiled.create_infer_request()
    for name, values in inputs.items():
        request.set_tensor(name, openvino.Tensor(values))
    request.infer()
    found = request.get_tensor("disparity").data.copy()
    latencies_ms = []
    started = time.perf_counter()
    while len(latencies_ms) < 10 or time.perf_counter() - started < 2:
        before = time.perf_counter()
        request.infer()
        latencies_ms.append(1000 * (time.perf_counter() - before))
    version = openvino.__version__.partition("-")[0]
    return "openvino {}, {}".format(version, taken), found.ravel().tolist(), latencies_ms
