"""Accuracies against the paper's tables, written down by hand, and what follows from them."""

import json
from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rts2.model.arch import Arch
from rts2.model.errors import Rts2Error, UsageError
from rts2.profiles.evidence import BRANCHES
from rts2.search.accuracy import LOWER_IS_BETTER, METRICS, Accuracy, Metric
from rts2.search.effects import EffectRows, Effects
from rts2.search.sources import Disparities, Measured, Published, source
from rts2.search.space import Space

PLAIN, SEMANTIC, FULL = 0, 1, 2
"""The variants in the order of the space's first axis."""

PAPER: dict[tuple[int, int, int], tuple[float | None, ...]] = {
    # (c, variant, stages): D1-all, EPE, mIoU, pAcc
    (1, PLAIN, 3): (5.75, 1.14, None, None),
    (1, FULL, 3): (5.57, 1.12, 58.86, 80.86),
    (4, PLAIN, 3): (4.22, 0.96, None, None),
    (4, FULL, 3): (3.80, 0.90, 60.93, 89.77),
    (8, PLAIN, 3): (3.98, 0.91, None, None),
    (8, FULL, 3): (3.33, 0.84, 62.22, 90.64),
    (16, PLAIN, 3): (3.52, 0.87, None, None),
    (16, FULL, 3): (2.90, 0.78, 67.41, 92.92),
    (32, PLAIN, 3): (3.12, 0.82, None, None),
    (32, FULL, 3): (2.62, 0.74, 69.62, 93.57),
    (8, SEMANTIC, 3): (3.90, 0.90, 64.21, 91.56),
    (1, PLAIN, 1): (11.60, None, None, None),
    (1, PLAIN, 2): (8.40, None, None, None),
    (8, FULL, 1): (8.00, None, None, None),
    (8, FULL, 2): (4.70, None, None, None),
}
"""Tables II, III and IV of the paper."""

CS = tuple(range(1, 33))
PAPERS_OWN = Space(d_max=(12,), conv3d=((16,), (4,), (4,)))
"""Every c, everything else as in the paper."""


def published() -> Published:
    found = source("published")
    assert isinstance(found, Published)
    return found


def over_c(stages: int, metric: Metric) -> NDArray[np.float64]:
    """(variants, c) of the paper's first volume and 3D widths."""
    columns = published().columns(PAPERS_OWN, stages)
    return np.broadcast_to(columns.metrics[metric], PAPERS_OWN.shape(stages)).reshape(3, 32)


def flags(marked: NDArray[np.bool_], stages: int) -> NDArray[np.bool_]:
    return np.broadcast_to(marked, PAPERS_OWN.shape(stages)).reshape(3, 32)


@pytest.mark.parametrize(("key", "row"), PAPER.items(), ids=str)
def test_the_papers_rows_are_exact(
    key: tuple[int, int, int], row: tuple[float | None, ...]
) -> None:
    c, variant, stages = key
    for metric, value in zip(METRICS, row, strict=True):
        found = over_c(stages, metric)[variant, c - 1]
        assert np.isnan(found) if value is None else found == value


def test_the_table_holds_the_papers_rows_and_no_others() -> None:
    rows = published().table.rows
    found = {
        (row.arch.c, 1 * row.arch.semantic + 1 * row.arch.refinement, row.arch.stages): (
            row.d1_all,
            row.epe,
            row.miou,
            row.pacc,
        )
        for row in rows
    }
    assert found == PAPER
    assert len(rows) == len(found)
    assert all(row.arch.d_max == 12 and row.source for row in rows)


@pytest.mark.parametrize("stages", [1, 2, 3])
def test_the_papers_rows_are_marked_and_nothing_else_is(stages: int) -> None:
    exact = published().columns(Space(), stages).exact
    marked = {tuple(int(i) for i in at) for at in np.argwhere(exact)}
    rows = [
        Arch(
            c=c,
            stages=stages,
            semantic=variant >= SEMANTIC,
            refinement=variant == FULL,
        )
        for c, variant, count in PAPER
        if count == stages
    ]
    assert marked == {Space().position(arch) for arch in rows}


@pytest.mark.parametrize(("stages", "metric"), list(product((1, 2, 3), METRICS)))
def test_wider_is_never_worse(stages: int, metric: Metric) -> None:
    sign = -1 if LOWER_IS_BETTER[metric] else 1
    for values in over_c(stages, metric):
        known = values[~np.isnan(values)]
        assert (sign * np.diff(known) >= 0).all()


@pytest.mark.parametrize("metric", METRICS)
def test_between_rows_values_lie_between_rows(metric: Metric) -> None:
    column = METRICS.index(metric)
    for variant in (PLAIN, FULL):
        values = over_c(3, metric)[variant]
        rows = sorted(
            (c, row[column]) for (c, v, s), row in PAPER.items() if (v, s) == (variant, 3)
        )
        for (low, before), (high, after) in pairwise(rows):
            if before is None or after is None:
                assert np.isnan(values[low - 1 : high]).all()
                continue
            between = values[low : high - 1]
            assert (between > min(before, after)).all()
            assert (between < max(before, after)).all()


def test_between_rows_it_is_linear_in_the_logarithm_of_c() -> None:
    """√(1 · 4) and √(4 · 16) lie halfway, 2^2.25 a quarter of the way from 4 to 8."""
    d1, miou = over_c(3, "d1_all")[FULL], over_c(3, "miou")[FULL]
    assert d1[2 - 1] == pytest.approx((5.57 + 3.80) / 2)
    assert miou[2 - 1] == pytest.approx((58.86 + 60.93) / 2)
    assert d1[12 - 1] == pytest.approx(3.33 + np.log2(12 / 8) * (2.90 - 3.33))


def test_more_stages_and_more_branches_are_more_accurate() -> None:
    d1 = [over_c(stages, "d1_all") for stages in (1, 2, 3)]
    assert (d1[0] > d1[1]).all()
    assert (d1[1] > d1[2]).all()
    for values in d1:
        assert (values[FULL] < values[PLAIN]).all()


@pytest.mark.parametrize("metric", ["d1_all", "epe"])
def test_the_variant_between_lies_between_its_neighbours(metric: Metric) -> None:
    """By the share that the ablation at c=8 gives: 0.08 of 0.65 in D1, 0.01 of 0.07 in EPE."""
    share = {"d1_all": 0.08 / 0.65, "epe": 0.01 / 0.07}[metric]
    plain, between, full = over_c(3, metric)
    assert between == pytest.approx(plain + share * (full - plain))


def test_fewer_stages_keep_their_ratio_beyond_the_rows() -> None:
    """Stage 2 of the full c=8 network is 4.70 / 3.33 worse; so are c=16 and its variants."""
    two, three = over_c(2, "d1_all"), over_c(3, "d1_all")
    assert two[FULL, 15] == pytest.approx(2.90 * 4.70 / 3.33)
    assert two[PLAIN, 15] == pytest.approx(3.52 * 4.70 / 3.33)
    ratio = two / three
    assert ratio[PLAIN, 0] == pytest.approx(8.40 / 5.75)
    halfway = (np.log2(4) - np.log2(1)) / (np.log2(8) - np.log2(1))
    expected = 8.40 / 5.75 + halfway * (4.70 / 3.33 - 8.40 / 5.75)
    assert ratio[FULL, 3] == pytest.approx(expected)


@pytest.mark.parametrize("stages", [1, 2, 3])
def test_what_the_paper_never_reports_is_unknown(stages: int) -> None:
    assert np.isnan(over_c(stages, "miou")[PLAIN]).all()
    assert np.isnan(over_c(stages, "pacc")[PLAIN]).all()
    if stages < 3:
        for metric in ("epe", "miou", "pacc"):
            assert np.isnan(over_c(stages, metric)).all()
    else:
        assert not np.isnan(over_c(3, "epe")).any()
        assert np.flatnonzero(~np.isnan(over_c(3, "miou")[SEMANTIC])).tolist() == [8 - 1]


@pytest.mark.parametrize("stages", [1, 2, 3])
def test_other_3d_widths_are_extrapolated_and_in_doubt(stages: int) -> None:
    """As far as the metric is known of the paper's own; a row alone tells of no other network."""
    space = Space(c=(8,), d_max=(12,))
    usual = np.ones(space.shape(stages), dtype=bool)
    for stage, width in enumerate((16, 4, 4)[:stages]):
        usual &= space.along(stages, 3 + stage) == width
    assert np.count_nonzero(usual) == 3
    columns = published().columns(space, stages)
    assert columns.extrapolated[~usual].all()
    assert not columns.extrapolated[usual].any()
    for metric in METRICS:
        known = ~np.isnan(columns.metrics[metric])
        own = known[usual].reshape(3, *[1] * (usual.ndim - 1))
        assert (known <= own).all()
        doubt = columns.doubt[metric]
        assert not doubt[usual].any()
        if metric in ("d1_all", "epe"):  # class scores see no volume
            assert (doubt[known & ~usual] > 0).all()
    assert not np.isnan(columns.metrics["d1_all"]).any()


def test_extrapolated_is_what_lies_outside_of_the_rows() -> None:
    """Rows of one and two stages stop at c=8; every row has twelve planes."""
    for stages in (1, 2):
        outside = flags(published().columns(PAPERS_OWN, stages).extrapolated, stages)
        assert not outside[:, :8].any()
        assert outside[:, 8:].all()
    assert not flags(published().columns(PAPERS_OWN, 3).extrapolated, 3).any()
    space = Space(d_max=(11, 12, 13), conv3d=((16,), (4,), (4,)))
    columns = published().columns(space, 3)
    outside = np.broadcast_to(columns.extrapolated, space.shape(3)).reshape(3, 32, 3)
    assert outside[..., 0].all()
    assert not outside[..., 1].any()
    assert outside[..., 2].all()


def test_a_share_and_an_overshoot_by_hand() -> None:
    """Ten pixels of disparity 0.5, six of 2.5, four of 3.5."""
    few = Disparities(counts=(10, 0, 6, 4), source="by hand")
    assert [few.share_from(at) for at in (0, 1, 2, 3, 4, 99)] == [100, 50, 50, 20, 0, 0]
    assert few.overshoot(4) == 0
    assert few.overshoot(3) == pytest.approx(0.5 * 4 / 20)
    assert few.overshoot(2) == pytest.approx((0.5 * 6 + 1.5 * 4) / 20)
    assert few.overshoot(1) == pytest.approx((1.5 * 6 + 2.5 * 4) / 20)


def no_effect(stages: int, branches: str, metric: str) -> dict[str, Any]:
    flat = {"values": [2, 32], "effects": [0, 0]}
    told = {"stages": stages, "branches": branches, "metric": metric, "spread": 0}
    return {**told, "d_max": flat, "conv3d": [flat] * stages}


NO_EFFECT = EffectRows.model_validate(
    {
        "schema": "rts2.effects/1",
        "protocol": "nothing but the disparities that are lost",
        "inherited": 0,
        "rows": [no_effect(*each) for each in product((1, 2, 3), BRANCHES, METRICS)],
    }
)


def with_counts(counts: tuple[int, ...]) -> Published:
    disparities = Disparities(counts=counts, source="by hand")
    table = published().table.model_copy(update={"disparities": disparities})
    return Published(table, Effects(NO_EFFECT))


def test_a_small_first_volume_loses_the_far_disparities() -> None:
    """Of 200 pixels, 150 near, 30 at 100.5 and 20 at 150.5; seven planes see up to 112.

    Six planes see up to 96: all 50 are lost, by 4.5 and 54.5 pixels.
    """
    counts = [0] * 200
    counts[3], counts[100], counts[150] = 150, 30, 20
    space = Space(c=(8, 9), d_max=(6, 7, 9, 10, 12, 24), conv3d=((16,), (4,), (4,)))
    for stages in (1, 2, 3):
        metrics = with_counts(tuple(counts)).columns(space, stages).metrics
        d1 = np.broadcast_to(metrics["d1_all"], space.shape(stages)).reshape(3, 2, 6)
        lost = d1 - d1[:, :, 4:5]
        assert lost == pytest.approx(np.broadcast_to([25, 10, 10, 0, 0, 0], lost.shape))
    epe = np.broadcast_to(metrics["epe"], space.shape(3)).reshape(3, 2, 6)
    lost = epe - epe[:, :, 4:5]
    expected = [(30 * 4.5 + 20 * 54.5) / 200, 20 * 38.5 / 200, 20 * 6.5 / 200, 0, 0, 0]
    assert lost == pytest.approx(np.broadcast_to(expected, lost.shape))
    miou = np.broadcast_to(metrics["miou"], space.shape(3)).reshape(3, 2, 6)
    assert (miou[FULL] == miou[FULL][:, :1]).all()


def test_a_larger_first_volume_gains_what_the_papers_loses() -> None:
    """One pixel in a hundred at 200.5: twelve planes end at 192, thirteen at 208."""
    space = Space(c=(8, 9), d_max=(12, 13), conv3d=((16,), (4,), (4,)))
    metrics = with_counts((99, *[0] * 199, 1)).columns(space, 3).metrics
    d1 = metrics["d1_all"].reshape(3, 2, 2)
    assert d1[..., 1] - d1[..., 0] == pytest.approx(np.full((3, 2), -1))
    epe = metrics["epe"].reshape(3, 2, 2)
    assert epe[..., 1] - epe[..., 0] == pytest.approx(np.full((3, 2), -0.085))


def test_more_planes_never_lose_more_of_the_shipped_disparities() -> None:
    space = Space(c=(8,), conv3d=((16,), (4,), (4,)))
    found = replace(published(), effects=Effects(NO_EFFECT)).columns(space, 3)
    for metric in ("d1_all", "epe"):
        values = found.metrics[metric].reshape(3, len(space.d_max))
        assert (np.diff(values, axis=1) <= 1e-12).all()
        assert (values[:, 0] > values[:, 6]).all()


def measured(folder: Path, *rows: dict[str, Any]) -> Measured:
    path = folder / "accuracy.json"
    path.write_text(json.dumps({"schema": "rts2.accuracy/1", "rows": rows}))
    found = source(str(path))
    assert isinstance(found, Measured)
    return found


def test_measured_rows_are_known_exactly_and_nothing_else_is(tmp_path: Path) -> None:
    narrow = {"c": 8, "stages": 2, "conv3d": [8, 2]}
    plain = {"c": 3, "stages": 2, "semantic": False}
    found = measured(
        tmp_path,
        {"arch": narrow, "d1_all": 5.5, "miou": 60.5},
        {"arch": plain, "d1_all": 7.25, "epe": 1.5},
    )
    space = Space()
    columns = found.columns(space, 2)
    known = {
        space.position(Arch(**narrow)): (5.5, None, 60.5, None),
        space.position(Arch(**plain)): (7.25, 1.5, None, None),
    }
    assert {tuple(int(i) for i in at) for at in np.argwhere(columns.exact)} == known.keys()
    for index, metric in enumerate(METRICS):
        values = columns.metrics[metric].copy()
        for position, row in known.items():
            assert position is not None
            assert (
                np.isnan(values[position]) if row[index] is None else values[position] == row[index]
            )
            values[position] = np.nan
        assert np.isnan(values).all()
    assert not columns.extrapolated.any()
    for stages in (1, 3):
        other = found.columns(space, stages)
        assert not other.exact.any()
        assert all(np.isnan(other.metrics[metric]).all() for metric in METRICS)


def test_what_rows_count_as(tmp_path: Path) -> None:
    assert source("published").exact_evidence == "published"
    assert measured(tmp_path, {"arch": {}, "d1_all": 3.0}).exact_evidence == "measured"


def test_columns_broadcast_to_their_block() -> None:
    space = Space(c=(1, 8), d_max=(6, 12))
    for stages in space.stages:
        found: Accuracy = published().columns(space, stages)
        for array in (*found.metrics.values(), found.exact, found.extrapolated):
            assert np.broadcast_to(array, space.shape(stages)).shape == space.shape(stages)


BROKEN: dict[str, tuple[Any, str]] = {
    "no rows": ({"schema": "rts2.accuracy/1", "rows": []}, "rows"),
    "another schema": ({"schema": "rts2.published-accuracy/1", "rows": []}, "schema"),
    "an unknown metric": (
        {"schema": "rts2.accuracy/1", "rows": [{"arch": {}, "d1": 3.0}]},
        "rows.0.d1",
    ),
    "a broken arch": (
        {"schema": "rts2.accuracy/1", "rows": [{"arch": {"c": 0}, "d1_all": 3.0}]},
        "rows.0.arch.c",
    ),
    "a percentage above 100": (
        {"schema": "rts2.accuracy/1", "rows": [{"arch": {}, "d1_all": 101}]},
        "rows.0.d1_all",
    ),
    "not a number": (
        {"schema": "rts2.accuracy/1", "rows": [{"arch": {}, "miou": float("nan")}]},
        "rows.0.miou",
    ),
    "endless pixels": (
        {"schema": "rts2.accuracy/1", "rows": [{"arch": {}, "epe": float("inf")}]},
        "rows.0.epe",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_table_names_the_field(name: str, tmp_path: Path) -> None:
    document, field = BROKEN[name]
    path = tmp_path / "broken.json"
    path.write_text(json.dumps(document))
    with pytest.raises(Rts2Error, match=field.replace(".", r"\.")) as refusal:
        source(str(path))
    assert str(path) in str(refusal.value)


def test_a_missing_table_is_wrong_use(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such file"):
        source(str(tmp_path / "nowhere.json"))
    with pytest.raises(UsageError, match="no such file"):
        source("kitti")


def test_two_rows_of_one_network_are_refused(tmp_path: Path) -> None:
    """Neither is more true than the other."""
    with pytest.raises(Rts2Error, match="twice"):
        measured(tmp_path, {"arch": {}, "d1_all": 3.0}, {"arch": {"c": 8}, "d1_all": 4.0})


def test_a_row_that_measures_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(Rts2Error, match=r"rows\.0"):
        measured(tmp_path, {"arch": {}})
