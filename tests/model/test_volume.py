"""Cost volumes and soft-argmin against loops, PyTorch's own sampler, and closed forms."""

import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from rts2.model.volume import first_volume, residual_volume, soft_argmin

B, C, H, W = 2, 3, 5, 17


def features() -> tuple[torch.Tensor, torch.Tensor]:
    return torch.randn(B, C, H, W), torch.randn(B, C, H, W)


def looped(left: np.ndarray, right: np.ndarray, planes: int) -> np.ndarray:
    """The first volume, one pixel at a time."""
    batch, _, height, width = left.shape
    volume = np.zeros((batch, planes, height, width))
    for b, shift, y, x in np.ndindex(batch, planes, height, width):
        seen = right[b, :, y, x - shift] if x >= shift else 0
        volume[b, shift, y, x] = np.abs(left[b, :, y, x] - seen).sum()
    return volume


def sampled(left: torch.Tensor, right: torch.Tensor, disparity: torch.Tensor) -> torch.Tensor:
    """The residual volume by two-dimensional sampling, in double precision."""
    left, right, disparity = left.double(), right.double(), disparity.double()
    height, width = left.shape[-2:]
    y = torch.linspace(-1, 1, height, dtype=torch.double).view(1, height, 1)
    planes = []
    for k in range(-2, 3):
        x = torch.arange(width, dtype=torch.double) - disparity[:, 0] - k
        grid = torch.stack([2 * x / (width - 1) - 1, y.expand_as(x)], 3)
        warped = F.grid_sample(right, grid, align_corners=True, padding_mode="zeros")
        planes.append((left - warped).abs().sum(1))
    return torch.stack(planes, 1)


@pytest.mark.parametrize("planes", [1, 2, 12, W, W + 4])
def test_first_volume_is_the_loop(planes: int) -> None:
    left, right = features()
    wanted = looped(left.double().numpy(), right.double().numpy(), planes)
    np.testing.assert_allclose(first_volume(left, right, planes).numpy(), wanted, atol=1e-5)


def test_a_shift_costs_nothing_in_its_own_plane() -> None:
    texture = torch.randn(1, C, H, W + 3)
    volume = first_volume(texture[..., :W], texture[..., 3:], 6)
    assert volume[0, 3, :, 3:].abs().max() == 0
    assert volume[0, :, :, 5:].argmin(0).eq(3).all()


DISPARITIES = {
    "random": lambda: 6 * torch.rand(B, 1, H, W),
    "whole": lambda: torch.randint(-3, W + 3, (B, 1, H, W)).float(),
    "left of view": lambda: W + 4 * torch.randn(B, 1, H, W),
    "right of view": lambda: -W + 4 * torch.randn(B, 1, H, W),
    "far out": lambda: 1000 * torch.randn(B, 1, H, W),
}


@pytest.mark.parametrize("kind", DISPARITIES)
def test_residual_volume_is_the_sampler(kind: str) -> None:
    left, right = features()
    disparity = DISPARITIES[kind]()
    wanted = sampled(left, right, disparity)
    found = residual_volume(left, right, disparity).double()
    # Beyond the image fp32 coordinates are as coarse as 1e-4; there, all of them see zeros.
    torch.testing.assert_close(found, wanted, atol=1e-5, rtol=0)


def test_residual_volume_around_zero_is_the_first_volume() -> None:
    left, right = features()
    around = residual_volume(left, right, torch.zeros(B, 1, H, W))
    torch.testing.assert_close(around[:, 2:], first_volume(left, right, 3))


def test_soft_argmin_of_two_planes_is_the_sigmoid() -> None:
    gap = torch.linspace(-4, 4, 9)
    cost = torch.stack([torch.zeros_like(gap), gap]).view(1, 2, 1, 9)
    torch.testing.assert_close(soft_argmin(cost, 0)[0, 0, 0], torch.sigmoid(-gap))


def test_soft_argmin_of_an_arithmetic_cost_is_that_of_a_geometric_law() -> None:
    planes, step = 12, 0.7
    cost = (step * torch.arange(planes)).view(1, planes, 1, 1)
    ratio = math.exp(-step)
    mean = ratio / (1 - ratio) - planes * ratio**planes / (1 - ratio**planes)
    assert soft_argmin(cost, 0).item() == pytest.approx(mean, abs=1e-6)


def test_soft_argmin_counts_from_its_first_plane() -> None:
    flat = torch.zeros(1, 5, 2, 3)
    assert soft_argmin(flat, -2).abs().max() < 1e-6
    sure = flat.clone()
    sure[:, 4] = -1000  # too large for exp without its shift
    assert soft_argmin(sure, -2).eq(2).all()
