"""What lower precisions cost: the table in the box, and how it is carried over."""

import numpy as np
import pytest

from rts2.model.arch import Arch
from rts2.model.errors import Rts2Error
from rts2.model.files import parse_json
from rts2.profiles.evidence import BRANCHES
from rts2.search.accuracy import METRICS
from rts2.search.lowered import Lowered, LoweredRows, Row, measured
from rts2.search.sources import source
from rts2.search.space import Space

SPACE = Space(c=(1, 2, 4, 16), d_max=(12, 24), conv3d=((16,), (4,), (4,)))


def table(*rows: Row) -> Lowered:
    return Lowered(LoweredRows(schema="rts2.lowered/1", protocol="made up", rows=rows))


def test_fp32_and_fp16_are_what_the_source_says() -> None:
    accuracy = source("published").columns(SPACE, 3)
    for precision in ("fp32", "fp16"):
        assert table().knows(precision)
        assert table().applied(accuracy, SPACE, 3, precision) is accuracy
    assert not table().knows("int8")


def test_a_change_is_linear_in_log2_of_c_and_extrapolated_beyond() -> None:
    rows = [
        Row(arch=Arch(c=c), precision="int8", d1_all=change, miou=-change)
        for c, change in ((1, 0.8), (4, 0.2))
    ]
    accuracy = source("published").columns(SPACE, 3)
    found = table(*rows).applied(accuracy, SPACE, 3, "int8")
    full = BRANCHES.index("full")
    change = (found.metrics["d1_all"] - accuracy.metrics["d1_all"])[full, :, 0, 0, 0, 0]
    np.testing.assert_allclose(change, [0.8, 0.5, 0.2, 0.2])
    fall = (found.metrics["miou"] - accuracy.metrics["miou"])[full, :, 1, 0, 0, 0]
    np.testing.assert_allclose(fall, [-0.8, -0.5, -0.2, -0.2])
    assert list(found.extrapolated[full, :, 0, 0, 0, 0]) == [False, False, False, True]
    assert np.isnan(found.metrics["epe"]).all()  # no row tells it
    assert np.isnan(found.metrics["d1_all"][:full]).all()  # nor another variant
    assert not found.exact.any()


def test_nobody_gains_by_a_lower_precision() -> None:
    better = Row(arch=Arch(c=1), precision="bf16", d1_all=-0.5, epe=-0.1, miou=0.3, pacc=0.2)
    assert [better.change(metric) for metric in METRICS] == [0, 0, 0, 0]


def test_the_box_was_judged_in_both_precisions() -> None:
    """Every stage count and variant of c = 1, 4 and 8."""
    rows = measured().table.rows
    assert "generated scenes" in measured().table.protocol
    for precision in ("int8", "bf16"):
        archs = {row.arch for row in rows if row.precision == precision}
        assert {arch.c for arch in archs} == {1, 4, 8}
        assert len(archs) == 27
    for row in rows:
        assert row.d1_all is not None
        assert row.epe is not None
        assert (row.miou is None) == (not row.arch.semantic)
    # What integers cost is of the order of their budget.
    integers = [row.change("d1_all") for row in rows if row.precision == "int8"]
    assert np.median(integers) < 0.3


def test_a_broken_table_is_refused() -> None:
    text = (
        '{"schema": "rts2.lowered/1", "protocol": "", "rows": [{"arch": {}, "precision": "fp8"}]}'
    )
    with pytest.raises(Rts2Error, match=r"rows\.0\.precision"):
        parse_json(text, LoweredRows, "a table")
