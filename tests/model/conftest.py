"""What the tests of the networks share."""

from collections.abc import Callable

import pytest
import torch
from torch import nn

from rts2.model.checkpoint import Network


def _lively(network: Network) -> Network:
    norms = [m for m in network.modules() if isinstance(m, nn.BatchNorm2d | nn.BatchNorm3d)]
    for norm in norms:
        norm.momentum = None  # a plain mean over all images so far
    with torch.no_grad():
        network.train()(*torch.randn(2, 4, 3, 64, 96))
    return network.eval()


@pytest.fixture
def lively() -> Callable[[Network], Network]:
    """Makes random weights give disparities that differ from pixel to pixel, as trained ones do.

    The norms take their statistics from a few pairs; with their defaults most layers would be dead.
    """
    return _lively
