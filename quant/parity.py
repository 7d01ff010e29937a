"""How far a quantized network is from its float one: noise in dB, and errors on the same pairs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..model.console import progress
from ..model.data.scene import Sample, Scene
from ..model.errors import Rts2Error
from ..model.evaluation import score
from ..model.metrics import Score
from ..model.predictor import Estimate, Predictor

SHIFT_PX = 24
"""The disparity of the synthetic pair, within reach of every network (d_max of 2 and more)."""


class Measured(NamedTuple):
    """Both networks on the same scenes."""

    reference: Score
    other: Score
    sqnr_db: float
    """Of the disparities of all scenes together; infinite when they are equal."""


def sqnr_db(reference: NDArray[Any], other: NDArray[Any]) -> float:
    """Signal to quantization noise: 10·log10(Σ reference² / Σ (reference − other)²).

    Infinite where both are equal. Raises `Rts2Error` for arrays of different shapes.
    """
    if reference.shape != other.shape:
        raise Rts2Error(f"both must have one shape: {reference.shape}, {other.shape}")
    return decibels(*powers(reference, other))


def measure(reference: Predictor, other: Predictor, scenes: Iterable[Scene]) -> Measured:
    """Runs two networks on every scene, scores both, and compares their disparities.

    Raises `Rts2Error` where `other` fails, or gives values that are not finite.
    """
    scores = [Score(), Score()]
    total = np.zeros(2)
    for scene in scenes:
        estimates = reference.predict(scene.left, scene.right), _finite(other, scene)
        total += powers(estimates[0].disparity, estimates[1].disparity)
        for index, (model, estimate) in enumerate(zip((reference, other), estimates, strict=True)):
            scores[index] += score(estimate, scene, model.arch)
    return Measured(scores[0], scores[1], decibels(*total))


def judge(reference: Predictor, other: Predictor, frames: Sequence[Sample]) -> Measured:
    """`measure` on frames of a data set, read one after the other, with a bar on a terminal."""
    shown = progress(frames, "judging", len(frames))
    return measure(reference, other, (frame.read() for frame in shown))


def synthetic_scene(resolution: tuple[int, int]) -> Scene:
    """A smooth random texture and the same moved by `SHIFT_PX`, always the same; no truth known."""
    width, height = resolution
    texture = _smooth(np.random.default_rng(0).random((height, width + SHIFT_PX, 3)))
    pixels = np.rint(255 * (texture - texture.min()) / np.ptp(texture)).astype(np.uint8)
    return Scene(
        name="one synthetic pair",
        left=pixels[:, :width],
        right=pixels[:, SHIFT_PX:],
        truth=np.full((height, width), np.nan, np.float32),
    )


def _finite(model: Predictor, scene: Scene) -> Estimate:
    """The answer of a network that may overflow; where it does, a runtime may fail altogether."""
    remedy = "in this precision the network leaves the range of its numbers; keep fp32"
    try:
        estimate = model.predict(scene.left, scene.right)
    except Rts2Error as error:
        raise Rts2Error(f"{scene.name}: {remedy}") from error
    if not np.isfinite(estimate.disparity).all():
        raise Rts2Error(f"{scene.name}: {remedy}")
    return estimate


def powers(reference: NDArray[Any], other: NDArray[Any]) -> tuple[float, float]:
    """Σ reference² and Σ (reference − other)²: the power of the signal and that of the noise."""
    signal = reference.astype(np.float64)
    return float(np.square(signal).sum()), float(np.square(signal - other).sum())


def decibels(signal: float, noise: float) -> float:
    """10·log10(signal / noise); infinite without noise."""
    with np.errstate(divide="ignore"):
        return float(10 * (np.log10(signal) - np.log10(noise))) if noise else float("inf")


def _smooth(noise: NDArray[np.float64]) -> NDArray[np.float64]:
    """A 7×7 mean, twice: structure of a few pixels, as real images have it."""
    for axis in (0, 1, 0, 1):
        noise = sum((np.roll(noise, shift, axis) for shift in range(-3, 4)), np.zeros_like(noise))
    return noise
