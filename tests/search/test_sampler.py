"""The next chain: from a surrogate that is held against closed forms, and never one twice."""

from collections.abc import Iterator

import moocore
import numpy as np
import optuna
import pytest

from rts2.model.arch import LARGEST, Arch
from rts2.model.errors import UsageError
from rts2.profiles.profile import load
from rts2.search.exhaustive import Question
from rts2.search.landscape import Chains, Landscape
from rts2.search.sampler import FrontSampler, Staircase, Surrogate, as_stored, features
from rts2.search.space import Space

from .standin import GRID, SMALL, held, standin_row

METRICS = ("d1_all", "miou")


def landscape(space: Space = SMALL, target_fps: float = 1.0) -> Landscape:
    question = Question(load("tx2"), target_fps, allow_extrapolated=True)
    return Landscape.of(question, Chains.of(LARGEST, space), METRICS)


@pytest.fixture(autouse=True)
def _silent() -> Iterator[None]:
    optuna.logging.set_verbosity(optuna.logging.CRITICAL)
    yield
    optuna.logging.set_verbosity(optuna.logging.INFO)


def chosen(sampler: FrontSampler, count: int) -> list[int]:
    """The chains that a study judges one after the other, all with the same values for Optuna."""
    study = optuna.create_study(sampler=sampler, directions=["minimize"] * 3)
    found = []
    for _ in range(count):
        trial = study.ask(sampler.dimensions())
        arch = sampler.chains.arch(trial.params)
        trial.set_user_attr("rows", as_stored(standin_row(part) for part in held(arch)))
        study.tell(trial, [1.0, 1.0, 1.0])
        found.append(sampler.chains.number(trial.params))
    return found


def test_the_surrogate_is_the_posterior_of_a_linear_gaussian_model() -> None:
    """Held against the textbook's normal equations at the ridge that it chose."""
    rng = np.random.default_rng(3)
    inputs, weights = rng.normal(size=(40, 5)), rng.normal(size=5)
    values = inputs @ weights + 0.1 * rng.normal(size=40)
    found = Surrogate.fitted(inputs, values)
    centred = values - values.mean()
    fits = []
    for ridge in np.geomspace(1e-4, 1e2, 13):
        covariance = inputs @ inputs.T + ridge * np.eye(40)
        prior = centred @ np.linalg.solve(covariance, centred) / 40
        _, volume = np.linalg.slogdet(covariance)
        fits.append((-40 * np.log(prior) - volume, ridge, prior))
    _, ridge, prior = max(fits)
    inverse = np.linalg.inv(inputs.T @ inputs + ridge * np.eye(5))
    new = rng.normal(size=(7, 5))
    mean, deviation = found.predicted(new)
    assert mean == pytest.approx(values.mean() + new @ inverse @ inputs.T @ centred)
    variance = np.einsum("ni,ij,nj->n", new, ridge * prior * inverse, new)
    assert deviation == pytest.approx(np.sqrt(variance))


def test_what_few_points_do_not_tell_is_unsure() -> None:
    inputs = np.eye(6)
    _, deviation = Surrogate.fitted(inputs[:2], np.array([1.0, 3.0])).predicted(inputs)
    assert deviation[2:].min() > deviation[:2].max()


def test_gains_are_differences_of_hypervolume() -> None:
    rng = np.random.default_rng(5)
    points, new = rng.uniform(0, 10, (12, 2)), rng.uniform(0, 10, (200, 2))
    front = Staircase.of(points[:, 0], points[:, 1], 10.0, 10.0)
    before = moocore.hypervolume(points, ref=[10, 10])
    assert front.area == pytest.approx(before)
    after = [moocore.hypervolume(np.vstack([points, one]), ref=[10, 10]) for one in new]
    gains = front.gains(new[:, 0], new[:, 1])
    assert gains == pytest.approx(np.array(after) - before, abs=1e-9)
    assert (gains > 0).any()
    assert front.gains(np.array([1.0]), np.array([np.inf])) == 0


def test_a_front_of_nothing_gains_the_whole_rectangle() -> None:
    front = Staircase.of(np.array([3.0]), np.array([11.0]), 10.0, 10.0)
    assert front.area == 0
    assert front.gains(np.array([4.0]), np.array([7.0])) == pytest.approx((10 - 4) * (10 - 7))


def test_features_are_of_every_beginning_and_of_full_rank() -> None:
    chains = Chains.of(LARGEST, GRID)
    for stages, dimensions in ((1, 3), (2, 4), (3, 5)):
        found = features(chains, stages)
        assert len(found) == chains.count(stages)
        assert np.abs(found).max() == 1
        assert found.shape[1] == 1 + 2 * dimensions + dimensions * (dimensions - 1) // 2 + 2


def test_chains_are_numbered_as_their_networks_are() -> None:
    chains = Chains.of(LARGEST, GRID)
    for number in (0, 17, 899):
        arch = chains.arch(chains.values(number))
        assert chains.number(chains.values(number)) == number == chains.nearest(arch)
        for part in held(arch):
            flat = chains.flat(part)
            assert flat is not None
            assert flat % chains.count(part.stages) == chains.beginning(part.stages)[number]


def test_a_supernet_of_less_holds_less() -> None:
    whole = Arch(c=4, stages=2, d_max=12, conv3d=(16, 4), semantic=True, refinement=False)
    chains = Chains.of(whole, GRID)
    assert chains.axes == {
        "c": (1, 2, 3, 4),
        "d_max": (6, 9, 12),
        "conv3d_1": (4, 16),
        "conv3d_2": (2, 4),
    }
    assert chains.levels == 2
    assert chains.arch(chains.values(0)).branches == "disparity+semantic"
    with pytest.raises(UsageError, match="its d_max is at most 5, the space begins at 6"):
        Chains.of(Arch(d_max=5), GRID)
    with pytest.raises(UsageError, match="of 19 classes, and the supernet of 2"):
        Chains.of(Arch(classes=2), GRID)


def test_only_chains_that_hold_a_network_that_meets_the_target_are_admitted() -> None:
    known = landscape(target_fps=40.0)
    assert 0 < len(known.admitted) < known.chains.size
    for number in range(known.chains.size):
        parts = held(known.chains.arch(known.chains.values(number)))
        meets = any(known.latency_ms(part) <= known.target_ms for part in parts if part.semantic)
        assert meets == (number in known.admitted)


def test_no_chain_is_chosen_twice_and_all_are_in_the_end() -> None:
    sampler = FrontSampler(landscape(), METRICS, first=(3, 3, 9))
    found = chosen(sampler, 16)
    assert found[:2] == [3, 9]
    assert sorted(found) == list(range(16))


def test_the_same_history_gives_the_same_choice() -> None:
    known = landscape(GRID, 5.0)
    assert chosen(FrontSampler(known, METRICS), 20) == chosen(FrontSampler(known, METRICS), 20)


def test_a_twentieth_of_the_chains_comes_nearer_to_the_front_than_chance() -> None:
    """Of the hypervolume in latency, D1 and mIoU that all 900 chains have."""
    known = landscape(GRID, 5.0)
    points = {}
    for number in known.admitted:
        rows = map(standin_row, held(known.chains.arch(known.chains.values(int(number)))))
        told = [(known.latency_ms(r.arch), r.d1_all, -r.miou) for r in rows if r.miou is not None]
        points[int(number)] = [one for one in told if one[0] < np.inf]
    reference = np.max([one for each in points.values() for one in each], axis=0)

    def volume(numbers: list[int]) -> float:
        found = [one for number in numbers for one in points[number]]
        return float(moocore.hypervolume(np.array(found), ref=reference))

    rng = np.random.default_rng(0)
    chance = [volume(rng.choice(list(points), 45, replace=False).tolist()) for _ in range(5)]
    assert volume(chosen(FrontSampler(known, METRICS), 45)) > max(chance)


def test_a_chain_is_taken_while_its_values_are_stored_one_by_one() -> None:
    """Another worker may look between the first parameter and the last."""
    sampler = FrontSampler(landscape(), METRICS)
    study = optuna.create_study(directions=["minimize"] * 3)
    values = sampler.chains.values(3)
    study.enqueue_trial(values)
    trial = study.ask()
    assert sampler.taken(study.get_trials()[0]) == 3
    name, axis = next(iter(sampler.chains.axes.items()))
    trial.suggest_categorical(name, axis)
    assert sampler.taken(study.get_trials()[0]) == 3
