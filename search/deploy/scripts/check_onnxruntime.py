"""Checks this bundle on this machine: hashes, disparity, frame rate. Needs numpy, onnxruntime."""

import hashlib
import json
import os
import statistics
import sys
import time

import numpy as np
import onnxruntime

FOLDER = os.path.dirname(os.path.abspath(__file__))


def path(name):
    return os.path.join(FOLDER, name)


def main():
    with open(path("deployment.json"), encoding="utf-8") as handle:
        deployment = json.load(handle)
    for entry in deployment["files"]:
        with open(path(entry["name"]), "rb") as handle:
            if hashlib.sha256(handle.read()).hexdigest() != entry["sha256"]:
                sys.exit("{} has changed since it was written".format(entry["name"]))
    shape = deployment["input"]["shape"]
    inputs = {
        side: np.fromfile(path("sample_{}.bin".format(side)), "<f4").reshape(shape)
        for side in ("left", "right")
    }
    session = onnxruntime.InferenceSession(path("model.onnx"), providers=["CPUExecutionProvider"])
    found = session.run(["disparity"], inputs)[0]
    wanted = np.fromfile(path("sample_disparity.bin"), "<f4").reshape(found.shape)
    error = float(np.abs(found - wanted).mean())
    times = []
    started = time.perf_counter()
    while len(times) < 10 or time.perf_counter() - started < 2:
        before = time.perf_counter()
        session.run(None, inputs)
        times.append(time.perf_counter() - before)
    print("onnxruntime {}".format(onnxruntime.__version__))
    print("disparity differs by {:.2g} px on average".format(error))
    print("measured  {:.1f} FPS".format(1 / statistics.median(times)))
    expected = deployment["expected"]
    if expected:
        text = "expected  {fps:.1f} FPS ({fps_low:.1f} to {fps_high:.1f})"
        print(text.format(**expected))
    allowed = deployment["check"]["tolerance_px"]
    if not error <= allowed:
        sys.exit("FAILED: {:.2g} px are allowed".format(allowed))
    print("ok")


if __name__ == "__main__":
    main()
