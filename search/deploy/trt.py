"""TensorRT: a graph that the oldest importer takes, and a script that builds the engine there."""

from __future__ import annotations

from collections.abc import Sequence
from shlex import quote
from typing import TYPE_CHECKING

from ...model.arch import Precision
from ...model.errors import UsageError
from ...model.files import write_bytes
from ...profiles.opset import refuse_operators
from ...profiles.profile import Profile, RuntimeSupport
from ...profiles.trtexec import (
    LAYER_INFO,
    LOCATE,
    PATH,
    Generation,
    build_flags,
    generation,
    keeps_layers,
    rest,
    stored,
)
from .layers import FLOAT, OTHERS, halved, of_integers, precise
from .schema import LayerPrecision, TensorRtExecution
from .target import NOT_CALIBRATED, Made, Order, Target, Tolerance

if TYPE_CHECKING:
    from ...quant.fp16 import Kept
    from .integers import Lowered

SCRIPT = "build.sh"
TIMING_CACHE = "timing.cache"

RUN = ("--warmUp=500", "--duration=5", "--iterations=50")
"""How a pair is timed; all versions take it."""

UNTOLD = (
    "half precision was asked for; TensorRT {} lets no single layer stay fp32 and takes what is "
    "fastest: verify.py holds the disparity"
)

NOTES = """`build.sh` makes an engine for this very board and this version of TensorRT, and
`layers.json` tells the precision of each of its layers. `timing.cache` makes a later build fast.
Launching the network as a CUDA graph can make it faster than what is expected here."""


def make(order: Order) -> Made:
    """Lowers the graph as far as the version of TensorRT wants it so, and writes the script."""
    from ...model.graph import save_graph
    from ...quant.fp16 import kept_float, to_fp16
    from ...quant.source import opened
    from .integers import lower

    version = generation_of(order.profile, order.support, order.generation)
    model, header = opened(order.graph)
    kept = kept_float(model) if order.precision != "fp32" else []
    graph = stored(version, order.precision)
    lowered = None
    if graph == "int8":
        lowered = lower(order.graph, symmetric=True)
    elif graph == "fp16":
        save_graph(to_fp16(model), header.model_copy(update={"precision": "fp16"}), order.graph)
    refuse_operators(order.graph, order.support)
    flags = build_flags(version, order.precision, graph, [layer for layer, _ in kept])
    common = (f"--timingCacheFile={TIMING_CACHE}", *LAYER_INFO)
    execution = TensorRtExecution(
        generation=version, program=PATH, build=(*flags, *common), run=RUN
    )
    script = order.folder / SCRIPT
    write_bytes(script, _script(order, execution).encode())
    script.chmod(0o755)
    calibration = NOT_CALIBRATED if lowered is None else lowered.calibration
    return Made(execution, _layers(version, order.precision, kept, lowered), calibration)


def generation_of(
    profile: Profile, support: RuntimeSupport, asked: Generation | None
) -> Generation:
    """The generation that was asked for, else the device's usual one.

    Raises `UsageError` for one that the device does not have.
    """
    known = support.generations or (generation(support.version),)
    if asked is None:
        return known[0]
    if asked not in known:
        raise UsageError(
            f"{profile.title} runs TensorRT {' or '.join(known)}, not {asked}; "
            "leave --tensorrt out, or correct the profile's runtimes"
        )
    return asked


def _layers(
    version: Generation, precision: Precision, kept: Sequence[Kept], lowered: Lowered | None
) -> tuple[LayerPrecision, ...]:
    told = keeps_layers(version)
    if lowered is not None:
        rows = of_integers(lowered.layers, lowered.left, rest(version))
        return (*rows, *precise(kept)) if told else rows
    if precision == "fp32":
        return FLOAT
    if told or stored(version, precision) == precision:
        return halved(precision, kept)
    return (LayerPrecision(layer=OTHERS, precision=precision, reason=UNTOLD.format(version)),)


def _script(order: Order, execution: TensorRtExecution) -> str:
    """One `trtexec` call that builds; verify.py makes those that run."""
    flags = [f"--onnx={order.graph.name}", f"--saveEngine={execution.file}", *execution.build]
    placed = ""
    if order.plan_to is not None:
        place = order.plan_to.rpartition("/")[0]
        placed = f"mkdir -p {quote(place)}\ncp {execution.file} {quote(order.plan_to)}\n"
    lines = " \\\n    ".join(map(quote, flags))
    return f"""#!/bin/sh
# Builds the engine for {order.profile.title} with TensorRT {execution.generation}, then checks it.
# Run it on the device, at the power mode and clocks that you will use (on a Jetson: nvpmodel -q,
# jetson_clocks --show).
set -eu
cd "$(dirname "$0")"

{LOCATE}
"$TRTEXEC" {lines}
{placed}TRTEXEC="$TRTEXEC" exec python3 verify.py
"""


TARGET = Target(
    title="TensorRT",
    tolerances={
        "fp32": Tolerance(0.1, 1.0, 0.99),
        "fp16": Tolerance(0.1, 1.0, 0.99),
        "int8": Tolerance(0.5, 5.0, 0.95),
    },
    make=make,
    next_step=f"sh {SCRIPT}",
    leaves=("model.plan", TIMING_CACHE, "layers.json", "trtexec.log"),
    notes=NOTES,
)
"""Beside half precision, the tolerance of fp32 allows for TF32."""
