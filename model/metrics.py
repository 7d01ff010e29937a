"""How right a disparity map and a label map are: KITTI's and Cityscapes' measures.

Pure numpy. What can be summed over images is summed (`Score` + `Score`), so that a data set's
figure is that of all its pixels, and not a mean of means. D1, mIoU and pAcc are in percent, errors
in pixels; a figure of nothing is None.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from .errors import Rts2Error

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
    """What one image scores, or, added up, many.

    `missing` counts the pixels of the truth for which there was no estimate. They are in no error,
    unless the holes were filled before.
    `labels` is a confusion matrix, None without semantics.
    """

    everything: Errors = field(default_factory=Errors)
    background: Errors = field(default_factory=Errors)
    foreground: Errors = field(default_factory=Errors)
    missing: int = 0
    labels: Counts | None = None

    def __add__(self, other: Score) -> Score:
        known = [labels for labels in (self.labels, other.labels) if labels is not None]
        return Score(
            self.everything + other.everything,
            self.background + other.background,
            self.foreground + other.foreground,
            self.missing + other.missing,
            sum(known[1:], known[0]) if known else None,
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
    def miou(self) -> float | None:
        return None if self.labels is None else miou(self.labels)

    @property
    def pacc(self) -> float | None:
        return None if self.labels is None else pixel_accuracy(self.labels)


def disparity_score(estimate: Map, truth: Map, foreground: Mask | None = None) -> Score:
    """Scores `estimate` where both it and `truth` are finite; all are (H, W) in pixels.

    `foreground` splits the errors; without it both parts stay empty. Give what
    `interpolate_background` returns to score as KITTI's server does.
    """
    _require_shape(estimate, truth, "estimate", "truth")
    wanted = np.isfinite(truth)
    valid = wanted & np.isfinite(estimate)
    everything = errors(estimate, truth, valid)
    missing = int(wanted.sum()) - everything.pixels
    if foreground is None:
        return Score(everything, missing=missing)
    _require_shape(foreground, truth, "foreground", "truth")
    return Score(
        everything,
        errors(estimate, truth, valid & ~foreground),
        errors(estimate, truth, valid & foreground),
        missing,
    )


def errors(estimate: Map, truth: Map, where: Mask) -> Errors:
    """The errors of the pixels in the mask; everything is (H, W)."""
    wanted = truth[where].astype(np.float64)
    error = np.abs(estimate[where].astype(np.float64) - wanted)
    outliers = (error > OUTLIER_PX) & (error > OUTLIER_SHARE * np.abs(wanted))
    return Errors(error.size, int(outliers.sum()), float(error.sum()))


def end_point_error(estimate: Map, truth: Map) -> float | None:
    """The mean absolute disparity error in pixels, where both maps are finite."""
    return disparity_score(estimate, truth).epe


def d1_all(estimate: Map, truth: Map) -> float | None:
    """The share of outliers in percent, where both maps are finite."""
    return disparity_score(estimate, truth).d1_all


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


def miou(counts: Counts) -> float | None:
    """Mean intersection over union in percent, of the classes that occur in truth or prediction.

    `counts` is the confusion matrix of a whole data set: images of few classes must not weigh more.
    """
    hits = np.diagonal(counts)
    union = counts.sum(0) + counts.sum(1) - hits
    occurs = union > 0
    return float(100 * (hits[occurs] / union[occurs]).mean()) if occurs.any() else None


def pixel_accuracy(counts: Counts) -> float | None:
    """The share of rightly labelled pixels in percent, from a confusion matrix."""
    pixels = int(counts.sum())
    return float(100 * np.trace(counts) / pixels) if pixels else None


def _carried(rows: Map) -> Map:
    """Each NaN takes the last value to its left in its row; leading ones stay NaN."""
    columns = np.where(np.isnan(rows), 0, np.arange(rows.shape[1]))
    carried: Map = np.take_along_axis(rows, np.maximum.accumulate(columns, axis=1), axis=1)
    return carried


def _require_shape(given: NDArray[Any], wanted: NDArray[Any], name: str, other: str) -> None:
    if given.shape != wanted.shape:
        raise Rts2Error(f"{name} and {other} must have one shape: {given.shape}, {wanted.shape}")
