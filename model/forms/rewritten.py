"""A network as graphs hold it."""

from __future__ import annotations

from copy import deepcopy

from ..anynet import AnyNet
from ..rts2net import Encoder, Regression, Volume
from .banded import Formed
from .matching import ROWS
from .stem import widen_stem


def rewritten(network: Formed) -> Formed:
    """A copy of the network, in eval mode, with its parts in the forms that graphs have."""
    copy = deepcopy(network)
    copy.eval()
    for module in list(copy.modules()):
        if isinstance(module, Volume | Regression | AnyNet):
            module.matching = ROWS
        elif isinstance(module, Encoder):
            widen_stem(module)
    return copy
