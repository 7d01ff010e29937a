"""Reads what trtexec wrote when build.sh ran the sample pair. Needs Python 3.6, no packages."""

import json
import os
import sys


def sample(folder, _):
    """The runtime's name, the disparity as a flat list, and the latency of each run in ms."""
    outputs = {output["name"]: output["values"] for output in load(folder, "output.json")}
    if "disparity" not in outputs:
        sys.exit("output.json has no disparity, only {}".format(", ".join(sorted(outputs))))
    latencies_ms = [entry["computeMs"] for entry in load(folder, "times.json")]
    if not latencies_ms:
        sys.exit("times.json holds no run: run build.sh again")
    return "tensorrt", outputs["disparity"], latencies_ms


def load(folder, name):
    try:
        with open(os.path.join(folder, name), encoding="utf-8") as handle:
            return json.load(handle)
    except FileNotFoundError:
        sys.exit("{} is missing: run build.sh first".format(name))
