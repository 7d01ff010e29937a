"""A step: what it computes, and what it refuses."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from rts2.model.checkpoint import build
from rts2.model.errors import Rts2Error, UsageError
from rts2.model.losses import Truth, count, imitation, means, sums, total
from rts2.model.supernet import run
from rts2.model.train.loader import Batch
from rts2.model.train.precision import resolve
from rts2.model.train.recipe import Recipe, recipe_from
from rts2.model.train.trainer import Trainer, lay_out, term_names

CPU = torch.device("cpu")


def recipe(**values: object) -> Recipe:
    return recipe_from({"dataset": "folder", "steps": 9, "arch": {"c": 1}} | values)


def trainer(precision: str = "fp32", **values: object) -> Trainer:
    torch.manual_seed(0)
    given = recipe(**values)
    return Trainer(build(given.arch), given, resolve(precision, CPU), CPU)


def batch(seed: int = 0, known: float = 1.0) -> Batch:
    torch.manual_seed(seed)
    left, right = torch.randint(0, 256, (2, 2, 64, 64, 3), dtype=torch.uint8)
    truth = 30 * torch.rand(2, 64, 64)
    truth[torch.rand(2, 64, 64) > known] = math.nan
    return Batch(["a", "b"], left, right, Truth(truth, torch.randint(0, 19, (2, 64, 64)).byte()))


def weights(learner: Trainer) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in learner.network.parameters()])


def gradient(learner: Trainer) -> torch.Tensor:
    return torch.cat([p.grad.flatten() for p in learner.network.parameters() if p.grad is not None])


def test_a_step_is_the_objective_s_gradient_by_adam() -> None:
    """Adam's first step moves each weight by the rate against its gradient's sign."""
    learner, given = trainer(), batch()
    before = weights(learner)
    outcome = learner.step([given], rate=1e-3)
    torch.manual_seed(0)
    twin = build(learner.recipe.arch).train()
    scale, shift = torch.tensor([0.229, 0.224, 0.225]), torch.tensor([0.485, 0.456, 0.406])
    left, right = (
        ((image / 255 - shift) / scale).permute(0, 3, 1, 2) for image in (given.left, given.right)
    )
    found = sums(twin(left, right), given.truth)
    loss = total(means(found, count(given.truth, (16, 8, 4))))
    assert outcome.loss == pytest.approx(loss.item(), rel=1e-4)
    moved, slope = weights(learner) - before, gradient(learner)
    steep = slope.abs() > 1e-4
    assert steep.float().mean() > 0.5
    torch.testing.assert_close(moved[steep], -1e-3 * slope[steep].sign(), rtol=1e-2, atol=1e-6)


def test_two_equal_micro_batches_are_one_batch() -> None:
    one, two = trainer(), trainer(batch=4, accumulate=2)
    alone, both = one.step([batch()], 1e-3), two.step([batch(), batch()], 1e-3)
    assert both.loss == pytest.approx(alone.loss, rel=1e-6)
    assert both.terms == pytest.approx(alone.terms, rel=1e-6)
    torch.testing.assert_close(gradient(two), gradient(one), rtol=1e-4, atol=1e-6)


def test_micro_batches_weigh_by_their_pixels() -> None:
    """One of them knows a tenth of its pixels: the mean is over pixels, not over micro-batches."""
    full, sparse = batch(1), batch(2, known=0.1)
    apart = [trainer().step([part], 1e-3).terms["disparity_3"] for part in (full, sparse)]
    pixels = [int(part.truth.disparity.isfinite().sum()) for part in (full, sparse)]
    together = trainer(batch=4, accumulate=2).step([full, sparse], 1e-3).terms["disparity_3"]
    wanted = np.average(apart, weights=pixels)
    assert together == pytest.approx(wanted, rel=1e-5)
    assert abs(together - np.mean(apart)) > 1e-3


def test_a_loss_that_is_not_finite_names_the_batch_and_moves_nothing() -> None:
    learner, given = trainer(), batch()
    learner.step([given], 1e-3)
    before = weights(learner)
    disparity = given.truth.disparity.clone()
    disparity[0, :10] = 3e38  # finite, but not their sum
    broken = replace(given, truth=given.truth._replace(disparity=disparity))
    with pytest.raises(Rts2Error, match="the loss is inf, for the batch of a, b"):
        learner.step([broken], 1e-3)
    assert torch.equal(weights(learner), before)
    assert learner.updates == 1


def test_a_gradient_that_is_not_finite_names_the_batch_too() -> None:
    learner = trainer()
    parameter = next(learner.network.parameters())
    parameter.register_hook(lambda slope: slope * math.nan)
    before = weights(learner)
    with pytest.raises(Rts2Error, match="the gradient is nan, for the batch of a, b"):
        learner.step([batch()], 1e-3)
    assert torch.equal(weights(learner), before)


def test_class_weights_enter_the_semantic_terms_alone() -> None:
    shares = np.full(19, 1 / 19)
    shares[:2] = (1.5 / 19, 0.5 / 19)
    given = recipe(k=1.12)
    torch.manual_seed(0)
    weighted = Trainer(build(given.arch), given, "fp32", CPU, shares=shares)
    plain = trainer()
    terms = [learner.step([batch()], 1e-3).terms for learner in (weighted, plain)]
    for name in terms[0]:
        assert (terms[0][name] == terms[1][name]) == ("semantic" not in name)


@pytest.mark.filterwarnings("ignore:.*bfloat16.*")
def test_mixed_precision_keeps_disparities_in_fp32_and_the_loss_close() -> None:
    full, mixed = trainer(), trainer("bf16")
    wanted, found = full.step([batch()], 1e-3), mixed.step([batch()], 1e-3)
    for stage in found.stages:
        assert stage.disparity.dtype == torch.float32
        assert stage.refined is not None
        assert stage.refined.dtype == torch.float32
        assert stage.scores is not None
        assert stage.scores.dtype == torch.bfloat16
    assert found.loss == pytest.approx(wanted.loss, rel=0.05)
    assert all(p.dtype == torch.float32 for p in mixed.network.parameters())


def test_precision_follows_the_device() -> None:
    assert resolve("fp32", CPU) == "fp32"
    assert resolve("auto", CPU) in ("fp32", "bf16")
    with pytest.raises(UsageError, match="fp16 trains on CUDA alone"):
        resolve("fp16", CPU)


def test_convolutions_lie_channels_last() -> None:
    network = build(recipe().arch)
    lay_out(network)
    stem, volume = network.encoder.stem[0][0].weight, network.regularize[0].layers[3].weight
    assert stem.is_contiguous(memory_format=torch.channels_last)
    assert volume.is_contiguous(memory_format=torch.channels_last_3d)


def test_terms_are_those_of_the_arch() -> None:
    assert term_names(recipe(arch={"c": 1, "stages": 1})) == [
        "disparity_1",
        "semantic_1",
        "refined_1",
    ]
    anynet = recipe(arch={"family": "anynet", "c": 1})
    assert term_names(anynet) == ["disparity_1", "disparity_2", "disparity_3"]
    learner = trainer(arch={"family": "anynet", "c": 1})
    assert list(learner.step([batch()], 1e-3).terms) == term_names(anynet)


def test_networks_beside_the_whole_one_add_to_its_gradient_and_tell_nothing() -> None:
    """Half of what a smaller one learns is the truth, half what the whole one says."""
    whole = {"arch": {"c": 2}, "supernet": 1}
    alone, among = trainer(**whole), trainer(**whole)
    small = recipe(arch={"c": 1}).arch
    first, second = alone.step([batch()], 1e-3), among.step([batch()], 1e-3, [small])
    assert second.terms == first.terms
    twin = trainer(**whole).network
    left, right = (alone._normalised(image) for image in (batch().left, batch().right))
    said, own = twin(left, right), run(twin, small, left, right)
    counted = count(batch().truth, (16, 8, 4))
    truth = total(means(sums(own, batch().truth), counted))
    ((truth + total(imitation(own, said))) / 2).backward()
    added = torch.cat([p.grad.flatten() for p in twin.parameters() if p.grad is not None])
    torch.testing.assert_close(gradient(among), gradient(alone) + added, rtol=1e-3, atol=1e-5)


def test_a_network_that_says_the_same_imitates_at_no_cost() -> None:
    learner = trainer()
    left, right = (learner._normalised(image) for image in (batch().left, batch().right))
    stages = learner.network(left, right)
    other = [stage._replace(disparity=stage.disparity + 3) for stage in stages]
    terms = imitation(stages, stages)
    assert set(terms) == set(term_names(learner.recipe))
    assert all(value.item() == pytest.approx(0, abs=1e-6) for value in terms.values())
    assert imitation(stages, other)["disparity_2"].item() == pytest.approx(2.5, rel=1e-5)
