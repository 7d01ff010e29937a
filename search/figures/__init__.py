"""The figures of a search as plain JSON, as Plotly draws them.

A trace holds points of one precision, runtime and evidence. Its `meta` tells them, so that a filter
shows and hides whole traces; its `customdata` tells which point of the front each mark is.
"""

from __future__ import annotations

from collections.abc import Sequence

from ..accuracy import LOWER_IS_BETTER, Metric
from ..context import Published
from ..result import Found
from ..sensitivity import Dimension
from .dimension import dimension
from .front import front
from .parallel import parallel
from .style import Figure

__all__ = ["Figure", "figures", "metrics_of"]


def figures(
    found: Found, dimensions: Sequence[Dimension], published: Sequence[Published]
) -> dict[str, Figure]:
    """Every figure by its name: `front-METRIC`, `parallel`, and `dimension-0` and so on."""
    return {
        **{f"front-{metric}": front(found, metric, published) for metric in metrics_of(found)},
        "parallel": parallel(found),
        **{f"dimension-{at}": dimension(found, each) for at, each in enumerate(dimensions)},
    }


def metrics_of(found: Found) -> tuple[Metric, Metric]:
    """What is drawn against the frame rate: an error, the objective if it is one, and the mIoU."""
    return (found.objective if LOWER_IS_BETTER[found.objective] else "d1_all"), "miou"
