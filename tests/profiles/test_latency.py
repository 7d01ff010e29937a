"""Latency models by hand, and against a plain loop over the steps of real networks."""

from itertools import product
from math import prod
from typing import Literal, get_args

import numpy as np
import pytest
from pydantic import ValidationError

from rts2.model.arch import Arch
from rts2.model.errors import Rts2Error
from rts2.model.ops import Kind, Op, ops
from rts2.profiles.features import FEATURES
from rts2.profiles.latency import (
    LatencyModel,
    Steps,
    latencies_ms,
    predict_ms,
    require_costs,
    step_costs_ms,
)
from rts2.profiles.profile import load, names

PAIR = Op(
    "pair",
    "conv2d",
    ((2, 3, 10, 10),),
    (2, 20, 10, 10),
    weights=540,
    macs=2_000_000_000,
    launches=3,
)
SINGLE = Op("single", "conv2d", ((1, 8, 5, 5),), (1, 32, 5, 5), macs=500_000_000)
SOLID = Op("solid", "conv3d", ((1, 1, 4, 5, 5),), (1, 2, 4, 5, 5), macs=250_000_000)
NORM = Op("norm", "norm", ((2, 20, 10, 10),), (2, 20, 10, 10), weights=40)
WARP = Op("warp", "warp_volume", ((1, 2, 300, 200),) * 2, (1, 5, 300, 200), launches=29)
TINY = (PAIR, SINGLE, SOLID, NORM, WARP)

WORK = {
    "gmac": (2.0, 0.5, 0.25, 0, 0),
    "gmac_2d": (2.0, 0.5, 0, 0, 0),
    "gmac_2d_single": (0, 0.5, 0, 0, 0),
    # 20 outputs fill two blocks of 16, so 32 are computed; 32 fill theirs. An image's three inputs
    # stay three, 8 inputs become 16; of a 3D conv outputs alone are filled, 2 become 16.
    "gmac_2d_blocked": (2.0 * 32 / 20, 0.5 * 16 / 8, 0, 0, 0),
    # The same, but 8 inputs are less than a block and stay 8.
    "gmac_2d_packed": (2.0 * 32 / 20, 0.5, 0, 0, 0),
    "gmac_3d": (0, 0, 0.25, 0, 0),
    "gmac_3d_blocked": (0, 0, 0.25 * 16 / 2, 0, 0),
    "gmac_product": (0, 0, 0.25, 0, 0),
    "gbyte": (
        4e-9 * (600 + 4000 + 540),
        4e-9 * (200 + 800),
        4e-9 * (100 + 200),
        4e-9 * (4000 + 4000 + 40),
        4e-9 * (2 * 120_000 + 300_000),
    ),
    "gbyte_resize": (0, 0, 0, 0, 0),
    "gbyte_argmax": (0, 0, 0, 0, 0),
    # 20 outputs leave a block half empty; a number for each multiply-add of one of 2 outputs.
    "gbyte_repacked": (4e-9 * 4000, 0, 0, 0, 0),
    "gbyte_columns": (0, 0, 4 * 0.25 / 2, 0, 0),
    "gbyte_strided": (0, 0, 0, 0, 0),
    "mvoxel_warp": (0, 0, 0, 0, 0.3),
    "extra_kernel": (2, 0, 0, 0, 28),
}
"""What each step of `TINY` counts in each feature, by hand."""


def model(
    combine: Literal["sum", "max"] = "sum",
    starts: Literal["kernels", "steps"] = "steps",
    folded: tuple[Kind, ...] = (),
    start_ms: float = 0.0,
    **ms_per: float,
) -> LatencyModel:
    return LatencyModel(
        combine=combine, starts=starts, folded=folded, start_ms=start_ms, ms_per=ms_per
    )


def test_the_hand_counts_cover_every_feature() -> None:
    assert WORK.keys() == FEATURES.keys()


@pytest.mark.parametrize("feature", WORK)
def test_features_by_hand(feature: str) -> None:
    assert [FEATURES[feature](op) for op in TINY] == pytest.approx(WORK[feature], rel=1e-12)


@pytest.mark.parametrize(("channels", "computed"), [(1, 16), (16, 16), (17, 32), (48, 48)])
def test_channels_are_filled_up_to_whole_blocks(channels: int, computed: int) -> None:
    op = Op("conv", "conv2d", ((1, 1, 1, 1),), (1, channels, 1, 1), macs=channels * 10**9)
    assert FEATURES["gmac_2d_blocked"](op) == pytest.approx(computed)


def test_inputs_that_cannot_be_packed_are_laid_out_in_columns() -> None:
    """ONNX Runtime copies four channels at a time; below a block it reads planes."""
    for inputs, multiplied in ((15, False), (16, False), (18, True), (20, False), (29, True)):
        for width in (10, 5):
            op = Op("conv", "conv2d", ((1, inputs, 10, 10),), (1, 32, 10, width), macs=10**9)
            assert (FEATURES["gmac_2d_packed"](op) == 0) is multiplied
            assert FEATURES["gmac_product"](op) == (1 if multiplied else 0)
            windows = 4 / 32 if multiplied else 0
            assert FEATURES["gbyte_columns"](op) == windows
            assert FEATURES["gbyte_strided"](op) == (windows if width < 10 else 0)


def test_a_stem_counts_as_graphs_hold_it() -> None:
    """c = 13 has two pixels, 26 channels, in one, which cannot be packed; c = 12 has 24."""
    for c, multiplied in ((13, True), (12, False)):
        second = next(op for op in ops(Arch(c=c), (640, 192)) if op.name == "encoder.stem.1.conv")
        assert FEATURES["gmac_product"](second) == pytest.approx(
            3 * 2 * 2 * c * c * 2 * 96 * 320 / 1e9 if multiplied else 0
        )


def test_bytes_of_resizing_are_those_of_resizing_alone() -> None:
    op = Op("up", "resize", ((1, 2, 10, 10),), (1, 2, 20, 20))
    assert FEATURES["gbyte_resize"](op) == pytest.approx(4e-9 * (200 + 800))


def test_the_sum_form_by_hand() -> None:
    form = model("sum", "steps", start_ms=0.5, gmac_2d=3, gmac_3d=8)
    assert step_costs_ms(form, Steps.of([TINY])) == pytest.approx([6.5, 2.0, 2.5, 0.5, 0.5])
    assert latencies_ms(form, Steps.of([TINY])) == pytest.approx([12.0])


def test_the_max_form_by_hand() -> None:
    form = model("max", "steps", start_ms=1.75, gmac_2d=3, gmac_3d=8)
    assert step_costs_ms(form, Steps.of([TINY])) == pytest.approx([6.0, 1.75, 2.0, 1.75, 1.75])
    assert latencies_ms(form, Steps.of([TINY])) == pytest.approx([13.25])


def test_starting_kernels_counts_launches_and_starting_steps_does_not() -> None:
    kernels = model("sum", "kernels", start_ms=0.5)
    steps = model("sum", "steps", start_ms=0.5)
    assert latencies_ms(kernels, Steps.of([TINY])) == pytest.approx([0.5 * (3 + 1 + 1 + 1 + 29)])
    assert latencies_ms(steps, Steps.of([TINY])) == pytest.approx([0.5 * 5])


@pytest.mark.parametrize("combine", ["sum", "max"])
def test_work_of_one_step_adds_up_over_features(combine: Literal["sum", "max"]) -> None:
    form = model(combine, start_ms=0.1, gmac_2d=1, gmac_2d_single=2, gbyte=1000)
    work = 0.5 + 2 * 0.5 + 1000 * 4e-9 * 1000
    expected = 0.1 + work if combine == "sum" else work
    assert latencies_ms(form, Steps.of([[SINGLE]])) == pytest.approx([expected])


@pytest.mark.parametrize("combine", ["sum", "max"])
def test_folded_kinds_cost_nothing(combine: Literal["sum", "max"]) -> None:
    whole = model(combine, start_ms=0.5, gbyte=1e6)
    folding = model(combine, folded=("norm", "warp_volume"), start_ms=0.5, gbyte=1e6)
    without = step_costs_ms(whole, Steps.of([TINY]))
    without[3:] = 0
    assert step_costs_ms(folding, Steps.of([TINY])) == pytest.approx(without)
    assert latencies_ms(folding, Steps.of([[NORM]])) == [0.0]


def test_lists_do_not_leak_into_one_another() -> None:
    form = model(start_ms=1.0, gmac_2d=1)
    table = Steps.of([[PAIR], TINY, [NORM, NORM]])
    assert latencies_ms(form, table) == pytest.approx([3.0, 7.5, 2.0])
    assert table.summed(table.macs) == pytest.approx([2e9, 2.75e9, 0])
    assert table.summed(table.weights) == pytest.approx([540, 580, 80])


ARCHS = [
    Arch(c=c, stages=stages, d_max=d_max, conv3d=(8, 4, 2)[:stages], semantic=s, refinement=r)
    for c, stages, d_max, (s, r) in product(
        (1, 20), (1, 2, 3), (6, 12), ((False, False), (True, False), (True, True))
    )
]


@pytest.mark.parametrize("device", names())
def test_a_table_of_networks_equals_single_predictions(device: str) -> None:
    form = load(device).calibrations[0].model
    together = latencies_ms(form, Steps.of([ops(arch, (320, 96)) for arch in ARCHS]))
    apart = [predict_ms(form, arch, (320, 96)) for arch in ARCHS]
    assert together == pytest.approx(np.array(apart), rel=1e-12)


@pytest.mark.parametrize("device", ["tx2", "rtx2080ti"])
def test_predictions_equal_a_plain_loop(device: str) -> None:
    profile = load(device)
    forms = [known.model for known in profile.calibrations]
    forms += [d.scale(profile.calibration(*d.base).model) for d in profile.derivations]
    for form, arch in product(forms, ARCHS[::7]):
        looped = sum(looped_ms(form, op) for op in ops(arch, (320, 96)))
        assert predict_ms(form, arch, (320, 96)) == pytest.approx(looped, rel=1e-12)


def looped_ms(form: LatencyModel, op: Op) -> float:
    """The cost of one step, written down again from the definition."""
    if op.kind in form.folded:
        return 0.0
    gmac, inputs, outputs = op.macs / 1e9, op.inputs[0][1], op.output[1]
    moved = 4e-9 * (sum(map(prod, op.inputs)) + prod(op.output) + op.weights)
    filled = gmac * 16 * -(-outputs // 16) / outputs
    deep = 1 if inputs <= 3 else 16 * -(-inputs // 16) / inputs
    counted = {
        "gmac": gmac,
        "extra_kernel": op.launches - 1,
        "gmac_2d": gmac if op.kind == "conv2d" else 0,
        "gmac_2d_single": gmac if op.kind == "conv2d" and op.inputs[0][0] == 1 else 0,
        "gmac_2d_blocked": filled * deep if op.kind == "conv2d" else 0,
        "gmac_3d": gmac if op.kind == "conv3d" else 0,
        "gmac_3d_blocked": filled if op.kind == "conv3d" else 0,
        "gbyte": moved,
        "gbyte_resize": moved if op.kind == "resize" else 0,
        "mvoxel_warp": prod(op.output) / 1e6 if op.kind == "warp_volume" else 0,
    }
    start = form.start_ms * (op.launches if form.starts == "kernels" else 1)
    work = sum(ms * counted[name] for name, ms in form.ms_per.items())
    return start + work if form.combine == "sum" else max(start, work)


@pytest.mark.parametrize("device", names())
def test_more_work_is_never_faster(device: str) -> None:
    form = load(device).calibrations[0].model
    for wide, deep in ((Arch(c=9), Arch(c=8)), (Arch(), Arch(d_max=8))):
        assert predict_ms(form, wide, (1242, 375)) >= predict_ms(form, deep, (1242, 375))
    assert predict_ms(form, Arch(stages=2), (1242, 375)) < predict_ms(form, Arch(), (1242, 375))
    assert predict_ms(form, Arch(), (2484, 750)) > predict_ms(form, Arch(), (1242, 375))


def test_a_step_without_a_cost_is_named() -> None:
    """Where nothing but convolutions has a coefficient, the first other step is unknown."""
    form = model(start_ms=0.0, gmac=1.0)
    with pytest.raises(Rts2Error, match=r"no cost for encoder\.pair \(concat\)"):
        predict_ms(form, Arch(), (320, 96))
    with pytest.raises(Rts2Error, match=r"no cost for features\.pair \(concat\)"):
        predict_ms(form, Arch(family="anynet", c=1, semantic=False, refinement=False), (320, 96))


def test_a_folded_step_may_cost_nothing() -> None:
    steps = Steps.of([[PAIR, NORM]])
    require_costs(model(folded=("norm",), gmac=1.0), steps)
    with pytest.raises(Rts2Error, match=r"no cost for norm \(norm\)"):
        require_costs(model(gmac=1.0), steps)


def test_an_unknown_feature_is_refused_by_name() -> None:
    with pytest.raises(ValidationError, match="gmac_4d is no feature; known are gmac, gmac_2d"):
        model(gmac_2d=1.0, gmac_4d=1.0)


@pytest.mark.parametrize("value", [-1e-9, float("nan"), float("inf")])
def test_coefficients_are_finite_and_not_negative(value: float) -> None:
    with pytest.raises(ValidationError, match="start_ms"):
        model(start_ms=value)
    with pytest.raises(ValidationError, match="gbyte"):
        model(gbyte=value)


def test_an_unknown_kind_cannot_be_folded() -> None:
    assert "norm" in get_args(Kind)
    with pytest.raises(ValidationError, match="folded"):
        LatencyModel.model_validate(
            {"combine": "sum", "starts": "steps", "folded": ["nrom"], "start_ms": 0, "ms_per": {}}
        )
