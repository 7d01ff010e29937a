"""A supernet as a command means it: which file, judged on which data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

from pydantic import BaseModel, ConfigDict

from ..model.box import in_box, named_model, names
from ..model.errors import UsageError
from ..model.files import read_json
from .accuracy import Metric
from .result import Task

if TYPE_CHECKING:
    from ..model.data.catalog import Dataset
    from ..model.data.scene import Sample
    from .inherited import Inherited

HEADER_AT: Final = 8
"""A safetensors file begins with the length of its header, a JSON object."""

CACHE: Final = "judged"
"""The folder, in --out, of networks that were judged."""

RECORD: Final = "record.json"
"""What a training leaves beside its weights."""


class Record(BaseModel):
    """A training's record, as far as it is asked."""

    model_config = ConfigDict(frozen=True)

    seconds: float


def supernet(accuracy: str) -> Path | None:
    """The weights that `--accuracy` names, told by content; None for anything else."""
    path = named_model(accuracy) if accuracy in names() else Path(accuracy)
    if not path.is_file():
        return None
    with path.open("rb") as file:
        head = file.read(HEADER_AT + 1)
    return path if head[HEADER_AT:] == b"{" and not head.startswith(b"{") else None


def trained_s(path: Path) -> float | None:
    """How long a supernet trained; None where no record beside it tells."""
    record = path.with_suffix(".json") if in_box(path) else path.parent / RECORD
    if not record.is_file():
        return None
    return read_json(record, Record, "a training's record").seconds


@dataclass(frozen=True)
class Source:
    """What judges, as a value that other processes take."""

    path: Path
    data: Path
    """A folder, or `streets`."""
    dataset: str | None
    """None: told by the folder's layout."""
    split: str | None
    """What judges; None for the data set's own."""
    size: tuple[int, int]
    """Of streets."""
    folder: Path
    """Where judged networks are kept."""
    threads: int

    def open(self) -> Inherited:
        """The judge, on so many threads; once in a process, as it holds its images.

        Raises:
            UsageError: no such data, or a checkpoint that is no supernet.
            Rts2Error: a file is broken.
        """
        return _opened(self)

    def training(self) -> Sequence[Sample]:
        """What the norms take their statistics from."""
        return self._opened(self._row.trained)

    def judging(self) -> Sequence[Sample]:
        """What judges, apart from what trains where the data set has such a part."""
        row = self._row
        return self._opened(self.split or ("val" if "val" in row.splits else row.judged))

    def metrics(self, objective: Metric, task: Task) -> tuple[Metric, ...]:
        """The fronts to study: the objective's, and mIoU's where classes are asked for and known.

        Raises `UsageError` where the objective cannot be judged on these images.
        """
        labelled = self.judging()[0].read().semantic is not None
        if objective == "miou" and not labelled:
            raise UsageError(
                f"--objective miou needs images with labels, and {self.data} has none; take d1_all"
            )
        both = task == "semantic-stereo" and labelled
        return tuple(dict.fromkeys((objective, "miou") if both else (objective,)))

    @property
    def _row(self) -> Dataset:
        from ..model.data.catalog import DATASETS

        if self._name not in DATASETS:
            raise UsageError(f"--dataset must be one of {', '.join(DATASETS)}, not {self._name}")
        return DATASETS[self._name]

    @property
    def _name(self) -> str:
        from ..model.data.catalog import STREETS

        if str(self.data) == STREETS:
            return STREETS
        return self.dataset or ("folder" if (self.data / "left").is_dir() else "kitti2015")

    def _opened(self, split: str) -> Sequence[Sample]:
        from ..model.data.catalog import STREETS, open_dataset

        if self._name == STREETS:
            return open_dataset(STREETS, split=split, size=self.size)
        # A folder of a few frames has no written split: whoever judges on all calibrates on all.
        whole = self.split == "all" and split in self._row.splits
        return open_dataset(self._name, self.data, "all" if whole else split)


@cache
def _opened(source: Source) -> Inherited:
    import torch

    from .inherited import Data, Inherited

    torch.set_num_threads(source.threads)
    return Inherited(source.path, Data.of(source.training(), source.judging()), source.folder)
