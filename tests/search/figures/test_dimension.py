"""The figures of single dimensions: rates above, accuracies below, gaps where nobody knows."""

from rts2.search.figures.dimension import dimension
from rts2.search.figures.style import SYMBOLS
from rts2.search.palette import ACCENT

from ..reports import dimensions, dimensions_of_one_row, found


def test_each_value_has_its_rate_and_its_accuracy() -> None:
    for known in dimensions():
        rates, errors = dimension(found(), known)["data"]
        points = [each.point for each in known.variations]
        assert rates["x"] == errors["x"] == [each.value for each in known.variations]
        assert rates["y"] == [point.fps for point in points]
        assert errors["y"] == [point.d1_all for point in points]
        assert rates["marker"]["symbol"] == [SYMBOLS[p.evidence.latency] for p in points]
        own = [
            value
            for value, c in zip(rates["x"], rates["marker"]["color"], strict=True)
            if c == ACCENT
        ]
        assert own == [known.own]


def test_what_nobody_knows_has_no_mark_and_is_counted() -> None:
    (widths,) = (each for each in dimensions_of_one_row() if each.name == "3D width, stage 1")
    figure = dimension(found(), widths)
    assert figure["data"][1]["y"] == [None, 4.7]
    told = [note["text"] for note in figure["layout"]["annotations"]]
    assert told == ["FPS", "D1-all (1 of 2 not known)"]


def test_the_target_is_drawn_where_it_is_in_reach() -> None:
    near, *_ = dimensions()
    (line,) = dimension(found(), near)["layout"]["shapes"]
    assert (line["y0"], line["y1"]) == (10.0, 10.0)
    far, *_ = dimensions(target_fps=1e5)
    assert dimension(found(target_fps=1e5), far)["layout"]["shapes"] == []


def test_names_are_written_in_short_lines() -> None:
    (executors,) = (each for each in dimensions() if not each.ordered and " on " in each.own)
    axis = dimension(found(), executors)["layout"]["xaxis"]
    assert axis["ticktext"][0] == "fp32<br>PyTorch"
    assert axis["tickvals"][0] == "fp32 on PyTorch"
