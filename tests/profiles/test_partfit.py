"""Tables of parts from timings that are not exact, held against a machine that is known."""

import random
from itertools import islice
from math import ceil, exp, log

import numpy as np
import pytest

from rts2.model.ops import ops
from rts2.profiles.latency import predict_ms
from rts2.profiles.partfit import Harvest, Known, damping, fit_parts, left_out, missed
from rts2.profiles.parts import Part, parts
from rts2.profiles.plan import Candidate, jobs, random_candidate

PLANNED = [(job.arch, job.resolution) for job in islice(jobs(0, ("fp32",)), 64)]


def machine_ms(part: Part) -> float:
    """Blocks of four channels, and a third more where the last one is not full."""
    first, *rest = part.at
    blocks = ceil(first / 4) * (1 + (first % 4 > 0) / 3)
    return part.pixels / 1e6 * (0.5 + blocks * (1 + 0.05 * sum(rest)))


def truth(candidate: Candidate) -> float:
    return sum(machine_ms(part) for part in parts(ops(*candidate)))


def harvests(
    part_noise: float = 0.0, total_noise: float = 0.0, busy: frozenset[int] = frozenset()
) -> list[Harvest]:
    """The first 64 of the plan. The busy ones took 1.5 times as long beside a reference that took
    twice as long."""
    chance = np.random.default_rng(0)
    found = []
    for index, (arch, resolution) in enumerate(PLANNED):
        known = parts(ops(arch, resolution))
        ms = np.array([machine_ms(part) for part in known])
        noisy = ms * np.exp(chance.normal(0, part_noise, len(ms)))
        total = ms.sum() * exp(chance.normal(0, total_noise)) * (0.75 if index in busy else 1)
        scaled = noisy * total / noisy.sum()
        error, drift = (0.06, log(2)) if index in busy else (0.0, 0.0)
        told = {part.name: float(each) for part, each in zip(known, scaled, strict=True)}
        found.append(Harvest(arch, resolution, told, error, drift))
    return found


def errors(known: list[Harvest], count: int = 100) -> np.ndarray:
    model, chance = fit_parts(known), random.Random(1)
    drawn = [random_candidate(chance) for _ in range(count)]
    return np.array([abs(predict_ms(model, *each) / truth(each) - 1) for each in drawn])


def test_noise_of_parts_and_networks_is_averaged_out() -> None:
    """6% on every part and 1% on every network: unseen ones within 5%, nine in ten within 3%."""
    found = errors(harvests(part_noise=0.06, total_noise=0.01))
    assert found.max() < 0.05
    assert np.mean(found < 0.03) > 0.9


def test_networks_of_a_busy_machine_weigh_less_and_are_set_right() -> None:
    """Every fifth ratio came out a quarter too small: 0.75 = 2^-0.415."""
    known = harvests(0.02, 0.005, busy=frozenset(range(4, 64, 5)))
    assert damping(known) == pytest.approx(log(0.75) / log(2), abs=0.06)
    assert errors(known).max() < 0.05
    blind = [harvest._replace(error=0.0, drift=0.0) for harvest in known]
    assert errors(blind).mean() > 3 * errors(known).mean()


def test_without_a_drift_nothing_is_damped() -> None:
    assert damping(harvests(0.02)) == 0


def test_a_c_that_nobody_timed_fills_its_blocks_as_others_do() -> None:
    """Without 12 and 13 at either size: 12 fills three blocks, 13 needs a fourth."""
    known = [harvest for harvest in harvests() if harvest.arch.c not in (12, 13)]
    model = fit_parts(known)
    for c in (12, 13):
        part = Part("encoder", (c,), 640 * 192)
        assert model.cost_ms(part) == pytest.approx(machine_ms(part), rel=0.1)
    assert machine_ms(Part("encoder", (13,), 1)) > 1.5 * machine_ms(Part("encoder", (12,), 1))


def test_errors_of_networks_left_out_are_scaled_to_what_is_asked() -> None:
    """Among the plan's 64 networks each c stands twice; what is asked is surer than what is left
    out, and the scaled errors say how far off unseen networks are."""
    known = harvests(part_noise=0.06, total_noise=0.01)
    chance = random.Random(2)
    asked = [random_candidate(chance) for _ in range(50)]
    chosen = list(range(0, 64, 4))
    plain, scaled = left_out(known, chosen), left_out(known, chosen, asked)
    assert np.sign(plain) == pytest.approx(np.sign(scaled))
    assert np.median(scaled / plain) < 1
    model = fit_parts(known)
    missed = [abs(log(truth(each) / predict_ms(model, *each))) for each in asked]
    assert np.median(np.abs(scaled)) == pytest.approx(np.median(missed), abs=0.01)


def test_a_part_that_one_network_alone_had_at_a_size_is_told_from_the_other_size() -> None:
    known = harvests()
    sizes = [h.resolution for h in known if "head.0" in h.ms and not h.arch.semantic]
    once = next(
        index
        for index, harvest in enumerate(known)
        if "head.0" in harvest.ms and not harvest.arch.semantic
    )
    alone = [
        harvest
        for index, harvest in enumerate(known)
        if index == once or "head.0" not in harvest.ms or harvest.resolution != sizes[0]
    ]
    (residual,) = left_out(alone, [alone.index(known[once])])
    assert abs(residual) < 0.1


def test_both_forms_of_the_3d_convs_have_tables_of_their_own() -> None:
    """Banded takes 0.8 times as long: every stage of every network is predicted in that form."""
    known = []
    for job in islice(jobs(0, ("fp32",)), 64):
        found = parts(ops(job.arch, job.resolution), job.forms)
        ms = {p.name: machine_ms(p) * (0.8 if "banded" in p.name else 1) for p in found}
        known.append(Harvest(job.arch, job.resolution, ms, forms=job.forms))
    model = fit_parts(known)
    for arch, resolution in PLANNED[::5]:
        found = parts(ops(arch, resolution))
        assert model.forms(found) == ("banded",) * arch.stages
        saved = 0.2 * sum(machine_ms(p) for p in found if "regularize" in p.name)
        assert model.fastest_ms(found) == pytest.approx(model.total_ms(found) - saved, rel=0.02)


def test_without_banded_timings_there_is_one_form_alone() -> None:
    model = fit_parts(harvests())
    assert not [name for name in model.tables if "banded" in name]
    assert model.forms(parts(ops(*PLANNED[0]))) == ("3d",) * PLANNED[0][0].stages


def test_another_precision_needs_fewer_timings_where_it_goes_like_the_first() -> None:
    """Half the time and a bit a call, of 24 networks: from them alone, and with the first's."""
    first = harvests()
    like = fit_parts(first)
    second = [
        harvest._replace(ms={part: 0.05 + ms / 2 for part, ms in harvest.ms.items()})
        for harvest in first[:24]
    ]
    chance = random.Random(1)
    drawn = [random_candidate(chance) for _ in range(60)]
    missed = []
    for model in (fit_parts(second), fit_parts(second, Known(like))):
        told = []
        for each in drawn:
            known = parts(ops(*each))
            true = sum(0.05 + machine_ms(part) / 2 for part in known)
            told.append(abs(model.total_ms(known) / true - 1))
        missed.append(np.mean(told))
    assert missed[1] < 0.01 < missed[0]


def test_tables_of_before_let_few_timings_say_how_fast_the_machine_is() -> None:
    """Twenty networks of a machine 1.3 times as slow, whose kernels fill blocks alike."""
    slower = [
        harvest._replace(ms={part: 1.3 * ms for part, ms in harvest.ms.items()})
        for harvest in harvests(0.06, 0.01)[:24]
    ]
    before = fit_parts(harvests())
    chance = random.Random(5)
    drawn = [random_candidate(chance) for _ in range(60)]
    wrong = []
    for known in (Known(), Known(before=before)):
        model = fit_parts(slower, known)
        told = [predict_ms(model, *each) / (1.3 * truth(each)) - 1 for each in drawn]
        wrong.append(np.mean(np.abs(told)))
    assert wrong[1] < 0.02 < wrong[0]
    chosen = range(0, 24, 2)
    assert missed(slower, chosen, Known(before=before)) < missed(slower, chosen, Known())


def test_tables_of_before_that_are_wrong_predict_worse() -> None:
    """Every value of c turned round: what is timed tells that they are no use."""
    known = harvests()
    turned = fit_parts(
        [
            harvest._replace(
                ms={part: ms * (1 + 0.5 * (harvest.arch.c % 3)) for part, ms in harvest.ms.items()}
            )
            for harvest in known
        ]
    )
    chosen = range(0, 64, 4)
    assert missed(known, chosen, Known(before=turned)) > missed(known, chosen, Known())
