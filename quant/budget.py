"""What may be lost in accuracy, and which layers go back to float until no more is lost."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from ..model.errors import UsageError
from ..model.qdq import Flow
from .parity import Measured
from .selection import Cost, cheapest, with_errors

PRICES: Final = 10
"""How often the price of an error is doubled in search of a choice within the budget."""

SMALLEST: Final = 1e-9
"""An error below it is none."""


@dataclass(frozen=True)
class Budget:
    """What may be lost in accuracy, in points."""

    max_d1_drop: float
    max_miou_drop: float

    def holds(self, found: Measured) -> bool:
        """Whether D1 has risen, and mIoU fallen, by no more than they may."""
        d1_drop, miou_drop = drops(found)
        return d1_drop <= self.max_d1_drop and (miou_drop or 0.0) <= self.max_miou_drop


INT8: Final = Budget(max_d1_drop=0.3, max_miou_drop=0.5)
HALF: Final = Budget(max_d1_drop=0.05, max_miou_drop=0.1)
"""What is allowed unless told."""


def drops(found: Measured) -> tuple[float, float | None]:
    """By how many points D1 has risen, and mIoU fallen; None where no classes are known.

    Raises `UsageError` where no disparity was known to judge by.
    """
    before, after = found.reference, found.other
    if before.d1_all is None or after.d1_all is None:
        raise UsageError(
            "what judges needs a disparity truth, and has none; give --eval a folder with "
            "disparity/, or streets"
        )
    if before.miou is None or after.miou is None:
        return after.d1_all - before.d1_all, None
    return after.d1_all - before.d1_all, before.miou - after.miou


def first_within(
    budget: Budget,
    choices: Iterable[frozenset[str]],
    judge: Callable[[frozenset[str]], Measured],
) -> tuple[frozenset[str], Measured, bool]:
    """The first choice that keeps the budget, what it costs, and True; the last one and False
    where none does.
    """
    chosen, measured = frozenset[str](), None
    for choice in choices:
        chosen, measured = choice, judge(choice)
        if budget.holds(measured):
            return chosen, measured, True
    assert measured is not None, "there is a first choice"
    return chosen, measured, False


def dearer(
    costs: Sequence[Cost],
    flows: Iterable[Flow],
    ms_per_element: float,
    errors: Mapping[str, float],
    fastest: frozenset[str],
) -> Iterator[frozenset[str]]:
    """Ever fewer layers of `fastest`: with each, error is worth more time than before."""
    known = with_errors((cost for cost in costs if cost.layer in fastest), errors)
    own = [flow for flow in flows if {flow.giver, flow.taker} <= fastest]
    saved = sum(max(cost.float_ms - cost.integer_ms, 0.0) for cost in known)
    middle = saved / max(sum(cost.error for cost in known), SMALLEST)
    last = fastest
    for doubled in range(PRICES):
        price = middle * 2.0 ** (doubled - PRICES // 2)
        choice = cheapest(known, own, ms_per_element, price)
        if choice and choice != last:
            last = choice
            yield choice
