"""One set of weights for every network of a space (weight sharing).

Whatever a smaller network has, channels, planes of the first volume, widths of its 3D convs, is the
first part of what the largest network has; a layer that reads several maps side by side has the
first channels of each. Fewer stages or branches need no slicing at all: they are computed first and
nothing of the rest feeds back. So the weights of every network are slices of the largest's.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from typing import Final

import numpy as np
import torch
from torch import Tensor, nn
from torch.func import functional_call

from .arch import CONV3D, FACTORS, SPACE_CONV3D, SPACE_D_MAX, Arch
from .checkpoint import build
from .errors import UsageError
from .rts2net import RTS2Net, Stage

LEVEL: Final = re.compile(r"(disparity|semantic)\.levels\.(\d)\.0\.0\.weight")
HYBRID: Final = re.compile(r"refine\.(\d)\.residual\.0\.0\.0\.weight")
"""The layers that read several maps side by side."""

Norms: Final = (nn.BatchNorm2d, nn.BatchNorm3d)


def outside(arch: Arch, whole: Arch) -> list[str]:
    """What keeps `arch` from being sliced out of the weights of `whole`; empty if nothing does."""
    found = [
        f"{name} is at most {most}, {asked} was asked for"
        for name, asked, most in (
            ("c", arch.c, whole.c),
            ("stages", arch.stages, whole.stages),
            ("d_max", arch.d_max, whole.d_max),
        )
        if asked > most
    ]
    if any(asked > most for asked, most in zip(arch.conv3d, whole.conv3d, strict=False)):
        found.append(f"conv3d is at most {list(whole.conv3d)}, {list(arch.conv3d)} was asked for")
    for name in ("family", "classes"):
        asked, own = getattr(arch, name), getattr(whole, name)
        if asked != own and not (name == "classes" and not arch.semantic):
            found.append(f"{name} is {own}, {asked} was asked for")
    lacking = (b for b in ("semantic", "refinement") if getattr(arch, b) > getattr(whole, b))
    return found + [f"it has no {branch} branch" for branch in lacking]


def sliced(weights: Mapping[str, Tensor], whole: Arch, arch: Arch) -> dict[str, Tensor]:
    """The weights of `arch` among those of `whole`, by name: views where that is possible."""
    found = {}
    for name, like in _shapes(arch).items():
        if name not in weights:
            continue
        value = weights[name]
        inputs = _joined(name, arch)
        if inputs:
            maps = torch.split(value, list(_joined(name, whole)), 1)
            value = torch.cat([m[:, :own] for m, own in zip(maps, inputs, strict=True)], 1)
        found[name] = value[tuple(slice(length) for length in like)]
    return found


def extract(network: RTS2Net, arch: Arch) -> RTS2Net:
    """The network of `arch` with its slices of a supernet's weights.

    Its batch norms hold the largest network's statistics until they are recalibrated. Raises
    `UsageError` with everything in which the arch exceeds the supernet.
    """
    beyond = outside(arch, network.arch)
    if beyond:
        raise UsageError(f"the supernet does not hold that arch: {'; '.join(beyond)}")
    part = build(arch)
    assert isinstance(part, RTS2Net)  # of the supernet's family
    part.load_state_dict(sliced(network.state_dict(), network.arch, arch))
    return part


def run(
    network: RTS2Net,
    arch: Arch,
    left: Tensor,
    right: Tensor,
    prepare: Callable[[nn.Module], None] = lambda _network: None,
) -> list[Stage]:
    """What the network of `arch` says with its slices of `network`'s weights, as they are trained:
    gradients reach those, and every batch norm takes the statistics of the batch.

    `prepare` may put other layers in the place of those that have no weights yet.
    """
    weights = sliced(dict(network.named_parameters()), network.arch, arch)
    bare = _bare(arch)
    prepare(bare)
    found: list[Stage] = functional_call(bare, weights, (left, right))
    return found


def recalibrate(network: nn.Module, batches: Iterable[tuple[Tensor, Tensor]]) -> None:
    """Gives every batch norm the mean statistics of these batches (left, right), and no memory of
    those before; leaves the network in evaluation mode.
    """
    norms = [module for module in network.modules() if isinstance(module, Norms)]
    memory = [norm.momentum for norm in norms]
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum = None  # torch's word for a plain mean
    network.train()
    with torch.no_grad():
        for left, right in batches:
            network(left, right)
    for norm, momentum in zip(norms, memory, strict=True):
        norm.momentum = momentum
    network.eval()


def _bare(arch: Arch) -> RTS2Net:
    """The network of `arch` without weights, in training mode, its norms without statistics."""
    with torch.device("meta"):
        network = RTS2Net(arch)
    for module in network.modules():
        if isinstance(module, Norms):
            module.track_running_stats = False
            module.running_mean = module.running_var = module.num_batches_tracked = None
    return network.train()


def smallest(whole: Arch) -> Arch:
    """The smallest network trained among the weights of `whole`, all stages and branches."""
    widths = tuple(min(SPACE_CONV3D[stage][0], most) for stage, most in enumerate(whole.conv3d))
    return _part(whole, 1, min(SPACE_D_MAX[0], whole.d_max), widths)


def drawn(whole: Arch, rng: np.random.Generator) -> Arch:
    """A random network of `whole`: c log-uniform, as one more channel means less among many, all
    else uniform; every stage and branch, which train networks of fewer along.
    """
    c = round(float(np.exp(rng.uniform(np.log(0.5), np.log(whole.c + 0.5)))))
    d_max = int(rng.integers(min(SPACE_D_MAX[0], whole.d_max), whole.d_max + 1))
    widths = []
    for stage, most in enumerate(whole.conv3d):
        known = {width for width in (*SPACE_CONV3D[stage], CONV3D[stage], most) if width <= most}
        widths.append(int(rng.choice(sorted(known))))
    return _part(whole, max(c, 1), d_max, tuple(widths))


def beside(whole: Arch, seed: int, step: int, count: int) -> tuple[Arch, ...]:
    """What a step of the sandwich rule trains beside the largest: the smallest, `count` random."""
    rng = np.random.default_rng([seed, step])
    return (smallest(whole), *(drawn(whole, rng) for _ in range(count)))


def _part(whole: Arch, c: int, d_max: int, conv3d: tuple[int, ...]) -> Arch:
    return whole.model_copy(update={"c": c, "d_max": d_max, "conv3d": conv3d})


def _shapes(arch: Arch) -> dict[str, torch.Size]:
    with torch.device("meta"):
        return {name: value.shape for name, value in RTS2Net(arch).state_dict().items()}


def _joined(name: str, arch: Arch) -> tuple[int, ...]:
    """How many channels a layer reads of each map; empty where it reads one map."""
    level, hybrid = LEVEL.fullmatch(name), HYBRID.fullmatch(name)
    if level is not None:
        stage = int(level[2])
        deeper = 16 if level[1] == "semantic" else 0
        below = FACTORS[stage - 1] if stage else deeper
        return below * arch.c, FACTORS[stage] * arch.c
    if hybrid is not None:
        stage = int(hybrid[1])
        return arch.planes(stage), arch.planes(stage), 1 if stage else 0
    return ()
