"""How right a disparity map and a label map are: KITTI's and Cityscapes' measures.

Pure numpy. What can be summed over images is summed (`Score` + `Score`), so that a data set's
figure is that of all its pixels, and not a mean of means. D1, mIoU and pAcc are in percent, errors
in pixels; a figure of nothing is None.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from .errors import Rts2Error

if TYPE_CHECKING:
    from .instances import Objects

Map = NDArray[np.floating[Any]]
Labels = NDArray[np.integer[Any]]
Mask = NDArray[np.bool_]
Counts = NDArray[np.int64]

OUTLIER_PX: Final = 3.0
OUTLIER_SHARE: Final = 0.05
"""An outlier errs by more than 3 px and by more than 5 % of the truth (KITTI 2015)."""

IGNORED: Final = 255
"""The train id of a pixel that semantic metrics leave out."""

KIT_HOLE: Final = -1.0
"""What KITTI's kit takes for a disparity where even its interpolation has none."""


@dataclass(frozen=True)
class Errors:
    """Disparity errors summed over pixels; sums add."""

    pixels: int = 0
    outliers: int = 0
    total_px: float = 0.0

    def __add__(self, other: Errors) -> Errors:
        return Errors(
            self.pixels + other.pixels,
            self.outliers + other.outliers,
            self.total_px + other.total_px,
        )

    @property
    def epe(self) -> float | None:
        """The mean absolute error in pixels."""
        return self.total_px / self.pixels if self.pixels else None

    @property
    def d1(self) -> float | None:
        """The share of outliers in percent."""
        return 100 * self.outliers / self.pixels if self.pixels else None


@dataclass(frozen=True, eq=False)
class Score:
    """What one image scores, or, added up, many."""

    everything: Errors = field(default_factory=Errors)
    background: Errors = field(default_factory=Errors)
    foreground: Errors = field(default_factory=Errors)
    visible: Errors = field(default_factory=Errors)
    """Of the pixels that both images see."""
    missing: int = 0
    """Pixels of the truth without an estimate: in no error, unless the holes were filled before."""
    labels: Counts | None = None
    """A confusion matrix; None without semantics."""
    objects: Objects | None = None
    """What became of the truth's single objects; None where it does not tell them apart."""

    def __add__(self, other: Score) -> Score:
        return Score(
            self.everything + other.everything,
            self.background + other.background,
            self.foreground + other.foreground,
            self.visible + other.visible,
            self.missing + other.missing,
            _known_sum(self.labels, other.labels),
            _known_sum(self.objects, other.objects),
        )

    @property
    def epe(self) -> float | None:
        return self.everything.epe

    @property
    def d1_all(self) -> float | None:
        return self.everything.d1

    @property
    def d1_bg(self) -> float | None:
        return self.background.d1

    @property
    def d1_fg(self) -> float | None:
        return self.foreground.d1

    @property
    def d1_noc(self) -> float | None:
        """KITTI's D1 over the pixels that are not occluded."""
        return self.visible.d1

    @property
    def miou(self) -> float | None:
        return None if self.labels is None else miou(self.labels)

    @property
    def pacc(self) -> float | None:
        return None if self.labels is None else pixel_accuracy(self.labels)


def disparity_score(
    estimate: Map, truth: Map, foreground: Mask | None = None, visible: Mask | None = None
) -> Score:
    """Scores `estimate` where both it and `truth` are finite; all are (H, W) in pixels.

    `foreground` splits the errors, `visible` is where both images see the same; without them those
    parts stay empty. Give what `interpolate_background` returns to score as KITTI's server does.
    """
    for array, name in ((estimate, "estimate"), (foreground, "foreground"), (visible, "visible")):
        if array is not None:
            _require_shape(array, truth, name, "truth")
    wanted = np.isfinite(truth)
    valid = wanted & np.isfinite(estimate)

    def within(mask: Mask | None) -> Errors:
        return Errors() if mask is None else errors(estimate, truth, valid & mask)

    return Score(
        everything=errors(estimate, truth, valid),
        background=within(None if foreground is None else ~foreground),
        foreground=within(foreground),
        visible=within(visible),
        missing=int(wanted.sum()) - int(valid.sum()),
    )


def errors(estimate: Map, truth: Map, where: Mask) -> Errors:
    """The errors of the pixels in the mask; everything is (H, W)."""
    wanted = truth[where].astype(np.float64)
    error = np.abs(estimate[where].astype(np.float64) - wanted)
    outliers = (error > OUTLIER_PX) & (error > OUTLIER_SHARE * np.abs(wanted))
    return Errors(error.size, int(outliers.sum()), float(error.sum()))


def interpolate_background(estimate: Map) -> Map:
    """Fills what is not finite as KITTI's development kit does before the server scores.

    In each row a hole takes the lesser of its two neighbours, at the border the one neighbour
    there is; rows without any estimate at the top and bottom take the nearest row that has one.
    Such rows in between have no rule: the kit scores them as `KIT_HOLE`, and so they become.
    """
    holes = np.where(np.isfinite(estimate), estimate, np.nan)
    rows = np.fmin(_carried(holes), _carried(holes[:, ::-1])[:, ::-1])
    known = np.flatnonzero(np.isfinite(rows).any(axis=1))
    if known.size:
        rows[: known[0]] = rows[known[0]]
        rows[known[-1] + 1 :] = rows[known[-1]]
    filled: Map = np.nan_to_num(rows, nan=KIT_HOLE)
    return filled


def confusion(prediction: Labels, truth: Labels, classes: int) -> Counts:
    """Pixel counts, (classes, classes): row the true label, column the predicted one.

    Pixels whose truth is `IGNORED` do not count. Raises `Rts2Error` for any other label that is
    no class.
    """
    _require_shape(prediction, truth, "prediction", "truth")
    counted = truth != IGNORED
    wanted, found = truth[counted].astype(np.int64), prediction[counted].astype(np.int64)
    for labels, name in ((wanted, "true"), (found, "predicted")):
        if labels.size and not (labels.min() >= 0 and labels.max() < classes):
            worst = labels.min() if labels.min() < 0 else labels.max()
            raise Rts2Error(f"a {name} label must be 0 to {classes - 1}, found {worst}")
    flat: Counts = np.bincount(wanted * classes + found, minlength=classes * classes)
    return flat.reshape(classes, classes).astype(np.int64)


def class_ious(counts: Counts) -> NDArray[np.float64]:
    """Intersection over union of each class in percent; NaN where it is not defined.

    That is where a class occurs neither in the truth nor in the prediction; one that is only
    predicted has 0. Cityscapes' and KITTI's evaluations do the same.
    """
    hits = np.diagonal(counts)
    union = counts.sum(0) + counts.sum(1) - hits
    return ratios(100 * hits, union)


def ratios(parts: NDArray[Any], wholes: NDArray[Any]) -> NDArray[np.float64]:
    """Parts by wholes; NaN where the whole is 0."""
    return np.where(wholes > 0, parts / np.where(wholes > 0, wholes, 1), np.nan)


def known_mean(values: NDArray[np.float64]) -> float | None:
    """The mean of what is not NaN; None where all is."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else None


def miou(counts: Counts) -> float | None:
    """Mean intersection over union in percent, of the classes that occur in truth or prediction.

    `counts` is the confusion matrix of a whole data set: images of few classes must not weigh more.
    """
    return known_mean(class_ious(counts))


def grouped(counts: Counts, groups: Sequence[int]) -> Counts:
    """The confusion matrix of groups of classes; `groups` has the group of each class, from 0."""
    member = np.equal.outer(np.arange(max(groups) + 1), groups).astype(np.int64)
    return np.asarray(member @ counts @ member.T)


def pixel_accuracy(counts: Counts) -> float | None:
    """The share of rightly labelled pixels in percent, from a confusion matrix."""
    pixels = int(counts.sum())
    return float(100 * np.trace(counts) / pixels) if pixels else None


def _carried(rows: Map) -> Map:
    """Each NaN takes the last value to its left in its row; leading ones stay NaN."""
    columns = np.where(np.isnan(rows), 0, np.arange(rows.shape[1]))
    carried: Map = np.take_along_axis(rows, np.maximum.accumulate(columns, axis=1), axis=1)
    return carried


def _known_sum(one: Any, other: Any) -> Any:
    """The sum of what is not None."""
    if one is None or other is None:
        return other if one is None else one
    return one + other


def _require_shape(given: NDArray[Any], wanted: NDArray[Any], name: str, other: str) -> None:
    if given.shape != wanted.shape:
        raise Rts2Error(f"{name} and {other} must have one shape: {given.shape}, {wanted.shape}")
