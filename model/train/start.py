"""The weights that a run starts from."""

from __future__ import annotations

import logging
from pathlib import Path

import torch

from ..arch import Arch
from ..checkpoint import Network, build, cut, load
from ..errors import UsageError
from ..rts2net import RTS2Net
from ..supernet import extract, outside


def begin(arch: Arch, seed: int, init: Path | None) -> Network:
    """The network of step 0: the weights of the checkpoint `init`, or random ones of `seed`.

    A supernet gives the weights of any network that it holds. Of another checkpoint, branches and
    stages that it lacks start from random weights, and a line says so. Raises `UsageError` where
    its arch differs in more than that.
    """
    torch.manual_seed(seed)
    if init is None:
        return build(arch)
    network, header = load(init)
    differences = arch.missing_from(header.arch)
    if not differences:
        return cut(network, arch)
    if header.supernet and isinstance(network, RTS2Net) and not outside(arch, header.arch):
        return extract(network, arch)
    if header.arch.missing_from(arch):
        raise UsageError(
            f"{init} does not fit the arch: {'; '.join(differences)}; "
            "leave out --arch and --branches to train its own"
        )
    larger = build(arch)
    missing = larger.load_state_dict(network.state_dict(), strict=False).missing_keys
    note = "%s holds %d of the arch's %d tensors; the others start from random values"
    total = len(larger.state_dict())
    logging.getLogger(__name__).warning(note, init, total - len(missing), total)
    return larger
