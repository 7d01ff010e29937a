"""Which layers to compute in integers: the cheapest choice, all of them weighed at once.

A layer costs one time in float and another in integers, and where a value goes from a layer of one
kind to one of the other it must be converted. The cheapest choice under such costs is a minimum
cut: between a source that stands for integers and a sink that stands for float,

    cost(S) = Σ integers(i), i in S + Σ float(i), i not in S + Σ conversion(i, j), one of i, j in S

(Greig, Porteous and Seheult 1989). What a layer costs in accuracy is added to its time in integers
at a price: the higher the price, the more layers go back to float, those first that save the least
time for the error that they bring.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ..model.qdq import Flow

TICK_MS: Final = 1e-5
"""What capacities are counted in."""

MOST: Final = 2**30
"""The largest capacity: ten seconds."""


@dataclass(frozen=True)
class Cost:
    """What one layer takes in each of its two kinds, in milliseconds, and its error in integers."""

    layer: str
    float_ms: float
    integer_ms: float
    error: float = 0.0


def cheapest(
    costs: Sequence[Cost],
    flows: Iterable[Flow],
    ms_per_element: float,
    ms_per_error: float = 0.0,
) -> frozenset[str]:
    """The layers to compute in integers, those that make the sum of all costs least.

    `ms_per_element`: what converting a value costs for each of its numbers. `ms_per_error`: what
    error is worth in time. Of several cheapest choices the one with the fewest layers.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order, maximum_flow

    number = {cost.layer: index for index, cost in enumerate(costs)}
    source, sink = len(costs), len(costs) + 1
    capacity = np.zeros((len(costs) + 2, len(costs) + 2), np.int64)
    for index, cost in enumerate(costs):
        capacity[source, index] = _ticks(cost.float_ms)
        capacity[index, sink] = _ticks(cost.integer_ms + ms_per_error * cost.error)
    for flow in flows:
        giver, taker = number[flow.giver], number[flow.taker]
        ticks = _ticks(flow.elements * ms_per_element)
        capacity[giver, taker] += ticks
        capacity[taker, giver] += ticks
    graph = csr_array(np.minimum(capacity, MOST).astype(np.int32))
    residual = csr_array(np.maximum(graph.toarray() - maximum_flow(graph, source, sink).flow, 0))
    reached = breadth_first_order(residual, source, return_predecessors=False)
    return frozenset(costs[index].layer for index in reached if index < len(costs))


def total_ms(
    costs: Iterable[Cost], flows: Iterable[Flow], ms_per_element: float, chosen: frozenset[str]
) -> float:
    """What a choice costs, in milliseconds, without what all choices share."""
    layers = sum(c.integer_ms if c.layer in chosen else c.float_ms for c in costs)
    return layers + ms_per_element * converted(flows, chosen)


def converted(flows: Iterable[Flow], chosen: frozenset[str]) -> int:
    """How many numbers flow between layers of different kinds."""
    return sum(f.elements for f in flows if (f.giver in chosen) != (f.taker in chosen))


def checkered(layers: Sequence[str], flows: Iterable[Flow]) -> frozenset[str]:
    """Every other layer along the flows: what is measured in it converts as much as can be."""
    deep: dict[str, int] = dict.fromkeys(layers, 0)
    for flow in flows:
        deep[flow.taker] = max(deep[flow.taker], deep[flow.giver] + 1)
    return frozenset(layer for layer, depth in deep.items() if depth % 2)


def with_errors(costs: Iterable[Cost], errors: Mapping[str, float]) -> tuple[Cost, ...]:
    """The same costs with what each layer's error is; one without a known error has none."""
    return tuple(Cost(c.layer, c.float_ms, c.integer_ms, errors.get(c.layer, 0.0)) for c in costs)


def _ticks(ms: float) -> int:
    return min(round(max(ms, 0.0) / TICK_MS), MOST)
