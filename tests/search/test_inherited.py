"""Accuracies inherited from a supernet: one run judges all that a network holds, once."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from rts2.model.arch import Arch
from rts2.model.checkpoint import build, load, save
from rts2.model.data.scene import Foreground, Scene
from rts2.model.errors import Rts2Error, UsageError
from rts2.model.evaluation import evaluate, overall
from rts2.model.predictor import TorchPredictor
from rts2.search.inherited import Data, Inherited

WHOLE = Arch(c=3, d_max=6, conv3d=(4, 4, 4))
PART = Arch(c=2, d_max=5, conv3d=(3, 2, 4))


@dataclass(frozen=True)
class Textured:
    """A made-up pair, the same each time it is read."""

    seed: int
    size: tuple[int, int] = (96, 64)
    foreground: Foreground | None = None

    @property
    def name(self) -> str:
        return f"textured {self.seed}"

    def read(self) -> Scene:
        rng = np.random.default_rng(self.seed)
        width, height = self.size
        left, right = rng.integers(0, 256, (2, height, width, 3), np.uint8)
        truth = rng.uniform(1, 60, (height, width)).astype(np.float32)
        labels = rng.integers(0, 19, (height, width)).astype(np.uint8)
        return Scene(self.name, left, right, truth, semantic=labels)


def data(judging: Sequence[int] = range(3)) -> Data:
    training = [Textured(seed, (96 + seed % 2, 64)) for seed in range(100, 105)]
    return Data.of(training, [Textured(seed) for seed in judging])


@pytest.fixture(scope="module")
def supernet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(1)
    path = tmp_path_factory.mktemp("supernet") / "supernet.safetensors"
    save(build(WHOLE), path, "a test", supernet=True)
    return path


def test_a_network_is_judged_with_all_that_it_holds(supernet: Path, tmp_path: Path) -> None:
    """As rts2-eval judges each of them, cut out and run alone."""
    judge = Inherited(supernet, data(), tmp_path)
    rows = judge.rows(PART)
    assert len(rows) == 9
    assert rows[-1].arch == PART
    assert judge.evaluations == 1
    whole = judge.network(PART)
    for row in rows:
        alone = build(row.arch)
        alone.load_state_dict({n: whole.state_dict()[n] for n in alone.state_dict()})
        samples = [Textured(seed) for seed in range(3)]
        judged = list(evaluate(TorchPredictor(alone), samples))
        (_, found) = list(overall([each.scores for each in judged]).items())[-1]
        assert row.d1_all == pytest.approx(found.d1_all)
        assert row.epe == pytest.approx(found.epe)
        assert row.miou == (pytest.approx(found.miou) if row.arch.semantic else None)


def test_what_is_known_is_not_judged_again(supernet: Path, tmp_path: Path) -> None:
    first = Inherited(supernet, data(), tmp_path)
    rows = first.rows(PART)
    held = PART.up_to(2).model_copy(update={"refinement": False})
    assert first.rows(held)[-1] in rows
    second = Inherited(supernet, data(), tmp_path)
    assert second.rows(PART) == rows
    assert (first.evaluations, first.hits) == (1, 1)
    assert (second.evaluations, second.hits) == (0, 1)


def test_other_images_or_weights_are_judged_anew(supernet: Path, tmp_path: Path) -> None:
    Inherited(supernet, data(), tmp_path).rows(PART)
    other = Inherited(supernet, data(judging=(7,)), tmp_path)
    other.rows(PART)
    network, header = load(supernet)
    network.encoder.stem[0][0].weight.data += 1
    save(network, tmp_path / "other.safetensors", header.origin, supernet=True)
    third = Inherited(tmp_path / "other.safetensors", data(), tmp_path)
    third.rows(PART)
    assert (other.evaluations, third.evaluations) == (1, 1)


def test_a_broken_entry_is_named(supernet: Path, tmp_path: Path) -> None:
    Inherited(supernet, data(), tmp_path).rows(PART)
    (path,) = tmp_path.rglob("*.json")
    told = json.loads(path.read_text())
    path.write_text(json.dumps(told | {"digest": "0"}))
    with pytest.raises(Rts2Error, match="is of another network or other images; delete it"):
        Inherited(supernet, data(), tmp_path).rows(PART)


def test_what_is_no_supernet_or_no_truth_is_refused(supernet: Path, tmp_path: Path) -> None:
    save(build(WHOLE), tmp_path / "one.safetensors", "a test")
    with pytest.raises(UsageError, match="holds one network, not a supernet"):
        Inherited(tmp_path / "one.safetensors", data(), tmp_path)
    with pytest.raises(Rts2Error, match="need a known disparity"):
        Inherited(supernet, data(judging=()), tmp_path)
    with pytest.raises(UsageError, match="c is at most 3, 4 was asked for"):
        Inherited(supernet, data(), tmp_path).rows(Arch(c=4, d_max=5, conv3d=(3, 2, 4)))
