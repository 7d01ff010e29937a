"""The data sets by name: how each is opened, its splits, and what training takes from it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from ..errors import UsageError
from . import cityscapes, kitti, sceneflow
from . import folder as plain
from .frame import Frame
from .layout import chosen, read_names
from .scene import Sample
from .streets import VAL_SEED, Look, Streets

STREETS: Final = "streets"

ALL: Final = "all"
"""The split of every frame with truth; a list file chooses from it."""

STREETS_COUNT: Final[Mapping[str, int]] = {"train": 10_000, "val": 200}
"""How many streets a split has unless told."""

STREETS_SIZE: Final = (1242, 375)

CITYSCAPES_K: Final = 1.12
KITTI_K: Final = 2.0
"""k of the class weights (the paper's equation 3)."""


@dataclass(frozen=True)
class Dataset:
    """One row of the catalog."""

    about: str
    splits: tuple[str, ...]
    trained: str
    """The split that training takes unless told."""
    judged: str
    """The split that evaluation takes unless told."""
    k: float
    """Of the class weights."""
    frames: Callable[[Path, str], tuple[Frame, ...]] | None
    """Opens a split in a folder; None where nothing is on disk."""

    @property
    def has_folder(self) -> bool:
        """Whether the data set lies in a folder that the user names."""
        return self.frames is not None


DATASETS: Final[Mapping[str, Dataset]] = {
    "kitti2015": Dataset(
        about="KITTI 2015: the folder that holds training/",
        splits=(ALL, "train", "val", "test"),
        trained="train",
        judged=ALL,
        k=KITTI_K,
        frames=kitti.open_2015,
    ),
    "kitti2012": Dataset(
        about="KITTI 2012: the folder that holds training/",
        splits=(ALL, "test"),
        trained=ALL,
        judged=ALL,
        k=KITTI_K,
        frames=kitti.open_2012,
    ),
    "cityscapes": Dataset(
        about="Cityscapes, fine labels: the folder that holds leftImg8bit/",
        splits=("train", "val", ALL, "test"),
        trained="train",
        judged="val",
        k=CITYSCAPES_K,
        frames=cityscapes.open_fine,
    ),
    "cityscapes-coarse": Dataset(
        about="Cityscapes, coarse labels: the folder that holds leftImg8bit/",
        splits=("train_extra", "train", "val", ALL),
        trained="train_extra",
        judged="val",
        k=CITYSCAPES_K,
        frames=cityscapes.open_coarse,
    ),
    "sceneflow": Dataset(
        about="SceneFlow, clean pass: the folder that holds FlyingThings3D/, Driving/ or Monkaa/",
        splits=("train", "test", ALL),
        trained="train",
        judged="test",
        k=CITYSCAPES_K,
        frames=sceneflow.open_clean,
    ),
    "sceneflow-final": Dataset(
        about="SceneFlow, final pass: as sceneflow",
        splits=("train", "test", ALL),
        trained="train",
        judged="test",
        k=CITYSCAPES_K,
        frames=sceneflow.open_final,
    ),
    "folder": Dataset(
        about="any pairs: the folder that holds left/, right/, and maybe disparity/ and semantic/",
        splits=(ALL,),
        trained=ALL,
        judged=ALL,
        k=CITYSCAPES_K,
        frames=plain.open_all,
    ),
    STREETS: Dataset(
        about="generated street scenes; nothing to download, no folder",
        splits=("train", "val"),
        trained="train",
        judged="val",
        k=CITYSCAPES_K,
        frames=None,
    ),
}
"""What --dataset takes. A new data set is one more row."""


def require_generated(name: str, given: Iterable[str]) -> None:
    """Raises `UsageError` where an option of `given` is not for the data set, as nobody makes it.

    `given` names options as their fields are named, `data_seed` for --data-seed.
    """
    if not DATASETS[name].has_folder:
        return
    for option in given:
        raise UsageError(
            f"--{option.replace('_', '-')} is for generated scenes (--dataset {STREETS}), and "
            f"{name} lies in a folder; leave it out, or give --split a list"
        )


def open_dataset(
    name: str,
    folder: Path | None = None,
    split: str | Path | None = None,
    *,
    count: int | None = None,
    size: tuple[int, int] | None = None,
    seed: int = 0,
    rectification_px: float = 0.0,
) -> Sequence[Sample]:
    """The samples of a data set, none of them read yet.

    `split` is one of the row's splits, or a file that lists frames; None stands for the split that
    judges. `count`, `size` (width, height), `seed` and `rectification_px`, the spread of a vertical
    offset of the right image, are for `streets`, the rest has its own;
    the streets that judge have a seed of their own, whatever `seed` says.

    Raises:
        UsageError: no such data set, folder or split; the folder does not hold the layout.
        Rts2Error: some frames lack one of their files.
    """
    row = DATASETS.get(name)
    if row is None:
        raise UsageError(f"a data set must be one of {', '.join(DATASETS)}, not {name!r}")
    wanted = row.judged if split is None else str(split)
    if row.frames is None:
        look = Look(rectification_px=rectification_px)
        return _streets(row, folder, wanted, count, size or STREETS_SIZE, seed, look)
    if folder is None:
        raise UsageError(f"{name} needs its folder ({row.about}); give --data DIR")
    if wanted in row.splits:
        return row.frames(folder, wanted)
    if not Path(wanted).is_file():
        raise _no_split(name, row, f"{wanted} is neither of them nor a file that lists frames")
    return chosen(row.frames(folder, ALL), read_names(Path(wanted)), wanted, folder)


def _streets(
    row: Dataset,
    folder: Path | None,
    split: str,
    count: int | None,
    size: tuple[int, int],
    seed: int,
    look: Look,
) -> Sequence[Sample]:
    """Generated scenes: what trains and what judges differ in their seed."""
    if folder is not None:
        raise UsageError(f"{STREETS} are generated and have no folder; leave out --data {folder}")
    if split not in row.splits:
        raise _no_split(STREETS, row, f"not {split}")
    if split == "train" and seed == VAL_SEED:
        raise UsageError(f"the seed {VAL_SEED} belongs to the streets that judge; take another")
    count = STREETS_COUNT[split] if count is None else count
    return Streets(count, seed if split == "train" else VAL_SEED, size, look)


def _no_split(name: str, row: Dataset, found: str) -> UsageError:
    return UsageError(f"the splits of {name} are {', '.join(row.splits)}: {found}")
