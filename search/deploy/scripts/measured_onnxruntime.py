"""Runs the sample pair in ONNX Runtime. Needs numpy and onnxruntime."""

import os
import time

import numpy as np
import onnxruntime


def sample(folder, deployment):
    """The runtime's name, the disparity as a flat list, and the latency of each run in ms."""
    names, files = deployment["input"]["names"], deployment["check"]["inputs"]
    inputs = {
        name: np.fromfile(os.path.join(folder, file), "<f4").reshape(deployment["input"]["shape"])
        for name, file in zip(names, files)
    }
    path = os.path.join(folder, "model.onnx")
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    found = session.run(["disparity"], inputs)[0]
    latencies_ms = []
    started = time.perf_counter()
    while len(latencies_ms) < 10 or time.perf_counter() - started < 2:
        before = time.perf_counter()
        session.run(None, inputs)
        latencies_ms.append(1000 * (time.perf_counter() - before))
    return "onnxruntime " + onnxruntime.__version__, found.ravel().tolist(), latencies_ms
