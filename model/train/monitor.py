"""What a person sees of a run while it runs: a bar or lines, curves, pictures."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Mapping
from pathlib import Path
from time import monotonic
from typing import Any, Final

import numpy as np

from ..data.images import Bytes, Disparity, write_image
from ..layers import enlarge
from ..metrics import IGNORED
from ..pictures import BRIGHTEST, coloured, painted
from ..rts2net import Stage
from .loader import Batch

LINE_SECONDS: Final = 30
"""How often a line is printed where there is no terminal."""

CURVE_STEPS: Final = 10
"""TensorBoard gets every tenth step: its files hold what a person looks at, the CSV all."""

SMOOTHED: Final = 0.95
"""How much of the loss shown is that of the steps before."""


class Monitor:
    """Shows a run. Nothing here changes what a step computes."""

    def __init__(self, folder: Path, steps: int, done: int) -> None:
        self.folder, self.steps, self.begun = folder, steps, done
        self.curves = _writer(folder / "tensorboard", done)
        self.start = self.told = monotonic()
        self.smooth: float | None = None
        if done:
            sys.stderr.write(f"going on from step {done} of {steps}\n")
        self.bar, self.task = _bar(steps, done)

    def step(self, row: Mapping[str, float]) -> None:
        """Shows a finished step from its line of the log."""
        step, loss = int(row["step"]), row["loss"]
        self.smooth = (
            loss if self.smooth is None else SMOOTHED * self.smooth + (1 - SMOOTHED) * loss
        )
        if step % CURVE_STEPS == 0:
            for name, value in row.items():
                if name != "step":
                    self.curves.add_scalar(name, value, step)
        now = monotonic()
        rate = f"{row['images_per_s']:.1f} images/s, {row['wait_share']:.0%} waiting"
        if self.bar is not None:
            text = f"loss {self.smooth:.3f} · {rate}"
            self.bar.update(self.task, completed=step, text=text)
        elif now - self.told >= LINE_SECONDS or step == self.steps:
            self.told = now
            left = (now - self.start) / (step - self.begun) * (self.steps - step)
            sys.stderr.write(
                f"step {step} of {self.steps} · epoch {int(row['epoch'])} · loss {self.smooth:.3f} "
                f"· {rate} · {_duration(left)} left\n"
            )
            sys.stderr.flush()

    def picture(self, step: int, batch: Batch, stages: list[Stage]) -> None:
        """Writes the first pair of a batch with what the network made of it."""
        image = panel(batch, stages[-1])
        write_image(self.folder / "pictures" / f"{step:07d}.png", image)
        self.curves.add_image("sample", image, step, dataformats="HWC")

    def close(self) -> None:
        if self.bar is not None:
            self.bar.stop()
        self.curves.close()


def panel(batch: Batch, stage: Stage) -> Bytes:
    """Two rows: left image, truth, labels; right image, estimate, estimated labels."""
    truth = batch.truth.disparity[0].numpy()
    size = truth.shape
    estimate: Disparity = (
        enlarge(stage.best[:1].float(), size[0] // stage.best.shape[-2])[0, 0].cpu().numpy()
    )
    known = truth[np.isfinite(truth)]
    highest = float(np.percentile(known, BRIGHTEST)) if known.size else None
    rows = [
        [batch.left[0].numpy(), coloured(truth, highest)],
        [batch.right[0].numpy(), coloured(estimate, highest)],
    ]
    if stage.scores is not None:
        scores = enlarge(stage.scores[:1].float(), size[0] // stage.scores.shape[-2])
        labels = batch.truth.labels
        wanted = np.full(size, IGNORED, np.uint8) if labels is None else labels[0].numpy()
        rows[0].append(painted(wanted))
        rows[1].append(painted(scores[0].argmax(0).byte().cpu().numpy()))
    return np.vstack([np.hstack(row) for row in rows])


def _bar(steps: int, done: int) -> tuple[Any, Any]:
    """A bar on stderr with the time left; none where stderr is no terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
    from rich.progress import TimeRemainingColumn as Left

    console = Console(stderr=True)
    if not console.is_terminal:
        return None, None
    text = TextColumn("{task.fields[text]}", markup=False)
    bar = Progress(MofNCompleteColumn(), BarColumn(), Left(), text, console=console)
    bar.start()
    return bar, bar.add_task("", total=steps, completed=done, text="")


def _writer(folder: Path, done: int) -> Any:
    """TensorBoard's writer; curves of steps after `done` give way to new ones."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from torch.utils.tensorboard import SummaryWriter

        return SummaryWriter(str(folder), purge_step=done + 1 if done else None)


def _duration(seconds: float) -> str:
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}"
