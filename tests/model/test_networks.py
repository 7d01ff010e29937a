"""Both families: shapes, early stops, parameters, gradients, batches."""

from collections.abc import Callable
from itertools import product

import pytest
import torch
from torch import Tensor, nn

from rts2.model.anynet import AnyNet
from rts2.model.arch import Arch
from rts2.model.checkpoint import Network, build, parameters
from rts2.model.errors import UsageError
from rts2.model.rts2net import RTS2Net

BRANCHES = ({"semantic": False}, {"refinement": False}, {})
VARIANTS = [
    *(
        Arch(c=c, stages=stages, d_max=d_max, conv3d=conv3d[:stages], classes=classes, **branches)
        for (c, d_max, conv3d, classes), stages, branches in product(
            ((1, 5, (3, 1, 2), 7), (3, 12, (16, 4, 4), 19)), (1, 2, 3), BRANCHES
        )
    ),
    *(
        Arch(family="anynet", c=1, d_max=7, conv3d=(3, 1, 2)[:stages], stages=stages)
        for stages in (1, 2, 3)
    ),
]
SMALL = [Arch(c=2), Arch(family="anynet", c=2)]
H, W = 64, 96

Lively = Callable[[Network], Network]


def pair(batch: int = 1) -> tuple[Tensor, Tensor]:
    return torch.randn(batch, 3, H, W), torch.randn(batch, 3, H, W)


@pytest.mark.parametrize("arch", VARIANTS, ids=repr)
def test_every_variant_says_what_it_has(arch: Arch) -> None:
    network = build(arch)
    assert isinstance(network, RTS2Net if arch.family == "rts2net" else AnyNet)
    with torch.inference_mode():
        found = network(*pair())
    assert len(found) == arch.stages
    for stage, stride in zip(found, (16, 8, 4), strict=False):
        side = stride if arch.family == "rts2net" else 1
        assert stage.disparity.shape == (1, 1, H // side, W // side)
        assert (stage.refined is not None) == arch.refinement
        assert (stage.scores is not None) == arch.semantic
        assert stage.best is (stage.disparity if stage.refined is None else stage.refined)
        assert stage.refined is None or stage.refined.shape == stage.disparity.shape
        if stage.scores is not None:
            assert stage.scores.shape == (1, arch.classes, H // stride, W // stride)


@pytest.mark.parametrize("arch", [arch for arch in VARIANTS if arch.stages == 3], ids=repr)
def test_disparities_lie_within_reach(lively: Lively, arch: Arch) -> None:
    network = lively(build(arch))
    with torch.inference_mode():
        found = network(*pair())
    lowest, highest = 0.0, 16.0 * (arch.d_max - 1)
    for stage, residual in zip(found, (0, 2 * 8, 2 * 4), strict=False):
        lowest, highest = lowest - residual, highest + residual
        assert lowest - 1e-3 <= stage.best.min() < stage.best.max() <= highest + 1e-3


@pytest.mark.parametrize("arch", SMALL, ids=Arch.label)
@pytest.mark.parametrize("stages", [1, 2, 3])
def test_an_early_stop_is_the_prefix_of_the_whole(lively: Lively, arch: Arch, stages: int) -> None:
    network = lively(build(arch))
    images = pair()
    with torch.inference_mode():
        whole, part = network(*images), network(*images, stages)
    assert len(part) == stages
    for early, full in zip(part, whole, strict=False):
        for a, b in zip(early, full, strict=True):
            assert (a is None and b is None) or torch.equal(a, b)


@pytest.mark.parametrize("arch", SMALL, ids=Arch.label)
@pytest.mark.parametrize("stages", [1, 2, 3])
def test_an_early_stop_computes_nothing_of_later_stages(arch: Arch, stages: int) -> None:
    """What runs is, layer by layer, what a network built with that many stages consists of."""
    network = build(arch)
    run: list[str] = []
    names = {module: name for name, module in network.named_modules()}
    for module in names:
        if isinstance(module, nn.Conv2d | nn.Conv3d | nn.BatchNorm2d | nn.BatchNorm3d):
            module.register_forward_hook(lambda module, *_: run.append(names[module]))
    with torch.inference_mode():
        network(*pair(), stages)
    short = {name.removesuffix(".weight") for name in build(arch.up_to(stages)).state_dict()}
    assert sorted(run) == sorted(name for name in names.values() if name in short)


def test_more_stages_than_there_are_is_wrong_use() -> None:
    with pytest.raises(UsageError, match="stages must be 1 to 2 for this network, not 3"):
        build(Arch(c=1, stages=2))(*pair(), 3)


def test_anynet_has_the_parameters_of_the_official_one() -> None:
    assert parameters(build(Arch(family="anynet", c=1))) == 34_629


@pytest.mark.parametrize("arch", SMALL, ids=Arch.label)
def test_gradients_reach_every_parameter(lively: Lively, arch: Arch) -> None:
    network = lively(build(arch)).train()
    found = network(*pair(2))
    sum(part.square().mean() for stage in found for part in stage if part is not None).backward()
    still = [n for n, p in network.named_parameters() if p.grad is None or not p.grad.any()]
    assert still == []


@pytest.mark.parametrize("arch", SMALL, ids=Arch.label)
def test_a_batch_is_its_singles(lively: Lively, arch: Arch) -> None:
    network = lively(build(arch)).double()
    left, right = (image.double() for image in pair(2))
    with torch.inference_mode():
        batch = network(left, right)
        singles = [network(left[i : i + 1], right[i : i + 1]) for i in (0, 1)]
    for stage, pieces in zip(batch, zip(*singles, strict=True), strict=True):
        torch.testing.assert_close(stage.best, torch.cat([piece.best for piece in pieces]))


@pytest.mark.parametrize("arch", SMALL, ids=Arch.label)
def test_left_and_right_are_not_the_same(lively: Lively, arch: Arch) -> None:
    network = lively(build(arch))
    left, right = pair()
    with torch.inference_mode():
        there, back = network(left, right)[-1].best, network(right, left)[-1].best
    assert (there - back).abs().mean() > 1
