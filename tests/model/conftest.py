"""What the tests of the networks share."""

from collections.abc import Callable

import pytest
import torch

from rts2.model.checkpoint import Network
from rts2.model.supernet import recalibrate


def _lively(network: Network) -> Network:
    left, right = torch.randn(2, 4, 3, 64, 96)
    recalibrate(network, [(left, right)])
    return network


@pytest.fixture
def lively() -> Callable[[Network], Network]:
    """Makes random weights give disparities that differ from pixel to pixel, as trained ones do.

    The norms take their statistics from a few pairs; with their defaults most layers would be dead.
    """
    return _lively
