"""What the tests of quantization share: small networks with a life of their own."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import nn

from rts2.model.arch import Arch
from rts2.model.checkpoint import Network, build, save

SIZE = (96, 64)
"""Width and height of every image here: no padding for either family."""


def _network(arch: Arch) -> Network:
    network = build(arch)
    norms = [m for m in network.modules() if isinstance(m, nn.BatchNorm2d | nn.BatchNorm3d)]
    for norm in norms:
        norm.momentum = None  # a plain mean over all images so far
    with torch.no_grad():
        network.train()(*torch.randn(2, 4, 3, SIZE[1], SIZE[0]))
    return network.eval()


@pytest.fixture
def network() -> Callable[[Arch], Network]:
    """Random networks whose norms know the statistics of their inputs: no layer is dead."""
    return _network


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small RTS²Net on disk."""
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("model") / "small.safetensors"
    save(_network(Arch(c=1, d_max=4, conv3d=(2, 1, 1))), path, "made up for a test")
    return path


@pytest.fixture(scope="session")
def graph(tmp_path_factory: pytest.TempPathFactory, checkpoint: Path) -> Path:
    """The same as ONNX."""
    from rts2.model.checkpoint import load
    from rts2.model.export import export

    path = tmp_path_factory.mktemp("model") / "small.onnx"
    loaded, header = load(checkpoint)
    export(loaded, path, SIZE, header.origin)
    return path
