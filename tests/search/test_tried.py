"""Points tried on the machine at hand: timed, and judged where integers change what they say."""

import pytest
import torch

from rts2.model.arch import Arch
from rts2.model.checkpoint import build, save
from rts2.model.data.catalog import open_dataset
from rts2.profiles.profile import Profile
from rts2.search.exhaustive import Question
from rts2.search.inherited import Data, Inherited
from rts2.search.result import Point, PointEvidence
from rts2.search.tried import Trials, alike

SIZE = (96, 64)
ARCH = Arch(c=2, d_max=6, stages=2, conv3d=(4, 2))


@pytest.fixture(scope="module")
def judge(tmp_path_factory: pytest.TempPathFactory) -> Inherited:
    torch.manual_seed(3)
    folder = tmp_path_factory.mktemp("supernet")
    path = folder / "supernet.safetensors"
    save(build(Arch(c=2, d_max=6, conv3d=(4, 2, 2))), path, "a test", supernet=True)
    training = open_dataset("streets", split="train", count=4, size=SIZE)
    judging = [
        *open_dataset("streets", split="val", count=2, size=SIZE),
        *open_dataset("streets", split="val", count=1, size=(128, 64)),
    ]
    return Inherited(path, Data(training, judging), folder / "judged")


def point(precision: str, runtime: str = "onnxruntime") -> Point:
    return Point.model_validate(
        {
            "arch": ARCH,
            "precision": precision,
            "runtime": runtime,
            **dict.fromkeys(("latency_ms", "fps", "fps_low", "fps_high"), 1.0),
            **dict.fromkeys(("d1_all", "epe", "miou", "pacc"), None),
            **dict.fromkeys(("params", "size_bytes", "macs"), 1),
            "evidence": PointEvidence(latency="interpolated", accuracy="measured"),
        }
    )


def test_fp32_is_timed_and_integers_are_judged_too(judge: Inherited, by_parts: Profile) -> None:
    """On images of two sizes; integers change what the network says, and not by much."""
    trials = Trials(Question(by_parts, 1.0, resolution=SIZE), judge)
    plain, lowered = trials(point("fp32")), trials(point("int8"))
    assert plain is not None
    assert plain.score is None
    assert plain.timing.ratio > 0
    assert lowered is not None
    assert lowered.score is not None
    (row,) = (row for row in judge.rows(ARCH) if row.arch == ARCH)
    assert lowered.score.everything.pixels > 0
    assert lowered.score.epe is not None
    assert lowered.score.epe != row.epe
    assert lowered.score.epe == pytest.approx(row.epe, rel=0.2)
    assert lowered.score.miou is not None


def test_what_cannot_run_here_is_not_tried(judge: Inherited, by_parts: Profile) -> None:
    trials = Trials(Question(by_parts, 1.0, resolution=SIZE), judge)
    assert trials(point("fp32", "tensorrt")) is None
    assert trials(point("fp16")) is None


def test_pairs_of_the_size_that_most_have() -> None:
    few = open_dataset("streets", split="train", count=1, size=(128, 64))
    many = open_dataset("streets", split="train", count=2, size=SIZE)
    assert [sample.size for sample in alike([*few, *many])] == [SIZE, SIZE]
