"""ONNX Runtime on a CPU: the graph as it stands, and the options that it was timed with.

No optimized graph is delivered. ONNX Runtime lays channels out in blocks of what the processor at
hand has, and its fused operators are its version's own: such a file may not load elsewhere, or run
slower there. verify.py writes one on the device where it is asked to.
"""

from __future__ import annotations

from .layers import FLOAT, of_integers
from .schema import OrtExecution
from .target import Made, Order, Target, Tolerance

OPTIMIZED = "optimized.onnx"

NOTES = f"""`python3 verify.py --save-optimized` writes `{OPTIMIZED}`, the graph as ONNX Runtime
optimizes it here, which opens faster. It belongs to this processor and this version of ONNX
Runtime, so it is made on the device, and must be made again where one of them changes."""


def make(order: Order) -> Made:
    """Lowers the graph to integers where they were asked for."""
    machine = order.profile.machine
    execution = OrtExecution(intra_op_threads=0 if machine is None else machine.threads)
    if order.precision == "fp32":
        return Made(execution, FLOAT)
    from .integers import lower

    lowered = lower(order.graph)
    layers = of_integers(lowered.layers, lowered.left, "fp32")
    return Made(execution, layers, lowered.calibration)


TARGET = Target(
    title="ONNX Runtime",
    tolerances={"fp32": Tolerance(0.01, 0.1, 0.999), "int8": Tolerance(0.5, 5.0, 0.95)},
    make=make,
    next_step="python3 verify.py",
    leaves=(OPTIMIZED,),
    notes=NOTES,
)
"""Integers are held against ONNX Runtime's own answer; processors without their instructions round
differently."""
