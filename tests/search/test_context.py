"""Published networks against the paper's tables, written down by hand."""

import json
from importlib import resources

import pytest

from rts2.model.errors import Rts2Error
from rts2.model.files import parse_json
from rts2.profiles.profile import load
from rts2.search.context import Benchmarks, benchmarks, context, of_benchmarks, of_paper

KITTI = (1242, 375)


def test_the_tables_are_the_papers() -> None:
    """Tables V and VI: nine networks and six."""
    tables = benchmarks()
    assert "tables V and VI" in tables.source
    assert [(row.network, row.d1_all) for row in tables.stereo] == [
        ("GANet", 1.81),
        ("HD3", 2.02),
        ("GWCNet", 2.11),
        ("SegStereo", 2.25),
        ("PSMNet", 2.32),
        ("RTS²Net, c=32", 3.56),
        ("DispNetC", 4.34),
        ("MADNet", 4.66),
        ("StereoNet", 4.83),
    ]
    assert [(row.network, row.iou_class) for row in tables.semantic] == [
        ("VideoProp-LabelRelax", 72.82),
        ("IfN-DomAdap-Seg", 59.50),
        ("SegStereo", 59.10),
        ("RTS²Net, c=32", 57.67),
        ("SDNet", 51.14),
        ("APMoE_seg_ROB", 47.96),
    ]
    for row in tables.stereo:
        low, high = sorted((row.d1_bg, row.d1_fg))
        assert low <= row.d1_all <= high


def test_a_benchmarks_network_has_the_speed_of_its_runtime_and_one_metric() -> None:
    found = of_benchmarks(benchmarks())
    assert {each.origin for each in found} == {"benchmark"}
    assert len(found) == 9 + 5, "one row has no runtime"
    psmnet = next(each for each in found if each.name == "PSMNet")
    assert (psmnet.fps, psmnet.metrics) == (pytest.approx(1 / 0.41), {"d1_all": 2.32})
    twice = [each.metrics for each in found if each.name == "SegStereo"]
    assert twice == [{"d1_all": 2.25}, {"miou": 59.10}]


def test_the_papers_networks_have_their_speed_on_the_device() -> None:
    """The full c = 8 of three stages: 6.3 FPS on a TX2, 60.4 on an RTX 2080 Ti."""
    for device, fps in (("tx2", 6.3), ("rtx2080ti", 60.4)):
        (known,) = (
            each for each in of_paper(load(device), KITTI) if each.name == "c=8, 3 stages, full"
        )
        assert known.fps == fps
        assert known.metrics == {"d1_all": 3.33, "epe": 0.84, "miou": 62.22, "pacc": 90.64}
    assert [len(of_paper(load(device), KITTI)) for device in ("tx2", "rtx2080ti")] == [15, 11]


def test_elsewhere_nothing_was_published() -> None:
    assert of_paper(load("cpu"), KITTI) == []
    assert of_paper(load("tx2"), (640, 480)) == []
    assert {each.origin for each in context(load("cpu"), KITTI)} == {"benchmark"}
    assert of_paper(load("tx2"), (1248, 384)), "padded, it is the same size"


@pytest.mark.parametrize(
    ("field", "value"),
    [("runtime_s", 0), ("d1_all", 101), ("d1_all", None), ("network", ""), ("made_up", 1)],
)
def test_a_broken_table_is_refused_with_its_field(field: str, value: object) -> None:
    text = (resources.files("rts2.search") / "published" / "benchmarks.json").read_text("utf-8")
    broken = json.loads(text)
    broken["stereo"][2][field] = value
    with pytest.raises(Rts2Error, match=f"stereo.2.{field}"):
        parse_json(json.dumps(broken), Benchmarks, "the table")
