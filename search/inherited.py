"""Accuracies that networks inherit from a supernet, measured on the user's data.

A network's slices of the supernet's weights get batch norm statistics of their own from a few
training images, and are judged on a fixed part of the images that judge. One run judges a family of
networks at once: those of fewer stages and branches are computed on the way.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from time import perf_counter
from typing import Annotated, Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from ..model.arch import Arch, Branches
from ..model.checkpoint import load
from ..model.data.scene import Sample, Scene
from ..model.errors import Rts2Error, UsageError
from ..model.evaluation import score
from ..model.files import output_folder, read_json, sha256, write_json
from ..model.metrics import Score
from ..model.ops import padded
from ..model.predictor import cut_back, enlarged, prepared
from ..model.rts2net import RTS2Net, Stage
from ..model.supernet import extract, recalibrate
from .accuracy import Row

BATCH: Final = 4
BATCHES: Final = 8
"""Training images that give the norms their statistics: so many batches of so many."""

JUDGED: Final = 32
"""Images that judge unless told."""

Key = tuple[int, Branches]
"""A network among those that a larger one holds: its stages and branches."""


@dataclass(frozen=True)
class Data:
    """What calibrates the norms and what judges, a fixed part of each."""

    training: Sequence[Sample]
    judging: Sequence[Sample]

    @classmethod
    def of(cls, training: Sequence[Sample], judging: Sequence[Sample], count: int = JUDGED) -> Data:
        """Evenly spaced parts of what trains and of what judges, `count` of the latter."""
        return cls(_spaced(training, BATCH * BATCHES), _spaced(judging, count))


class Known(BaseModel):
    """One judged network and all that it holds: schema rts2.inherited/1."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    schema_: Literal["rts2.inherited/1"] = Field(default="rts2.inherited/1", alias="schema")
    digest: str
    """Of weights and images: all that the figures depend on."""
    arch: Arch
    rows: Annotated[tuple[Row, ...], Field(min_length=1)]
    seconds: Annotated[float, Field(ge=0)]


class Inherited:
    """Judges networks of a supernet, each once: what is known stands on disk."""

    def __init__(self, path: Path, data: Data, folder: Path) -> None:
        """`folder` keeps what is known, of any supernet and data.

        Raises:
            UsageError: the checkpoint is no supernet.
            Rts2Error: an image cannot be read, or what is kept is broken.
        """
        network, header = load(path)
        if not header.supernet or not isinstance(network, RTS2Net):
            raise UsageError(
                f"{path} holds one network, not a supernet; rts2-train --supernet makes one"
            )
        self.path, self.arch, self.origin = path, network.arch, header.origin
        self._network = network
        self._training = [sample.read() for sample in data.training]
        self.data, self.judging = data, [sample.read() for sample in data.judging]
        _require_labels(self.judging)
        self._folder = folder / self.digest[:16]
        self._rows: dict[Arch, Row] = {}
        self.evaluations = self.hits = 0
        self.seconds = 0.0
        """What the evaluations took."""

    @cached_property
    def digest(self) -> str:
        """The SHA-256 of the supernet's weights and of every image that its figures rest on."""
        found = hashlib.sha256(sha256(self.path).encode())
        for scene in (*self._training, *self.judging):
            for name, array in sorted(scene.arrays().items()):
                found.update(f"{name} {array.dtype} {array.shape}".encode())
                found.update(np.ascontiguousarray(array).tobytes())
        return found.hexdigest()

    def rows(self, arch: Arch) -> tuple[Row, ...]:
        """The accuracy of `arch` and of every network that it holds: fewer stages or branches.

        Judged now, or known from before, here or by another process that keeps to this folder.
        Raises `UsageError` where the supernet does not hold it.
        """
        if arch in self._rows or self._recalled(arch):
            self.hits += 1
        else:
            self._keep(arch)
        return tuple(self._rows[part] for part in _held(arch).values())

    def network(self, arch: Arch) -> RTS2Net:
        """The network of `arch`, its norms calibrated: an ordinary network, ready to run."""
        part = extract(self._network, arch)
        recalibrate(part, self._batches())
        return part

    def _keep(self, arch: Arch) -> None:
        started = perf_counter()
        rows = tuple(self._judged(arch))
        seconds = perf_counter() - started
        known = Known(digest=self.digest, arch=arch, rows=rows, seconds=seconds)
        output_folder(self._folder)
        write_json(self._file(arch), known.model_dump(mode="json", by_alias=True))
        self._rows |= {row.arch: row for row in rows}
        self.evaluations += 1
        self.seconds += seconds

    def _recalled(self, arch: Arch) -> bool:
        """Whether the folder knows the network."""
        path = self._file(arch)
        if not path.is_file():
            return False
        known = read_json(path, Known, "a judged network")
        if (known.digest, known.arch) != (self.digest, arch):
            raise Rts2Error(f"{path} is of another network or other images; delete it")
        self._rows |= {row.arch: row for row in known.rows}
        return True

    def _file(self, arch: Arch) -> Path:
        name = hashlib.sha256(arch.model_dump_json().encode()).hexdigest()
        return self._folder / f"{name[:16]}.json"

    def _judged(self, arch: Arch) -> Iterator[Row]:
        network = self.network(arch)
        held = _held(arch)
        totals = dict.fromkeys(held, Score())
        for scene in self.judging:
            for key, found in _scores(network, scene):
                totals[key] += found
        source = f"inherited, {self.origin}; judged on {len(self.judging)} images"
        for key, part in held.items():
            yield _row(part, totals[key], source)

    def _batches(self) -> Iterator[tuple[Tensor, Tensor]]:
        """The training images, cut to the size that all of them have, in batches."""
        width, height = (min(side) for side in zip(*(s.size for s in self._training), strict=True))
        scenes = [scene.bottom_right(width, height) for scene in self._training]
        for at in range(0, len(scenes), BATCH):
            part = scenes[at : at + BATCH]
            yield _stacked([s.left for s in part]), _stacked([s.right for s in part])


def _held(arch: Arch) -> dict[Key, Arch]:
    """The networks that `arch` computes on its way, itself the last."""
    found = {}
    for stages in range(1, arch.stages + 1):
        for semantic, refinement in ((False, False), (True, False), (True, True)):
            if semantic > arch.semantic or refinement > arch.refinement:
                continue
            branches = {"semantic": semantic, "refinement": refinement}
            part = arch.up_to(stages).model_copy(update=branches)
            found[stages, part.branches] = part
    return found


def _scores(network: RTS2Net, scene: Scene) -> Iterator[tuple[Key, Score]]:
    """How one scene is judged, for every network that `network` computes on its way."""
    pair = [
        torch.from_numpy(prepared(image, network.arch.multiple))
        for image in (scene.left, scene.right)
    ]
    with torch.inference_mode():
        stages = network(*pair)
    for number, stage in enumerate(stages, 1):
        for branches, found in _variants(stage, scene, network.arch).items():
            yield (number, branches), found


def _variants(stage: Stage, scene: Scene, arch: Arch) -> dict[Branches, Score]:
    """What a stage scores in networks of fewer branches; each of its maps is judged once."""
    size = padded(scene.size, arch.multiple)

    def judged(part: Stage) -> Score:
        disparity, semantic = enlarged(part, torch.Size(size))
        return score(cut_back(disparity, semantic, scene.left, 0.0, None), scene, arch)

    first = judged(Stage(stage.disparity, None, stage.scores))
    found: dict[Branches, Score] = {"disparity": replace(first, labels=None, objects=None)}
    if stage.scores is not None:
        found["disparity+semantic"] = first
    if stage.refined is not None:
        refined = judged(Stage(stage.refined))
        found["full"] = replace(refined, labels=first.labels, objects=first.objects)
    return found


def _row(arch: Arch, found: Score, source: str) -> Row:
    semantics = {"miou": found.miou, "pacc": found.pacc} if arch.semantic else {}
    return Row(arch=arch, d1_all=found.d1_all, epe=found.epe, source=source, **semantics)


def _require_labels(scenes: Sequence[Scene]) -> None:
    if not scenes or not any(np.isfinite(scene.truth).any() for scene in scenes):
        raise Rts2Error("images that judge need a known disparity; give data with ground truth")


def _spaced(samples: Sequence[Sample], count: int) -> list[Sample]:
    """`count` samples from first to last, or all where there are fewer."""
    places = np.linspace(0, len(samples) - 1, min(count, len(samples))).round().astype(int)
    return [samples[int(place)] for place in places]


def _stacked(images: Sequence[NDArray[np.uint8]]) -> Tensor:
    return torch.from_numpy(np.concatenate([prepared(image, 32) for image in images]))
