"""What int8 and bf16 cost in accuracy: the networks in the box, each stage count and variant.

    python benchmarks/lowered.py [--json] [--out FILE] [--frames N]

Judged on generated scenes that no training has seen. int8 is calibrated on others, and has the
usual layers in integers; bf16 goes through OpenVINO, where that is installed and the processor has
it. `--out` writes the table from which a search takes the accuracy of lower precisions.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from datetime import date
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rts2.model.arch import Arch, Precision
from rts2.model.box import named_model, names
from rts2.model.checkpoint import cut, load
from rts2.model.data.catalog import open_dataset
from rts2.model.data.scene import Sample, Scene
from rts2.model.export import export
from rts2.model.machine import cores, processor
from rts2.model.metrics import Score
from rts2.model.predictor import OnnxPredictor
from rts2.model.qdq import integers, usual
from rts2.profiles.runtimes import available, precisions
from rts2.quant.calibration import calibrate
from rts2.quant.half import OpenVinoPredictor
from rts2.quant.intermediate import to_ir
from rts2.quant.parity import measure
from rts2.quant.source import opened

SIZE = (1242, 375)
PAIRS = 16
VARIANTS = ((False, False), (True, False), (True, True))


def archs(whole: Arch) -> Iterator[Arch]:
    """Everything that can be cut out of a network."""
    for stages in range(1, whole.stages + 1):
        for semantic, refinement in VARIANTS:
            told = {"semantic": semantic, "refinement": refinement}
            yield whole.up_to(stages).model_copy(update=told)


def changes(
    name: str, arch: Arch, frames: Sequence[Scene], pairs: Sequence[Sample], half: bool
) -> Iterator[dict[str, Any]]:
    """One row a precision."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "float.onnx"
        network, header = load(named_model(name))
        forms = ("banded",) * arch.stages
        export(cut(network, arch), path, SIZE, header.origin, forms=forms)
        model, told = opened(path)
        known = calibrate(model, told, pairs, Path(folder) / "calibration.npz")
        made = integers(model, usual(model), known.ranges("percentile"))
        others = {"int8": OnnxPredictor.of(made)}
        if half:
            to_ir(path, path.with_suffix(".xml"))
            others["bf16"] = OpenVinoPredictor(path, path.with_suffix(".xml"), "bf16", cores())
        for precision, other in others.items():
            found = measure(OnnxPredictor(path), other, frames)
            yield row(arch, precision, found.reference, found.other)


def row(arch: Arch, precision: Precision | str, before: Score, after: Score) -> dict[str, Any]:
    """By how much each metric changed."""
    told: dict[str, Any] = {"arch": arch.model_dump(mode="json"), "precision": precision}
    for metric in ("d1_all", "epe", "miou", "pacc"):
        pair = getattr(before, metric), getattr(after, metric)
        told[metric] = None if None in pair else round(pair[1] - pair[0], 4)
    return told


def main() -> None:
    """Prints a row a network, or writes them."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--frames", type=int, default=10)
    options = parser.parse_args()
    half = "openvino" in available() and "bf16" in precisions("openvino")
    frames = [s.read() for s in open_dataset("streets", count=options.frames, size=SIZE)]
    pairs = open_dataset("streets", split="train", count=PAIRS, size=SIZE)
    rows = []
    for name in names():
        for arch in archs(load(named_model(name))[0].arch):
            for found in changes(name, arch, frames, pairs, half):
                rows.append(found)
                if not options.json:
                    told = "  ".join(f"{k} {found[k]}" for k in ("d1_all", "epe", "miou", "pacc"))
                    print(f"{arch.label():32} {found['precision']}  {told}", flush=True)
    table = {
        "schema": "rts2.lowered/1",
        "protocol": (
            f"the networks in the box, cut to each stage count and variant, on {len(frames)} "
            f"generated scenes of {SIZE[0]}x{SIZE[1]} kept for judging, in int8 (ONNX Runtime, "
            f"usual layers, percentile, {PAIRS} pairs) and bf16 (OpenVINO) against fp32 (ONNX "
            f"Runtime); {processor()}, {date.today().isoformat()}"
        ),
        "rows": rows,
    }
    if options.out:
        options.out.write_text(json.dumps(table, indent=1) + "\n")
    if options.json:
        json.dump(table, sys.stdout)


if __name__ == "__main__":
    main()
