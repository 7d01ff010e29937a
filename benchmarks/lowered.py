"""What int8 and bf16 cost in accuracy: the networks in the box, each stage count and variant.

    python benchmarks/lowered.py [--json] [--out FILE] [--frames N]

Judged on generated scenes that no training has seen. int8 is calibrated on others, and has the
usual layers in integers; bf16 goes through OpenVINO, where that is installed and the processor has
it. So does int8 a second time, with bf16 in between: the worse of both counts. `--out` writes the
table from which a search takes the accuracy of lower precisions.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
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
from rts2.model.graph import save_graph
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
from rts2.search.accuracy import LOWER_IS_BETTER, METRICS, Metric

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
        made = _Made(name, arch, pairs, Path(folder))
        plain, lowered = made.graphs("onnxruntime")
        others = {"int8": [OnnxPredictor(lowered)]}
        if half:
            graph, integral = made.graphs("openvino")
            others["int8"].append(_compiled(integral, "int8"))
            others["bf16"] = [_compiled(graph, "bf16")]
        for precision, predictors in others.items():
            found = [measure(OnnxPredictor(plain), other, frames) for other in predictors]
            told = [change(each.reference, each.other) for each in found]
            yield {
                "arch": arch.model_dump(mode="json"),
                "precision": precision,
                **{metric: worst(metric, [each[metric] for each in told]) for metric in METRICS},
            }


@dataclass(frozen=True)
class _Made:
    """One network's graphs."""

    name: str
    arch: Arch
    pairs: Sequence[Sample]
    folder: Path

    def graphs(self, runtime: str) -> tuple[Path, Path]:
        """In float, and with its usual layers in integers."""
        path = self.folder / f"{runtime}.onnx"
        network, header = load(named_model(self.name))
        forms = ("banded",) * self.arch.stages
        part = cut(network, self.arch)
        export(part, path, SIZE, header.origin, forms=forms, runtime=runtime)
        model, told = opened(path)
        known = calibrate(model, told, self.pairs, path.with_suffix(".npz"))
        lowered = path.with_name(f"{runtime}-int8.onnx")
        made = integers(model, usual(model), known.ranges("percentile"))
        save_graph(made, told.model_copy(update={"precision": "int8"}), lowered)
        return path, lowered


def _compiled(graph: Path, precision: Precision) -> OpenVinoPredictor:
    return OpenVinoPredictor(graph, to_ir(graph), precision, cores())


def change(before: Score, after: Score) -> dict[str, float | None]:
    """By how much each metric changed."""
    pairs = {metric: (getattr(before, metric), getattr(after, metric)) for metric in METRICS}
    return {
        metric: None if None in pair else round(pair[1] - pair[0], 4)
        for metric, pair in pairs.items()
    }


def worst(metric: Metric, changes: Sequence[float | None]) -> float | None:
    """The one that costs most."""
    known = [each for each in changes if each is not None]
    return (max if LOWER_IS_BETTER[metric] else min)(known, default=None)


def lowered(half: bool) -> str:
    """What was judged, in words."""
    runtimes = "the worse of ONNX Runtime and OpenVINO" if half else "ONNX Runtime"
    integers = f"int8 (usual layers, percentile, {PAIRS} pairs; {runtimes})"
    return f"{integers} and bf16 (OpenVINO)" if half else integers


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
                    told = "  ".join(f"{metric} {found[metric]}" for metric in METRICS)
                    print(f"{arch.label():32} {found['precision']}  {told}", flush=True)
    table = {
        "schema": "rts2.lowered/1",
        "protocol": (
            f"the networks in the box, cut to each stage count and variant, on {len(frames)} "
            f"generated scenes of {SIZE[0]}x{SIZE[1]} kept for judging, in {lowered(half)} against "
            f"fp32 (ONNX Runtime); {processor()}, {date.today().isoformat()}"
        ),
        "rows": rows,
    }
    if options.out:
        options.out.write_text(json.dumps(table, indent=1) + "\n")
    if options.json:
        json.dump(table, sys.stdout)


if __name__ == "__main__":
    main()
