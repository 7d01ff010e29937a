"""The forms in which a graph can hold the 3D convs of RTS²Net: as they are, or as 2D convs.

A 3D conv of 3×3×3 over (channels, planes) is exactly a 2D conv over channels·planes whose weights
are banded along the planes:

    W2[(o, d'), (i, d), y, x] = W3[o, i, d − d' + 1, y, x] where |d − d'| ≤ 1, else 0

with the channel at the fore: (o, d') is channel o·planes + d'. Planes out of range meet no weight,
which is the zero padding of the 3D conv. The 2D form multiplies planes/3 times as much, most of it
by zero, in the operator that every runtime knows best; which of the two is faster depends on the
runtime and on the widths.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from typing import TypeVar, get_args

import torch
from torch import Tensor, nn

from ..arch import Form
from ..checkpoint import Network
from ..errors import UsageError
from ..rts2net import Regularization

Formed = TypeVar("Formed", bound=Network)


class Banded(nn.Module):
    """A `Regularization` for one number of planes as 2D convs: the same answers, from eval mode.

    For deployment alone: in training mode its norms would take their statistics plane by plane,
    and its bands would not stay banded.
    """

    def __init__(self, regularization: Regularization, planes: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(*(_flat(layer, planes) for layer in regularization.layers))
        self.regression = regularization.regression
        self.eval()

    def forward(self, volume: Tensor, around: Tensor | None) -> tuple[Tensor, Tensor]:
        """(B, planes, h, w) → (B, planes, h, w), (B, 1, h, w)."""
        # One channel of planes is as many channels: the volume needs no other shape.
        regular = self.layers(volume)
        return regular, self.regression(regular, around)


def formed(network: Formed, forms: Sequence[Form] | None) -> Formed:
    """A copy of the network, in eval mode, whose stages hold their 3D convs in the given forms.

    `forms` has one entry for each stage of the network's arch; None or nothing means "3d" for all.

    Raises:
        UsageError: there is not one known form per stage.
    """
    copy = deepcopy(network)
    copy.eval()
    if forms:
        _check(network, forms)
        for stage, form in enumerate(forms):
            if form == "banded":
                volume, planes = copy.regularize[stage], copy.arch.planes(stage)
                # AnyNet's regressions are no part of its volumes.
                copy.regularize[stage] = (
                    Banded(volume, planes)
                    if isinstance(volume, Regularization)
                    else _flat(volume, planes).eval()
                )
    return copy


def forms_run(forms: Sequence[Form] | None, stages: int) -> tuple[Form, ...] | None:
    """The forms of the first `stages` stages; None where they are "3d" throughout."""
    run = tuple(forms or ())[:stages]
    return run if "banded" in run else None


def _check(network: Network, forms: Sequence[Form]) -> None:
    given, known = ", ".join(map(str, forms)), get_args(Form)
    unknown = [form for form in forms if form not in known]
    if unknown:
        raise UsageError(f"a form must be {' or '.join(known)}, not {unknown[0]}")
    stages = network.arch.stages
    if len(forms) != stages:
        raise UsageError(
            f"forms must be one for each stage of the network, {stages} in all, "
            f"not {len(forms)}: {given}"
        )


def _flat(layer: nn.Module, planes: int) -> nn.Module:
    """One layer, or a chain of them, over (channels, planes) as one over channels·planes."""
    if isinstance(layer, nn.Sequential):
        return nn.Sequential(*(_flat(each, planes) for each in layer))
    if isinstance(layer, nn.Conv3d):
        return _flat_conv(layer, planes)
    return _flat_norm(layer, planes) if isinstance(layer, nn.BatchNorm3d) else deepcopy(layer)


def _flat_conv(conv: nn.Conv3d, planes: int) -> nn.Conv2d:
    weight = _banded(conv.weight.detach(), planes)
    outputs, inputs = weight.shape[:2]
    # On no device, as weights that are replaced anyway should draw no random numbers.
    flat = nn.Conv2d(inputs, outputs, 3, padding=1, bias=False, device="meta")
    flat.weight = nn.Parameter(weight)
    return flat


def _banded(weight: Tensor, planes: int) -> Tensor:
    """(outputs, inputs, 3, 3, 3) → (outputs·planes, inputs·planes, 3, 3)."""
    diagonals = [torch.ones(planes - abs(step)).diag(step) for step in (-1, 0, 1)]
    bands = torch.stack(diagonals).to(weight)  # (3, planes of the output, planes of the input)
    spread = torch.einsum("oikyx,kpd->opidyx", weight, bands)
    return spread.flatten(2, 3).flatten(0, 1).contiguous()


def _flat_norm(norm: nn.BatchNorm3d, planes: int) -> nn.BatchNorm2d:
    flat = nn.BatchNorm2d(norm.num_features * planes, norm.eps).to(norm.weight)
    flat.load_state_dict(
        {
            name: value.repeat_interleave(planes) if value.dim() else value
            for name, value in norm.state_dict().items()
        }
    )
    return flat
