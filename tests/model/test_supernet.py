"""One set of weights: every network is its slices, exactly."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rts2.model.arch import LARGEST, Arch
from rts2.model.checkpoint import build, cut, load, save
from rts2.model.errors import UsageError
from rts2.model.rts2net import RTS2Net
from rts2.model.supernet import beside, drawn, extract, outside, recalibrate, run, sliced, smallest

WHOLE = Arch(c=5, d_max=9, conv3d=(7, 4, 6))


@pytest.fixture(scope="module")
def whole() -> RTS2Net:
    """A network of random weights, its norms too."""
    torch.manual_seed(3)
    network = build(WHOLE)
    for name, value in network.state_dict().items():
        if "running_var" in name or ".1.weight" in name:
            value.uniform_(0.5, 2)
        elif "running_mean" in name or name.endswith("bias"):
            value.normal_()
    assert isinstance(network, RTS2Net)
    return network


def pair(height: int = 64, width: int = 96) -> tuple[torch.Tensor, torch.Tensor]:
    left, right = torch.randn(2, 2, 3, height, width, generator=torch.Generator().manual_seed(1))
    return left, right


@st.composite
def inside(draw: st.DrawFn) -> Arch:
    stages = draw(st.integers(1, 3))
    branches = draw(st.sampled_from([(False, False), (True, False), (True, True)]))
    return Arch(
        c=draw(st.integers(1, WHOLE.c)),
        stages=stages,
        d_max=draw(st.integers(2, WHOLE.d_max)),
        conv3d=tuple(draw(st.integers(1, most)) for most in WHOLE.conv3d[:stages]),
        semantic=branches[0],
        refinement=branches[1],
    )


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(arch=inside())
def test_the_extracted_network_says_what_the_supernet_says(whole: RTS2Net, arch: Arch) -> None:
    inner, outer = extract(whole, arch).train()(*pair()), run(whole, arch, *pair())
    assert len(inner) == len(outer) == arch.stages
    for own, its in zip(inner, outer, strict=True):
        for mine, other in zip(own, its, strict=True):
            assert (mine is None) == (other is None)
            if mine is not None:
                torch.testing.assert_close(mine, other, rtol=1e-6, atol=1e-6)


def test_fewer_stages_and_branches_are_parts_of_the_whole(whole: RTS2Net) -> None:
    """So that a network of all of them trains and judges those of fewer along."""
    for branches in ({"semantic": False, "refinement": False}, {"refinement": False}):
        for stages in (1, 2, 3):
            arch = WHOLE.up_to(stages).model_copy(update=branches)
            part, own = extract(whole, arch), cut(whole, arch)
            for name, value in own.state_dict().items():
                assert torch.equal(value, part.state_dict()[name])
            with torch.no_grad():
                alone, among = part(*pair())[-1], whole(*pair())[stages - 1]
            assert torch.equal(alone.disparity, among.disparity)


def test_layers_that_read_several_maps_have_the_first_channels_of_each(whole: RTS2Net) -> None:
    arch = WHOLE.model_copy(update={"c": 2, "d_max": 4})
    weights = whole.state_dict()
    found = sliced(weights, WHOLE, arch)
    name = "disparity.levels.1.0.0.weight"  # 8c from below, 4c of the encoder
    joined = torch.cat([weights[name][:8, :16], weights[name][:8, 40:48]], 1)
    assert torch.equal(found[name], joined)
    name = "semantic.levels.0.0.0.weight"  # 16c from 1/32, 8c of the encoder
    joined = torch.cat([weights[name][:16, :32], weights[name][:16, 80:96]], 1)
    assert torch.equal(found[name], joined)
    name = "refine.0.residual.0.0.0.weight"  # the planes, and as many of the compressed scores
    joined = torch.cat([weights[name][:8, :4], weights[name][:8, 9:13]], 1)
    assert torch.equal(found[name], joined)


def test_gradients_reach_the_slices_alone(whole: RTS2Net) -> None:
    whole.zero_grad()
    arch = Arch(c=2, stages=1, d_max=4, conv3d=(3,), semantic=False)
    run(whole, arch, *pair())[-1].disparity.square().mean().backward()
    stem = dict(whole.named_parameters())["encoder.stem.0.0.weight"].grad
    assert stem is not None
    assert stem[:2].abs().amax((1, 2, 3)).min() > 0
    assert stem[2:].abs().max() == 0
    assert whole.regularize[1].layers[0].weight.grad is None
    whole.zero_grad()


def test_the_statistics_of_a_supernet_do_not_move_when_others_run(whole: RTS2Net) -> None:
    before = {name: value.clone() for name, value in whole.state_dict().items()}
    run(whole, smallest(WHOLE), *pair())
    assert all(torch.equal(value, before[name]) for name, value in whole.state_dict().items())


def test_recalibrated_norms_hold_the_mean_of_the_batches(whole: RTS2Net) -> None:
    """Over one batch, evaluation then says what training said, but for the unbiased variance."""
    part = extract(whole, WHOLE.model_copy(update={"c": 2}))
    first, second = pair(), tuple(2 * image for image in pair())
    recalibrate(part, [first, second])
    conv, norm = part.encoder.stem[0][0], part.encoder.stem[0][1]
    with torch.no_grad():
        means = [conv(torch.cat(both)).mean((0, 2, 3)) for both in (first, second)]
    torch.testing.assert_close(norm.running_mean, (means[0] + means[1]) / 2, rtol=1e-5, atol=1e-6)
    assert not part.training
    assert norm.momentum == 0.1


def test_recalibration_forgets_what_was(whole: RTS2Net) -> None:
    one, two = (extract(whole, WHOLE.up_to(1)) for _ in range(2))
    recalibrate(one, [pair(32, 64)])
    recalibrate(one, [pair()])
    recalibrate(two, [pair()])
    for name, value in one.state_dict().items():
        assert torch.equal(value, two.state_dict()[name])


def test_what_a_supernet_does_not_hold_is_told_in_full(whole: RTS2Net) -> None:
    large = Arch(c=6, d_max=10, conv3d=(8, 4, 4), classes=3)
    with pytest.raises(UsageError) as told:
        extract(whole, large)
    assert str(told.value) == (
        "the supernet does not hold that arch: c is at most 5, 6 was asked for; d_max is at most "
        "9, 10 was asked for; conv3d is at most [7, 4, 6], [8, 4, 4] was asked for; classes is 19, "
        "3 was asked for"
    )
    assert outside(Arch(family="anynet", c=1), LARGEST) == [
        "family is rts2net, anynet was asked for"
    ]
    bare = Arch(semantic=False)
    assert outside(Arch(), bare) == ["it has no semantic branch", "it has no refinement branch"]
    assert not outside(Arch(semantic=False, classes=3), LARGEST)


def test_the_sandwich_is_the_smallest_and_random_ones_of_the_step() -> None:
    first, again, other = (beside(LARGEST, 7, step, 3) for step in (4, 4, 5))
    assert first == again
    assert first != other
    assert first[0] == Arch(c=1, d_max=6, conv3d=(4, 2, 2))
    assert len(first) == 4
    assert not any(outside(arch, LARGEST) for arch in first)


def test_every_value_of_the_space_is_drawn_and_small_c_more_often() -> None:
    rng = np.random.default_rng(0)
    archs = [drawn(LARGEST, rng) for _ in range(3000)]
    assert {arch.c for arch in archs} == set(range(1, 33))
    assert {arch.d_max for arch in archs} == set(range(6, 25))
    assert {arch.conv3d[0] for arch in archs} == {4, 8, 12, 16, 24, 32}
    assert sum(arch.c <= 8 for arch in archs) > sum(arch.c > 8 for arch in archs)


def test_a_checkpoint_says_whether_it_is_a_supernet(whole: RTS2Net, tmp_path: Path) -> None:
    save(whole, tmp_path / "a.safetensors", "a test", supernet=True)
    save(whole, tmp_path / "b.safetensors", "a test")
    network, header = load(tmp_path / "a.safetensors")
    assert header.supernet
    assert network.arch == WHOLE
    assert not load(tmp_path / "b.safetensors")[1].supernet
