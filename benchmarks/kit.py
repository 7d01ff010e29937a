"""What a field kit is worth: twelve networks timed here, and how far off unseen ones are then.

The whole path runs: kit, run.sh, collect.py, import. A stand-in for `trtexec` prints that
program's output, with times of ONNX Runtime on one thread of this CPU; the prior is what a data
sheet tells of any CPU with AVX-512.
"""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from rts2.model.ops import ops
from rts2.profiles.calibrate import summary
from rts2.profiles.conformal import half_width
from rts2.profiles.kit.fewshot import calibrated
from rts2.profiles.kit.folder import write
from rts2.profiles.kit.plan import NETWORKS, networks
from rts2.profiles.kit.results import Results, timings
from rts2.profiles.latency import LatencyModel, Steps, latencies_ms
from rts2.profiles.plan import random_candidate
from rts2.profiles.profile import (
    Calibration,
    Point,
    PrecisionSupport,
    Profile,
    RuntimeSupport,
)

BAR = 0.06
UNSEEN = 30
SECONDS = 2
STANDIN = Path(__file__).parents[1] / "tests" / "profiles" / "kit" / "standin.py"

PRIOR = LatencyModel(
    combine="sum",
    starts="steps",
    folded=("norm", "relu"),
    start_ms=0.01,
    ms_per={
        "gmac_2d_packed": 20.0,
        "gmac_product": 20.0,
        "gbyte": 100.0,
        "gbyte_repacked": 100.0,
        "gbyte_columns": 100.0,
        "gbyte_strided": 300.0,
        "gbyte_resize": 0.0,
        "gbyte_argmax": 0.0,
    },
)
"""50 multiply-adds a nanosecond (one unit of 16 lanes at 3 GHz), 10 bytes a nanosecond, a number
gathered by itself in about 4 cycles; what comes on top for resizing and for the best class, no data
sheet tells."""


def stranger() -> Profile:
    """A device of which only the data sheet is known."""
    told = "data sheet"
    return Profile(
        schema_="rts2.profile/1",
        name="this-cpu",
        title="This CPU",
        hardware=(),
        precisions=(PrecisionSupport(precision="fp32", supported=True, reason=told, source=told),),
        runtimes=(RuntimeSupport(runtime="tensorrt", version="8.2.1", opset=13, source=told),),
        calibrations=(
            Calibration(
                runtime="tensorrt", precision="fp32", model=PRIOR, residuals=(), source=told
            ),
        ),
        points=(),
    )


def timed(folder: Path, unseen: int) -> tuple[Point, ...]:
    """The kit's networks, then unseen ones, through its own scripts."""
    chance = random.Random(1_000_003)
    chosen = [*networks(PRIOR), *(random_candidate(chance) for _ in range(unseen))]
    kit = folder / "kit"
    write(stranger(), ("fp32",), kit, chosen)
    program = folder / "trtexec"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" "{STANDIN}" "$@"\n')
    program.chmod(0o755)
    given = os.environ | {"TRTEXEC": str(program), "DURATION": str(SECONDS), "KIT_SPREAD": "0.02"}
    subprocess.run(["sh", str(kit / "run.sh")], check=True, env=given, stdout=sys.stderr)
    subprocess.run([sys.executable, str(kit / "collect.py")], check=True, stdout=sys.stderr)
    results = Results.model_validate_json((kit / "kit-results.json").read_text())
    return timings(results, stranger()).points["fp32"]


def measured(unseen: int) -> dict[str, float]:
    """Errors of the frame rate of unseen networks: of the prior alone, and once a kit was run."""
    with tempfile.TemporaryDirectory() as folder:
        points = timed(Path(folder), unseen)
    known, fresh = points[:NETWORKS], points[NETWORKS:]
    found = calibrated(known, PRIOR, "this kit")
    steps = Steps.of([ops(point.arch, point.resolution) for point in fresh])
    true = np.array([point.latency_ms for point in fresh])
    before = np.log(true / latencies_ms(PRIOR, steps))
    after = np.log(true / latencies_ms(found.model, steps))
    width = half_width(found.residuals, 0.9)
    return {
        "held_out_mape": summary(after)["mape"],
        "held_out_max_ape": summary(after)["max_ape"],
        "held_out_within_10": summary(after)["within_10"],
        "left_one_out_mape": summary(found.residuals)["mape"],
        "prior_mape": summary(before)["mape"],
        "half_width_90": width,
        "coverage_90": float((np.abs(after) <= width).mean()),
    }


def main() -> None:
    """Measures and prints the table, or its fractions as JSON."""
    found = measured(UNSEEN)
    if "--json" in sys.argv:
        print(json.dumps(found))
        return
    print(f"{NETWORKS} networks timed, {UNSEEN} unseen ones predicted, one thread of this CPU")
    print(f"  mean error, data sheet alone     {found['prior_mape']:7.1%}")
    print(f"  mean error, each left out        {found['left_one_out_mape']:7.1%}")
    print(f"  mean error, unseen networks      {found['held_out_mape']:7.1%}   (bar: {BAR:.0%})")
    print(f"  worst error, unseen networks     {found['held_out_max_ape']:7.1%}")
    print(f"  90% interval                    ±{found['half_width_90']:7.1%}")
    print(f"  unseen networks inside it        {found['coverage_90']:7.1%}")


if __name__ == "__main__":
    main()
