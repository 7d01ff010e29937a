"""Tables of parts from networks that were timed as a whole and part by part.

What a part takes is a smooth base times what is its own at each value of its first axis:

    ln cost(place, size) = ln base(place, size) + shared(value) + own(value, size)

The base sees how a cost grows, and that kernels work in blocks of channels. What no base sees is
told by the timings: `shared` at every input size, `own` at one alone. All of it is found at once,
from every time of a part and every sum over a network, each as heavy as it is certain, so that a
value that was timed once borrows from its neighbours and one that was timed often does not.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..model.arch import Arch, Form
from ..model.errors import Rts2Error
from ..model.ops import ops
from .parts import AXES, Floats, Part, PartModel, PartTable, axis_values, parts
from .plan import Candidate

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

BLOCKS: Final = (2, 4, 8, 16)
"""In what numbers kernels take channels: a part has 1, 2, 4 or 8 times c of them, so that all of
its channels fill blocks of 16 where c fills blocks of 16, 8, 4 or 2."""

BEFORE_SHARED: Final = 0.05
BEFORE_OWN: Final = 0.03
"""The same off tables of before, which know how the runtime fills its kernels."""

FOLDS: Final = 8
"""Into how many parts timings are cut to see what predicts them better."""

RIDGE: Final = 0.02
"""How much the base prefers small coefficients to a better fit of one timing, relatively."""

SHARED: Final = 0.25
OWN: Final = 0.06
"""How far (ln) a value is expected off the base, at all sizes and at one of them."""

PART_NOISE: Final = 0.06
PART_FLOOR: Final = 0.01
"""The error (ln) of a part's time, and the share of its network below which it drowns."""

TOTAL_NOISE: Final = 0.02
"""The error (ln) of a network's time beside its standard error. All five were read off networks
that were timed again and again; half or twice any of them moves the error on unseen networks by a
tenth of itself."""

TICK_MS: Final = 1e-3
"""What runtimes count times in: less reads as nothing."""

DAMPED: Final = 0.5
"""How far the drift of a network is expected from that of the reference, as a power of it."""

ROUNDS: Final = 2
"""How often the base and what differs from it are found in turn."""


class Known(NamedTuple):
    """What is known of a runtime's costs beside the timings."""

    like: PartModel | None = None
    """The tables of another precision: the base may grow like them, too."""
    before: PartModel | None = None
    """Tables of this precision, of before or of another machine: the base is in proportion."""


NOTHING: Final = Known()


class Harvest(NamedTuple):
    """One timed network: what each of its parts took, in milliseconds."""

    arch: Arch
    resolution: tuple[int, int]
    ms: Mapping[str, float]
    error: float = 0.0
    """The relative standard error of their sum."""
    drift: float = 0.0
    """How much slower than usual (ln) the reference ran beside it, where the machine was busy;
    divided out of `ms` already, as if both slowed down alike."""
    forms: tuple[Form, ...] | None = None
    """Of the stages' 3D convs; all are 3d without them."""


def fit_parts(harvests: Sequence[Harvest], known: Known = NOTHING) -> PartModel:
    """The tables of every part from networks that were timed part by part.

    Raises:
        Rts2Error: a part was not timed at one of the sizes.
    """
    return _Fit(_Rows.of(harvests), known).model()


def missed(harvests: Sequence[Harvest], chosen: Sequence[int], known: Known) -> float:
    """The mean of |ln(true / predicted)| over the chosen networks, each predicted from tables
    without it and some others.
    """
    rows = _Rows.of(harvests)
    found = []
    for fold in range(FOLDS):
        out = list(chosen)[fold::FOLDS]
        if not out:
            continue
        others = _Fit(rows.where(~np.isin(rows.network, out)), known)
        for index in out:
            own = rows.where(rows.network == index)
            found.append(abs(np.log(own.ms.sum() / others.costs(own).sum())))
    return float(np.mean(found))


def left_out(
    harvests: Sequence[Harvest],
    chosen: Sequence[int] | None = None,
    asked: Sequence[Candidate] = (),
    known: Known = NOTHING,
) -> Floats:
    """ln(true / predicted) of each network, or of the chosen ones, predicted from tables without
    it; scaled, where networks are given that will be `asked` about, to what those expect.

    What was timed is no fair sample of what will be asked: where one network alone had its c,
    leaving that one out asks for what no table knows. So each error counts as a multiple of the
    standard error that its own prediction had, times the median one of the asked networks.
    """
    rows = _Rows.of(harvests)
    usual = _usual_uncertainty(rows, asked, known) if asked else None
    found = []
    for index in range(len(harvests)) if chosen is None else chosen:
        own = rows.where(rows.network == index)
        others = _Fit(rows.where(rows.network != index), known)
        scale = usual / others.uncertainty(own) if usual else 1.0
        found.append(scale * np.log(own.ms.sum() / others.costs(own).sum()))
    return np.array(found)


def _usual_uncertainty(rows: _Rows, asked: Sequence[Candidate], known: Known) -> float:
    whole = _Fit(rows, known)
    each = [Harvest(*candidate, defaultdict(float)) for candidate in asked]
    every = _Rows.of(each, rows.groups)
    told = (whole.uncertainty(every.where(every.network == index)) for index in range(len(each)))
    return float(np.median(list(told)))


def damping(harvests: Sequence[Harvest], known: Known = NOTHING) -> float:
    """By what power of the reference's drift a network's drift differs from the reference's.

    Others who use the machine delay a reference of small kernels more than most networks, whose
    ratio to it then comes out too small: below 0.
    """
    return float(_Fit(_Rows.of(harvests), known).damping)


@dataclass(frozen=True)
class _Rows:
    """One row for every part of every network."""

    parts: NDArray[np.object_]
    network: NDArray[np.int64]
    group: NDArray[np.int64]
    """Which part at which size, as an index into `groups`."""
    ms: Floats
    error: Floats
    drift: Floats
    groups: tuple[tuple[str, int], ...]

    @classmethod
    def of(
        cls, harvests: Sequence[Harvest], groups: tuple[tuple[str, int], ...] | None = None
    ) -> _Rows:
        """Of all harvests, numbered by these groups or by their own."""
        sizes = sorted({part.pixels for harvest in harvests for part in _parts(harvest)})
        groups = groups or tuple(product(AXES, sizes))
        number = {group: index for index, group in enumerate(groups)}
        rows = [
            (part, index, number[part.name, part.pixels], harvest.ms[part.name])
            for index, harvest in enumerate(harvests)
            for part in _parts(harvest)
        ]
        told, network, group, ms = zip(*rows, strict=True)
        every = np.empty(len(told), object)
        every[:] = told
        return cls(
            every,
            np.array(network),
            np.array(group),
            np.maximum(ms, TICK_MS),
            np.array([harvests[index].error for index in network]),
            np.array([harvests[index].drift for index in network]),
            groups,
        )

    def where(self, chosen: NDArray[np.bool_]) -> _Rows:
        """Some of the rows."""
        return _Rows(
            self.parts[chosen],
            self.network[chosen],
            self.group[chosen],
            self.ms[chosen],
            self.error[chosen],
            self.drift[chosen],
            self.groups,
        )


def _parts(harvest: Harvest) -> tuple[Part, ...]:
    return parts(ops(harvest.arch, harvest.resolution), harvest.forms)


class _Fit:
    """Bases, and what differs from them, found in turn."""

    def __init__(self, rows: _Rows, known: Known) -> None:
        self._groups = rows.groups
        self._known = known
        shared = {
            (name, value): index
            for index, (name, value) in enumerate(
                (name, value) for name in AXES for value in axis_values(name)[0]
            )
        }
        self._shared = shared
        self._sizes = sorted({size for _, size in rows.groups})
        self._values = np.zeros(len(shared) * (1 + len(self._sizes)))
        self._bases: dict[int, _Base] = {}
        self.damping = 0.0
        for _ in range(ROUNDS):
            differs = np.exp(self._differs(rows) + self.damping * rows.drift)
            for group in np.unique(rows.group):
                own = rows.group == group
                told = self._told(rows.parts[own])
                sure = PART_NOISE / np.hypot(PART_NOISE, rows.error[own])
                self._bases[int(group)] = _Base(told, (rows.ms / differs)[own], sure)
            self._solve(rows)

    def costs(self, rows: _Rows) -> Floats:
        """What each row should take, in milliseconds."""
        return self._base(rows) * np.exp(self._differs(rows))

    def uncertainty(self, rows: _Rows) -> float:
        """The standard error (ln) of the sum of one network's rows, as a timing would show it."""
        from scipy.linalg import cho_solve

        cost = self.costs(rows)
        share = np.zeros(len(self._values) + 1)
        np.add.at(share, self._places_of(rows.parts), (cost / cost.sum())[:, None])
        return float(np.sqrt(share @ cho_solve(self._normal, share) + TOTAL_NOISE**2))

    def model(self) -> PartModel:
        """The tables."""
        tables = {}
        timed = {self._groups[group][0] for group in self._bases}
        for name in AXES:
            if name.startswith("banded.") and name not in timed:
                continue  # nobody asked for that form
            axes = axis_values(name)
            places = list(product(*axes))
            told = []
            for size in self._sizes:
                group = self._groups.index((name, size))
                if group not in self._bases and not name.startswith("banded."):
                    raise Rts2Error(f"no network with {name} was timed at {size} pixels; time more")
                of_size = [Part(name, place, size) for place in places]
                value = self._values[self._places_of(of_size)].sum(1)
                cost = self._base_cost(group, self._told(of_size)) * np.exp(value)
                told.append(tuple(float(f"{ms:.6g}") for ms in cost))
            tables[name] = PartTable(axes=axes, ms=tuple(told))
        return PartModel(pixels=tuple(self._sizes), tables=tables)

    def _base(self, rows: _Rows) -> Floats:
        found = np.empty(len(rows.ms))
        for group in np.unique(rows.group):
            own = rows.group == group
            found[own] = self._base_cost(int(group), self._told(rows.parts[own]))
        return found

    def _told(self, found: Sequence[Part] | NDArray[np.object_]) -> _Told:
        """What bases of these parts, all of one name, are computed from."""
        like, before = (_costs(model, found) for model in self._known)
        return _Told(np.array([part.at for part in found], float), like, before)

    def _base_cost(self, group: int, told: _Told) -> Floats:
        """The base of a part at one size; where it was timed at others alone, in proportion."""
        name, size = self._groups[group]
        known = [at for at in self._bases if self._groups[at][0] == name]
        if not known:
            raise Rts2Error(f"too few networks with {name} were timed; time more")
        nearest = min(known, key=lambda at: abs(self._groups[at][1] - size))
        return self._bases[nearest](told) * (size / self._groups[nearest][1])

    def _differs(self, rows: _Rows) -> Floats:
        return np.asarray(self._values[self._places_of(rows.parts)].sum(1))

    def _places_of(self, found: Sequence[Part] | NDArray[np.object_]) -> NDArray[np.int64]:
        """Where in the unknowns a part's two values stand, (parts, 2)."""
        shared = np.array([self._shared[part.name, part.at[0]] for part in found])
        size = np.array([self._sizes.index(part.pixels) for part in found])
        return np.stack([shared, len(self._shared) * (1 + size) + shared], 1)

    def _solve(self, rows: _Rows) -> None:
        """What differs from the bases: linear least squares in ln, a network's sum by its slope."""
        from scipy.linalg import cho_factor, cho_solve
        from scipy.sparse import vstack

        base = self._base(rows)
        cost = base * np.exp(self._differs(rows))
        total = np.bincount(rows.network, rows.ms)[rows.network]
        predicted = np.bincount(rows.network, cost)[rows.network]
        _, first = np.unique(rows.network, return_index=True)

        each = self._matrix(rows, np.ones(len(rows.ms)), np.arange(len(rows.ms)), rows.drift)
        spread = np.sqrt(PART_NOISE**2 + rows.error**2 + (PART_FLOOR * total / rows.ms) ** 2)
        told = np.log(rows.ms / base)

        share = cost / predicted
        member = np.searchsorted(rows.network[first], rows.network)
        sums = self._matrix(rows, share, member, rows.drift[first])
        known = np.bincount(member, share * self._differs(rows))
        summed = np.log(total / predicted)[first] + known
        certain = np.hypot(TOTAL_NOISE, rows.error[first])

        weights = 1 / np.concatenate([spread, certain])
        matrix = vstack([each, sums]).multiply(weights[:, None]).tocsr()
        values = np.concatenate([told, summed]) * weights
        normal = (matrix.T @ matrix).toarray() + np.diag(self._expected())
        self._normal = cho_factor(normal, overwrite_a=True)
        found = cho_solve(self._normal, matrix.T @ values)
        self._values, self.damping = found[:-1], found[-1]

    def _matrix(
        self, rows: _Rows, weight: Floats, member: NDArray[np.int64], drift: Floats
    ) -> csr_matrix:
        """How the unknowns add up: a column a value, and the damping last."""
        from scipy.sparse import csr_matrix

        columns = self._places_of(rows.parts)
        height, width = len(drift), len(self._values) + 1
        data = np.concatenate([np.repeat(weight, 2), drift])
        row = np.concatenate([np.repeat(member, 2), np.arange(height)])
        column = np.concatenate([columns.ravel(), np.full(height, width - 1)])
        return csr_matrix((data, (row, column)), (height, width))

    def _expected(self) -> Floats:
        """One over the variance that each unknown is expected to have around 0."""
        before = self._known.before
        known = np.array([before is not None and name in before.tables for name, _ in self._shared])
        shared = np.where(known, BEFORE_SHARED, SHARED)
        own = np.tile(np.where(known, BEFORE_OWN, OWN), len(self._sizes))
        return 1 / np.concatenate([shared, own, [DAMPED]]) ** 2


def _costs(model: PartModel | None, found: Sequence[Part] | NDArray[np.object_]) -> Floats:
    """What tables say of parts of one name, 0 where they do not know it."""
    if model is None or found[0].name not in model.tables:
        return np.zeros(len(found))
    return np.array([model.cost_ms(part) for part in found])


class _Told(NamedTuple):
    """What a base is computed from."""

    places: Floats
    """(n, axes)"""
    like: Floats
    """(n,): what the same part takes in another precision; 0 where that is unknown."""
    before: Floats
    """(n,): what it took in tables of before; 0 where that is unknown."""


class _Base:
    """A cost that grows along a part's axes: non-negative least squares on relative error."""

    def __init__(self, told: _Told, truth: Floats, sure: Floats) -> None:
        from scipy.optimize import nnls

        columns = self._columns(told) * (sure / truth)[:, None]
        scale = columns.max(0)
        self._seen = scale > 0
        columns = columns[:, self._seen] / scale[self._seen]
        small = RIDGE * np.eye(columns.shape[1])
        aims = np.concatenate([sure, np.zeros(len(small))])
        values, _ = nnls(np.concatenate([columns, small]), aims)
        self._values = values / scale[self._seen]

    def __call__(self, told: _Told) -> Floats:
        return np.asarray(self._columns(told)[:, self._seen] @ self._values)

    @staticmethod
    def _columns(told: _Told) -> Floats:
        """1, x, x² of the first axis, the same with x filled up to blocks, and where it fills none;
        each times 1, y and y² of the second axis where there is one (banded planes meet planes);
        and what another precision takes. Where tables of before know it, what those have alone.
        """
        if told.before.any():
            return told.before[:, None]
        places = told.places
        x = places[:, 0]
        columns = [np.ones_like(x), x, x**2]
        for block in BLOCKS:
            filled, open_ = block * np.ceil(x / block), x % block > 0
            columns += [filled, filled**2, x * open_, x**2 * open_]
        powers = np.stack(columns, 1)
        if places.shape[1] > 1:
            y = places[:, 1:2]
            powers = np.concatenate([powers, powers * y, powers * y**2], 1)
        return np.column_stack([powers, told.like])
