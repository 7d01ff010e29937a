"""Tables of parts, held against machines whose costs are known exactly."""

import random
from itertools import product
from math import ceil
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from rts2.model.arch import SPACE_C, UNTRAINED, Arch
from rts2.model.checkpoint import build
from rts2.model.errors import Rts2Error
from rts2.model.export import export
from rts2.model.graph import load_graph
from rts2.model.ops import ops
from rts2.profiles.latency import Steps, latencies_ms, predict_ms
from rts2.profiles.partfit import Harvest, fit_parts, left_out
from rts2.profiles.parts import (
    AXES,
    Part,
    PartModel,
    PartTable,
    axis_values,
    part_of,
    parts,
    per_part,
)
from rts2.profiles.plan import RESOLUTIONS, jobs, random_candidate
from rts2.search.space import Parts, Space

Candidate = tuple[Arch, tuple[int, int]]


def machine_ms(part: Part) -> float:
    """A machine that computes 16 channels at once: a staircase in the first axis."""
    weight = 1 + list(AXES).index(part.name)
    first, *rest = part.at
    planes = rest[0] if rest else 1
    return weight * part.pixels / 1e6 * (0.2 + ceil(first / 16) * (1 + 0.1 * planes))


def harvest(candidate: Candidate) -> Harvest:
    arch, resolution = candidate
    found = parts(ops(arch, resolution))
    return Harvest(arch, resolution, {part.name: machine_ms(part) for part in found})


def harvested(count: int) -> list[Harvest]:
    """The first networks that a fit times."""
    chosen = [job for job, _ in zip(jobs(0, ("fp32",)), range(count), strict=False)]
    return [harvest((job.arch, job.resolution)) for job in chosen]


@pytest.fixture(scope="module")
def model() -> PartModel:
    return fit_parts(harvested(180))


@pytest.mark.parametrize(
    "arch",
    [
        Arch(c=1),
        Arch(c=2, stages=2, semantic=False, refinement=False),
        Arch(c=1, stages=1, refinement=False),
    ],
    ids=Arch.label,
)
def test_every_node_of_a_graph_belongs_to_a_part_of_the_op_list(arch: Arch, tmp_path: Path) -> None:
    export(build(arch), tmp_path / "a.onnx", (96, 64), UNTRAINED)
    nodes = [node.name for node in load_graph(tmp_path / "a.onnx").graph.node]
    assert {part_of(node, arch.stages) for node in nodes} == {
        part.name for part in parts(ops(arch, (96, 64)))
    }


def test_a_node_of_no_part_is_named() -> None:
    with pytest.raises(Rts2Error, match="stranger/Conv belongs to no part"):
        part_of("stranger/Conv", 3)


def test_parts_tell_what_their_cost_depends_on() -> None:
    found = parts(ops(Arch(c=7, stages=2, d_max=11, conv3d=(24, 6)), (640, 192)))
    size = 640 * 192
    assert found == (
        Part("encoder", (7,), size),
        Part("context", (7,), size),
        Part("embedding.0", (7,), size),
        Part("volume.0", (7, 11), size),
        Part("regularize.0", (24, 11), size),
        Part("semantics.0", (7,), size),
        Part("refine.0", (11,), size),
        Part("embedding.1", (7,), size),
        Part("volume.1", (7, 5), size),
        Part("regularize.1", (6, 5), size),
        Part("semantics.1", (7,), size),
        Part("refine.1", (5,), size),
        Part("head.1", (1,), size),
    )


def test_times_by_node_add_up_to_the_whole() -> None:
    nodes = {"encoder/Concat": 1.0, "encoder.context.0/MaxPool": 2.0, "output/Resize": 1.0}
    assert per_part(nodes, Arch(stages=2), 8.0) == {"encoder": 2.0, "context": 4.0, "head.1": 2.0}


def test_unseen_networks_are_predicted_where_costs_add_up(model: PartModel) -> None:
    """To one percent: only how a cost goes along the planes is smoothed."""
    chance = random.Random(5)
    for _ in range(60):
        arch, resolution = random_candidate(chance)
        truth = sum(machine_ms(part) for part in parts(ops(arch, resolution)))
        assert predict_ms(model, arch, resolution) == pytest.approx(truth, rel=1e-2)


def test_the_staircase_in_c_comes_out(model: PartModel) -> None:
    cost = {c: model.cost_ms(Part("encoder", (c,), 640 * 192)) for c in SPACE_C}
    assert cost[16] == pytest.approx(cost[1], rel=1e-3)
    assert cost[17] == pytest.approx(cost[32], rel=1e-3)
    assert cost[17] / cost[16] == pytest.approx(2.42 / 1.32, rel=1e-2)


def test_between_two_sizes_the_cost_is_linear_and_below_never_free(model: PartModel) -> None:
    small, large = (640 * 192, 1248 * 384)
    middle = Part("encoder", (3,), (small + large) // 2)
    assert model.cost_ms(middle) == pytest.approx(machine_ms(middle), rel=1e-3)
    tiny = Part("encoder", (3,), 96 * 64)
    assert model.cost_ms(tiny) == pytest.approx(machine_ms(tiny), rel=1e-3)
    table = PartTable(axes=((1,),), ms=((1,), (5,)))
    steep = PartModel(pixels=(100, 200), tables={"context": table})
    assert steep.cost_ms(Part("context", (1,), 50)) == pytest.approx(0.5)
    assert steep.cost_ms(Part("context", (1,), 300)) == pytest.approx(9.0)


def test_a_c_that_nobody_timed_lies_between_its_neighbours() -> None:
    known = [h for h in harvested(180) if h.arch.c not in (9, 25)]
    model = fit_parts(known)
    for c in (9, 25):
        part = Part("encoder", (c,), 640 * 192)
        assert model.cost_ms(part) == pytest.approx(machine_ms(part), rel=0.02)


def test_a_network_left_out_is_predicted_from_the_others_alone() -> None:
    """One network that took twice as long misses by ln 2, or more where others share its c."""
    known = harvested(140)
    ms = known[100].ms
    known[100] = known[100]._replace(ms={part: 2 * value for part, value in ms.items()})
    residuals = left_out(known)
    assert residuals[100] == pytest.approx(np.log(2), abs=0.1)
    assert np.median(np.abs(residuals)) < 0.01


def test_blocks_of_the_space_sum_the_same_costs(model: PartModel) -> None:
    space, chance = Space(), random.Random(2)
    table = Parts.of(space, RESOLUTIONS[1])
    assert isinstance(table.steps, Steps)
    costs = latencies_ms(model, table.steps)
    totals = {stages: table.totals(stages, costs) for stages in space.stages}
    for _ in range(40):
        arch, _ = random_candidate(chance)
        position = space.position(arch)
        assert position is not None
        assert totals[arch.stages][position] == pytest.approx(
            predict_ms(model, arch, RESOLUTIONS[1]), rel=1e-9
        )


def test_another_family_has_no_cost(model: PartModel) -> None:
    with pytest.raises(Rts2Error, match=r"features\.pair has no cost in a profile by parts"):
        predict_ms(model, Arch(family="anynet", c=1), (640, 192))


def test_a_part_that_nobody_timed_is_named() -> None:
    with pytest.raises(Rts2Error, match=r"no network with context was timed"):
        fit_parts([harvest((Arch(semantic=False, refinement=False), (640, 192)))])
    empty = PartModel(pixels=(1,), tables={})
    with pytest.raises(Rts2Error, match="encoder has no cost in this profile"):
        empty.cost_ms(Part("encoder", (1,), 1))


def test_tables_of_another_shape_are_refused() -> None:
    with pytest.raises(ValidationError, match="2 places"):
        PartTable(axes=((1, 2),), ms=((1.0,),))
    with pytest.raises(ValidationError, match="must rise"):
        PartTable(axes=((2, 1),), ms=((1.0, 2.0),))
    table = PartTable(axes=((1,),), ms=((1.0,),))
    with pytest.raises(ValidationError, match="cellar is no part"):
        PartModel(pixels=(1,), tables={"cellar": table})
    with pytest.raises(ValidationError, match="needs the axes"):
        PartModel(pixels=(1,), tables={"volume.0": table})
    with pytest.raises(ValidationError, match="pixels must rise"):
        PartModel(pixels=(2, 2), tables={})


def test_the_plan_covers_every_c_at_both_sizes_and_every_head_first() -> None:
    first = [job for job, _ in zip(jobs(3, ("fp32",)), range(64), strict=False)]
    assert {(j.arch.c, j.resolution) for j in first} == set(product(SPACE_C, RESOLUTIONS))
    whole = [j.arch.c for j in first if j.arch.stages == 3 and j.arch.refinement]
    assert set(whole) == set(SPACE_C)
    heads = {(j.arch.stages, j.arch.semantic, j.resolution) for j in first[:16]}
    assert heads == set(product((1, 2, 3), (False, True), RESOLUTIONS))
    assert axis_values("regularize.1") == ((2, 4, 6, 8, 12, 16), (5,))
