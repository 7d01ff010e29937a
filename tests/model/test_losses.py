"""The paper's objective against values worked by hand."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from rts2.model.arch import Arch
from rts2.model.checkpoint import build
from rts2.model.errors import Rts2Error
from rts2.model.losses import (
    Counts,
    Truth,
    at_stage,
    class_weights,
    coarse_factor,
    count,
    cross_entropy,
    means,
    smooth_l1,
    sums,
    total,
)
from rts2.model.rts2net import Stage

NAN = math.nan


def test_smooth_l1_is_square_below_one_pixel_and_straight_above() -> None:
    disparity = torch.tensor([[[[3.0, 3.0, 3.0, 3.0, 3.0, 3.0]]]])
    truth = torch.tensor([[[3.0, 3.5, 2.2, 4.0, 10.0, NAN]]])
    # 0, ½·0.5², ½·0.8², 1−½, 7−½, unknown
    assert smooth_l1(disparity, truth).item() == pytest.approx(0 + 0.125 + 0.32 + 0.5 + 6.5)


def test_disparities_are_enlarged_bilinearly_to_the_truth() -> None:
    disparity = torch.tensor([[[[0.0, 4.0]]]])  # twice as large: 0, 1, 3, 4 in both rows
    truth = torch.zeros(1, 2, 4)
    assert smooth_l1(disparity, truth).item() == pytest.approx(2 * (0 + 0.5 + 2.5 + 3.5))


def test_an_unknown_pixel_gives_no_gradient() -> None:
    disparity = torch.tensor([[[[1.0, 5.0]]]], requires_grad=True)
    smooth_l1(disparity, torch.tensor([[[NAN, 3.0]]])).backward()
    assert disparity.grad is not None
    assert disparity.grad.flatten().tolist() == [0.0, 1.0]


def scores_of(*odds: tuple[float, ...]) -> Tensor:
    """(1, classes, 1, pixels) whose softmax are the given shares."""
    return torch.tensor(odds).log().T[None, :, None]


def test_cross_entropy_sums_the_logs_of_the_labelled_pixels() -> None:
    scores = scores_of((0.75, 0.25), (0.5, 0.5), (0.1, 0.9))
    labels = torch.tensor([[[0, 1, 255]]], dtype=torch.uint8)
    assert cross_entropy(scores, labels).item() == pytest.approx(math.log(4 / 3) + math.log(2))
    weights = torch.tensor([3.0, 0.5])  # the sum is weighted; nothing divides by the weights
    weighted = 3 * math.log(4 / 3) + 0.5 * math.log(2)
    assert cross_entropy(scores, labels, weights).item() == pytest.approx(weighted)


def test_labels_are_taken_at_the_centres_of_a_stage_s_pixels() -> None:
    labels = torch.arange(64, dtype=torch.uint8).view(1, 8, 8)
    assert at_stage(labels, 4).tolist() == [[[18, 22], [50, 54]]]
    sure = torch.full((1, 64, 2, 2), -1000.0)
    for place, label in enumerate((18, 22, 50, 54)):
        sure[0, label, place // 2, place % 2] = 0
    assert cross_entropy(sure, labels).item() == 0


def test_two_classes_weigh_by_each_other_s_logarithm() -> None:
    """For N = 2, equation 3 becomes W₁ = 2·log(P₂ + k) / (log(P₁ + k) + log(P₂ + k))."""
    first, second = math.log(0.25 + 2), math.log(0.75 + 2)
    found = class_weights(np.array([0.25, 0.75]), 2)
    assert found.tolist() == pytest.approx(
        [2 * second / (first + second), 2 * first / (first + second)]
    )


def test_class_weights_of_three_classes_by_hand() -> None:
    """P + k = e, e, e² have the logarithms 1, 1, 2, so W = 3·(1, 1, ½)/2.5."""
    shares = np.array([0.0, 0.0, math.e**2 - math.e])
    assert class_weights(shares, math.e).tolist() == pytest.approx([1.2, 1.2, 0.6])


def test_class_weights_have_mean_one_and_spread_as_k_nears_one() -> None:
    shares = np.array([0.6, 0.3, 0.1, 0.0])
    narrow, wide = class_weights(shares, 2), class_weights(shares, 1.12)
    assert narrow.mean() == pytest.approx(1)
    assert wide.mean() == pytest.approx(1)
    assert (np.diff(wide) > 0).all()
    assert wide.max() / wide.min() > narrow.max() / narrow.min()
    with pytest.raises(Rts2Error, match=r"k must be above 1.* not 1"):
        class_weights(shares, 1)


def test_coarse_annotations_raise_the_semantic_loss() -> None:
    assert coarse_factor(labelled=20, compared=100, gamma=0.1) == pytest.approx(1 + 0.1 * 80 / 20)
    assert coarse_factor(100, 100, 0.1) == 1
    assert coarse_factor(0, 100, 0.1) == 1


def test_means_divide_by_the_pixels_that_count() -> None:
    terms = {name: torch.tensor(12.0) for name in ("disparity_1", "refined_2", "semantic_2")}
    counts = Counts(known=6, labelled=(1, 4), compared=(2, 16))
    found = means(terms, counts, gamma=0.1)
    assert {n: v.item() for n, v in found.items()} == pytest.approx(
        {"disparity_1": 2, "refined_2": 2, "semantic_2": 3 * (1 + 0.1 * 12 / 4)}
    )
    nothing = means(terms, Counts(0, (0, 0), (2, 16)), gamma=0.1)
    assert all(value.isfinite() for value in nothing.values())


def test_the_objective_weighs_stages_and_tasks() -> None:
    one = torch.tensor(1.0)
    names = [f"{t}_{s}" for t in ("disparity", "semantic", "refined") for s in (1, 2, 3)]
    assert total(dict.fromkeys(names, one)).item() == pytest.approx((1 / 4 + 1 / 2 + 1) * 5)
    assert total({"disparity_1": one}).item() == pytest.approx(1 / 4)
    assert total({"semantic_2": one, "refined_3": one}).item() == pytest.approx(2 / 2 + 2)


def test_a_batch_of_constants_by_hand() -> None:
    """One pixel at 1/16 says 10 and, refined, 12.25; the truth is 12 in half of the image."""
    truth = torch.full((1, 16, 16), 12.0)
    truth[:, 8:] = NAN
    labels = torch.full((1, 16, 16), 255, dtype=torch.uint8)
    labels[0, 8, 8] = 1  # the centre
    stage = Stage(
        torch.full((1, 1, 1, 1), 10.0), torch.full((1, 1, 1, 1), 12.25), scores_of((0.75, 0.25))
    )
    given = Truth(truth, labels)
    counts = count(given, (16,))
    assert counts == Counts(128, (1,), (1,))
    found = means(sums([stage], given), counts)
    assert {name: value.item() for name, value in found.items()} == pytest.approx(
        {"disparity_1": 1.5, "refined_1": 0.03125, "semantic_1": math.log(4)}
    )
    assert total(found).item() == pytest.approx((1.5 + 2 * math.log(4) + 2 * 0.03125) / 4)


VARIANTS = {
    "full": (Arch(c=1), 9),
    "two stages": (Arch(c=1, stages=2), 6),
    "disparity+semantic": (Arch(c=1, refinement=False), 6),
    "disparity": (Arch(c=1, semantic=False), 3),
    "anynet": (Arch(family="anynet", c=1), 3),
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_absent_branches_have_no_term(variant: str) -> None:
    arch, terms = VARIANTS[variant]
    stages = build(arch)(*torch.randn(2, 1, 3, 64, 64))
    truth = Truth(20 * torch.rand(1, 64, 64), torch.randint(0, 19, (1, 64, 64)))
    found = sums(stages, truth)
    assert len(found) == terms
    assert all(value.dim() == 0 and value.isfinite() for value in found.values())
    assert not any("semantic" in name for name in sums(stages, Truth(truth.disparity)))


def test_parts_of_a_batch_add_up_to_the_objective_of_the_whole() -> None:
    """However unevenly the known pixels are spread."""
    disparity, labels = 20 * torch.rand(3, 64, 64), torch.randint(0, 19, (3, 64, 64))
    disparity[0, :50] = NAN
    labels[2, 10:] = 255
    images = torch.randn(2, 3, 3, 64, 64)
    network = build(Arch(c=1))

    def objective(rows: slice, counts: Counts) -> Tensor:
        truth = Truth(disparity[rows], labels[rows])
        return total(means(sums(network(*images[:, rows]), truth), counts, gamma=0.1))

    parts = [slice(0, 1), slice(1, 3)]
    counts = [count(Truth(disparity[rows], labels[rows]), (16, 8, 4)) for rows in parts]
    whole = counts[0] + counts[1]
    assert whole == count(Truth(disparity, labels), (16, 8, 4))
    assert Counts.of(whole.numbers()) == whole
    added = sum(objective(rows, whole).item() for rows in parts)
    assert added == pytest.approx(objective(slice(0, 3), whole).item(), rel=1e-5)


def test_losses_of_half_precision_are_in_fp32() -> None:
    scores = scores_of((0.75, 0.25)).bfloat16()
    assert cross_entropy(scores, torch.zeros(1, 1, 1)).dtype == torch.float32
    assert smooth_l1(torch.ones(1, 1, 1, 1).bfloat16(), torch.ones(1, 1, 1)).dtype == torch.float32
