"""Which layer is computed in what, and why: the rows of deployment.json."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final

from ...model.arch import Precision
from .schema import LayerPrecision

if TYPE_CHECKING:
    from ...quant.fp16 import Kept

OTHERS: Final = "*"
"""All layers that no other row names."""

FLOAT: Final = (LayerPrecision(layer=OTHERS, precision="fp32", reason="float, as it was trained"),)

HALVED: Final = "half precision was asked for"

IN_INTEGERS: Final = "a convolution that is usually worth it: weights and inputs in 8 bits"


def halved(precision: Precision, kept: Sequence[Kept]) -> tuple[LayerPrecision, ...]:
    """Half precision throughout, but for what carries a disparity."""
    others = LayerPrecision(layer=OTHERS, precision=precision, reason=HALVED)
    return (others, *precise(kept))


def precise(kept: Sequence[Kept]) -> tuple[LayerPrecision, ...]:
    """What stays fp32 in half precision."""
    return tuple(
        LayerPrecision(layer=layer, precision="fp32", reason=reason) for layer, reason in kept
    )


def of_integers(
    names: Sequence[str], left: Mapping[str, str], rest: Precision
) -> tuple[LayerPrecision, ...]:
    """Every layer of a graph in integers; those `left` in float run in `rest`, with the reason."""
    convolutions = tuple(
        LayerPrecision(layer=name, precision=rest, reason=left[name])
        if name in left
        else LayerPrecision(layer=name, precision="int8", reason=IN_INTEGERS)
        for name in names
    )
    others = LayerPrecision(
        layer=OTHERS, precision=rest, reason="no convolution: integers would save nothing"
    )
    return (*convolutions, others)
