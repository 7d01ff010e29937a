"""ONNX Runtime against PyTorch eager on this machine: the same weights, interleaved runs."""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

import torch

from rts2.model.arch import UNTRAINED, Arch
from rts2.model.checkpoint import build
from rts2.model.export import Deployed, export
from rts2.model.machine import cores
from rts2.profiles.runtimes.ort import Session
from rts2.profiles.timing import measure

RESOLUTION = (1242, 375)
NETWORKS = {
    "c8": Arch(c=8),
    "c32": Arch(c=32),
    "anynet": Arch(family="anynet", c=1),
}


def ratio(arch: Arch) -> tuple[float, float]:
    """Median ms in PyTorch eager and in ONNX Runtime, each the other's reference."""
    torch.manual_seed(0)
    network = build(arch)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "network.onnx"
        header = export(network, path, RESOLUTION, UNTRAINED)
        session = Session(path, cores())
    deployed = Deployed(network).eval()
    width, height = header.size
    pair = torch.rand(2, 1, 3, height, width)

    def eager() -> None:
        with torch.inference_mode():
            deployed(*pair)

    timing = measure(eager, session.run)
    return timing.median_ms, timing.reference_ms


def main() -> None:
    """Measures and prints the table, or its ratios as JSON."""
    torch.set_num_threads(cores())
    timed = {name: ratio(arch) for name, arch in NETWORKS.items()}
    if "--json" in sys.argv:
        print(json.dumps({f"{name}_ort_vs_eager": e / o for name, (e, o) in timed.items()}))
        return
    print(f"1248×384, fp32, {cores()} threads, median ms")
    print("  network       eager   ONNX Runtime   ratio")
    for name, (eager, ort) in timed.items():
        print(f"  {name:10} {eager:8.1f} {ort:14.1f} {eager / ort:6.2f} ×")


if __name__ == "__main__":
    main()
