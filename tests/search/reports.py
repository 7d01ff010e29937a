"""Searches of a small space, as figures and page show them."""

from functools import cache
from typing import Any

from rts2.model.arch import Arch
from rts2.profiles.profile import Profile, load
from rts2.search.exhaustive import Question, search
from rts2.search.result import Cost, Found, Verified
from rts2.search.sensitivity import Dimension, sensitivity
from rts2.search.sources import Measured, MeasuredRows, source
from rts2.search.space import Space

SPACE = Space(c=(1, 4, 8, 16), d_max=(10, 12), conv3d=((8, 16), (4,), (4,)))
COST = Cost(
    wall_s=61.0,
    evaluations=40,
    fresh=10,
    cache_hits=7,
    failed=1,
    workers=2,
    evaluation_s=55.0,
    candidates=1234,
    training_s=None,
)


def question(device: str | Profile = "tx2", **asked: Any) -> Question:
    profile = load(device) if isinstance(device, str) else device
    return Question(profile, **{"target_fps": 10.0, **asked})


@cache
def found(device: str = "tx2", **asked: Any) -> Found:
    return search(question(device, **asked), source("published"), SPACE)


@cache
def dimensions(device: str = "tx2", **asked: Any) -> tuple[Dimension, ...]:
    """Around the pick, or the nearest."""
    known = found(device, **asked)
    base = known.selected or known.nearest
    if base is None:
        return ()
    return sensitivity(question(device, **asked), source("published"), base, SPACE)


@cache
def dimensions_of_one_row() -> tuple[Dimension, ...]:
    """Around a pick whose accuracy was measured, and no other's: 4.70%."""
    row = {"arch": Arch(c=8, stages=2), "d1_all": 4.7}
    table = MeasuredRows.model_validate({"schema": "rts2.accuracy/1", "rows": [row]})
    known = search(question(), Measured(table), SPACE)
    assert known.selected is not None
    return sensitivity(question(), Measured(table), known.selected, SPACE)


def demoted() -> Found:
    """As after a pick was timed, missed its target, and gave way to another."""
    known = found()
    assert known.selected is not None
    slow = known.selected.model_copy(update={"fps": 9.0, "latency_ms": 1000 / 9})
    seen = Verified(timed=5, predicted=2, unreliable=1, demoted=slow)
    return known.model_copy(update={"verified": seen, "cost": COST})
