"""ONNX Runtime against PyTorch eager on this machine: the same weights, interleaved runs."""

from __future__ import annotations

import json
import sys

import torch

from rts2.model.arch import Arch
from rts2.model.checkpoint import build
from rts2.model.machine import cores
from rts2.profiles.runtimes import Sized, open_session
from rts2.profiles.timing import Reference, Timing, measure

RESOLUTION = (1242, 375)
NETWORKS = {
    "c8": Arch(c=8),
    "c32": Arch(c=32),
    "anynet": Arch(family="anynet", c=1),
}


def timed(arch: Arch) -> Timing:
    """PyTorch eager, with ONNX Runtime as its reference."""
    torch.manual_seed(0)
    sized = Sized(build(arch), RESOLUTION)
    eager, ort = (
        open_session(runtime, sized, threads=cores()) for runtime in ("pytorch", "onnxruntime")
    )
    return measure(eager.run, Reference(ort.run))


def main() -> None:
    """Measures and prints the table, or its ratios as JSON."""
    found = {name: timed(arch) for name, arch in NETWORKS.items()}
    if "--json" in sys.argv:
        print(json.dumps({f"{name}_ort_vs_eager": each.ratio for name, each in found.items()}))
        return
    print(f"1248×384, fp32, {cores()} threads, median ms")
    print("  network       eager   ONNX Runtime   ratio")
    for name, each in found.items():
        mark = "" if each.reliable else "  unreliable"
        row = f"  {name:10} {each.median_ms:8.1f} {each.reference_ms:14.1f} {each.ratio:6.2f} ×"
        print(row + mark)


if __name__ == "__main__":
    main()
