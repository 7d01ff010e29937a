"""The networks in the box: trained weights that come with the package, called by name."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Final

from pydantic import BaseModel, ConfigDict

from .arch import Arch
from .errors import UsageError
from .files import read_json

DEFAULT: Final = "c8"
"""What runs where no model is given."""

SHIPPED: Final = ("c1", "c4", "c8")

SUFFIX: Final = ".safetensors"

JUDGE: Final = "kitti2015"
"""Whose real frames tell what a network in the box reaches."""


class Figures(BaseModel):
    """What a network reached after `stage` stages; None where nobody knows."""

    model_config = ConfigDict(frozen=True)

    stage: int
    d1_all: float | None
    epe: float | None
    miou: float | None


class Judged(BaseModel):
    """A network's figures on a data set."""

    model_config = ConfigDict(frozen=True)

    dataset: str
    split: str
    samples: int
    stages: tuple[Figures, ...]


class Record(BaseModel):
    """What stands beside a network in the box, as far as it is asked."""

    model_config = ConfigDict(frozen=True)

    judged: tuple[Judged, ...]


def named_model(text: str) -> Path:
    """The file that a user means: a network in the box by its name, or a path as it is given.

    A name is a bare word, without folder and suffix, and the box comes first: one command means
    one network in every folder. `./c8` is the file of that name.

    Raises `UsageError` for a word that is neither in the box nor a file.
    """
    path = Path(text)
    if not _is_word(text):
        return path
    boxed = _folder() / f"{text}{SUFFIX}"
    if boxed.is_file():
        return boxed
    if path.exists():
        return path
    raise UsageError(
        "a model (a checkpoint or an ONNX file) must be a file, or the name of a network in the "
        f"box: {text} is neither; {listed()}"
    )


def names() -> tuple[str, ...]:
    """The networks that this installation has."""
    folder = _folder()
    return tuple(sorted(path.stem for path in folder.glob(f"*{SUFFIX}"))) if folder.is_dir() else ()


def holding(arch: Arch) -> Path | None:
    """The network in the box out of which `arch` can be cut; None where there is none."""
    from .checkpoint import read_header

    for name in names():
        path = _folder() / f"{name}{SUFFIX}"
        if not arch.missing_from(read_header(path).arch):
            return path
    return None


def in_box(path: Path) -> bool:
    """Whether the file is a network in the box."""
    return path.parent == _folder()


def judged(path: Path, arch: Arch) -> tuple[Figures, str] | None:
    """What a network in the box, cut to `arch`, reaches on `JUDGE`, and what was judged, in words.

    None where its record does not tell: it was judged whole, and stopped after each stage.
    """
    from .checkpoint import read_header

    record = path.with_suffix(".json")
    whole = read_header(path).arch
    if not record.is_file() or arch.stages > whole.stages or arch != whole.up_to(arch.stages):
        return None
    for each in read_json(record, Record, "the record of a network in the box").judged:
        for figures in each.stages:
            if (each.dataset, figures.stage) == (JUDGE, arch.stages):
                return figures, f"{each.dataset} {each.split}, {each.samples} frames, in fp32"
    return None


def _is_word(text: str) -> bool:
    return text not in ("", ".", "..") and Path(text).name == text and not Path(text).suffix


def listed() -> str:
    """What the box holds, in words."""
    found = names()
    return (
        f"the box holds {', '.join(found)}"
        if found
        else "the box of this version is empty, give a file"
    )


def _folder() -> Path:
    return Path(str(resources.files(__package__) / "weights"))
