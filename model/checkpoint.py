"""Weights on disk: our own safetensors with the arch in the header, and AnyNet's released files."""

from __future__ import annotations

import pickle
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

import torch
from pydantic import BaseModel, ConfigDict
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from .anynet import AnyNet
from .arch import UNTRAINED, Arch
from .errors import Rts2Error, UsageError
from .files import existing_file, parse_json, replacing
from .rts2net import RTS2Net

Network = RTS2Net | AnyNet
Schema = TypeVar("Schema", bound=BaseModel)

HEADER = "rts2"
"""The key of our entry in the safetensors header."""

FAMILIES: dict[str, type[RTS2Net] | type[AnyNet]] = {"rts2net": RTS2Net, "anynet": AnyNet}


class Header(BaseModel):
    """What a checkpoint of ours says of itself."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    arch: Arch
    origin: str
    """How the weights came to be, in a sentence; `untrained` for random ones."""
    supernet: bool = False
    """Whether the weights are those of every smaller network too."""

    @property
    def trained(self) -> bool:
        return self.origin != UNTRAINED


def build(arch: Arch) -> Network:
    """The network of `arch` with fresh random weights, in evaluation mode."""
    return FAMILIES[arch.family](arch).eval()


def save(network: Network, path: Path, origin: str, supernet: bool = False) -> None:
    """Writes weights and arch as safetensors, whole or not at all."""
    header = Header(arch=network.arch, origin=origin, supernet=supernet)
    weights = {name: value.contiguous() for name, value in network.state_dict().items()}
    with replacing(path) as temporary:
        save_file(weights, temporary, {HEADER: header.model_dump_json()})


def load(path: Path) -> tuple[Network, Header]:
    """A network from our safetensors or from a released AnyNet checkpoint, told by content.

    Raises:
        UsageError: there is no such file.
        Rts2Error: the file is truncated, foreign, or holds anything but plain tensors.
    """
    existing_file(path, "a checkpoint")
    with path.open("rb") as handle:
        head = handle.read(9)
    # A safetensors file starts with the length of its header, which may look like either mark.
    pickled = head[:2] in (b"PK", b"\x80\x02") and head[8:] != b"{"
    network, header = _import_anynet(path) if pickled else _load_own(path)
    broken = not_finite(network)
    if broken:
        raise Rts2Error(f"{path}: {broken[0]} holds values that are not finite; train it again")
    return network, header


def cut(network: Network, arch: Arch) -> Network:
    """The part of `network` that `arch` names: fewer stages, fewer branches, the same weights.

    Raises `UsageError` with every difference that no cut can bridge.
    """
    differences = arch.missing_from(network.arch)
    if differences:
        raise UsageError(f"the checkpoint does not hold that arch: {'; '.join(differences)}")
    part = build(arch)
    whole = network.state_dict()
    part.load_state_dict({name: whole[name] for name in part.state_dict()})
    return part


def parameters(network: nn.Module) -> int:
    """How many trained numbers a network has."""
    return sum(parameter.numel() for parameter in network.parameters())


def not_finite(network: nn.Module) -> list[str]:
    """The names of the tensors that hold a NaN or an infinity."""
    return [
        name
        for name, value in network.state_dict().items()
        if value.is_floating_point() and not value.isfinite().all()
    ]


def read_header(path: Path) -> Header:
    """What a checkpoint of ours says of itself, without its weights; raises as `load` does."""
    return _read_own(path, tensors=False)[0]


def _load_own(path: Path) -> tuple[Network, Header]:
    header, weights = _read_own(path)
    network = build(header.arch)
    _fill(network, weights, path)
    return network, header


def _read_own(path: Path, tensors: bool = True) -> tuple[Header, dict[str, Tensor]]:
    remedy = "rts2 reads the checkpoints that rts2 writes, and AnyNet's released ones"
    return read_stored(path, HEADER, Header, f"arch; {remedy}", tensors)


def read_stored(
    path: Path, entry: str, schema: type[Schema], lacking: str, tensors: bool = True
) -> tuple[Schema, dict[str, Tensor]]:
    """Our entry in a safetensors file's header, validated, and the file's tensors if wanted.

    `lacking` tells what a file without the entry holds none of, and what to do. Raises
    `Rts2Error` for such a file and for a broken one.
    """
    try:
        with safe_open(path, framework="pt") as file:
            text = (file.metadata() or {}).get(entry)
            if text is None:
                raise Rts2Error(f"{path} holds no {lacking}")
            found = {name: file.get_tensor(name) for name in (file.keys() if tensors else ())}
    except (SafetensorError, OSError) as error:
        raise Rts2Error(f"{path} is truncated or no safetensors file: {error}") from error
    return parse_json(text, schema, f"the header of {path}"), found


def _import_anynet(path: Path) -> tuple[Network, Header]:
    """AnyNet's official checkpoint: tensors behind `state_dict`, keys behind `module.`"""
    try:
        stored = torch.load(path, map_location="cpu", weights_only=True)
        weights = {str(key).removeprefix("module."): v for key, v in stored["state_dict"].items()}
    except pickle.UnpicklingError as error:
        raise Rts2Error(
            f"{path} is a pickle that holds more than tensors and could run code; "
            "load it where you trust it and save its state_dict with safetensors"
        ) from error
    except Exception as error:  # a broken file raises whatever torch's reader stumbles over
        raise Rts2Error(
            f"{path} is truncated or not a released AnyNet checkpoint; give one of those, "
            "or a checkpoint that rts2 wrote"
        ) from error
    named = {_own_name(key): value for key, value in weights.items() if "refine_spn" not in key}
    network = build(_arch_of(named, path))
    counters = {k: v for k, v in network.state_dict().items() if k.endswith("num_batches_tracked")}
    _fill(network, counters | named, path)  # the release predates batch counters
    return network, Header(arch=network.arch, origin=f"imported from {path.name}")


RENAMED = (
    (r"feature_extraction\.block0\.0\.", "features.stem."),
    (r"feature_extraction\.block0\.1\.", "features.down.0."),
    (r"feature_extraction\.blocks\.0\.", "features.down.1."),
    (r"feature_extraction\.blocks\.1\.", "features.down.2."),
    (r"feature_extraction\.upblocks\.(\d)\.conv\.", r"features.up.\1."),
    (r"volume_postprocess\.", "regularize."),
)
"""The official names of AnyNet's layers, and ours."""


def _own_name(key: str) -> str:
    for official, ours in RENAMED:
        key = re.sub(f"^{official}", ours, key)
    return key


def _arch_of(weights: Mapping[str, Tensor], path: Path) -> Arch:
    """The arch that AnyNet weights imply, read from their shapes."""
    try:
        return Arch(
            family="anynet",
            c=weights["features.stem.0.weight"].shape[0],
            conv3d=tuple(weights[f"regularize.{stage}.0.2.weight"].shape[0] for stage in range(3)),
        )
    except (KeyError, ValueError, IndexError, AttributeError) as error:
        raise Rts2Error(f"{path} does not hold the layers of AnyNet") from error


def _fill(network: Network, weights: Mapping[str, Tensor], path: Path) -> None:
    expected = network.state_dict()
    for name, tensor in expected.items():
        given = weights.get(name)
        if not isinstance(given, Tensor) or given.shape != tensor.shape:
            found = "missing" if given is None else f"of shape {list(getattr(given, 'shape', []))}"
            raise Rts2Error(f"{path}: {name} must have shape {list(tensor.shape)}, it is {found}")
    extra = sorted(weights.keys() - expected.keys())
    if extra:
        raise Rts2Error(f"{path} holds weights that its arch does not have, first {extra[0]}")
    network.load_state_dict(dict(weights))
