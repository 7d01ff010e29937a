"""Checks what build.sh ran on this device: hashes, disparity, frame rate. Needs Python 3.6."""

import hashlib
import json
import os
import statistics
import struct
import sys

FOLDER = os.path.dirname(os.path.abspath(__file__))


def path(name):
    return os.path.join(FOLDER, name)


def load(name):
    try:
        with open(path(name), encoding="utf-8") as handle:
            return json.load(handle)
    except FileNotFoundError:
        sys.exit("{} is missing: run build.sh first".format(name))


def main():
    deployment = load("deployment.json")
    for entry in deployment["files"]:
        with open(path(entry["name"]), "rb") as handle:
            if hashlib.sha256(handle.read()).hexdigest() != entry["sha256"]:
                sys.exit("{} has changed since it was written".format(entry["name"]))
    outputs = {output["name"]: output["values"] for output in load("output.json")}
    if "disparity" not in outputs:
        sys.exit("output.json has no disparity, only {}".format(", ".join(sorted(outputs))))
    found = outputs["disparity"]
    with open(path("sample_disparity.bin"), "rb") as handle:
        data = handle.read()
    wanted = struct.unpack("<{}f".format(len(data) // 4), data)
    if len(found) != len(wanted):
        sys.exit("the disparity has {} pixels, not {}".format(len(found), len(wanted)))
    error = sum(abs(a - b) for a, b in zip(found, wanted)) / len(wanted)
    times = [entry["computeMs"] for entry in load("times.json")]
    print("disparity differs by {:.2g} px on average".format(error))
    print("measured  {:.1f} FPS".format(1000 / statistics.median(times)))
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
