"""Which node of an ONNX file each step of a runtime works for.

A runtime runs another graph than the file's: operators are fused, split, renamed, and steps that
only lay data out anew stand in between. Every step is traced back, so that the sum of its times
over the file's nodes is the sum over the steps.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

HEAVY: Final = frozenset(
    ("Conv", "ConvInteger", "ConvTranspose", "Gemm", "MatMul", "MatMulInteger", "QLinearConv")
)
"""Of operators in one step the one of these is what takes the time."""

How = Literal["named", "fused", "traced", "inserted"]


@dataclass(frozen=True)
class Node:
    """An operator of the file, or a step of a runtime: what flows in and out, by name."""

    name: str
    kind: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


@dataclass(frozen=True)
class Step:
    """A step of a runtime, and what the runtime says of it."""

    node: Node
    told: tuple[str, ...] = ()
    """Names of the file's nodes or values that the step stands for, and perhaps others."""
    moves: bool = False
    """It only lays data out anew: whatever it gives was computed before."""


@dataclass(frozen=True)
class Origin:
    """The file's node that a step works for, and how that is known.

    `named`: the runtime names it, or the value that it gives. `fused`: it flows into what is named.
    `traced`: it lies between what is named before and behind. `inserted`: the step does the work
    of no node; it counts for the one that wanted it, if that is one, else for its producer.
    """

    node: str
    how: How


class Tracer:
    """Traces the steps of one runtime's graph to the nodes of the file."""

    def __init__(self, nodes: Sequence[Node], steps: Sequence[Step]) -> None:
        self.nodes = {node.name: node for node in nodes}
        self.order = {node.name: index for index, node in enumerate(nodes)}
        self.steps = {step.node.name: step for step in steps}
        self.maker = _makers(nodes)
        self._before, self._behind = _edges(nodes)
        self._steps_before, self._steps_behind = _edges([step.node for step in steps])
        self.claims: dict[str, set[str]] = {}
        """The nodes that each step does, by step."""
        self.claimed: set[str] = set()

    def origins(self) -> dict[str, Origin]:
        """The origin of every step, by the step's name."""
        found: dict[str, Origin] = {}
        for name, step in self.steps.items():
            self._claim(name, self._told(step))
        for name, step in self.steps.items():
            if not step.moves and name not in self.claims:
                given = {self.maker[value] for value in step.node.outputs if value in self.maker}
                self._claim(name, given - self.claimed)
        for name in list(self.claims):
            named = self.principal(self.claims[name])
            self._claim(name, self._swallowed(name))
            chosen = self.principal(self.claims[name])
            found[name] = Origin(chosen, "named" if chosen == named else "fused")
        for name, step in self.steps.items():
            between = set() if step.moves or name in found else self._between(name)
            if between:
                found[name] = Origin(self.principal(between), "traced")
        beside = {n: self._beside(n, found) for n in self.steps if n not in found}
        return found | {name: Origin(node, "inserted") for name, node in beside.items()}

    def principal(self, names: Collection[str]) -> str:
        """The node among several in one step that takes the time."""
        ordered = sorted(names, key=self.order.__getitem__)
        heavy = [name for name in ordered if self.nodes[name].kind in HEAVY]
        return heavy[0] if heavy else ordered[-1]

    def _claim(self, step: str, nodes: set[str]) -> None:
        if nodes:
            self.claims.setdefault(step, set()).update(nodes)
            self.claimed |= nodes

    def _told(self, step: Step) -> set[str]:
        """The nodes that the runtime names; a suffix behind a slash is the runtime's own."""
        found = set()
        for told in step.told:
            name = told
            while name and name not in self.nodes and name not in self.maker:
                name = name.rpartition("/")[0]
            if name:
                found.add(name if name in self.nodes else self.maker[name])
        return found

    def _swallowed(self, step: str) -> set[str]:
        """Unclaimed nodes that flow into what the step does, where no other step can do them."""
        around = self._nearest(step, self._steps_before, self.claims)
        passed = _walk([step], self._steps_before, around) - around - {step}
        if any(not self.steps[name].moves for name in passed):
            return set()
        own = self.claims[step] - _all(self.claims[name] for name in around)
        return self._unclaimed(own, self._before)

    def _between(self, step: str) -> set[str]:
        """Unclaimed nodes between what is done before the step and what is done behind it."""
        before = self._nearest(step, self._steps_before, self.claims)
        behind = self._nearest(step, self._steps_behind, self.claims)
        free = self.nodes.keys() - self.claimed
        after = self._unclaimed(_all(self.claims[n] for n in before), self._behind)
        ahead = self._unclaimed(_all(self.claims[n] for n in behind), self._before)
        return (after if before else set(free)) & (ahead if behind else set(free))

    def _unclaimed(self, starts: Iterable[str], edges: Mapping[str, set[str]]) -> set[str]:
        return _walk(starts, edges, self.claimed) - self.claimed

    def _beside(self, step: str, found: Mapping[str, Origin]) -> str:
        """The node that wanted an inserted step, or the one whose result it takes."""
        wanting = {found[n].node for n in self._nearest(step, self._steps_behind, found)}
        making = {found[n].node for n in self._nearest(step, self._steps_before, found)}
        if len(wanting) == 1 or not making:
            making = wanting or set(self.nodes)
        return max(making, key=self.order.__getitem__)

    def _nearest(
        self, step: str, edges: Mapping[str, set[str]], known: Collection[str]
    ) -> set[str]:
        """The steps of `known` that are reached first along the edges."""
        return {n for n in _walk([step], edges, known) if n in known and n != step}


def _walk(starts: Iterable[str], edges: Mapping[str, set[str]], ends: Collection[str]) -> set[str]:
    """What is reached from the starts, the starts included, going on behind no end."""
    reached = set(starts)
    waiting = list(reached)
    while waiting:
        for name in edges[waiting.pop()] - reached:
            reached.add(name)
            if name not in ends:
                waiting.append(name)
    return reached


def _makers(nodes: Iterable[Node]) -> dict[str, str]:
    return {value: node.name for node in nodes for value in node.outputs}


def _edges(nodes: Sequence[Node]) -> tuple[dict[str, set[str]], dict[str, set[str]]]:
    """For every node those that it takes from, and those that take from it."""
    maker = _makers(nodes)
    before = {node.name: {maker[v] for v in node.inputs if v in maker} for node in nodes}
    behind: dict[str, set[str]] = {node.name: set() for node in nodes}
    for name, others in before.items():
        for other in others:
            behind[other].add(name)
    return before, behind


def _all(sets: Iterable[set[str]]) -> set[str]:
    return set().union(*sets)


def nodes_of(model: Any) -> list[Node]:
    """The nodes of an ONNX model, whose names must be distinct (see `distinctly_named`)."""
    return [
        Node(node.name, node.op_type, tuple(filter(None, node.input)), tuple(node.output))
        for node in model.graph.node
    ]


def distinctly_named(model: Any) -> bool:
    """Names every node without a name, or with another's, after its first output.

    Returns whether any was renamed.
    """
    seen: set[str] = set()
    renamed = False
    for node in model.graph.node:
        if not node.name or node.name in seen:
            node.name = node.output[0]
            renamed = True
        seen.add(node.name)
    return renamed


@dataclass(frozen=True)
class Kernel:
    """What one step of a runtime takes, and for which node of the file."""

    name: str
    origin: Origin
    ms: float
    """The fastest of its runs: what else runs on the machine only ever adds."""
    kind: str = ""
    """What the runtime calls the operator that it runs; empty for what is no step of its graph."""


def kernels(
    runs: Sequence[Mapping[str, float]], nodes: Sequence[Node], steps: Sequence[Step]
) -> tuple[Kernel, ...]:
    """The steps with the fastest of their times, each traced to a node of the file.

    `runs`: for every run what each step took in ms, in the order in which they ran. What ran
    without being a step of the graph counts for the node of the step that ran next.
    """
    origins = Tracer(nodes, steps).origins()
    kinds = {step.node.name: step.node.kind for step in steps}
    ran = list(dict.fromkeys(name for run in runs for name in run))
    found = []
    latest: Origin | None = None
    for name in reversed(ran):
        beside = latest or Origin(nodes[-1].name, "inserted")
        latest = origins.get(name) or Origin(beside.node, "inserted")
        fastest = min(run[name] for run in runs if name in run)
        found.append(Kernel(name, latest, fastest, kinds.get(name, "")))
    return tuple(reversed(found))


def node_times_ms(found: Iterable[Kernel]) -> dict[str, float]:
    """What each node of the file takes; those that nothing was run for are left out."""
    times: dict[str, float] = {}
    for kernel in found:
        node = kernel.origin.node
        times[node] = times.get(node, 0.0) + kernel.ms
    return times
