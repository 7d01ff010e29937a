"""One training step: forward, objective, backward, update."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ..arch import MEAN, STD, STRIDES, Arch
from ..checkpoint import Network
from ..errors import Rts2Error
from ..losses import Counts, Sums, Truth, class_weights, count, imitation, means, sums, total
from ..rts2net import RTS2Net, Stage
from ..supernet import run
from .distributed import World, share_norms
from .loader import Batch
from .precision import DTYPES, Resolved
from .recipe import Recipe

TASKS: Final = ("disparity", "semantic", "refined")


@dataclass(frozen=True)
class Outcome:
    """What a step found before it moved the weights."""

    loss: float
    terms: dict[str, float]
    """Means over pixels, before stage and task weights."""
    stages: list[Stage]
    """The outputs for the step's first micro-batch."""


class Trainer:
    """A network with its optimizer, ready to step. Weights change in `step` alone."""

    def __init__(
        self,
        network: Network,
        recipe: Recipe,
        precision: Resolved,
        device: torch.device,
        world: World | None = None,
        shares: NDArray[np.float64] | None = None,
    ) -> None:
        """`shares` are the classes' shares of the labelled pixels; None weighs them alike."""
        self.recipe, self.device = recipe, device
        self.world = World() if world is None else world
        self.dtype = DTYPES[precision]
        self.network = network.to(device).train()
        lay_out(self.network)
        if self.world.size > 1:
            share_norms(self.network)
        self.optimizer = torch.optim.Adam(
            self.network.parameters(), lr=recipe.lr, betas=recipe.betas
        )
        self.scaler = torch.amp.GradScaler(device.type, enabled=precision == "fp16")
        self.updates = 0
        self.weights: Tensor | None = None
        if shares is not None and recipe.k is not None:
            weights = class_weights(shares, recipe.k)
            self.weights = torch.tensor(weights, dtype=torch.float32, device=device)

    def step(self, micros: Sequence[Batch], rate: float, beside: Sequence[Arch] = ()) -> Outcome:
        """Moves the weights by the objective over all micro-batches of all processes.

        Networks `beside` the whole one add to the gradient of the weights that they share with it.
        What is told is of the whole one alone. Raises `Rts2Error`, and leaves the weights, where
        loss or gradients are not finite.
        """
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.zero_grad(set_to_none=True)
        counts = self._counts(micros)
        summed: dict[str, Tensor] = {}
        shown: list[Stage] = []
        for batch in micros:
            stages, terms = self._backward(batch, counts, beside)
            shown = shown or [_detached(stage) for stage in stages]
            summed = {name: summed.get(name, 0) + value for name, value in terms.items()}
        values = torch.stack(list(summed.values()))
        gradients = [p.grad for p in self.network.parameters() if p.grad is not None]
        self.world.add([values, *gradients])
        terms = means(dict(zip(summed, values, strict=True)), counts, self.recipe.coarse_gamma)
        loss = float(total(terms))
        if not np.isfinite(loss):
            raise self._not_finite("loss", loss, micros)
        self._update(gradients, micros)
        return Outcome(loss, {name: float(value) for name, value in terms.items()}, shown)

    def _counts(self, micros: Sequence[Batch]) -> Counts:
        """The counts of the whole step, known before its first gradient."""
        arch = self.recipe.arch
        strides = STRIDES[: arch.stages] if arch.semantic else ()
        each = [
            count(Truth(b.truth.disparity, b.truth.labels if strides else None), strides)
            for b in micros
        ]
        own = sum(each[1:], each[0])
        return Counts.of(self.world.total(own.numbers()))

    def _backward(
        self, batch: Batch, counts: Counts, beside: Sequence[Arch]
    ) -> tuple[list[Stage], Sums]:
        """Adds a micro-batch's part of the gradient; returns its outputs and summed terms."""
        left, right = (self._normalised(image) for image in (batch.left, batch.right))
        labels = batch.truth.labels
        truth = Truth(
            batch.truth.disparity.to(self.device, non_blocking=True),
            None if labels is None else labels.to(self.device, non_blocking=True),
        )
        with self._mixed():
            stages: list[Stage] = self.network(left, right)
        terms = sums(stages, truth, self.weights)
        self._add(self._objective(terms, counts))
        for arch in beside:
            self._imitate(arch, (left, right), truth, stages, counts)
        return stages, {name: value.detach() for name, value in terms.items()}

    def _imitate(
        self,
        arch: Arch,
        pair: tuple[Tensor, Tensor],
        truth: Truth,
        largest: Sequence[Stage],
        counts: Counts,
    ) -> None:
        """Adds the gradient of a smaller network: half of it learns from the truth, half from what
        the largest one says of every pixel.
        """
        assert isinstance(self.network, RTS2Net)  # the recipe's rule
        with self._mixed():
            stages = run(self.network, arch, *pair, self._shared)
        learned = self._objective(sums(stages, truth, self.weights), counts)
        imitated = total(imitation(stages, largest)) / (self.recipe.accumulate * self.world.size)
        self._add((learned + imitated) / 2)  # all micro-batches have as many pixels

    def _objective(self, terms: Sums, counts: Counts) -> Tensor:
        return total(means(terms, counts, self.recipe.coarse_gamma))

    def _add(self, loss: Tensor) -> None:
        self.scaler.scale(loss).backward()  # type: ignore[no-untyped-call]  # torch's own

    def _mixed(self) -> torch.autocast:
        mixed = self.dtype != torch.float32
        return torch.autocast(self.device.type, self.dtype if mixed else None, enabled=mixed)

    def _shared(self, network: nn.Module) -> None:
        """Makes the norms of a network see all processes, where there are several."""
        if self.world.size > 1:
            share_norms(network)

    def _normalised(self, images: Tensor) -> Tensor:
        """(B, H, W, 3) bytes → (B, 3, H, W) as networks expect it, channels last in memory."""
        scale = torch.tensor(STD, device=self.device) * 255
        shift = torch.tensor(MEAN, device=self.device) / torch.tensor(STD, device=self.device)
        return (images.to(self.device, non_blocking=True) / scale - shift).permute(0, 3, 1, 2)

    def _update(self, gradients: Sequence[Tensor], micros: Sequence[Batch]) -> None:
        if self.scaler.is_enabled():  # it watches for what is not finite, and halves its scale
            before = self.scaler.get_scale()
            self.scaler.step(self.optimizer)
            self.scaler.update()
            self.updates += self.scaler.get_scale() >= before
            return
        norm = torch.stack([gradient.norm() for gradient in gradients]).norm()
        if not norm.isfinite():
            raise self._not_finite("gradient", float(norm), micros)
        self.optimizer.step()
        self.updates += 1

    def _not_finite(self, what: str, value: float, micros: Sequence[Batch]) -> Rts2Error:
        own = [name for batch in micros for name in batch.names]
        names = ", ".join(name for part in self.world.gathered(own) for name in part)
        return Rts2Error(f"the {what} is {value}, for the batch of {names}")


def lay_out(network: nn.Module) -> None:
    """Puts convolutions' weights channels last: the fast layout, on CPUs and on CUDA."""
    for module in network.modules():
        if isinstance(module, nn.Conv2d):
            module.weight.data = module.weight.data.to(memory_format=torch.channels_last)
        elif isinstance(module, nn.Conv3d):
            module.weight.data = module.weight.data.to(memory_format=torch.channels_last_3d)


def _detached(stage: Stage) -> Stage:
    """The same maps without their way back."""
    refined, scores = (None if m is None else m.detach() for m in (stage.refined, stage.scores))
    return Stage(stage.disparity.detach(), refined, scores)


def term_names(recipe: Recipe) -> list[str]:
    """The terms of a recipe's objective, stage by stage."""
    arch = recipe.arch
    present = {"disparity": True, "semantic": arch.semantic, "refined": arch.refinement}
    return [
        f"{task}_{stage}" for stage in range(1, arch.stages + 1) for task in TASKS if present[task]
    ]
