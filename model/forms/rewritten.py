"""A network as the graphs for one runtime hold it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import deepcopy
from typing import Final, NamedTuple

from torch import Tensor

from ..anynet import AnyNet
from ..rts2net import Encoder, Regression, Volume
from ..volume import Matching
from .banded import Formed
from .head import class_ids, class_ids_by_maxima
from .matching import ROWS, enlarge_by_products
from .stem import widen_stem


class Steps(NamedTuple):
    """In which steps a runtime is the fastest to compute what is the same in all of them."""

    matching: Matching
    class_ids: Callable[[Tensor, int], Tensor]


USUAL: Final = Steps(ROWS, class_ids)

OF_RUNTIMES: Final[Mapping[str, Steps]] = {
    # OpenVINO sorts for an argmax, and resizes a single channel slowly.
    "openvino": Steps(ROWS._replace(enlarge=enlarge_by_products), class_ids_by_maxima),
}
"""Those of runtimes that are faster in others than the usual."""


def steps_for(runtime: str) -> Steps:
    """The steps of graphs for a runtime."""
    return OF_RUNTIMES.get(runtime, USUAL)


def rewritten(network: Formed, runtime: str = "onnxruntime") -> Formed:
    """A copy of the network, in eval mode, with its parts in the forms that graphs have."""
    copy = deepcopy(network)
    copy.eval()
    for module in list(copy.modules()):
        if isinstance(module, Volume | Regression | AnyNet):
            module.matching = steps_for(runtime).matching
        elif isinstance(module, Encoder):
            widen_stem(module)
    return copy
