"""A training run on disk: one safetensors file that continues it exactly.

Tensors: `network.NAME`, `first.NAME` and `second.NAME` (Adam's moments), `random.cpu` (and
`random.cuda`). Everything else stands in the header as JSON. No pickle is involved.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import torch
from pydantic import BaseModel, ConfigDict
from safetensors.torch import save
from torch import Tensor, nn

from ..checkpoint import read_stored
from ..errors import Rts2Error
from ..files import write_bytes
from .recipe import Recipe

HEADER: Final = "rts2-train"
"""The key of our entry in the safetensors header."""

MOMENTS: Final = {"first": "exp_avg", "second": "exp_avg_sq"}
"""Our names of Adam's moments, and torch's."""


class Standing(BaseModel):
    """Where a run stands."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    recipe: Recipe
    step: int
    """Steps done."""
    updates: int
    """Steps that moved the weights; loss scaling may have left some out."""
    samples: int
    """How many samples the data set has."""
    digest: str
    """The SHA-256 of their names, and of the generator where one makes them."""
    class_shares: list[float] | None
    """Each class's share of the labelled pixels; None without class weights."""
    scaler: dict[str, int | float] | None
    """The state of the loss scaling, its counts as whole numbers; None where there is none."""
    seconds: float
    """Time spent training."""


def save_state(
    path: Path, standing: Standing, network: nn.Module, optimizer: torch.optim.Optimizer
) -> None:
    """Writes the whole state, or nothing."""
    tensors = {f"network.{name}": value for name, value in network.state_dict().items()}
    for name, parameter in network.named_parameters():
        moments = optimizer.state.get(parameter, {})
        tensors |= {f"{ours}.{name}": moments[its] for ours, its in MOMENTS.items() if moments}
    tensors["random.cpu"] = torch.get_rng_state()
    if torch.cuda.is_available():
        tensors["random.cuda"] = torch.cuda.get_rng_state()
    whole = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    write_bytes(path, save(whole, {HEADER: standing.model_dump_json()}))


def read_standing(path: Path) -> Standing:
    """Where the run of a state file stands. Raises `Rts2Error` for any other file."""
    return _read(path, tensors=False)[0]


def restore(path: Path, updates: int, network: nn.Module, optimizer: torch.optim.Optimizer) -> None:
    """Fills network, optimizer and the random state from a state file after `updates` updates.

    Values are copied into the tensors that stand, as their layout in memory is part of what makes
    a step exact.
    """
    _, tensors = _read(path)
    try:
        _fill(tensors, updates, network, optimizer)
    except (KeyError, RuntimeError) as error:
        raise Rts2Error(f"{path} does not fit its recipe: {error}") from error


def _read(path: Path, tensors: bool = True) -> tuple[Standing, dict[str, Tensor]]:
    lacking = "training state; choose another --out"
    return read_stored(path, HEADER, Standing, lacking, tensors)


def _fill(
    tensors: dict[str, Tensor], updates: int, network: nn.Module, optimizer: torch.optim.Optimizer
) -> None:
    network.load_state_dict(
        {name: tensors[f"network.{name}"] for name in network.state_dict()}, strict=True
    )
    for name, parameter in network.named_parameters():
        if f"first.{name}" not in tensors:
            continue  # never had a gradient
        state: dict[str, Any] = {"step": torch.tensor(float(updates))}
        for ours, its in MOMENTS.items():
            state[its] = torch.empty_like(parameter, requires_grad=False)
            state[its].copy_(tensors[f"{ours}.{name}"])
        optimizer.state[parameter] = state
    torch.set_rng_state(tensors["random.cpu"])
    if "random.cuda" in tensors and torch.cuda.is_available():
        torch.cuda.set_rng_state(tensors["random.cuda"])
