"""Judging a network on a data set: every stage of every image, and all their pixels together."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import numpy as np

from .arch import Arch
from .data.labels import CATEGORIES, CLASS_NAMES
from .data.scene import Sample, Scene
from .instances import (
    CLASSES,
    Objects,
    Sizes,
    class_iious,
    iiou,
    iiou_category,
    objects,
    published_sizes,
)
from .metrics import (
    Counts,
    Score,
    class_ious,
    confusion,
    disparity_score,
    grouped,
    interpolate_background,
    miou,
)

if TYPE_CHECKING:
    from .predictor import Estimate, Predictor

Scores = dict[int | None, Score]
"""By stage, the last one last; None where a graph does not say which it shows."""

FIGURES: Final = (
    "d1_all",
    "d1_bg",
    "d1_fg",
    "d1_noc",
    "epe",
    "miou",
    "miou_category",
    "iiou",
    "iiou_category",
    "pacc",
)
"""What an evaluation tells, in the order of its reports: EPE in pixels, the rest in percent."""

Figures = dict[str, float | None]


@dataclass(frozen=True, eq=False)
class Judged:
    """One image's scores, and the maps that they rest on."""

    name: str
    estimates: Sequence[Estimate]
    """By stage, the last one last."""
    scores: Scores


class Weights(NamedTuple):
    """What iIoU weighs objects by."""

    source: Literal["published", "data set"]
    """Whose averages: those of the data set's own evaluation, or of the very images judged."""
    sizes: Sizes


def evaluate(
    predictor: Predictor,
    samples: Iterable[Sample],
    stages: int | None = None,
    crop: tuple[int, int] | None = None,
) -> Iterator[Judged]:
    """Reads, runs and judges one sample after the other.

    `crop` (width, height) takes the bottom-right corner of every image alone.
    """
    for sample in samples:
        scene = sample.read()
        if crop is not None:
            scene = scene.bottom_right(*crop)
        estimates = predictor.predict_stages(scene.left, scene.right, stages)
        scores = {each.stage: score(each, scene, predictor.arch) for each in estimates}
        yield Judged(sample.name, estimates, scores)


def score(estimate: Estimate, scene: Scene, arch: Arch | None) -> Score:
    """One estimate's score, as KITTI's server would judge it.

    Semantics count where both sides have the 19 train ids.
    """
    holes = np.isfinite(scene.truth) & ~np.isfinite(estimate.disparity)
    filled = interpolate_background(estimate.disparity) if holes.any() else estimate.disparity
    judged = disparity_score(filled, scene.truth, scene.foreground, scene.visible)
    judged = replace(judged, missing=int(holes.sum()))
    comparable = arch is None or arch.classes == CLASSES
    if estimate.semantic is None or scene.semantic is None or not comparable:
        return judged
    labels = confusion(estimate.semantic, scene.semantic, CLASSES)
    if scene.instances is None:
        return replace(judged, labels=labels)
    found = objects(estimate.semantic, scene.semantic, scene.instances)
    return replace(judged, labels=labels, objects=found)


def overall(scores: Sequence[Scores]) -> Scores:
    """The scores over all pixels of all images, by stage."""
    return {stage: sum((each[stage] for each in scores), Score()) for stage in scores[0]}


def weights(total: Scores, dataset: str) -> Weights | None:
    """The average object sizes for iIoU; None where nobody knows an object.

    Those of the data set's own evaluation where it has any, else those of the images judged.
    """
    known = [score.objects for score in total.values() if score.objects is not None]
    if not known:
        return None
    published = published_sizes(dataset)
    if published is not None:
        return Weights("published", published)
    return Weights("data set", known[0].average_sizes())


def figures(score: Score, weights: Weights | None) -> Figures:
    """Every one of `FIGURES`; None for what nobody knows."""
    found: Figures = dict.fromkeys(FIGURES)
    for name in ("d1_all", "d1_bg", "d1_fg", "d1_noc", "epe", "miou", "pacc"):
        found[name] = getattr(score, name)
    if score.labels is not None:
        found["miou_category"] = miou(grouped(score.labels, CATEGORIES))
    known = _weighed(score, weights)
    if known is not None:
        found |= {"iiou": iiou(*known), "iiou_category": iiou_category(*known)}
    return found


def by_class(score: Score, weights: Weights | None) -> Mapping[str, Figures] | None:
    """IoU and iIoU of each class in percent, by name; None without semantics."""
    if score.labels is None:
        return None
    known = _weighed(score, weights)
    unknown = np.full(CLASSES, np.nan)
    columns = class_ious(score.labels), unknown if known is None else class_iious(*known)
    rows = zip(CLASS_NAMES, *columns, strict=True)
    return {name: {"iou": _known(iou), "iiou": _known(weighed)} for name, iou, weighed in rows}


def report(scores: Sequence[tuple[str, Scores]], dataset: str) -> dict[str, Any]:
    """The figures of rts2.eval/1: of all pixels by stage, and of each image, by name, and stage."""
    total = overall([stages for _, stages in scores])
    weighed = weights(total, dataset)
    return {
        "object_sizes": None if weighed is None else weighed.source,
        "stages": [
            {
                "stage": stage,
                **figures(score, weighed),
                "pixels": score.everything.pixels,
                "missing": score.missing,
                "classes": by_class(score, weighed),
            }
            for stage, score in total.items()
        ],
        "images": [
            {"name": name, "stage": stage, **figures(score, weighed)}
            for name, stages in scores
            for stage, score in stages.items()
        ],
    }


def _weighed(score: Score, weights: Weights | None) -> tuple[Counts, Objects, Sizes] | None:
    """What iIoU is computed from, if all of it is known."""
    if weights is None or score.labels is None or score.objects is None:
        return None
    return score.labels, score.objects, weights.sizes


def _known(value: float) -> float | None:
    return None if np.isnan(value) else float(value)
