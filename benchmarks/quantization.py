"""What int8 and half precision win on this machine, each against fp32 in its own best form.

    python benchmarks/quantization.py [--json]

Ratios of latencies in one run, run by run in turn: the full network with c = 8 (the weights in the
box) and c = 32 (random ones), AnyNet with c = 1 (the released checkpoint where RTS2_DATA names a
folder that holds it, else random weights), and half precision through OpenVINO where it is
installed.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

from rts2.model.arch import UNTRAINED, Arch
from rts2.model.box import named_model
from rts2.model.checkpoint import build, save
from rts2.model.data.catalog import open_dataset
from rts2.model.machine import cores
from rts2.profiles.runtimes import available, precisions
from rts2.quant import half, ptq
from rts2.quant.budget import Budget
from rts2.quant.race import Duel
from rts2.quant.source import Asked, Source

ANY = Budget(100.0, 100.0)
PAIRS = 4
FRAMES = 2


def sources(folder: Path) -> Iterator[tuple[str, Source]]:
    """The networks, by name."""
    wide = folder / "c32.safetensors"
    save(build(Arch(c=32)), wide, UNTRAINED)
    anynet = Path(os.environ.get("RTS2_DATA", ".")) / "anynet_official" / "kitti2015.tar"
    if not anynet.is_file():
        anynet = folder / "anynet.safetensors"
        save(build(Arch(family="anynet", c=1, conv3d=(16, 4, 4))), anynet, UNTRAINED)
    for name, path in (("c8", named_model("c8")), ("c32", wide), ("anynet", anynet)):
        own = folder / name
        own.mkdir()
        yield name, Source(path, Asked(), own)


def integers(source: Source, folder: Path) -> Duel:
    """The whole choice of layers, and its duel with the float parent."""
    size = source.resolution
    setting = ptq.Setting(
        pairs=open_dataset("streets", split="train", count=PAIRS, size=size),
        frames=open_dataset("streets", count=FRAMES, size=size),
        budget=ANY,
        method="percentile",
        threads=cores(),
        cache=folder / "calibration.npz",
        folder=folder,
    )
    return ptq.quantize(source, setting).duel


def told(name: str, duel: Duel, seconds: float) -> tuple[str, float]:
    """A row of the table, and the ratio."""
    speedup = 1 / duel.ratio
    sure = "" if duel.timing.reliable else ", the machine was busy"
    times = f"{duel.parent_ms:8.1f} {duel.own_ms:8.1f} {speedup:6.2f}  ±{duel.timing.error:.1%}"
    return f"{name:26} {times}  {seconds:5.0f} s{sure}", round(speedup, 3)


def main() -> None:
    """Prints the table, or one JSON object of ratios."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    found: dict[str, float | None] = {}
    if not options.json:
        print(f"{'':26} {'fp32 ms':>8} {'ms':>8} {'ratio':>6}  error    took")
    with TemporaryDirectory() as folder:
        for name, source in sources(Path(folder)):
            started = perf_counter()
            duel = integers(source, Path(folder) / name)
            row, found[f"{name}_int8"] = told(f"{name} int8", duel, perf_counter() - started)
            if not options.json:
                print(row, flush=True)
            if name == "c8":
                found["c8_half"] = _half(source, options.json)
    if options.json:
        print(json.dumps(found))


def _half(source: Source, quiet: bool) -> float | None:
    """Half precision in OpenVINO over fp32 in ONNX Runtime; None where there is none."""
    able = precisions("openvino") if "openvino" in available() else ()
    precision = next((each for each in ("fp16", "bf16") if each in able), None)
    if precision is None:
        return None
    frames = open_dataset("streets", count=FRAMES, size=source.resolution)
    started = perf_counter()
    duel = half.quantize(source, precision, frames, ANY, cores()).duel
    row, speedup = told(f"c8 {precision} in OpenVINO", duel, perf_counter() - started)
    if not quiet:
        print(row, flush=True)
    return speedup


if __name__ == "__main__":
    main()
