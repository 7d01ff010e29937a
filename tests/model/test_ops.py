"""Op lists against hand counts and against the networks that they describe."""

import subprocess
import sys
from itertools import product

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from rts2.model.arch import Arch, Family
from rts2.model.checkpoint import build, parameters
from rts2.model.ops import Op, ops, padded

VARIANTS = ((False, False), (True, False), (True, True))
CORNERS = [
    Arch(
        c=c,
        stages=stages,
        d_max=d_max,
        conv3d=(width,) * stages,
        semantic=semantic,
        refinement=refinement,
    )
    for c, stages, d_max, width, (semantic, refinement) in product(
        (1, 3, 32), (1, 2, 3), (6, 24), (2, 32), VARIANTS
    )
]
ANYNETS = [Arch(family="anynet", c=c, stages=stages) for c in (1, 4) for stages in (1, 2, 3)]
MIXED = [Arch(c=5, d_max=7, conv3d=(12, 2, 6), classes=11)]


@pytest.mark.parametrize("arch", CORNERS + ANYNETS + MIXED, ids=Arch.label)
def test_macs_and_weights_are_those_of_the_built_network(arch: Arch) -> None:
    with torch.device("meta"):
        network = build(arch)
        image = torch.empty(1, 3, 96, 160)
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        network(image, image)
    steps = ops(arch, (160, 96))
    assert 2 * sum(op.macs for op in steps) == counter.get_total_flops()
    assert sum(op.weights for op in steps) == parameters(network)


def test_a_convolution_by_hand() -> None:
    stem = _named(Arch(c=4), (64, 32))["encoder.stem.0.conv"]
    assert stem.kind == "conv2d"
    assert stem.inputs == ((2, 3, 32, 64),)
    assert stem.output == (2, 4, 32, 64)
    assert stem.macs == 2 * 32 * 64 * 4 * 3 * 9
    assert stem.weights == 4 * 3 * 9
    assert stem.bytes == 4 * (2 * 3 * 32 * 64 + 2 * 4 * 32 * 64 + 4 * 3 * 9)


def test_volumes_by_hand() -> None:
    steps = _named(Arch(c=2, d_max=6), (64, 32))
    first = steps["volume.0"]
    assert first.output == (1, 6, 2, 4)
    assert first.elements == 2 * (16 * 2 * 4) + 6 * 2 * 4
    assert first.launches == 6 * 6 + 2
    residual = steps["volume.2"]
    assert residual.inputs == ((1, 4, 8, 16), (1, 4, 8, 16), (1, 1, 8, 16))
    assert residual.output == (1, 5, 8, 16)
    third = steps["regularize.2.1.conv"]
    assert third.macs == (4 * 4 * 27) * (5 * 8 * 16)


@pytest.mark.parametrize("family", ["rts2net", "anynet"])
def test_an_early_stop_is_a_prefix_up_to_the_head(family: Family) -> None:
    whole = [op.name for op in ops(Arch(family=family), (64, 64)) if "head" not in op.name]
    early = [op.name for op in ops(Arch(family=family, stages=2), (64, 64))]
    assert [name for name in early if "head" not in name] == [
        name for name in whole if name in set(early)
    ]
    assert len(early) < len(whole)


def test_every_name_occurs_once() -> None:
    for arch in (Arch(), Arch(family="anynet")):
        names = [op.name for op in ops(arch, (64, 64))]
        assert len(names) == len(set(names))


def test_images_are_padded_up() -> None:
    assert padded((1242, 375), 32) == (384, 1248)
    assert padded((1232, 368), 16) == (368, 1232)
    assert ops(Arch(), (1242, 375)) == ops(Arch(), (1248, 384))


def test_listing_needs_no_torch() -> None:
    code = (
        "import sys; from rts2.model.arch import Arch; from rts2.model.ops import ops;"
        "ops(Arch(), (1242, 375)); assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def _named(arch: Arch, resolution: tuple[int, int]) -> dict[str, Op]:
    return {op.name: op for op in ops(arch, resolution)}
