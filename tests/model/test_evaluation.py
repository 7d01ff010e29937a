"""Judging: every stage of every image against values worked by hand, and what a report says."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest

from rts2.model.arch import Arch
from rts2.model.data.labels import CLASS_NAMES
from rts2.model.data.scene import Foreground, Scene
from rts2.model.evaluation import FIGURES, evaluate, overall, report, score
from rts2.model.predictor import Estimate

ROAD, CAR = CLASS_NAMES.index("road"), CLASS_NAMES.index("car")
PIXEL = np.zeros((1, 4, 3), np.uint8)


class Fixed:
    """A predictor that says what it was told to."""

    origin = None

    def __init__(self, *estimates: Estimate, arch: Arch | None = None) -> None:
        self.estimates = list(estimates)
        self.arch = arch

    def predict(self, left: np.ndarray, right: np.ndarray, stages: int | None = None) -> Estimate:
        return self.predict_stages(left, right, stages)[-1]

    def predict_stages(
        self, left: np.ndarray, right: np.ndarray, stages: int | None = None
    ) -> list[Estimate]:
        height, width = left.shape[:2]
        shown = self.estimates[:stages]
        return [
            Estimate(each.disparity[-height:, -width:], None, each.seconds, each.stage)
            if each.semantic is None
            else Estimate(
                each.disparity[-height:, -width:],
                each.semantic[-height:, -width:],
                each.seconds,
                each.stage,
            )
            for each in shown
        ]


@dataclass(frozen=True)
class Made:
    """A sample that is in memory."""

    scene: Scene
    foreground: Foreground | None = None

    @property
    def name(self) -> str:
        return self.scene.name

    @property
    def size(self) -> tuple[int, int]:
        return self.scene.size

    def read(self) -> Scene:
        return self.scene


def scene(name: str = "0", **maps: np.ndarray) -> Scene:
    truth = np.array([[10, 10, 10, np.nan]], np.float32)
    return Scene(name, PIXEL, PIXEL, truth, **maps)  # type: ignore[arg-type]


def estimate(
    disparity: Sequence[float], semantic: Sequence[int] | None = None, stage: int | None = 1
) -> Estimate:
    labels = None if semantic is None else np.array([semantic], np.uint8)
    return Estimate(np.array([disparity], np.float32), labels, 0.5, stage)


def test_every_stage_of_every_sample_is_judged() -> None:
    labels = np.array([[0, 1, 255, 1]], np.uint8)
    wrong = estimate([20] * 4, [0] * 4)
    holed = estimate([10, np.nan, 30, 0], [0, 1, 0, 1], stage=2)
    samples = [Made(scene(name, semantic=labels)) for name in "ab"]
    judged = list(evaluate(Fixed(wrong, holed), samples))
    assert [one.name for one in judged] == ["a", "b"]
    for one in judged:
        assert list(one.scores) == [1, 2]
        assert [each.stage for each in one.estimates] == [1, 2]
        assert one.scores[1].d1_all == 100
        assert one.scores[1].pacc == pytest.approx(100 / 3)
        # The hole takes the lesser neighbour, 10 px, as the server does it, and is counted.
        assert one.scores[2].d1_all == pytest.approx(100 / 3)
        assert one.scores[2].missing == 1
        assert one.scores[2].miou == 100
    total = overall([one.scores for one in judged])
    assert total[2].everything.pixels == 6
    assert total[2].d1_all == pytest.approx(100 / 3)
    assert [list(one.scores) for one in evaluate(Fixed(wrong, holed), samples, stages=1)] == [
        [1],
        [1],
    ]


def test_crop_is_what_the_network_sees() -> None:
    (judged,) = evaluate(Fixed(estimate([99, 99, 10, 10])), [Made(scene())], crop=(2, 1))
    assert judged.scores[1].everything.pixels == 1
    assert judged.scores[1].epe == 0


def test_samples_are_read_one_by_one() -> None:
    """Nothing of the second is touched before the first is judged."""
    samples = iter([Made(scene("a")), Made(scene("b"))])
    judged = evaluate(Fixed(estimate([10] * 4)), samples)
    assert next(judged).name == "a"
    assert next(samples).name == "b"


def test_visible_and_foreground_pixels_are_told_apart() -> None:
    masks = {
        "visible": np.array([[True, False, True, True]]),
        "foreground": np.array([[True, False, False, True]]),
    }
    judged = score(estimate([10, 20, 20, 10]), scene(**masks), None)
    assert (judged.d1_noc, judged.d1_fg, judged.d1_bg) == (50, 0, 100)


def test_other_classes_are_not_judged_by_train_ids() -> None:
    labelled = scene(semantic=np.zeros((1, 4), np.uint8))
    said = estimate([10] * 4, [0] * 4)
    assert score(said, labelled, None).miou == 100
    assert score(said, labelled, Arch(c=1)).miou == 100
    assert score(said, labelled, Arch(c=1, classes=5)).miou is None


def cars() -> Scene:
    """A car of 3 pixels and one of 1."""
    return scene(
        semantic=np.full((1, 4), CAR, np.uint8), instances=np.array([[1, 1, 1, 2]], np.int32)
    )


def test_report_weighs_objects_by_the_data_set_itself() -> None:
    scores = [("0", {1: score(estimate([10] * 4, [CAR, CAR, CAR, ROAD]), cars(), None)})]
    told = report(scores, "streets")
    assert told["object_sizes"] == "data set"
    (stage,) = told["stages"]
    assert stage["miou"] == pytest.approx((75 + 0) / 2)
    assert stage["miou_category"] == pytest.approx((75 + 0) / 2)
    assert stage["iiou"] == stage["iiou_category"] == pytest.approx(50)
    assert stage["classes"]["car"] == pytest.approx({"iou": 75, "iiou": 50})
    assert stage["classes"]["road"] == {"iou": 0, "iiou": None}
    assert stage["classes"]["bus"] == {"iou": None, "iiou": None}
    (image,) = told["images"]
    assert image == {"name": "0", "stage": 1} | {name: stage[name] for name in FIGURES}


def test_report_weighs_objects_by_what_is_published() -> None:
    """One of two pixels of a car is lost, and 3 pixels of road are taken for a car."""
    truth = np.array([[CAR, CAR, ROAD, ROAD]], np.uint8)
    made = scene(semantic=truth, instances=np.array([[1, 1, 0, 0]], np.int32))
    scores = [("0", {1: score(estimate([10] * 4, [CAR, ROAD, CAR, CAR]), made, None)})]
    for dataset, size in (("kitti2015", 3669.255859), ("cityscapes", 12794.0202738185)):
        told = report(scores, dataset)
        assert told["object_sizes"] == "published"
        assert told["stages"][0]["iiou"] == pytest.approx(100 * (size / 2) / (size + 2))


def test_report_without_truth_knows_nothing() -> None:
    blank = Scene("0", PIXEL, PIXEL, np.full((1, 4), np.nan, np.float32))
    told = report([("0", {None: score(estimate([10] * 4, [0] * 4), blank, None)})], "folder")
    (stage,) = told["stages"]
    assert {stage[name] for name in FIGURES} == {None}
    assert (stage["stage"], stage["pixels"], stage["classes"]) == (None, 0, None)
    assert told["object_sizes"] is None


def test_labels_without_objects_have_no_iiou() -> None:
    made = scene(semantic=np.full((1, 4), CAR, np.uint8))
    told = report([("0", {1: score(estimate([10] * 4, [CAR] * 4), made, None)})], "kitti2015")
    assert told["stages"][0]["miou"] == 100
    assert told["stages"][0]["iiou"] is None
    assert told["object_sizes"] is None
