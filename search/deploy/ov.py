"""OpenVINO on a CPU: the graph with explicit hints, and in half precision its own format."""

from __future__ import annotations

from ...model.errors import Rts2Error
from .layers import FLOAT, halved
from .schema import OpenVinoExecution
from .target import Made, Order, Target, Tolerance

NOTES = """Left alone, OpenVINO computes in bf16 wherever the processor can, and takes another
precision without a word where the processor lacks the one that it was told: set the properties of
`execution` in `deployment.json`, and ask the compiled model what it took, as `verify.py` does."""


def make(order: Order) -> Made:
    """Writes OpenVINO's own format for half precision; fp32 runs the graph itself."""
    from ...profiles.runtimes.ov import HINTS, IR, missing
    from ...quant.fp16 import kept_float
    from ...quant.intermediate import to_ir
    from ...quant.source import opened

    machine = order.profile.machine
    properties: dict[str, str | int] = {
        "INFERENCE_PRECISION_HINT": HINTS[order.precision],
        "INFERENCE_NUM_THREADS": 0 if machine is None else machine.threads,
        "NUM_STREAMS": 1,
        "PERFORMANCE_HINT": "LATENCY",
    }
    if order.precision == "fp32":
        return Made(OpenVinoExecution(file=order.graph.name, properties=properties), FLOAT)
    reason = missing()
    if reason is not None:
        raise Rts2Error(f"a bundle in {order.precision} holds OpenVINO's own format: {reason}")
    path = order.graph.with_suffix(IR)
    to_ir(order.graph, path)
    kept = kept_float(opened(order.graph)[0])
    execution = OpenVinoExecution(file=path.name, properties=properties)
    return Made(execution, halved(order.precision, kept))


TARGET = Target(
    title="OpenVINO",
    tolerances={
        "fp32": Tolerance(0.01, 0.1, 0.999),
        "bf16": Tolerance(1.0, 10.0, 0.9),
        "fp16": Tolerance(0.1, 1.0, 0.99),
    },
    make=make,
    next_step="python3 verify.py",
    notes=NOTES,
)
