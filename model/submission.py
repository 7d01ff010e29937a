"""What KITTI 2015's servers take: a PNG for each of the 200 test frames, one zip a benchmark.

Disparity goes into `disp_0` as 16-bit PNG in steps of 1/256 px, dense, semantics into `semantic` as
8-bit PNG of label ids, which are not train ids; both are named as the left images. The zips stay
apart, because the semantic kit looks for its files by name alone, in every folder it is given.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from zipfile import ZipFile

import numpy as np
from PIL import Image

from .data.images import image_size, read_disparity, read_whole, write_disparity, write_image
from .data.labels import LABEL_IDS, label_ids
from .errors import Rts2Error, UsageError
from .files import output_folder, replacing
from .metrics import interpolate_background

if TYPE_CHECKING:
    from .predictor import Estimate

FRAMES: Final = tuple(f"{index:06}_10" for index in range(200))
"""The names that the servers ask for."""

Size = tuple[int, int]


@dataclass(frozen=True)
class Benchmark:
    """One of KITTI's benchmarks, by the folder that it takes."""

    folder: str
    archive: str
    fault: Callable[[Path], str | None]
    """What is wrong with the values of a file; None for a sound one."""


@dataclass(frozen=True)
class Part:
    """What was written for one benchmark, checked on disk."""

    benchmark: Benchmark
    frames: int
    missing: str | None
    """The first frame that the server asks for and that is not there."""
    archive: Path | None
    """The zip; None while frames are missing."""

    def told(self) -> str:
        """One line for people."""
        count = f"{self.benchmark.folder}/ has {self.frames} of {len(FRAMES)} frames"
        if self.archive is None:
            return f"{count}, incomplete: first missing {self.missing}.png; no zip is written"
        return f"{count}, checked: {self.archive.name}"

    def to_json(self) -> dict[str, Any]:
        return {
            "folder": self.benchmark.folder,
            "frames": self.frames,
            "expected": len(FRAMES),
            "first_missing": self.missing,
            "zip": None if self.archive is None else self.archive.name,
        }


def new_folder(path: Path) -> Path:
    """`path`, created where missing; frames of an earlier run must not mix with those of this one.

    Raises `UsageError` where it holds anything.
    """
    if path.is_dir() and any(path.iterdir()):
        found = sorted(entry.name for entry in path.iterdir())[0]
        raise UsageError(
            f"a submission needs a new or an empty folder: {path} holds {found}; choose another "
            "--submission"
        )
    return output_folder(path)


def write_frame(folder: Path, name: str, estimate: Estimate) -> None:
    """Writes one frame's maps; holes take the background's disparity, as the server fills them."""
    dense = interpolate_background(estimate.disparity)
    write_disparity(output_folder(folder / STEREO.folder) / f"{name}.png", dense)
    if estimate.semantic is not None:
        labels = label_ids(estimate.semantic)
        write_image(output_folder(folder / SEMANTIC.folder) / f"{name}.png", labels)


def finish(folder: Path, sizes: Mapping[str, Size]) -> tuple[Part, ...]:
    """Checks what `write_frame` wrote, and zips what is complete.

    `sizes` has the (width, height) of every frame's image, by name.

    Raises:
        Rts2Error: a file is not as the server wants it.
    """
    there = [each for each in (STEREO, SEMANTIC) if (folder / each.folder).is_dir()]
    return tuple(_part(folder, benchmark, sizes) for benchmark in there)


def _part(folder: Path, benchmark: Benchmark, sizes: Mapping[str, Size]) -> Part:
    files = {path.stem: path for path in sorted((folder / benchmark.folder).iterdir())}
    for name, path in files.items():
        _require_sound(path, sizes[name], benchmark)
    missing = [name for name in FRAMES if name not in files]
    if missing:
        return Part(benchmark, len(files), missing[0], None)
    return Part(benchmark, len(files), None, _zipped(folder, benchmark, list(files.values())))


def _require_sound(path: Path, size: Size, benchmark: Benchmark) -> None:
    """Raises `Rts2Error` for a file that the server would refuse."""
    found = image_size(path)
    fault = f"it is {found[0]}x{found[1]}" if found != size else benchmark.fault(path)
    if fault is not None:
        wanted = f"the {size[0]}x{size[1]} image of its frame"
        raise Rts2Error(f"{path} must be a sound map for {wanted}: {fault}")


def _disparity_fault(path: Path) -> str | None:
    holes = int(np.isnan(read_disparity(path)).sum())
    return f"{holes} pixels are 0, which is no estimate" if holes else None


def _semantic_fault(path: Path) -> str | None:
    with Image.open(path) as image:
        if image.mode != "L":
            return f"its mode is {image.mode}, not 8 bits of one channel"
    unknown = set(np.unique(read_whole(path)).tolist()) - set(LABEL_IDS)
    return f"{min(unknown)} is no label id that is scored" if unknown else None


def _zipped(folder: Path, benchmark: Benchmark, files: list[Path]) -> Path:
    archive = folder / benchmark.archive
    with replacing(archive) as temporary, ZipFile(temporary, "w") as target:
        for path in files:
            target.write(path, f"{benchmark.folder}/{path.name}")
    return archive


STEREO: Final = Benchmark("disp_0", "stereo.zip", _disparity_fault)
SEMANTIC: Final = Benchmark("semantic", "semantic.zip", _semantic_fault)
