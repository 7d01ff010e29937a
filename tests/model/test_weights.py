"""The networks in the box are whole, are what their records say, and see what they promise."""

import json
from pathlib import Path
from typing import Any

import pytest

from rts2.model.arch import Arch
from rts2.model.box import SHIPPED, named_model, names
from rts2.model.checkpoint import load
from rts2.model.data.catalog import open_dataset
from rts2.model.evaluation import evaluate, overall
from rts2.model.files import sha256
from rts2.model.predictor import open_model


def record(name: str) -> dict[str, Any]:
    return dict(json.loads(named_model(name).with_suffix(".json").read_text()))


def judged(name: str, dataset: str) -> dict[str, Any]:
    """What the record says of the last stage on a data set."""
    found = next(each for each in record(name)["judged"] if each["dataset"] == dataset)
    return dict(found["stages"][-1])


def test_the_box_holds_what_it_lists() -> None:
    assert names() == SHIPPED


@pytest.mark.parametrize("name", SHIPPED)
def test_weights_are_those_of_their_record(name: str) -> None:
    told = record(name)
    network, header = load(named_model(name))
    assert told["sha256"] == sha256(named_model(name))
    assert header.arch == network.arch == Arch(c=int(name[1:]))
    assert header.trained
    recipe = told["training"]["recipe"]
    assert recipe["arch"] == header.arch.model_dump(mode="json")
    assert recipe["dataset"] == "streets"
    assert recipe["init"] is None
    assert f"seed {recipe['seed']}" in header.origin
    assert told["training"]["steps"] == told["training"]["steps_planned"]


def test_wider_networks_err_less() -> None:
    errors = [judged(name, "streets")["d1_all"] for name in SHIPPED]
    assert errors == sorted(errors, reverse=True)


def test_c8_sees_streets_it_was_never_shown() -> None:
    samples = open_dataset("streets", split="val", count=4, size=(512, 256))
    scores = [each.scores for each in evaluate(open_model(named_model("c8")), samples)]
    total = overall(scores)[3]
    assert total.d1_all is not None
    assert total.d1_all < 2 * judged("c8", "streets")["d1_all"]
    assert total.pacc is not None
    assert total.pacc > 80


@pytest.mark.parametrize("name", SHIPPED)
def test_real_frames_score_what_the_record_says(name: str, real_data: Path) -> None:
    samples = open_dataset("kitti2015", real_data / "kitti2015")
    scores = [each.scores for each in evaluate(open_model(named_model(name)), samples)]
    told = judged(name, "kitti2015")
    total = overall(scores)[3]
    assert total.d1_all == pytest.approx(told["d1_all"], abs=0.1)
    assert total.epe == pytest.approx(told["epe"], abs=0.02)
    assert total.miou == pytest.approx(told["miou"], abs=0.5)
