"""One small network with everything in it, as a network and as a file."""

from pathlib import Path

import pytest

from rts2.model.arch import UNTRAINED, Arch
from rts2.model.checkpoint import build
from rts2.model.export import export
from rts2.profiles.runtimes import Sized


@pytest.fixture(scope="session")
def sized() -> Sized:
    return Sized(build(Arch(c=1, stages=2, d_max=3, conv3d=(2, 2))), (96, 64))


@pytest.fixture(scope="session")
def graph(sized: Sized, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("graphs") / "small.onnx"
    export(sized.network, path, sized.resolution, UNTRAINED)
    return path
