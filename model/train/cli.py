"""The command that makes networks: rts2-train."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from time import sleep
from typing import TYPE_CHECKING, Any, Final

from ..arch import LARGEST, Arch, arch_from
from ..box import SHIPPED, named_model
from ..console import (
    add_output,
    command,
    parser,
    positive,
    print_json,
    progress,
    resolution,
    seed,
    whole_between,
)
from ..data.catalog import DATASETS, require_generated
from ..errors import Rts2Error, UsageError
from ..files import existing_file, parse_json, read_json, sha256
from ..machine import cores
from .recipe import PRESETS, SANDWICH, Recipe, recipe_from

if TYPE_CHECKING:
    import torch

    from ..checkpoint import Network
    from .distributed import World
    from .run import Finished, Setting

BRANCHES = {
    "disparity": {"semantic": False, "refinement": False},
    "disparity+semantic": {"semantic": True, "refinement": False},
    "full": {"semantic": True, "refinement": True},
}


SILENT = 20
"""So few samples are counted before anybody asks what goes on."""

TELLING_SECONDS = 2
"""How long a process keeps quiet about an error that another one may tell: torchrun ends all once
one has ended."""

MOST: Final = 1_000_000
"""The largest count that an option takes."""

MOST_THREADS: Final = 1024
"""So many threads or processes no machine runs well."""


@command
def train(arguments: Sequence[str] | None = None) -> int:
    """The command rts2-train: weights from a data set and a recipe."""
    options = _parser().parse_args(arguments)
    if "WORLD_SIZE" in os.environ:  # where processes do not meet, torch prints its own stack
        os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "FATAL")
    from .distributed import leave, world_of_environment

    world = world_of_environment()
    try:
        _trained(options, world)
    except Rts2Error as error:
        return _ended(error, world)
    finally:
        leave(world)
    return 0


def _trained(options: argparse.Namespace, world: World) -> None:
    from .distributed import join, require_divides

    options.init = None if options.init is None else named_model(options.init)
    recipe = _recipe(options)
    require_divides(world, recipe.batch, recipe.accumulate)
    setting = _setting(options, world)
    join(world, setting.device)
    finished = _run(options, recipe, setting)
    if world.first:
        _report(options, recipe, finished)


def _ended(error: Rts2Error, world: World) -> int:
    """Tells an error of one process among several, or leaves that to the one that knows better."""
    from .distributed import Everywhere, Lost

    if world.first and not isinstance(error, Lost):
        raise error
    sleep(TELLING_SECONDS)
    if isinstance(error, Everywhere):
        return error.exit_code  # the first process tells it
    if isinstance(error, Lost):
        raise error
    raise type(error)(f"process {world.rank}: {error}") from error


def _run(options: argparse.Namespace, recipe: Recipe, setting: Setting) -> Finished:
    from .run import run
    from .source import cached, open_samples

    samples = setting.world.together(
        lambda: cached(open_samples(recipe, options.data), options.cache)
    )
    return run(recipe, samples, lambda: _start(options, recipe), setting)


def _start(options: argparse.Namespace, recipe: Recipe) -> Network:
    """The weights of step 0: those of --init, else random ones of the recipe's seed."""
    from .start import begin

    return begin(recipe.arch, recipe.seed, options.init)


def _setting(options: argparse.Namespace, world: World) -> Setting:
    import torch

    from .run import Setting

    own = max(1, cores() // world.local_size)
    torch.set_num_threads(options.threads or own)
    device = _device(options.on, world.local)
    return Setting(
        out=options.out,
        device=device,
        world=world,
        workers=_workers(device, own) if options.workers is None else options.workers,
        checkpoint_every=options.checkpoint_every,
        picture_every=options.picture_every,
        shown=_shown if world.first else lambda items, _title, _total: items,
    )


def _shown(items: Iterable[Any], title: str, total: int) -> Iterable[Any]:
    if total > SILENT and not sys.stderr.isatty():
        print(f"{title} on {total} samples", file=sys.stderr, flush=True)
    return progress(items, title, total)


def _device(on: str, local: int) -> torch.device:
    import torch

    if on == "cpu" or (on == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    count = torch.cuda.device_count()
    if local >= count:
        from .distributed import Everywhere

        error = UsageError(
            f"every process needs a GPU of its own: process {local} of this machine finds "
            f"{count}; start fewer, or give --on cpu"
        )
        raise error if local == count else Everywhere(error)
    torch.cuda.set_device(local)
    return torch.device("cuda", local)


def _workers(device: torch.device, own: int) -> int:
    """A GPU leaves a process's own cores to the loader; on a CPU they train."""
    return min(own, 16) if device.type == "cuda" else max(1, own // 4)


def _recipe(options: argparse.Namespace) -> Recipe:
    """The preset's fields, with every option that was given in their place."""
    values: dict[str, Any] = dict(PRESETS[options.preset]) if options.preset else {}
    given = {name: getattr(options, name) for name in FIELDS if getattr(options, name) is not None}
    if "epochs" in given and "steps" in given:
        raise UsageError("give either --epochs or --steps")
    if "steps" in given:
        values.pop("epochs", None)  # the preset's
    values |= given
    if "dataset" not in values:
        raise UsageError("what to learn from is needed: give --preset or --dataset")
    if "epochs" not in values and "steps" not in values:
        raise UsageError("how long to train is needed: give --epochs or --steps")
    values |= _of_dataset(values, given)
    own = {n: getattr(options, n) for n in COLOURS if getattr(options, n) is not None}
    values["augmentation"] = values.get("augmentation", {}) | own
    whole = None if values.get("supernet") is None else LARGEST.model_dump()
    values["arch"] = _arch(options, values.get("arch", whole))
    if options.init is not None:
        values["init"] = sha256(existing_file(options.init, "the checkpoint to start from"))
    if options.crop is not None:
        values["crop"] = options.crop[::-1]
    return recipe_from(values)


def _of_dataset(values: dict[str, Any], given: dict[str, Any]) -> dict[str, Any]:
    """What the data set decides: its k, unless told, and whether its scenes can be counted out."""
    row = DATASETS[values["dataset"]]
    generated = ("count", "data_seed", "rectification_px")
    require_generated(values["dataset"], (name for name in generated if name in given))
    found: dict[str, Any] = {"k": values.get("k", row.k) or None}
    # The preset's count goes, where it is of generated scenes.
    return found | {"count": None} if row.has_folder else found


def _arch(options: argparse.Namespace, preset: dict[str, Any] | None) -> Arch:
    """That of --init, else the preset's, with what --arch and --branches say in its place."""
    values = dict(preset or {})
    if options.init is not None:
        from ..checkpoint import load

        values = load(options.init)[1].arch.model_dump()
    given = {} if options.arch is None else _arch_values(options.arch)
    if "stages" in given:
        values.pop("conv3d", None)  # one width a stage: those of another number do not fit
    values |= given
    if options.branches is not None:
        values |= BRANCHES[options.branches]
    return arch_from(values)


def _arch_values(text: str) -> dict[str, Any]:
    """`c=8,stages=3,conv3d=16/4/4`, a JSON object, or a JSON file."""
    if text.endswith(".json"):
        return read_json(Path(text), Arch, "the arch").model_dump()
    if text.lstrip().startswith("{"):
        parse_json(text, Arch, "--arch")
        return dict(json.loads(text))
    values: dict[str, Any] = {}
    for part in text.split(","):
        name, equals, value = (piece.strip() for piece in part.partition("="))
        if not equals:
            raise UsageError(f"--arch takes name=value, such as c=8,stages=3; not {part!r}")
        values[name] = [_value(v) for v in value.split("/")] if name == "conv3d" else _value(value)
    return values


def _value(text: str) -> Any:
    """A number or a truth value where `text` is one."""
    try:
        return json.loads(text)
    except ValueError:
        return text


FIELDS = (
    "dataset",
    "split",
    "count",
    "data_seed",
    "rectification_px",
    "epochs",
    "steps",
    "batch",
    "accumulate",
    "lr",
    "betas",
    "schedule",
    "halve_every",
    "k",
    "counted",
    "coarse_gamma",
    "precision",
    "seed",
    "supernet",
)
"""The recipe's fields that an option of the same name sets."""

COLOURS = ("gain", "gamma", "colour", "noise", "apart", "flip")
"""The fields of the augmentation that an option sets."""


def _parser() -> argparse.ArgumentParser:
    command = parser(
        "rts2-train",
        "Trains a network by the paper's schedule, or any other. The same command goes on where "
        "it was interrupted; torchrun makes it many processes.",
        "rts2-train --preset cityscapes-fine --init coarse/checkpoint.safetensors "
        "--data CITYSCAPES --out fine",
    )
    command.add_argument("--preset", choices=sorted(PRESETS), help="a row of the table of runs")
    command.add_argument("--dataset", choices=sorted(DATASETS), help="what to learn from")
    command.add_argument("--data", type=Path, metavar="DIR", help="the data set's folder")
    command.add_argument(
        "--split",
        metavar="NAME",
        help="the part of it, or a list file (default: its training part)",
    )
    command.add_argument(
        "--cache", type=Path, metavar="DIR", help="keeps decoded or generated scenes here"
    )
    command.add_argument("--arch", metavar="ARCH", help="c=8,stages=3,… or JSON (default: c=8)")
    command.add_argument("--branches", choices=sorted(BRANCHES), help="the variant")
    command.add_argument(
        "--supernet",
        nargs="?",
        type=_beside,
        const=SANDWICH,
        metavar="N",
        help="train the arch (default: the largest of the space) and, among its weights, every "
        f"smaller network: N random ones a step beside the smallest (default: {SANDWICH})",
    )
    command.add_argument(
        "--init",
        metavar="MODEL",
        help=f"what to start from: a checkpoint, or {', '.join(SHIPPED)} in the box",
    )
    add_output(command, "rts2-train")
    _add_schedule(command)
    _add_objective(command)
    _add_colours(command)
    _add_setting(command)
    return command


def _add_schedule(command: argparse.ArgumentParser) -> None:
    group = command.add_argument_group("schedule")
    group.add_argument("--epochs", type=positive, metavar="N")
    group.add_argument("--steps", type=_whole, metavar="N", help="instead of epochs")
    group.add_argument("--batch", type=_whole, metavar="N", help="over all processes (default: 6)")
    group.add_argument("--accumulate", type=_whole, metavar="N", help="micro-batches of a step")
    group.add_argument("--crop", type=resolution, metavar="WxH", help="(default: 512x256)")
    group.add_argument("--lr", type=positive, metavar="RATE", help="(default: 5e-4)")
    group.add_argument("--betas", type=float, nargs=2, metavar="B", help="(default: 0.9 0.999)")
    group.add_argument("--schedule", choices=("constant", "halved", "cosine"))
    group.add_argument("--halve-every", type=positive, metavar="EPOCHS", help="(default: 200)")
    group.add_argument("--precision", choices=("auto", "fp32", "bf16", "fp16"))
    group.add_argument("--seed", type=seed, metavar="N", help="of weights, order and crops")
    group.add_argument("--count", type=_whole, metavar="N", help="how many streets there are")
    group.add_argument("--data-seed", type=seed, metavar="N", help="which streets they are")
    text = "spread of a vertical offset of the streets' right images"
    group.add_argument("--rectification-px", type=float, metavar="PX", help=text)


def _add_objective(command: argparse.ArgumentParser) -> None:
    group = command.add_argument_group("objective")
    group.add_argument("--k", type=float, help="of the class weights; 0 weighs all classes alike")
    group.add_argument(
        "--counted", type=_whole, metavar="N", help="samples that the classes are counted on"
    )
    group.add_argument("--coarse-gamma", type=float, metavar="G", help="for coarse labels: 0.1")


def _add_colours(command: argparse.ArgumentParser) -> None:
    group = command.add_argument_group("augmentation")
    group.add_argument("--gain", type=float, metavar="S", help="brightness times 1 ± S")
    group.add_argument("--gamma", type=float, metavar="S", help="brightness to a power of 2^±S")
    group.add_argument("--colour", type=float, metavar="S", help="each channel times 1 ± S")
    group.add_argument("--noise", type=float, metavar="LEVELS", help="grey levels of noise")
    group.add_argument("--apart", type=float, metavar="S", help="how far the eyes differ, 0 … 1")
    group.add_argument("--flip", action=argparse.BooleanOptionalAction, help="upside down, too")


def _add_setting(command: argparse.ArgumentParser) -> None:
    group = command.add_argument_group("machine (changes no result)")
    group.add_argument("--on", choices=("auto", "cpu", "cuda"), default="auto")
    group.add_argument("--workers", type=_workers_given, metavar="N", help="processes that load")
    group.add_argument(
        "--threads", type=_threads, metavar="N", help="of torch (default: all cores)"
    )
    group.add_argument("--checkpoint-every", type=_whole, default=500, metavar="STEPS")
    group.add_argument("--picture-every", type=_whole, default=500, metavar="STEPS")


def _whole(text: str) -> int:
    return whole_between(text, 1, MOST)


def _beside(text: str) -> int:
    return whole_between(text, 0, 16)


def _threads(text: str) -> int:
    return whole_between(text, 1, MOST_THREADS)


def _workers_given(text: str) -> int:
    return whole_between(text, 0, MOST_THREADS)


def _report(options: argparse.Namespace, recipe: Recipe, finished: Finished) -> None:
    from .log import read_log
    from .run import CHECKPOINT, LOG, summary

    tenths = summary(read_log(options.out / LOG))
    if options.json:
        print_json(
            {
                "schema": "rts2.train/1",
                "checkpoint": str(options.out / CHECKPOINT),
                "recipe": recipe.model_dump(mode="json"),
                "precision": finished.precision,
                "steps": finished.steps,
                "resumed_at": finished.resumed_at,
                "epochs": finished.epochs,
                "seconds": finished.seconds,
                "log": tenths,
            }
        )
        return
    if finished.resumed_at == finished.steps:
        print("nothing was left to do; to go further: --init its checkpoint, in another --out")
    first, last = tenths[0], tenths[-1]
    print(f"{recipe.arch.label()} · {recipe.dataset} · {finished.steps} steps of {recipe.batch}")
    print(f"loss      {first['loss']:.3f} in the first tenth, {last['loss']:.3f} in the last")
    print(f"speed     {last['images_per_s']:.1f} images/s, {last['wait_share']:.1%} of it waiting")
    print(f"written   {options.out}/  checkpoint.safetensors  record.json  log.csv  …")
