"""The metrics against the official figures, a plain loop, and sums done by hand."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import sklearn.metrics as skm
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from rts2.model.data.images import read_disparity
from rts2.model.errors import Rts2Error
from rts2.model.metrics import (
    IGNORED,
    Score,
    class_ious,
    confusion,
    disparity_score,
    grouped,
    interpolate_background,
    miou,
    pixel_accuracy,
)

NAN = np.nan

maps = arrays(
    np.float32,
    st.tuples(st.integers(1, 6), st.integers(1, 7)),
    elements=st.one_of(st.just(NAN), st.integers(1, 400).map(lambda steps: steps / 4)),
)


def kit_interpolation(estimate: np.ndarray) -> np.ndarray:
    """The development kit's passes in their order, pixel by pixel; −1 is invalid."""
    filled = np.where(np.isfinite(estimate), estimate, -1)
    height, width = filled.shape
    for row in filled:
        known = [u for u in range(width) if row[u] >= 0]
        for before, after in pairwise(known):
            for u in range(before + 1, after):
                row[u] = min(row[before], row[after])
        if known:
            row[: known[0]] = row[known[0]]
            row[known[-1] + 1 :] = row[known[-1]]
    for column in filled.T:
        known = [v for v in range(height) if column[v] >= 0]
        if known:
            column[: known[0]] = column[known[0]]
            column[known[-1] + 1 :] = column[known[-1]]
    return filled


def looped(estimate: np.ndarray, truth: np.ndarray, wanted: np.ndarray) -> tuple[int, int, float]:
    """Pixels, outliers and the sum of errors, pixel by pixel."""
    pixels = outliers = 0
    total = 0.0
    for v, u in np.ndindex(*truth.shape):
        if wanted[v, u] and np.isfinite(truth[v, u]) and np.isfinite(estimate[v, u]):
            error = abs(float(estimate[v, u]) - float(truth[v, u]))
            pixels += 1
            total += error
            outliers += error > 3 and error / float(truth[v, u]) > 0.05
    return pixels, outliers, total


def test_official_sample_where_the_estimate_is_valid(real_data: Path) -> None:
    kit = real_data / "kitti_devkit"
    score = disparity_score(
        read_disparity(kit / "disp_est.png"), read_disparity(kit / "disp_gt.png")
    )
    assert score.everything.pixels + score.missing == 111_326
    assert score.missing == 199
    assert score.d1_all == pytest.approx(13.468, abs=5e-4)
    assert score.epe == pytest.approx(2.3195, abs=5e-5)


def test_official_sample_after_background_interpolation(real_data: Path) -> None:
    kit = real_data / "kitti_devkit"
    filled = interpolate_background(read_disparity(kit / "disp_est.png"))
    truth = read_disparity(kit / "disp_gt.png")
    score = disparity_score(filled, truth)
    assert score.d1_all == pytest.approx(13.621, abs=5e-4)
    assert score.epe == pytest.approx(2.3679, abs=5e-5)
    assert score.missing == 0


def test_outliers_exceed_both_limits() -> None:
    truth = np.array([[10.0, 10.0, 100.0, 100.0, 80.0]])
    # 3 px exactly; 3.5 px; 4 px but 4 %; 6 px and 6 %; 4 px but 5 % exactly
    estimate = np.array([[13.0, 13.5, 104.0, 94.0, 84.0]])
    score = disparity_score(estimate, truth)
    assert score.d1_all == pytest.approx(40.0)
    assert score.epe == pytest.approx((3 + 3.5 + 4 + 6 + 4) / 5)


def test_foreground_and_background_split_the_errors() -> None:
    truth = np.array([[10.0, 10.0, 10.0, NAN]])
    estimate = np.array([[20.0, 10.0, 20.0, 50.0]])
    score = disparity_score(estimate, truth, np.array([[True, False, False, True]]))
    assert (score.d1_fg, score.d1_bg) == (100.0, 50.0)
    assert score.d1_all == pytest.approx(100 * 2 / 3)
    assert score.everything == score.foreground + score.background


def test_visible_pixels_are_judged_by_themselves() -> None:
    truth = np.array([[10.0, 10.0, 10.0, NAN]])
    estimate = np.array([[20.0, 10.0, 20.0, 50.0]])
    seen = np.array([[True, True, False, True]])
    score = disparity_score(estimate, truth, visible=seen)
    assert score.d1_noc == 50.0
    assert (score + score).visible.pixels == 4
    assert disparity_score(estimate, truth).d1_noc is None


def test_figure_of_nothing_is_unknown() -> None:
    empty = np.zeros((2, 2), bool)
    nothing = disparity_score(np.ones((2, 2)), np.full((2, 2), NAN), empty, empty)
    figures = (
        nothing.epe,
        nothing.d1_all,
        nothing.d1_bg,
        nothing.d1_fg,
        nothing.d1_noc,
        nothing.miou,
        nothing.pacc,
    )
    assert figures == (None,) * 7
    assert nothing.missing == 0


def test_infinite_estimate_is_missing() -> None:
    score = disparity_score(np.array([[np.inf, 5.0]]), np.array([[5.0, 5.0]]))
    assert (score.missing, score.epe) == (1, 0.0)
    assert (score + score).missing == 2


def test_maps_of_two_shapes_are_refused() -> None:
    with pytest.raises(Rts2Error, match="one shape"):
        disparity_score(np.ones((2, 3)), np.ones((3, 2)))
    with pytest.raises(Rts2Error, match="foreground and truth"):
        disparity_score(np.ones((2, 3)), np.ones((2, 3)), np.ones((2, 2), bool))
    with pytest.raises(Rts2Error, match="visible and truth"):
        disparity_score(np.ones((2, 3)), np.ones((2, 3)), visible=np.ones((2, 2), bool))


@given(maps, st.integers(0, 1000))
def test_score_is_that_of_a_plain_loop(truth: np.ndarray, seed: int) -> None:
    generator = np.random.default_rng(seed)
    estimate = truth + generator.normal(0, 4, truth.shape)
    estimate[generator.random(truth.shape) < 0.2] = NAN
    foreground = generator.random(truth.shape) < 0.5
    score = disparity_score(estimate, truth, foreground)
    for errors, wanted in (
        (score.everything, np.ones_like(foreground)),
        (score.foreground, foreground),
        (score.background, ~foreground),
    ):
        pixels, outliers, total = looped(estimate, truth, wanted)
        assert (errors.pixels, errors.outliers) == (pixels, outliers)
        assert errors.total_px == pytest.approx(total)


@given(maps)
def test_background_interpolation_is_the_kits(estimate: np.ndarray) -> None:
    np.testing.assert_array_equal(interpolate_background(estimate), kit_interpolation(estimate))


def test_background_interpolation_by_hand() -> None:
    estimate = np.array(
        [
            [NAN, NAN, NAN, NAN],
            [NAN, 4.0, NAN, 2.0],
            [NAN, NAN, NAN, NAN],
            [7.0, NAN, NAN, NAN],
            [NAN, NAN, NAN, NAN],
        ]
    )
    assert interpolate_background(estimate).tolist() == [
        [4, 4, 2, 2],
        [4, 4, 2, 2],
        [-1, -1, -1, -1],
        [7, 7, 7, 7],
        [7, 7, 7, 7],
    ]
    assert np.isnan(estimate[0, 0]), "the map given is left as it was"


def test_sum_of_images_weighs_pixels() -> None:
    """A small image of 100 % and a large one of 0 % make 10 %, not 50 %."""
    small = disparity_score(np.full((1, 10), 50.0), np.full((1, 10), 10.0))
    large = disparity_score(np.full((9, 10), 10.0), np.full((9, 10), 10.0))
    assert (small.d1_all, large.d1_all) == (100.0, 0.0)
    assert (small + large).d1_all == pytest.approx(10.0)
    assert (small + large).epe == pytest.approx(4.0)
    total = sum((small, large), Score())
    assert total.everything == (large + small).everything


def test_sum_of_confusions_keeps_what_is_known() -> None:
    labelled = Score(labels=np.array([[3, 1], [0, 4]]))
    assert (labelled + Score()).miou == (Score() + labelled).miou == labelled.miou
    assert (labelled + labelled).labels is not None
    assert (labelled + labelled).pacc == labelled.pacc == pytest.approx(87.5)
    assert (Score() + Score()).labels is None


def test_confusion_by_hand() -> None:
    truth = np.array([[0, 0, 1], [1, 2, 255]], np.uint8)
    prediction = np.array([[0, 1, 1], [1, 0, 2]], np.uint8)
    counts = confusion(prediction, truth, 4)
    assert counts.tolist() == [[1, 1, 0, 0], [0, 2, 0, 0], [1, 0, 0, 0], [0, 0, 0, 0]]
    # IoU: class 0 1/3, class 1 2/3, class 2 0/1; class 3 occurs nowhere.
    assert miou(counts) == pytest.approx(100 / 3)
    assert pixel_accuracy(counts) == pytest.approx(60.0)


def test_class_that_is_only_predicted_counts() -> None:
    counts = confusion(np.array([[0, 1]]), np.array([[0, 0]]), 3)
    assert miou(counts) == pytest.approx(25.0)  # 1/2 and 0/1


def test_data_sets_miou_is_no_mean_of_images() -> None:
    first = confusion(np.zeros((1, 4), int), np.zeros((1, 4), int), 2)
    second = confusion(np.zeros((1, 4), int), np.ones((1, 4), int), 2)
    assert (miou(first), miou(second)) == (100.0, 0.0)
    assert miou(first + second) == pytest.approx(25.0)  # 4/8 and 0/4


def test_confusion_of_ignored_pixels_is_empty() -> None:
    counts = confusion(np.zeros((2, 2), np.uint8), np.full((2, 2), 255, np.uint8), 3)
    assert counts.sum() == 0
    assert miou(counts) is None
    assert pixel_accuracy(counts) is None


@given(st.data())
def test_confusion_is_that_of_a_plain_loop(data: st.DataObject) -> None:
    shape = data.draw(st.tuples(st.integers(1, 5), st.integers(1, 5)))
    prediction = data.draw(arrays(np.uint8, shape, elements=st.integers(0, 3)))
    truth = data.draw(arrays(np.uint8, shape, elements=st.sampled_from([0, 1, 2, 3, 255])))
    expected = np.zeros((4, 4), int)
    for wanted, found in zip(truth.flat, prediction.flat, strict=True):
        if wanted != 255:
            expected[wanted, found] += 1
    assert confusion(prediction, truth, 4).tolist() == expected.tolist()


def labels(seed: int, most: int) -> np.ndarray:
    """Labels 0 … most − 1, some of them ignored."""
    generator = np.random.default_rng(seed)
    drawn = generator.integers(0, most, (20, 30)).astype(np.uint8)
    return np.where(generator.random(drawn.shape) < 0.1, IGNORED, drawn)


@pytest.mark.parametrize("seed", range(4))
def test_label_metrics_are_those_of_scikit_learn(seed: int) -> None:
    truth, prediction = labels(seed, 9), labels(seed + 100, 12) % IGNORED
    counts = confusion(prediction, truth, 14)
    kept = truth != IGNORED
    true, found = truth[kept], prediction[kept]
    assert counts.tolist() == skm.confusion_matrix(true, found, labels=range(14)).tolist()
    occurring = np.union1d(true, found)
    ious = skm.jaccard_score(true, found, labels=occurring, average=None)
    np.testing.assert_allclose(class_ious(counts)[occurring], 100 * ious)
    assert np.isnan(np.delete(class_ious(counts), occurring)).all()
    assert miou(counts) == pytest.approx(100 * ious.mean())
    assert pixel_accuracy(counts) == pytest.approx(100 * skm.accuracy_score(true, found))


@pytest.mark.parametrize("seed", range(4))
def test_groups_are_scored_as_if_they_had_been_labelled(seed: int) -> None:
    groups = np.array([0, 0, 1, 2, 1, 2])
    truth, prediction = labels(seed, 6), labels(seed + 100, 6) % IGNORED
    kept = truth != IGNORED
    true, found = groups[truth[kept]], groups[prediction[kept]]
    counts = grouped(confusion(prediction, truth, 6), groups.tolist())
    assert counts.tolist() == skm.confusion_matrix(true, found).tolist()
    assert miou(counts) == pytest.approx(100 * skm.jaccard_score(true, found, average="macro"))


@pytest.mark.parametrize(
    ("prediction", "truth", "message"),
    [(4, 0, "predicted label must be 0 to 3, found 4"), (0, 9, "true label .* found 9")],
)
def test_label_that_is_no_class_is_refused(prediction: int, truth: int, message: str) -> None:
    with pytest.raises(Rts2Error, match=message):
        confusion(np.array([[prediction]]), np.array([[truth]]), 4)
