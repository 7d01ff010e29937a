"""The command that writes what deploys a network, and checks it there: rts2-deploy."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

from ...model.arch import UNTRAINED, Arch, Precision
from ...model.box import holding, in_box, judged, listed, named_model
from ...model.bundle import CONFIGURATION
from ...model.console import (
    KITTI,
    add_output,
    command,
    parser,
    print_json,
    resolution,
    screen,
    seed,
)
from ...model.errors import NothingFeasible, Rts2Error, UsageError
from ...model.files import filling_folder, remove, remove_empty
from ...profiles.profile import Profile, load, names
from ...profiles.trtexec import GENERATIONS
from ..result import read
from .bundle import TARGETS, Source, runtime_of, stale, write
from .configuration import as_judged, of_arch, of_point
from .schema import Deployment


@command
def deploy(arguments: Sequence[str] | None = None) -> int:
    """Writes the folder that runs a network on a device, or checks one."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    return _verify(words[1:]) if words[:1] == ["verify"] else _deploy(words)


def _deploy(arguments: Sequence[str]) -> int:
    options = _deploy_parser().parse_args(arguments)
    profile = load(options.device)
    asked = _asked(options, profile)
    path = options.model or (None if options.untrained else _boxed(asked))
    source = _weights(path, options, asked)
    if asked is None:
        asked = _unpromised(source.network.arch, options, profile)
    elif path is not None and in_box(path) and asked.expected is not None:
        expected = as_judged(asked.expected, judged(path, asked.arch))
        asked = asked.model_copy(update={"expected": expected})
    leftover = stale(options.out)
    with filling_folder(options.out, CONFIGURATION) as folder:
        complete = write(
            source, asked, profile, folder, options.tensorrt, options.target == "triton"
        )
    _clear(leftover, complete, options.out)
    if options.json:
        print_json(complete.model_dump(mode="json", by_alias=True))
        return 0
    title = f"{complete.arch.label()} for {profile.title}"
    names = "  ".join([*(file.name for file in complete.files), CONFIGURATION])
    for line in (
        f"{title}, {complete.precision}, weights {complete.weights}",
        f"written   {options.out}/  {names}",
        f"next      on the device: {TARGETS[complete.runtime].next_step}",
    ):
        screen().print(line, soft_wrap=True)
    return 0


def _clear(leftover: Sequence[Path], complete: Deployment, out: Path) -> None:
    """Removes what an earlier bundle left, but for what the new one has."""
    kept = {out / file.name for file in complete.files}
    for path in leftover:
        if path not in kept:
            remove(path)
            remove_empty(path.parent, out)


def _verify(arguments: Sequence[str]) -> int:
    """Checks a bundle on this machine."""
    from .verification import parsed, verify

    options = _verify_parser().parse_args(arguments)
    found = verify(options.bundle, options.json)
    if not options.json:
        print(found.text, end="")
    elif found.text:
        print_json(parsed(found.text))
    if found.failure is not None:
        raise Rts2Error(found.failure)
    return 0


def _verify_parser() -> argparse.ArgumentParser:
    described = parser(
        "rts2-deploy verify",
        "Checks a bundle: the hash of every file, then what its own verify.py checks: the answers "
        "on two pairs, and the frame rate beside the promised one.",
        "rts2-deploy verify rts2-bundle",
    )
    described.add_argument("bundle", type=Path, metavar="DIR", help="the bundle's folder")
    add_output(described, out=None)
    return described


def _deploy_parser() -> argparse.ArgumentParser:
    described = parser(
        "rts2-deploy",
        "Writes the folder that runs a network on a device: the ONNX graph, its configuration, "
        "how to build it there and how to check it there. `rts2-deploy verify DIR` checks one.",
        "rts2-deploy --front rts2-out/front.json --device tx2",
    )
    add = described.add_argument
    add("--device", required=True, help=f"{', '.join(names())}, or a device profile's JSON file")
    text = "a search's result: its pick is deployed"
    add("--front", type=Path, metavar="front.json", help=text)
    text = "deploy the front's prospect instead of its pick"
    add("--prospect", action="store_true", help=text)
    text = (
        "a checkpoint, or the name of a network in the box; with --front it must hold the pick's "
        "arch, and is cut to it (default: the network in the box that holds it)"
    )
    add("--model", type=named_model, metavar="CHECKPOINT", help=text)
    text = "random weights, to try speed and integration without a trained network"
    add("--untrained", action="store_true", help=text)
    add("--seed", type=seed, default=0, help="of the random weights (default: 0)")
    text = "image size, WxH (default: the search's, else 1242x375)"
    add("--resolution", type=resolution, metavar="WxH", help=text)
    text = "without a front: what the network is computed in (default: fp32)"
    add("--precision", choices=get_args(Precision), help=text)
    text = "without a front: what computes it (default: the device's first that has the precision)"
    add("--runtime", choices=tuple(TARGETS), help=text)
    text = "the generation of TensorRT that the device has (default: the profile's)"
    add("--tensorrt", choices=GENERATIONS, help=text)
    text = "triton adds a model repository for NVIDIA's inference server (default: device)"
    add("--target", choices=("device", "triton"), default="device", help=text)
    add_output(described, out="rts2-bundle")
    return described


def _unpromised(arch: Arch, options: argparse.Namespace, profile: Profile) -> Deployment:
    """The configuration of a network without a front."""
    precision: Precision = options.precision or "fp32"
    runtime = runtime_of(profile, options.runtime, precision).runtime
    if options.runtime not in (None, runtime):
        raise UsageError(
            f"{profile.title} runs {', '.join(known.runtime for known in profile.runtimes)}, not "
            f"{options.runtime}; rts2-profile fit --runtime {options.runtime} adds it to a profile"
        )
    size = options.resolution or KITTI
    return of_arch(arch, profile, precision, runtime, size)


def _asked(options: argparse.Namespace, profile: Profile) -> Deployment | None:
    """The configuration that the front asks for; None without a front."""
    if options.front is None:
        if options.model is None:
            raise UsageError("give --front front.json, --model CHECKPOINT, or both")
        if options.prospect:
            raise UsageError("--prospect is a front's; give --front front.json")
        return None
    _refuse_with_front(options)
    found = read(options.front)
    if found.device != profile.name:
        raise UsageError(
            f"{options.front} was searched for {found.device}, not for {profile.name}; "
            "search again for that device"
        )
    if options.resolution not in (None, found.resolution):
        width, height = found.resolution
        raise UsageError(f"{options.front} was searched at {width}x{height}; search again")
    point = found.prospect if options.prospect else found.selected
    if point is None:
        if found.prospect is not None:
            raise NothingFeasible(
                f"{options.front} has no pick; --prospect deploys what it would pick on "
                "extrapolated numbers, to be timed on the device"
            )
        role = "prospect" if options.prospect else "pick"
        raise NothingFeasible(f"{options.front} has no {role}; search with another target")
    return of_point(point, found, profile)


def _refuse_with_front(options: argparse.Namespace) -> None:
    """Raises `UsageError` for what a front has decided."""
    for name in ("precision", "runtime"):
        if getattr(options, name) is not None:
            raise UsageError(f"--{name} is the front's to say; search with it, or leave it out")


def _boxed(asked: Deployment | None) -> Path:
    """The network in the box that holds what the front asks for."""
    assert asked is not None, "without a model there is a front"
    path = holding(asked.arch)
    if path is None:
        raise UsageError(
            f"no network in the box holds {asked.arch.label()}; {listed()}: give --model "
            "CHECKPOINT (rts2-train makes one), or say --untrained for random weights"
        )
    return path


def _weights(path: Path | None, options: argparse.Namespace, asked: Deployment | None) -> Source:
    """The network to deploy, random without a path, and where its weights come from."""
    from ...model.checkpoint import build, cut
    from ...model.checkpoint import load as load_checkpoint

    if path is None:
        import torch

        assert asked is not None, "without a model there is a front"
        torch.manual_seed(options.seed)
        return Source(build(asked.arch), UNTRAINED)
    network, header = load_checkpoint(path)
    if not header.trained and not options.untrained:
        raise UsageError(f"{path} is untrained; --untrained deploys it all the same")
    if asked is None:
        return Source(network, header.origin)
    part = cut(network, asked.arch)
    if options.model is not None:
        return Source(part, header.origin)
    logging.getLogger(__name__).warning(
        "note: the accuracy that the search promises needs the training that it rests on; "
        "the weights of %s were %s (rts2-eval judges them, rts2-train --init %s goes on)",
        *(path.stem, header.origin, path.stem),
    )
    return Source(part, f"{path.stem} of the box, {header.origin}")
