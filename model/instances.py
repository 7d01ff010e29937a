"""iIoU: intersection over union in which every object of a class weighs the same.

Plain IoU is settled by the few large objects near the camera. The instance-level measure of
Cityscapes (section 4.1 of its paper), which KITTI adopted, weighs each pixel of an object of the
truth by the average size of its class over the size of this object; false positives belong to no
object and are not weighed. Sums add, so that an average that comes from the data set itself may be
known only at the end. Everything is by train id, of the 19 classes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from .data.labels import CATEGORIES, LABELS, WITH_INSTANCES
from .errors import Rts2Error
from .metrics import IGNORED, Counts, Labels, grouped, known_mean, ratios

Sizes = NDArray[np.float64]
"""The average size of each class's objects in pixels, (19,); NaN for what has no objects."""

CLASSES: Final = len(LABELS)

PUBLISHED: Final = {
    "cityscapes": {
        "person": 3462.4756337644,
        "rider": 3930.4788056518,
        "car": 12794.0202738185,
        "truck": 27855.1264367816,
        "bus": 35732.1511111111,
        "train": 67583.7075812274,
        "motorcycle": 6298.7200839748,
        "bicycle": 4672.3249222261,
    },
    "kitti2015": {
        "person": 1234.262573,
        "rider": 1318.393921,
        "car": 3669.255859,
        "truck": 1801.103394,
        "bus": 2761.151611,
        "train": 18448.460938,
        "motorcycle": 695.617676,
        "bicycle": 1244.791260,
    },
}
"""Average sizes in pixels as the data sets' own evaluations have them, by data set.

Cityscapes: cityscapesScripts, evalPixelLevelSemanticLabeling. KITTI: the script of that name in the
semantics development kit, whose averages are over its training and test images together.
"""


@dataclass(frozen=True, eq=False)
class Objects:
    """What became of the truth's objects, summed by class; every array is (19,)."""

    count: NDArray[np.float64]
    pixels: NDArray[np.float64]
    """How large they are together."""
    found: NDArray[np.float64]
    """The sum of the shares of each object that are labelled as its class."""
    found_category: NDArray[np.float64]
    """The same for the classes of its category."""

    def __add__(self, other: Objects) -> Objects:
        return Objects(
            self.count + other.count,
            self.pixels + other.pixels,
            self.found + other.found,
            self.found_category + other.found_category,
        )

    def average_sizes(self) -> Sizes:
        """The average size of these very objects."""
        return ratios(self.pixels, self.count)


def published_sizes(dataset: str) -> Sizes | None:
    """The average sizes that a data set's own evaluation uses; None where it has none."""
    if dataset not in PUBLISHED:
        return None
    return np.array([PUBLISHED[dataset].get(label.name, np.nan) for label in LABELS])


def objects(prediction: Labels, truth: Labels, instances: Labels) -> Objects:
    """Counts one image's objects; everything is (H, W).

    `truth` and `prediction` are train ids; `instances` numbers the objects, 0 being none. Pixels
    of one number in two classes are two objects, as KITTI counts from 1 in every class anew.
    """
    for array, name in ((prediction, "prediction"), (instances, "instances")):
        if array.shape != truth.shape:
            raise Rts2Error(f"{name} and truth must have one shape: {array.shape}, {truth.shape}")
    single = (instances != 0) & np.isin(truth, WITH_INSTANCES)
    wanted, found = truth[single], prediction[single]
    keys = instances[single].astype(np.int64) * CLASSES + wanted
    seen, owner = np.unique(keys, return_inverse=True)
    size = _sums(owner, np.ones(len(owner)), len(seen))
    hits = _sums(owner, found == wanted, len(seen))
    near = _sums(owner, _CATEGORY[found] == _CATEGORY[wanted], len(seen))
    columns = np.ones(len(seen)), size, hits / size, near / size
    return Objects(*(_sums(seen % CLASSES, column, CLASSES) for column in columns))


def class_iious(labels: Counts, seen: Objects, sizes: Sizes) -> NDArray[np.float64]:
    """The iIoU of each class in percent, (19,); NaN for what has no objects, or occurs nowhere.

    `labels` is the confusion matrix of the same images, (19, 19).
    """
    weights = np.nan_to_num(sizes)
    iou = _iiou(weights * seen.found, weights * seen.count, labels)
    return np.where(np.isin(np.arange(CLASSES), WITH_INSTANCES), iou, np.nan)


def iiou(labels: Counts, seen: Objects, sizes: Sizes) -> float | None:
    """The mean iIoU of the classes that have objects, in percent."""
    return known_mean(class_iious(labels, seen, sizes))


def iiou_category(labels: Counts, seen: Objects, sizes: Sizes) -> float | None:
    """The mean iIoU of the categories all of whose classes have objects, in percent."""
    weights = np.nan_to_num(sizes)
    of_category = np.array(CATEGORIES)
    found, whole = (
        _sums(of_category, weights * each, max(CATEGORIES) + 1)
        for each in (seen.found_category, seen.count)
    )
    iou = _iiou(found, whole, grouped(labels, CATEGORIES))
    return known_mean(iou[sorted({CATEGORIES[train_id] for train_id in WITH_INSTANCES})])


def _iiou(
    found: NDArray[np.float64], whole: NDArray[np.float64], counts: Counts
) -> NDArray[np.float64]:
    """Weighted true positives by true positives, false negatives and false positives."""
    false = counts.sum(0) - np.diagonal(counts)
    return ratios(100 * found, whole + false)


def _sums(groups: NDArray[Any], values: NDArray[Any], length: int) -> NDArray[np.float64]:
    """The sum of each group's values; `groups` has the group of each value, from 0."""
    return np.bincount(groups, values, length).astype(np.float64)


_CATEGORY: Final = np.array([*CATEGORIES, *[-1] * (IGNORED + 1 - CLASSES)])
"""The category of every label byte; what is no class is in none."""
