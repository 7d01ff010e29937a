"""The cheapest choice of layers, against every choice there is."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rts2.model.qdq import Flow
from rts2.quant.selection import Cost, cheapest, checkered, total_ms, with_errors


def every(names: list[str]) -> list[frozenset[str]]:
    return [frozenset(c) for size in range(len(names) + 1) for c in combinations(names, size)]


TIMES = st.integers(0, 400).map(lambda n: n / 100)


@st.composite
def networks(draw: st.DrawFn) -> tuple[list[Cost], list[Flow]]:
    count = draw(st.integers(1, 7))
    names = [f"layer{index}" for index in range(count)]
    costs = [Cost(name, draw(TIMES), draw(TIMES), draw(TIMES)) for name in names]
    pairs = [(a, b) for a in range(count) for b in range(a + 1, count)]
    chosen = draw(st.lists(st.sampled_from(pairs), unique=True)) if pairs else []
    flows = [Flow(names[a], names[b], draw(st.integers(1, 100))) for a, b in chosen]
    return costs, flows


@settings(max_examples=150, deadline=None)
@given(networks(), st.sampled_from([0.0, 0.01, 0.1]), st.sampled_from([0.0, 0.5, 2.0]))
def test_no_choice_is_cheaper(
    network: tuple[list[Cost], list[Flow]], rate: float, price: float
) -> None:
    costs, flows = network

    def cost(choice: frozenset[str]) -> float:
        errors = sum(c.error for c in costs if c.layer in choice)
        return total_ms(costs, flows, rate, choice) + price * errors

    best = min(map(cost, every([c.layer for c in costs])))
    assert cost(cheapest(costs, flows, rate, price)) == pytest.approx(best, abs=1e-3)


def test_conversions_hold_a_region_together() -> None:
    """The middle layer loses 1 ms in integers, and two conversions would cost 2."""
    costs = [Cost("a", 5, 1), Cost("b", 1, 2), Cost("c", 5, 1)]
    flows = [Flow("a", "b", 100), Flow("b", "c", 100)]
    assert cheapest(costs, flows, 0.01) == {"a", "b", "c"}
    assert cheapest(costs, flows, 0.001) == {"a", "c"}


def test_a_price_restores_first_what_saves_least_for_its_error() -> None:
    costs = with_errors([Cost("a", 2, 1), Cost("b", 4, 1), Cost("c", 2, 1)], {"a": 1, "b": 1})
    assert cheapest(costs, [], 0.0, 0.5) == {"a", "b", "c"}
    assert cheapest(costs, [], 0.0, 1.5) == {"b", "c"}
    assert cheapest(costs, [], 0.0, 10.0) == {"c"}


def test_what_is_as_fast_in_float_stays_float() -> None:
    assert cheapest([Cost("a", 1, 1)], [], 0.0) == frozenset()


def test_every_other_layer_of_a_chain() -> None:
    flows = [Flow("a", "b", 1), Flow("b", "c", 1), Flow("c", "d", 1)]
    chosen = checkered(["a", "b", "c", "d"], flows)
    assert chosen == {"b", "d"}
    assert all((f.giver in chosen) != (f.taker in chosen) for f in flows)


def test_times_of_ten_seconds_do_not_overflow() -> None:
    assert cheapest([Cost("a", 20_000.0, 1.0)], [], np.inf) == {"a"}
