"""The 19 classes that KITTI and Cityscapes score, in one table from which the rest derives.

Data sets store label ids, networks learn train ids: the row numbers of `LABELS`.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import Rts2Error
from ..metrics import IGNORED
from .images import Bytes


class Label(NamedTuple):
    """One class; its train id is its place in the table."""

    name: str
    label_id: int
    """What the label files and the submissions hold."""
    category: str
    has_instances: bool
    """Whether its objects are numbered one by one."""


LABELS: Final = (
    Label("road", 7, "flat", False),
    Label("sidewalk", 8, "flat", False),
    Label("building", 11, "construction", False),
    Label("wall", 12, "construction", False),
    Label("fence", 13, "construction", False),
    Label("pole", 17, "object", False),
    Label("traffic light", 19, "object", False),
    Label("traffic sign", 20, "object", False),
    Label("vegetation", 21, "nature", False),
    Label("terrain", 22, "nature", False),
    Label("sky", 23, "sky", False),
    Label("person", 24, "human", True),
    Label("rider", 25, "human", True),
    Label("car", 26, "vehicle", True),
    Label("truck", 27, "vehicle", True),
    Label("bus", 28, "vehicle", True),
    Label("train", 31, "vehicle", True),
    Label("motorcycle", 32, "vehicle", True),
    Label("bicycle", 33, "vehicle", True),
)

CLASS_NAMES: Final = tuple(label.name for label in LABELS)

LABEL_IDS: Final = tuple(label.label_id for label in LABELS)
"""The label ids of train ids 0 … 18; KITTI shares them with Cityscapes."""

CATEGORY_NAMES: Final = tuple(dict.fromkeys(label.category for label in LABELS))
"""The seven categories, in the order of the table."""

CATEGORIES: Final = tuple(CATEGORY_NAMES.index(label.category) for label in LABELS)
"""The category of each train id, as its place in `CATEGORY_NAMES`."""

WITH_INSTANCES: Final = tuple(i for i, label in enumerate(LABELS) if label.has_instances)
"""The train ids whose objects are numbered one by one."""

UNLABELLED_ID: Final = 0
"""The label id of what is no class."""


def train_ids(label_ids: NDArray[np.int32]) -> Bytes:
    """Label ids as train ids 0 … 18; every other label becomes `IGNORED`."""
    _require_bytes(label_ids, "label ids")
    table = np.full(256, IGNORED, np.uint8)
    table[list(LABEL_IDS)] = np.arange(len(LABEL_IDS))
    return table[label_ids]


def label_ids(train_ids: Bytes) -> Bytes:
    """Train ids as the label ids that submissions carry; what is no class becomes 0."""
    table = np.full(256, UNLABELLED_ID, np.uint8)
    table[: len(LABEL_IDS)] = LABEL_IDS
    return table[train_ids]


def require_train_ids(values: NDArray[np.int32], source: str) -> Bytes:
    """A map of train ids as bytes; a value that is neither 0 … 18 nor `IGNORED` is an error."""
    wrong = values[((values < 0) | (values >= len(LABELS))) & (values != IGNORED)]
    if wrong.size:
        raise Rts2Error(
            f"semantics must be train ids 0 to {len(LABELS) - 1}, or {IGNORED} for unlabelled: "
            f"{source} holds {wrong[0]} in {wrong.size} pixels"
        )
    return values.astype(np.uint8)


def _require_bytes(values: NDArray[np.int32], what: str) -> None:
    for worst in (values.min(initial=0), values.max(initial=0)):
        if not 0 <= worst <= 255:
            raise Rts2Error(f"{what} must be 0 to 255, found {worst}")
