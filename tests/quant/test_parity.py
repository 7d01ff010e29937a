"""Noise ratios in closed form, and the comparison of two networks whose answers are known."""

import math

import numpy as np
import pytest

from rts2.model.data.scene import Scene
from rts2.model.errors import Rts2Error
from rts2.model.predictor import Estimate
from rts2.quant.parity import SHIFT_PX, measure, sqnr_db, synthetic_scene

H, W = 4, 10


class Constant:
    """A network that sees the same disparity everywhere."""

    arch = None
    origin = None

    def __init__(self, disparity: float) -> None:
        self.disparity = disparity
        self.runs = 0

    def predict(self, left: np.ndarray, right: np.ndarray, stages: int | None = None) -> Estimate:
        self.runs += 1
        answer = np.full(left.shape[:2], self.disparity, np.float32)
        return Estimate(answer, None, 0.0, 3)

    def predict_stages(
        self, left: np.ndarray, right: np.ndarray, stages: int | None = None
    ) -> list[Estimate]:
        return [self.predict(left, right)]


def scene(truth: float) -> Scene:
    black = np.zeros((H, W, 3), np.uint8)
    return Scene(f"truth {truth}", black, black, np.full((H, W), truth, np.float32))


@pytest.mark.parametrize("share", [1.0, 0.1, 0.001, 3e-5])
def test_noise_that_is_a_share_of_the_signal(share: float) -> None:
    signal = np.random.default_rng(0).standard_normal(1000)
    assert sqnr_db(signal, signal * (1 + share)) == pytest.approx(-20 * math.log10(share))


def test_equal_and_silent_signals() -> None:
    signal = np.arange(5.0)
    assert sqnr_db(signal, signal.copy()) == math.inf
    assert sqnr_db(np.zeros(5), np.zeros(5)) == math.inf
    assert sqnr_db(np.zeros(5), signal) == -math.inf


def test_integers_do_not_wrap() -> None:
    assert sqnr_db(np.array([200], np.uint8), np.array([220], np.uint8)) == pytest.approx(20)


def test_shapes_must_agree() -> None:
    with pytest.raises(Rts2Error, match=r"one shape: \(2,\), \(3,\)"):
        sqnr_db(np.zeros(2), np.zeros(3))


def test_both_are_scored_and_run_once_a_scene() -> None:
    reference, other = Constant(20), Constant(22)
    found = measure(reference, other, [scene(20), scene(26)])
    assert (reference.runs, other.runs) == (2, 2)
    # 20 against truths 20 and 26: errors 0 and 6 px. 22: errors 2 and 4 px, 4 > 3 px and > 5 %.
    assert (found.reference.epe, found.other.epe) == (3, 3)
    assert (found.reference.d1_all, found.other.d1_all) == (50, 50)
    assert found.sqnr_db == pytest.approx(20)  # noise 2 on a signal of 20


def test_equal_networks_have_no_noise() -> None:
    assert measure(Constant(5), Constant(5), [scene(5)]).sqnr_db == math.inf


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_answers_that_are_not_finite_fail(value: float) -> None:
    with pytest.raises(Rts2Error, match=r"truth 5: in this precision .* keep fp32"):
        measure(Constant(5), Constant(value), [scene(5)])


def test_the_synthetic_pair_is_a_shift_of_itself() -> None:
    made = synthetic_scene((90, 50))
    assert made.left.shape == made.right.shape == (50, 90, 3)
    np.testing.assert_array_equal(made.left[:, SHIFT_PX:], made.right[:, :-SHIFT_PX])
    np.testing.assert_array_equal(made.left, synthetic_scene((90, 50)).left)
    assert made.left.std() > 20
    steps = np.abs(np.diff(made.left.astype(int), axis=1))
    assert steps.mean() < made.left.std() / 2  # smooth, as far as pixels go
    assert np.isnan(made.truth).all()
