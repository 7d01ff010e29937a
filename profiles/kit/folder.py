"""Writing a kit: graphs that the device's importer takes, and the scripts that time them there."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from importlib import resources
from importlib.metadata import version
from pathlib import Path

from ...model.arch import UNTRAINED, Precision
from ...model.errors import UsageError
from ...model.files import filling_folder, write_bytes, write_json
from ..opset import refuse_operators
from ..plan import Candidate
from ..profile import Profile, RuntimeSupport
from ..trtexec import LOCATE, PRECISIONS, build_flags
from .manifest import MANIFEST, KitNetwork, Manifest
from .plan import networks
from .prior import prior

Progress = Callable[[Iterable[Candidate], str, int], Iterable[Candidate]]

OPSET = 13
"""Where a profile does not say which opset its TensorRT reads: all since 8.0 read this one."""


def runtime_of(profile: Profile) -> RuntimeSupport:
    """The device's TensorRT; `UsageError` where it has none."""
    for support in profile.runtimes:
        if support.runtime == "tensorrt":
            return support
    raise UsageError(
        f"a kit runs trtexec, and {profile.title} has no TensorRT; "
        "rts2-profile fit measures a machine that rts2 runs on"
    )


def refuse(profile: Profile, precisions: Sequence[Precision]) -> None:
    """Raises `UsageError` for a precision that the device or a kit does not run."""
    support = runtime_of(profile)
    for precision in precisions:
        build_flags(support.version, precision)
        refusal = profile.refusal(precision)
        if refusal is not None:
            raise UsageError(f"{profile.title} does not run {precision}: {refusal.reason}")


def default_precisions(profile: Profile) -> tuple[Precision, ...]:
    """Every precision that both the device and a kit run."""
    return tuple(precision for precision in PRECISIONS if profile.refusal(precision) is None)


def write(
    profile: Profile,
    precisions: Sequence[Precision],
    folder: Path,
    chosen: Sequence[Candidate] | None = None,
    progress: Progress = lambda items, *_: items,
) -> Manifest:
    """Writes the kit of a device into `folder`, which other files may share.

    `chosen` are the networks to time, by default those that tell the most. Equal arguments give
    equal bytes.

    Raises:
        UsageError: the device has no TensorRT, or does not run a precision.
        Rts2Error: a graph has an operator that the device's TensorRT does not take.
    """
    support = runtime_of(profile)
    refuse(profile, precisions)
    if chosen is None:
        chosen = networks(prior(profile, "tensorrt", precisions[0]).model)
    with filling_folder(folder, MANIFEST) as new:
        entries = [
            _network(f"network-{index:02}", candidate, support, new)
            for index, candidate in enumerate(progress(chosen, "exporting", len(chosen)), 1)
        ]
        manifest = Manifest(
            device=profile.name,
            version=support.version,
            precisions=tuple(precisions),
            reference=_reference(entries),
            networks=tuple(entries),
            rts2=version("rts2"),
        ).identified()
        write_bytes(new / "run.sh", _script(manifest).encode())
        write_bytes(new / "collect.py", _text("collect.py").encode())
        write_bytes(new / "README.md", _readme(manifest, profile).encode())
        write_json(new / MANIFEST, manifest.model_dump(mode="json", by_alias=True))
        (new / "run.sh").chmod(0o755)
    return manifest


def _network(name: str, candidate: Candidate, support: RuntimeSupport, folder: Path) -> KitNetwork:
    """Exports one network of random weights that are the same each time."""
    import torch

    from ...model.checkpoint import build
    from ...model.export import export

    arch, resolution = candidate
    path = folder / f"{name}.onnx"
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = build(arch)
    export(network, path, resolution, UNTRAINED, opset=support.opset or OPSET)
    refuse_operators(path, support)
    hashed = hashlib.sha256(path.read_bytes()).hexdigest()
    return KitNetwork(name=name, sha256=hashed, arch=arch, resolution=resolution)


def _reference(entries: Sequence[KitNetwork]) -> str:
    """The network that is neither small nor large: its time is short, and its noise low."""
    by_work = sorted(entries, key=lambda entry: entry.work)
    return by_work[len(by_work) // 3].name


def _script(manifest: Manifest) -> str:
    """run.sh with this kit's networks and the flags of its TensorRT."""
    cases = [
        f"    {precision}) echo '{' '.join(build_flags(manifest.version, precision))}' ;;"
        for precision in manifest.precisions
    ]
    reference_first = sorted(
        (network.name for network in manifest.networks),
        key=lambda name: (name != manifest.reference, name),
    )
    filled = {
        "@KIT@": manifest.kit,
        "@REFERENCE@": manifest.reference,
        "@NETWORKS@": " ".join(reference_first),
        "@PRECISIONS@": " ".join(manifest.precisions),
        "@FLAGS@": "\n".join(cases),
        "@LOCATE@": LOCATE,
    }
    text = _text("run.sh")
    for mark, value in filled.items():
        text = text.replace(mark, value)
    return text


def _text(name: str) -> str:
    return (resources.files(__package__) / "scripts" / name).read_text(encoding="utf-8")


def _readme(manifest: Manifest, profile: Profile) -> str:
    runs = len(manifest.networks) * len(manifest.precisions)
    listed = "\n".join(
        f"| {network.file} | {network.arch.label()} | "
        f"{network.resolution[0]}×{network.resolution[1]} |"
        for network in manifest.networks
    )
    return f"""# A field kit for {profile.title}

It times {len(manifest.networks)} networks in {" and ".join(manifest.precisions)} with `trtexec`
(TensorRT {manifest.version}). It needs a shell, Python 3.6 or newer, and nothing else.

1. Copy this folder to the device. Set the power mode and the clocks that the device will work at,
   and lock them (on a Jetson: `sudo nvpmodel -m 0`, `sudo jetson_clocks`).
2. On the device: `sh run.sh`. It makes {runs} engines, which takes from minutes on a desktop to
   an hour or more on a Jetson. What was timed stays: it may be interrupted and run again.
3. On the device: `python3 collect.py`. Copy `kit-results.json` back and turn it into a profile:

       rts2-profile import kit-results.json --device {profile.name} --out {profile.name}-mine.json

| file | network | images |
| --- | --- | --- |
{listed}

Weights are random: the times are real, the disparities mean nothing.
"""
