"""OpenVINO on a CPU: the graph with explicit hints, and below fp32 its own format."""

from __future__ import annotations

from ...model.arch import Precision
from ...model.errors import Rts2Error
from ...profiles.profile import Profile
from .layers import FLOAT, halved, of_integers, precise
from .schema import OpenVinoExecution
from .target import Made, Order, Target, Tolerance

NOTES = """Left alone, OpenVINO computes in bf16 wherever the processor can, and takes another
precision without a word where the processor lacks the one that it was told: set the properties of
`execution` in `deployment.json`, and ask the compiled model what it took, as `verify.py` does."""


def make(order: Order) -> Made:
    """Writes OpenVINO's own format for lower precisions; fp32 runs the graph itself."""
    from ...profiles.runtimes.ov import HINTS, missing
    from ...quant.fp16 import kept_float
    from ...quant.intermediate import to_ir
    from ...quant.source import opened
    from .integers import lower

    machine, precision = order.profile.machine, order.precision
    floats = between_integers(order.profile) if precision == "int8" else precision
    properties: dict[str, str | int] = {
        "INFERENCE_PRECISION_HINT": HINTS[floats],
        "INFERENCE_NUM_THREADS": 0 if machine is None else machine.threads,
        "NUM_STREAMS": 1,
        "PERFORMANCE_HINT": "LATENCY",
    }
    if precision == "fp32":
        return Made(OpenVinoExecution(file=order.graph.name, properties=properties), FLOAT)
    reason = missing()
    if reason is not None:
        raise Rts2Error(f"a bundle in {precision} holds OpenVINO's own format: {reason}")
    lowered = lower(order.graph) if precision == "int8" else None
    execution = OpenVinoExecution(file=to_ir(order.graph).name, properties=properties)
    kept = kept_float(opened(order.graph)[0]) if floats != "fp32" else ()
    if lowered is None:
        return Made(execution, halved(floats, kept))
    layers = of_integers(lowered.layers, lowered.left, floats)
    return Made(execution, (*layers, *precise(kept)), lowered.calibration)


def between_integers(profile: Profile) -> Precision:
    """The precision of float operators in a graph of integers: bf16 where the device was timed so,
    as `rts2.profiles.runtimes.ov.hint` has it.
    """
    timed = {known.precision for known in profile.calibrations if known.runtime == "openvino"}
    return "bf16" if "bf16" in timed else "fp32"


TARGET = Target(
    title="OpenVINO",
    tolerances={
        "fp32": Tolerance(0.01, 0.1, 0.999),
        "bf16": Tolerance(0.5, 5.0, 0.95),
        "fp16": Tolerance(0.1, 1.0, 0.99),
        "int8": Tolerance(0.5, 5.0, 0.95),
    },
    make=make,
    next_step="python3 verify.py",
    notes=NOTES,
)
