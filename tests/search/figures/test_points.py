"""What is told of a point under the pointer."""

import json

from rts2.search.figures.points import between, groups, told

from ..reports import dimensions_of_one_row, found


def test_everything_of_a_point_is_told() -> None:
    """The published c = 8 of two stages: 10.9 FPS and 4.70%."""
    assert found().selected is not None
    assert told(found().selected).split("<br>") == [
        "<b>c=8, 2 stages, full</b>",
        "d_max 12, 3D widths 16/4",
        "fp32 on PyTorch",
        "10.9 FPS (10.4–11.4), published",
        "91.7 ms a pair",
        "D1-all 4.70%, EPE –",
        "mIoU –, pAcc –",
        "accuracy published",
        "632,316 parameters, 2.53 MB",
        "2.76 billion multiply-adds",
    ]


def test_an_accuracy_that_nobody_knows_has_no_evidence() -> None:
    (widths,) = (each for each in dimensions_of_one_row() if each.name == "3D width, stage 1")
    lines = [told(each.point).split("<br>")[7] for each in widths.variations]
    assert lines == ["accuracy not known", "accuracy measured"]


def test_an_interval_stands_beside_its_metric() -> None:
    assert found().selected is not None
    doubtful = found().selected.model_copy(update={"ranges": {"d1_all": (4.25, 5.5)}})
    assert between(doubtful, "d1_all") == "4.70% (4.25–5.50%)"
    assert between(doubtful, "epe") == "–"
    assert between(found().selected, "d1_all") == "4.70%"


def test_groups_part_the_front() -> None:
    known = groups(found())
    assert sorted(at for _, group in known for at in group) == list(range(len(found().front)))
    assert len({json.dumps(meta) for meta, _ in known}) == len(known)
