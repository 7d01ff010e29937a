"""What graphs always hold in another form says the same as the plain network."""

from collections.abc import Callable
from copy import deepcopy
from itertools import product

import pytest
import torch
from torch import Tensor, nn

from rts2.model.arch import Arch
from rts2.model.checkpoint import Network, build
from rts2.model.forms import (
    ROWS,
    class_ids,
    class_ids_by_maxima,
    enlarge_by_products,
    rewritten,
)
from rts2.model.layers import enlarge
from rts2.model.phases import Phases, phases
from rts2.model.volume import PLAIN

Lively = Callable[[Network], Network]
Classified = Callable[[Tensor, int], Tensor]


def relative(wanted: Tensor, found: Tensor) -> float:
    return float((wanted - found).abs().max() / wanted.abs().max())


@pytest.mark.parametrize("planes", [2, 5, 24])
def test_first_volumes_are_equal(planes: int) -> None:
    left, right = torch.randn(2, 2, 6, 5, 17, dtype=torch.float64)
    wanted = PLAIN.first_volume(left, right, planes)
    found = ROWS.first_volume(left, right, planes)
    assert wanted.shape == found.shape == (2, planes, 5, 17)
    assert relative(wanted, found) <= 1e-12


@pytest.mark.parametrize("channels", [2, 32, 40])
def test_residual_volumes_are_equal_out_of_view_too(channels: int) -> None:
    """Disparities of −30 … 30 in a map 17 wide: some planes see nothing, some a part."""
    left, right = torch.randn(2, 2, channels, 7, 17, dtype=torch.float64)
    disparity = torch.linspace(-30, 30, 2 * 7 * 17, dtype=torch.float64).view(2, 1, 7, 17)
    wanted = PLAIN.residual_volume(left, right, disparity)
    found = ROWS.residual_volume(left, right, disparity)
    assert wanted.shape == found.shape == (2, 5, 7, 17)
    assert relative(wanted, found) <= 1e-12


@pytest.mark.parametrize("shift", range(-8, 9))
def test_whole_disparities_meet_whole_pixels_at_the_bounds(shift: int) -> None:
    left, right = torch.randn(2, 1, 3, 2, 4)
    for edge in (-4.0, 0.0, 4.0):
        disparity = torch.full((1, 1, 2, 4), shift + edge)
        wanted = PLAIN.residual_volume(left, right, disparity)
        assert relative(wanted, ROWS.residual_volume(left, right, disparity)) <= 1e-6


@pytest.mark.parametrize("first", [0, -2])
@pytest.mark.parametrize("scale", [1e-3, 1, 1e4, 1e30])
def test_soft_argmins_are_equal_for_costs_of_any_size(scale: float, first: int) -> None:
    cost = torch.randn(2, 5, 7, 11) * scale
    wanted, found = (form.soft_argmin(cost, first) for form in (PLAIN, ROWS))
    assert wanted.shape == found.shape == (2, 1, 7, 11)
    assert (wanted - found).abs().max() <= 1e-5


def test_half_costs_are_taken_in_floats() -> None:
    found = ROWS.soft_argmin(torch.randn(1, 5, 3, 4).half(), 0)
    assert found.dtype == torch.float32


@pytest.mark.parametrize("classified", [class_ids, class_ids_by_maxima])
@pytest.mark.parametrize("factor", [4, 8, 16])
@pytest.mark.parametrize("size", [(1, 1), (3, 5)])
def test_classes_are_those_of_enlarged_scores(
    size: tuple[int, int], factor: int, classified: Classified
) -> None:
    scores = torch.randn(2, 19, *size, dtype=torch.float64)
    found = classified(scores, factor)
    assert found.dtype == torch.int32
    assert torch.equal(found, enlarge(scores, factor).argmax(1).int())


@pytest.mark.parametrize("classified", [class_ids, class_ids_by_maxima])
def test_of_equal_scores_the_first_wins(classified: Classified) -> None:
    scores = torch.zeros(1, 5, 2, 3)
    scores[:, [2, 4]] = 1.5
    assert torch.equal(classified(scores, 4), torch.full((1, 8, 12), 2, dtype=torch.int32))


@pytest.mark.parametrize("factor", [2, 4, 8, 16])
@pytest.mark.parametrize("size", [(1, 1), (3, 5), (96, 312)])
def test_products_enlarge_as_bilinear_maps(size: tuple[int, int], factor: int) -> None:
    maps = torch.rand(2, 1, *size, dtype=torch.float64) * 192
    wanted, found = enlarge(maps, factor), enlarge_by_products(maps, factor)
    assert wanted.shape == found.shape
    assert relative(wanted, found) <= 1e-12


@pytest.mark.parametrize(
    ("c", "wanted"),
    [(1, (2, 2)), (4, (2, 2)), (8, (1, 2)), (12, (1, 2)), (16, (1, 1)), (20, (1, 1)), (24, (1, 2))],
)
def test_a_stem_has_as_many_pixels_in_its_channels_as_help(c: int, wanted: Phases) -> None:
    assert phases(c) == wanted


@pytest.mark.parametrize("c", [1, 3, 8, 16, 24])
def test_encoders_are_equal_up_to_the_borders(lively: Lively, c: int) -> None:
    network = lively(build(Arch(c=c, stages=1, conv3d=(1,)))).double()
    left, right = torch.randn(2, 2, 3, 32, 96, dtype=torch.float64)
    with torch.inference_mode():
        wanted = network.encoder(left, right)
        found = rewritten(network).encoder(left, right)
    for a, b in zip([*wanted[0], wanted[1]], [*found[0], found[1]], strict=True):
        assert relative(a, b) <= 1e-12


@pytest.mark.parametrize("runtime", ["onnxruntime", "openvino"])
@pytest.mark.parametrize("family", ["rts2net", "anynet"])
def test_a_rewritten_network_is_a_copy_that_says_the_same(
    lively: Lively, family: str, runtime: str
) -> None:
    network = lively(build(Arch(family=family, c=2, d_max=5))).double().train()
    before, random = deepcopy(network.state_dict()), torch.get_rng_state()
    found = rewritten(network, runtime)
    assert torch.equal(random, torch.get_rng_state())
    assert all(module.training for module in network.modules())
    assert not any(module.training for module in found.modules())
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())
    forms = [m.matching for m in network.modules() if hasattr(m, "matching")]
    assert set(forms) == {PLAIN}
    left, right = torch.randn(2, 2, 3, 64, 96, dtype=torch.float64)
    with torch.inference_mode():
        answers = [net(left, right) for net in (network.eval(), found)]
    for plain, other in zip(*answers, strict=True):
        assert plain.best.std() > 0.1
        assert relative(plain.best, other.best) <= 1e-10


def test_names_of_modules_stay() -> None:
    """Nodes are told by them: equal paths, convs where there were convs."""
    network = build(Arch(c=1))
    pairs = zip(network.named_modules(), rewritten(network).named_modules(), strict=True)
    for (name, plain), (same, other) in pairs:
        assert name == same
        assert isinstance(plain, nn.Conv2d) == isinstance(other, nn.Conv2d)


def test_the_taps_of_a_widened_stem_are_those_of_the_old_one() -> None:
    """Each old tap once for every pixel of a group; the second conv has each tap once."""
    for c, (y, x) in product((2, 8), ((1, 2), (2, 2))):
        if phases(c) != (y, x):
            continue
        network = build(Arch(c=c, stages=1, conv3d=(1,)))
        plain, wide = network.encoder.stem, rewritten(network).encoder.stem
        sums = [(a[0].weight.sum(), b[0].weight.sum()) for a, b in zip(plain, wide, strict=True)]
        assert torch.isclose(sums[0][0] * y * x, sums[0][1], atol=1e-4)
        assert torch.isclose(sums[1][0], sums[1][1], atol=1e-4)
