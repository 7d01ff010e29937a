"""Checks this bundle on this device: hashes, disparity, frame rate. Needs Python 3.6 or newer."""

import hashlib
import json
import os
import statistics
import struct
import sys

FOLDER = os.path.dirname(os.path.abspath(__file__))


def read(name):
    try:
        with open(os.path.join(FOLDER, name), "rb") as handle:
            return handle.read()
    except FileNotFoundError:
        sys.exit("{} is missing".format(name))


def main():
    deployment = json.loads(read("deployment.json").decode("utf-8"))
    for entry in deployment["files"]:
        if hashlib.sha256(read(entry["name"])).hexdigest() != entry["sha256"]:
            sys.exit("{} has changed since it was written".format(entry["name"]))
    import measured  # it is one of the files just checked

    runtime, found, latencies_ms = measured.sample(FOLDER, deployment)
    data = read(deployment["check"]["disparity"])
    wanted = struct.unpack("<{}f".format(len(data) // 4), data)
    if len(found) != len(wanted):
        sys.exit("FAILED: the disparity has {} pixels, not {}".format(len(found), len(wanted)))
    error = sum(abs(a - b) for a, b in zip(found, wanted)) / len(wanted)
    allowed = deployment["check"]["tolerance_px"]
    print("runtime   {}".format(runtime))
    print("disparity {:.2g} px off on average, {:.2g} allowed".format(error, allowed))
    print("measured  {:.1f} FPS".format(1000 / statistics.median(latencies_ms)))
    if deployment["expected"]:
        text = "expected  {fps:.1f} FPS ({fps_low:.1f} to {fps_high:.1f}) on {runtime}"
        print(text.format(**deployment["expected"]))
    if not error <= allowed:
        sys.exit("FAILED: the disparity is too far off")
    print("ok")


if __name__ == "__main__":
    main()
