"""What a kit starts from."""

import pytest

from rts2.model.arch import Arch
from rts2.profiles.kit.prior import prior
from rts2.profiles.latency import LatencyModel, predict_ms
from rts2.profiles.profile import load

KITTI = (1242, 375)


def test_a_derivation_is_taken_as_it_is() -> None:
    """What the prior leaves room for costs nothing until a timing says so."""
    tx2 = load("tx2")
    derived = next(d for d in tx2.derivations if (d.runtime, d.precision) == ("tensorrt", "fp16"))
    base = tx2.calibration(*derived.base).model
    assert isinstance(base, LatencyModel)
    found = prior(tx2, "tensorrt", "fp16")
    expected = predict_ms(derived.scale(base), Arch(), KITTI)
    assert predict_ms(found.model, Arch(), KITTI) == pytest.approx(expected)
    assert derived.source in found.source


def test_without_one_the_nearest_calibration_is_taken_with_its_steps_fused() -> None:
    known = load("rtx2080ti")
    only = known.model_copy(update={"derivations": ()})
    found = prior(only, "tensorrt", "fp32")
    assert {"norm", "relu"} <= set(found.model.folded)
    assert "pytorch fp32" in found.source
