"""What a training run computes, as one frozen value; the paper's runs as a table.

Where two runs have equal recipes, data and machines, they compute the same weights. What changes
no result (where files go, how many workers load) is no part of it.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from ..arch import Arch
from ..errors import UsageError
from ..files import first_fault

Schedule = Literal["constant", "halved", "cosine"]
Precision = Literal["auto", "fp32", "bf16", "fp16"]

COUNTED: Final = 200
"""How many samples the share of each class is counted on, unless the recipe says otherwise."""

Positive = Annotated[int, Field(ge=1)]
Strength = Annotated[float, Field(ge=0, lt=1)]


class Augmentation(BaseModel):
    """How far colours may be drawn from what the camera gave; 0 leaves them.

    Both eyes share one draw, and each differs from it by `apart` of the same strengths: real
    cameras never agree. Each eye's draw ends at the strengths given, whatever `apart` is. Geometry
    stays, as the pair is rectified.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    gain: Strength = 0.0
    """Brightness is multiplied by 1 ± gain."""
    gamma: Strength = 0.0
    """Brightness is raised to a power of 2^±gamma."""
    colour: Strength = 0.0
    """Each channel is multiplied by 1 ± colour."""
    noise: Annotated[float, Field(ge=0, le=64)] = 0.0
    """The largest deviation of the noise, in grey levels."""
    apart: Annotated[float, Field(ge=0, le=1)] = 0.5
    flip: bool = False
    """Half of the samples upside down: keeps pairs rectified, and puts the sky below."""


class Recipe(BaseModel):
    """Everything that decides which weights come out."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    dataset: str
    split: str | None = None
    """Which part of the data set; None is its training part."""
    count: Positive | None = None
    """How many scenes a procedural data set has."""
    data_seed: Annotated[int, Field(ge=0)] = 0
    """Which scenes a procedural data set has."""
    rectification_px: Annotated[float, Field(ge=0, le=8)] = 0.0
    """The spread of a vertical offset of its right images: real pairs are never quite rectified."""
    arch: Arch = Arch()
    supernet: Annotated[int, Field(ge=0, le=16)] | None = None
    """How many random networks every step trains among the arch's weights, beside the arch and the
    smallest one (the sandwich rule); None trains the arch alone."""
    init: str | None = None
    """The SHA-256 of the checkpoint whose weights it starts from; None starts from random ones."""
    epochs: Annotated[float, Field(gt=0)] | None = None
    steps: Positive | None = None
    """How long: either epochs or steps."""
    batch: Positive = 6
    """Samples of a step, over all processes and micro-batches."""
    accumulate: Positive = 1
    """Into how many micro-batches a step is cut, one after the other."""
    crop: tuple[Positive, Positive] = (256, 512)
    """Height and width."""
    lr: Annotated[float, Field(gt=0)] = 5e-4
    betas: tuple[Annotated[float, Field(ge=0, lt=1)], Annotated[float, Field(ge=0, lt=1)]] = (
        0.9,
        0.999,
    )
    schedule: Schedule = "constant"
    halve_every: Annotated[float, Field(gt=0)] = 200
    """Epochs after which the `halved` schedule halves the rate."""
    k: Annotated[float, Field(gt=1)] | None = None
    """Spreads the class weights (equation 3); None weighs all classes alike."""
    counted: Positive = COUNTED
    """How many samples the share of each class is counted on."""
    coarse_gamma: Annotated[float, Field(ge=0)] = 0.0
    """Raises the semantic loss where annotations are coarse; the paper's value is 0.1."""
    augmentation: Augmentation = Augmentation()
    precision: Precision = "auto"
    seed: Annotated[int, Field(ge=0)] = 0

    @model_validator(mode="after")
    def _consistent(self) -> Recipe:
        if (self.epochs is None) == (self.steps is None):
            raise ValueError("give either epochs or steps")
        if self.batch % self.accumulate:
            raise ValueError(
                f"a batch of {self.batch} does not divide into {self.accumulate} micro-batches"
            )
        if self.supernet is not None and self.arch.family != "rts2net":
            raise ValueError("a supernet is of the rts2net family; leave --supernet out")
        multiple, (height, width) = self.arch.multiple, self.crop
        if any(side % multiple for side in self.crop):
            raise ValueError(
                f"the crop must have sides that are multiples of {multiple}, not {width}x{height}"
            )
        return self

    def total_steps(self, samples: int) -> int:
        """How many steps the run has on a data set of `samples`."""
        if self.steps is not None:
            return self.steps
        assert self.epochs is not None  # the validator's rule
        return max(1, math.ceil(self.epochs * samples / self.batch))

    def epoch(self, step: int, samples: int) -> int:
        """The epoch in which `step` (from 0) begins."""
        return step * self.batch // samples

    def rate(self, step: int, samples: int) -> float:
        """The learning rate of `step` (from 0)."""
        if self.schedule == "cosine":
            return self.lr * (1 + math.cos(math.pi * step / self.total_steps(samples))) / 2
        if self.schedule == "halved":
            return float(self.lr * 0.5 ** (self.epoch(step, samples) // self.halve_every))
        return self.lr

    def beside(self, step: int) -> tuple[Arch, ...]:
        """What `step` (from 0) trains among the weights of the arch."""
        if self.supernet is None:
            return ()
        from ..supernet import beside  # which imports torch

        return beside(self.arch, self.seed, step, self.supernet)

    def differences(self, other: Recipe) -> list[str]:
        """What differs, field by field: `lr is 0.001 there, 0.0005 here`."""
        mine, others = _flat(self.model_dump(mode="json")), _flat(other.model_dump(mode="json"))
        names = sorted(mine.keys() | others.keys())
        return [
            f"{name} is {others.get(name)} there, {mine.get(name)} here"
            for name in names
            if mine.get(name) != others.get(name)
        ]


def recipe_from(values: dict[str, Any]) -> Recipe:
    """A `Recipe` from loose values; a wrong one raises a one-line `UsageError`."""
    try:
        return Recipe.model_validate(values)
    except ValidationError as error:
        fault = error.errors(include_url=False)[0]
        rule = fault["msg"].removeprefix("Value error, ")
        raise UsageError(first_fault(error) if fault["loc"] else rule) from error


def _flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = value
    return flat


STEREO: Final = {"semantic": False}
"""The arch of the paper's table I, for data without labels: disparity alone."""

SANDWICH: Final = 2
"""How many random networks a supernet's step trains unless told."""

OURS: Final = {
    "lr": 1e-3,
    "schedule": "cosine",
    "augmentation": {"gain": 0.2, "gamma": 0.2, "colour": 0.1, "noise": 4.0},
}
"""How we train on generated scenes."""

PRESETS: Final[dict[str, dict[str, Any]]] = {
    "cityscapes-coarse": {"dataset": "cityscapes-coarse", "epochs": 60, "coarse_gamma": 0.1},
    "cityscapes-fine": {"dataset": "cityscapes", "epochs": 75},
    "kitti": {"dataset": "kitti2015", "epochs": 800, "schedule": "halved"},
    "sceneflow-short": {"dataset": "sceneflow", "epochs": 10, "arch": STEREO},
    "sceneflow": {"dataset": "sceneflow", "epochs": 40, "arch": STEREO},
    "kitti-short": {"dataset": "kitti2015", "epochs": 300, "schedule": "halved"},
    "streets": {"dataset": "streets", "count": 4800, "epochs": 5, **OURS},
    "streets-long": {"dataset": "streets", "count": 20_000, "epochs": 20, **OURS},
    "supernet": {"dataset": "streets", "count": 20_000, "epochs": 20, "supernet": SANDWICH, **OURS},
}
"""The paper's runs (section IV-A, table I), and ours on scenes that need no download, of which
`streets` made the weights in the box. What a row does not say is the field's default; k is the data
set's own."""
