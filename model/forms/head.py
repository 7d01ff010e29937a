"""The most probable class at full resolution, without scores at full resolution laid out anew."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

GROUPS = 16
"""In how many steps the pixels are classified: few enough to launch, small enough for a cache."""


def class_ids(scores: Tensor, factor: int) -> Tensor:
    """`enlarge(scores, factor).argmax(1)`: (B, classes, h, w) → (B, factor·h, factor·w), int32.

    `factor` is 4, 8 or 16. Between two neighbours a bilinear map is a straight line, and its
    `factor` points lie evenly on it, the first half a step away: every step is one sum. Between
    each four neighbours, the edges repeated outside, lie factor² pixels; those that have the same
    place there are classified together, with the scores of a pixel side by side, and what is
    interleaved in the end is one number a pixel. Pixels outside the outermost centres are cut off.
    """
    rows = _framed(_framed(scores.permute(0, 2, 3, 1), 1), 2)
    down = _between(rows, 1, factor)
    size = factor * factor // GROUPS  # lines of one group
    ids = []
    for start in range(0, factor, size):
        lines = torch.stack(down[start : start + size], 1)  # (B, size, h + 1, w + 2, classes)
        points = [line.argmax(-1) for line in _between(lines, 3, factor)]
        ids.append(torch.stack(points, 2).flatten(1, 2))  # (B, size·factor, h + 1, w + 1)
    return _interleaved(ids, factor)


def class_ids_by_maxima(scores: Tensor, factor: int) -> Tensor:
    """`class_ids` without an argmax, the scores of a class side by side.

    Of classes 0 … n − 1 the first that has the greatest score is n − max (n − k) over all k whose
    score is the greatest: two maxima, which run along memory where an argmax sorts.
    """
    classes = scores.shape[1]
    left = torch.arange(classes, 0, -1, dtype=scores.dtype, device=scores.device).view(-1, 1, 1)
    # Framed with five axes: of four OpenVINO may lay the channels side by side, and all back.
    planes = _framed(_framed(scores.unsqueeze(1), 3), 4).squeeze(1)
    height = planes.shape[2] - 1
    down = _between(planes, 2, factor)
    size = factor * factor // GROUPS
    ids = []
    for start in range(0, factor, size):
        lines = torch.cat(down[start : start + size], 2)  # (B, classes, size·(h + 1), w + 2)
        points = []
        for line in _between(lines, 3, factor):
            greatest = line >= line.amax(1, keepdim=True)
            after = torch.where(greatest, left, left.new_zeros(())).amax(1)
            points.append((classes - after).view(len(scores), size, height, -1))
        ids.append(torch.stack(points, 2).flatten(1, 2))  # (B, size·factor, h + 1, w + 1)
    return _interleaved(ids, factor)


def _interleaved(ids: list[Tensor], factor: int) -> Tensor:
    """The ids of pixels that have the same place between their neighbours → all, cut to size."""
    # Floats, as few runtimes interleave integers; they hold every class id.
    full = F.pixel_shuffle(torch.cat(ids, 1).float(), factor).squeeze(1)
    edge = factor // 2
    return full[:, edge:-edge, edge:-edge].int()


def _framed(maps: Tensor, axis: int) -> Tensor:
    """The first and the last of an axis once more."""
    last = maps.shape[axis] - 1
    return torch.cat([maps.narrow(axis, 0, 1), maps, maps.narrow(axis, last, 1)], axis)


def _between(maps: Tensor, axis: int, factor: int) -> list[Tensor]:
    """For each of `factor` even places between neighbours along an axis the values there."""
    count = maps.shape[axis] - 1
    near, far = maps.narrow(axis, 0, count), maps.narrow(axis, 1, count)
    step = (far - near) * (1 / factor)
    found = [near + step * 0.5]
    for _ in range(factor - 1):
        found.append(found[-1] + step)
    return found
