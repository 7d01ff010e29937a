"""A whole run: from a recipe and samples to a checkpoint, from wherever it stands."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from time import perf_counter
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError

from ..arch import UNTRAINED, Arch
from ..checkpoint import Network, build, not_finite, save
from ..data.scene import Sample, fingerprint
from ..errors import Rts2Error, UsageError
from ..files import output_folder, write_json
from ..machine import processor
from .distributed import Lost, World, first_line
from .loader import SMALLER, Batch, Fault, Places, ended, loader
from .log import Log, Row, read_log
from .monitor import Monitor
from .precision import Resolved, resolve
from .recipe import Recipe
from .source import Shown, class_shares, digest
from .state import Standing, read_standing, restore, save_state
from .trainer import Outcome, Trainer, term_names

STATE: Final = "state.safetensors"
CHECKPOINT: Final = "checkpoint.safetensors"
LOG: Final = "log.csv"
RECORD: Final = "record.json"
"""The files of a run."""

COMPUTING: Final = ("rts2", "torch", "numpy", "opencv-python-headless", "numba")
"""The packages whose versions may decide a bit of the weights."""

TENTHS: Final = 10
"""Into how many parts the record's summary of the log is cut."""


@dataclass(frozen=True)
class Setting:
    """Where and how a run is computed and shown; it changes no result."""

    out: Path
    device: torch.device
    world: World = World()  # noqa: RUF009  # a frozen value
    workers: int = 1
    checkpoint_every: int = 500
    picture_every: int = 500
    shown: Shown = lambda items, _title, _total: items


@dataclass(frozen=True)
class Finished:
    """What a run came to."""

    steps: int
    resumed_at: int
    epochs: float
    seconds: float
    """Time spent training, all resumptions together."""
    precision: Resolved


def run(
    recipe: Recipe, samples: Sequence[Sample], start: Callable[[], Network], setting: Setting
) -> Finished:
    """Trains to the recipe's last step, from the state in `setting.out` where there is one.

    `start` gives the weights of step 0. Raises:
        UsageError: the folder holds another run.
        Rts2Error: a sample is broken, the loss is not finite, the disk is full; the last
            checkpoint stands.
    """
    return Run(recipe, samples, start, setting).finish()


class Run:
    """A run that stands at some step."""

    def __init__(
        self,
        recipe: Recipe,
        samples: Sequence[Sample],
        start: Callable[[], Network],
        setting: Setting,
    ) -> None:
        self.recipe, self.samples, self.setting = recipe, samples, setting
        self.world = setting.world
        self.precision = resolve(recipe.precision, setting.device)
        self.steps = recipe.total_steps(len(samples))
        self.digest = digest(samples)
        self.state = setting.out / STATE
        standing = self.world.together(self._standing)
        self._agree(standing)
        if standing is None or standing.step < self.steps:
            self.world.together(self._require_writable)
        self.shares = self._shares(standing)
        network = build(recipe.arch) if standing else self.world.together(start)
        self.trainer = Trainer(
            network, recipe, self.precision, setting.device, self.world, self.shares
        )
        self.done, self.seconds = 0, 0.0
        self.kept: int | None = None
        if standing is not None:
            self.world.together(lambda: self._resume(standing))
        self.resumed_at = self.done

    def finish(self) -> Finished:
        """Takes every step that is left."""
        try:
            if self.done < self.steps:
                self._train()
        except Lost as error:
            raise Lost(f"step {self.done + 1}: {error}; {self._kept()}") from error
        return Finished(
            self.done,
            self.resumed_at,
            self.done * self.recipe.batch / len(self.samples),
            self.seconds,
            self.precision,
        )

    def _standing(self) -> Standing | None:
        """Where the run in the folder stands; `UsageError` where it is another run."""
        out = self.setting.out
        if not self.state.exists():  # which a run writes first
            for name in (CHECKPOINT, LOG, RECORD):
                if (out / name).exists():
                    raise UsageError(
                        f"{out} holds {name} without its run ({STATE}); choose another --out"
                    )
            return None
        found = read_standing(self.state)
        differences = self.recipe.differences(found.recipe)
        if found.samples != len(self.samples):
            differences.append(
                f"the data set has {found.samples} samples there, {len(self.samples)} here"
            )
        elif found.digest != self.digest:
            differences.append("the samples have other names, or another generator made them")
        if differences:
            raise UsageError(
                f"{out} holds another run: {'; '.join(differences)}; "
                "give the same options to go on with it, or another --out"
            )
        return found

    def _agree(self, standing: Standing | None) -> None:
        """All processes must see one folder and one data set; else an `Rts2Error`."""
        step = None if standing is None else standing.step
        views = self.world.gathered((step, len(self.samples), self.digest))
        for rank, view in enumerate(views):
            if view != views[0]:
                raise self.world.everywhere(
                    Rts2Error(
                        f"every machine must see the same --data and --out: process {rank} finds "
                        f"{view[1]} samples and step {view[0]}, process 0 {views[0][1]} and "
                        f"{views[0][0]}; share the folders"
                    )
                )

    def _require_writable(self) -> None:
        """Knows early whether results can be written; leaves no folder, as other faults may come.

        Raises `Rts2Error` where they cannot.
        """
        out = self.setting.out
        if not self.world.first:
            return
        missing = [folder for folder in (out, *out.parents) if not folder.exists()]
        try:
            output_folder(out)
        finally:
            for folder in missing:
                with suppress(OSError):
                    folder.rmdir()

    def _shares(self, standing: Standing | None) -> NDArray[np.float64] | None:
        """The classes' shares, counted once in a run's life."""
        if not self.recipe.arch.semantic or self.recipe.k is None:
            return None
        if standing is not None and standing.class_shares is not None:
            return np.array(standing.class_shares)
        setting = self.setting
        return class_shares(self.samples, self.recipe, setting.workers, self.world, setting.shown)

    def _resume(self, standing: Standing) -> None:
        restore(self.state, standing.updates, self.trainer.network, self.trainer.optimizer)
        self.trainer.updates = standing.updates
        if standing.scaler is not None:
            self.trainer.scaler.load_state_dict(dict(standing.scaler))
        self.done, self.seconds = standing.step, standing.seconds
        self.kept = standing.step

    def _train(self) -> None:
        if not self.world.first:
            for _ in self._stepped():
                if self._due(self.setting.checkpoint_every):
                    self.kept = self.done
            return
        out = output_folder(self.setting.out)
        output_folder(out / "pictures")
        if not self.state.exists():
            self._save_state()  # first of all: what else lies there is then known as ours
        with (
            closing(Log(out / LOG, term_names(self.recipe), self.done)) as log,
            closing(Monitor(out, self.steps, self.done)) as monitor,
        ):
            self._keep(log)
            for row, outcome, batch in self._stepped():
                log.write(row)
                monitor.step(row)
                if self._due(self.setting.picture_every):
                    monitor.picture(self.done, batch, outcome.stages)
                if self._due(self.setting.checkpoint_every):
                    self._keep(log)

    def _due(self, every: int) -> bool:
        return self.done % every == 0 or self.done == self.steps

    def _stepped(self) -> Iterator[tuple[Row, Outcome, Batch]]:
        """Takes the steps that are left; yields each one's line, outcome and first micro-batch."""
        recipe, count = self.recipe, len(self.samples)
        places = Places(recipe, self.done, self.steps, self.world.rank, self.world.size)
        pin = self.setting.device.type == "cuda"
        batches = iter(loader(self.samples, recipe, places, self.setting.workers, pin))
        begin = perf_counter()
        for step in range(self.done, self.steps):
            micros = self._fetched(batches)
            waited = perf_counter() - begin
            rate = recipe.rate(step, count)
            outcome = self._step(micros, rate, recipe.beside(step))
            took = perf_counter() - begin
            begin += took
            self.done, self.seconds = step + 1, self.seconds + took
            row: Row = {"step": step + 1, "epoch": recipe.epoch(step, count), "lr": rate}
            row |= {"loss": outcome.loss, **outcome.terms}
            row |= {"images_per_s": recipe.batch / took, "wait_share": waited / took}
            yield row | {"seconds": took}, outcome, micros[0]

    def _step(self, micros: list[Batch], rate: float, beside: Sequence[Arch]) -> Outcome:
        """One step; whatever ends it becomes one line."""
        try:
            return self.trainer.step(micros, rate, beside)
        except Lost:
            raise
        except Rts2Error as error:  # found in what all processes share
            told = Rts2Error(f"step {self.done + 1}: {error}; {self._kept()}")
            raise self.world.everywhere(told) from error
        except (RuntimeError, MemoryError) as error:
            if isinstance(error, MemoryError) or "memory" in str(error):
                raise Rts2Error(
                    f"step {self.done + 1} does not fit in memory; {SMALLER} ({first_line(error)})"
                ) from error
            if self.world.size > 1:
                raise self.world.lost(error) from error
            raise

    def _fetched(self, batches: Iterator[Batch | Fault]) -> list[Batch]:
        """The micro-batches of a step; a fault in any process ends all of them."""
        found: list[Batch | Fault] = []
        try:
            found += [next(batches) for _ in range(self.recipe.accumulate)]
        except (RuntimeError, MemoryError) as error:  # a worker was killed
            found.append(ended(error))
        faults = [fault for fault in found if isinstance(fault, Fault)]
        if self.world.total([len(faults)])[0]:
            told = [fault for part in self.world.gathered(faults) for fault in part]
            raise self.world.everywhere(told[0].error())
        return [batch for batch in found if isinstance(batch, Batch)]

    def _kept(self) -> str:
        """What is left on the disk, in words."""
        if self.kept is None:
            return "no checkpoint was written yet"
        return f"the checkpoint of step {self.kept} is kept"

    def _keep(self, log: Log) -> None:
        """Writes where the run stands: the state last, as it is what a run resumes from."""
        out, network, recipe = self.setting.out, self.trainer.network, self.recipe
        broken = not_finite(network)
        if broken:
            raise Rts2Error(
                f"{broken[0]} is not finite after step {self.done}; it is not saved; {self._kept()}"
            )
        log.sync()
        rows = read_log(out / LOG)
        try:
            save(network, out / CHECKPOINT, self._origin(rows), recipe.supernet is not None)
        except SafetensorError as error:
            raise Rts2Error(f"cannot write {out / CHECKPOINT}: {error}; {self._kept()}") from error
        self.kept = self.done
        write_json(out / RECORD, self._record(rows))
        self._save_state()

    def _save_state(self) -> None:
        """Writes what a run resumes from."""
        trainer = self.trainer
        scaler = trainer.scaler.state_dict() or None
        standing = Standing(
            recipe=self.recipe,
            step=self.done,
            updates=trainer.updates,
            samples=len(self.samples),
            digest=self.digest,
            class_shares=None if self.shares is None else self.shares.tolist(),
            scaler=scaler,
            seconds=self.seconds,
        )
        save_state(self.state, standing, trainer.network, trainer.optimizer)

    def _origin(self, rows: Sequence[Row]) -> str:
        """How the weights came to be, in a sentence."""
        if not rows:
            return UNTRAINED if self.recipe.init is None else f"begun from {self.recipe.init[:12]}"
        recipe = self.recipe
        loss = np.mean([row["loss"] for row in rows[-max(len(rows) // TENTHS, 1) :]])
        begun = "" if recipe.init is None else f", begun from {recipe.init[:12]}"
        return (
            f"trained on {recipe.dataset}, {self.done} of {self.steps} steps of {recipe.batch}, "
            f"seed {recipe.seed}, loss {loss:.3f}{begun}"
        )

    def _record(self, rows: Sequence[Row]) -> dict[str, Any]:
        """What somebody needs to know who meets the weights later."""
        return {
            "schema": "rts2.train-record/1",
            "recipe": self.recipe.model_dump(mode="json"),
            "precision": self.precision,
            "processes": self.world.size,
            "samples": len(self.samples),
            "data": fingerprint(self.samples),
            "steps": self.done,
            "steps_planned": self.steps,
            "images": self.done * self.recipe.batch,
            "seconds": self.seconds,
            "class_shares": None if self.shares is None else self.shares.tolist(),
            "log": summary(rows),
            "versions": _versions(),
            "machine": {
                "system": platform.platform(),
                "processor": machine(self.setting.device),
                "threads": torch.get_num_threads(),
            },
        }


def summary(rows: Sequence[Row]) -> list[Row]:
    """The means of a log's columns over each tenth of it, with the last step of each."""
    if not rows:
        return []
    ends = sorted({len(rows) * (part + 1) // TENTHS for part in range(TENTHS)} - {0})
    parts = [rows[begin:end] for begin, end in zip([0, *ends], ends, strict=False)]
    return [
        {name: float(np.mean([row[name] for row in part])) for name in part[0]}
        | {"step": part[-1]["step"]}
        for part in parts
    ]


def machine(device: torch.device) -> str:
    """The name of what computes."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else processor()


def _versions() -> dict[str, str]:
    """What computes, as far as it is installed."""
    found = {"python": platform.python_version()}
    for name in COMPUTING:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found
