"""Checkpoints: what is saved comes back, what is broken or foreign is refused in one line."""

import pickle
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from rts2.model.arch import Arch
from rts2.model.checkpoint import UNTRAINED, Network, build, cut, load, parameters, save
from rts2.model.errors import Rts2Error, UsageError

Lively = Callable[[Network], Network]

ANYNET = Arch(family="anynet", c=1, conv3d=(2, 1, 1))
FULL = Arch(c=1, d_max=4, conv3d=(2, 1, 1))
OFFICIAL = (
    ("features.stem.", "feature_extraction.block0.0."),
    ("features.down.0.", "feature_extraction.block0.1."),
    ("features.down.1.", "feature_extraction.blocks.0."),
    ("features.down.2.", "feature_extraction.blocks.1."),
    ("features.up.0.", "feature_extraction.upblocks.0.conv."),
    ("features.up.1.", "feature_extraction.upblocks.1.conv."),
    ("regularize.", "volume_postprocess."),
)


def pair() -> torch.Tensor:
    return torch.randn(2, 1, 3, 64, 96)


def released(network: Network, path: Path, zipped: bool = True) -> Path:
    """An AnyNet checkpoint as its authors write them: not zipped, which newer PyTorch would do."""
    weights = {}
    for name, value in network.state_dict().items():
        if not name.endswith("num_batches_tracked"):
            ours, theirs = next(both for both in OFFICIAL if name.startswith(both[0]))
            weights[f"module.{theirs}{name.removeprefix(ours)}"] = value
    spn = {"module.refine_spn.0.weight": torch.zeros(3)}
    content = {"epoch": 1, "state_dict": weights | spn, "optimizer": {}}
    torch.save(content, path, _use_new_zipfile_serialization=zipped)
    return path


@pytest.mark.parametrize(
    "arch", [FULL, Arch(c=1, stages=1, semantic=False), ANYNET], ids=Arch.label
)
def test_what_is_saved_comes_back(lively: Lively, arch: Arch, tmp_path: Path) -> None:
    network = lively(build(arch))
    save(network, tmp_path / "a.safetensors", "trained on streets")
    back, header = load(tmp_path / "a.safetensors")
    assert (header.arch, header.origin, header.trained) == (arch, "trained on streets", True)
    assert not back.training
    images = pair()
    with torch.inference_mode():
        for a, b in zip(network(*images), back(*images), strict=True):
            assert torch.equal(a.best, b.best)


def test_random_weights_say_so(tmp_path: Path) -> None:
    save(build(FULL), tmp_path / "a.safetensors", UNTRAINED)
    assert not load(tmp_path / "a.safetensors")[1].trained


@pytest.mark.parametrize("zipped", [True, False])
def test_a_released_anynet_is_imported(lively: Lively, tmp_path: Path, zipped: bool) -> None:
    network = lively(build(ANYNET))
    back, header = load(released(network, tmp_path / "best.tar", zipped))
    assert (header.arch, header.origin) == (ANYNET, "imported from best.tar")
    images = pair()
    with torch.inference_mode():
        assert torch.equal(network(*images)[-1].best, back(*images)[-1].best)


@pytest.mark.parametrize("mark", [b"PK", b"\x80\x02"])
def test_a_header_may_be_as_long_as_another_formats_mark(tmp_path: Path, mark: bytes) -> None:
    """Safetensors begin with the length of their header: 19280 reads as PK, 640 as a pickle."""
    path = tmp_path / "a.safetensors"
    network = build(Arch(c=1, stages=1, semantic=False, d_max=2, conv3d=(1,)))
    wanted = int.from_bytes(mark, "little")
    save(network, path, "")
    short = int.from_bytes(path.read_bytes()[:8], "little")
    save(network, path, "x" * ((wanted - short) % 65536))
    assert path.read_bytes()[:2] == mark
    assert load(path)[1].arch == network.arch


@pytest.mark.parametrize("name", ["kitti2015", "sceneflow"])
def test_the_real_ones_are_imported(real_data: Path, name: str) -> None:
    network, header = load(real_data / "anynet_official" / f"{name}.tar")
    assert header.arch == Arch(family="anynet", c=1)
    assert parameters(network) == 34_629


def test_a_cut_is_the_whole_stopped_early(lively: Lively) -> None:
    whole = lively(build(Arch(c=2)))
    images = pair()
    with torch.inference_mode():
        for stages in (1, 2):
            part = cut(whole, Arch(c=2, stages=stages))
            for a, b in zip(part(*images), whole(*images, stages), strict=True):
                assert torch.equal(a.best, b.best)


def test_a_cut_without_branches_keeps_the_coarse_disparity(lively: Lively) -> None:
    whole = lively(build(Arch(c=2)))
    images = pair()
    with torch.inference_mode():
        bare = cut(whole, Arch(c=2, semantic=False))(*images)
        for a, b in zip(bare, whole(*images), strict=True):
            assert a.refined is None
            assert torch.equal(a.disparity, b.disparity)


def test_a_cut_that_needs_more_names_it_all() -> None:
    with pytest.raises(UsageError, match=r"does not hold that arch: c is 1, 2 was .*; d_max is 4"):
        cut(build(FULL), Arch(c=2))


class Bomb:
    """A pickle that runs code where it is loaded."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple[Callable[..., object], tuple[object, ...]]:
        return (Path.touch, (self.target,))


@pytest.mark.parametrize("writer", ["zip", "legacy", "plain"])
def test_a_pickle_that_would_run_code_is_refused_unrun(tmp_path: Path, writer: str) -> None:
    path, trace = tmp_path / "evil.tar", tmp_path / "it ran"
    if writer == "plain":
        path.write_bytes(pickle.dumps(Bomb(trace)))
    else:
        content = {"state_dict": {"a": Bomb(trace)}}
        torch.save(content, path, _use_new_zipfile_serialization=writer == "zip")
    refused(path, "could run code" if writer != "plain" else "evil.tar")
    assert not trace.exists()


def refused(path: Path, said: str) -> None:
    with pytest.raises(Rts2Error) as raised:
        load(path)
    assert raised.value.exit_code == 1
    assert said in str(raised.value)
    assert str(path) in str(raised.value)


@pytest.mark.parametrize("kind", ["own", "zipped", "legacy"])
def test_truncated_files_are_refused(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "cut.tar"
    if kind == "own":
        save(build(FULL), path, UNTRAINED)
    else:
        released(build(ANYNET), path, kind == "zipped")
    whole = path.read_bytes()
    lengths = [*range(0, len(whole), len(whole) // 40), *range(2, 16), len(whole) - 8]
    for length in lengths:
        path.write_bytes(whole[:length])
        refused(path, "")


def edited(path: Path, edit: Callable[[dict[str, torch.Tensor]], None]) -> Path:
    """A checkpoint of ours whose weights were changed behind its header."""
    save(build(FULL), path, UNTRAINED)
    weights = load_file(path)
    edit(weights)
    header = f'{{"arch": {FULL.model_dump_json()}, "origin": "edited"}}'
    save_file(weights, path, {"rts2": header})
    return path


STEM = "encoder.stem.0.0.weight"


def test_a_wrong_shape_is_named(tmp_path: Path) -> None:
    path = edited(tmp_path / "a.safetensors", lambda w: w.update({STEM: torch.zeros(2, 3, 3, 3)}))
    refused(path, f"{STEM} must have shape [1, 3, 3, 3], it is of shape [2, 3, 3, 3]")


def test_a_missing_weight_is_named(tmp_path: Path) -> None:
    path = edited(tmp_path / "a.safetensors", lambda w: w.pop(STEM))
    refused(path, f"{STEM} must have shape [1, 3, 3, 3], it is missing")


def test_a_weight_too_many_is_named(tmp_path: Path) -> None:
    path = edited(tmp_path / "a.safetensors", lambda w: w.update({"zoo": torch.zeros(1)}))
    refused(path, "does not have, first zoo")


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_not_finite_are_refused(tmp_path: Path, value: float) -> None:
    path = edited(tmp_path / "a.safetensors", lambda w: w[STEM].fill_(value))
    refused(path, f"{STEM} holds values that are not finite")


def test_foreign_safetensors_are_refused(tmp_path: Path) -> None:
    save_file({"a": torch.zeros(1)}, tmp_path / "a.safetensors")
    refused(tmp_path / "a.safetensors", "holds no arch")


def test_a_header_that_is_wrong_is_refused(tmp_path: Path) -> None:
    save_file({"a": torch.zeros(1)}, tmp_path / "a.safetensors", {"rts2": '{"arch": {"c": 0}}'})
    refused(tmp_path / "a.safetensors", "arch.c: Input should be greater than or equal to 1")


def test_a_foreign_checkpoint_is_refused(tmp_path: Path) -> None:
    torch.save({"state_dict": {"module.conv.weight": torch.zeros(1)}}, tmp_path / "a.tar")
    refused(tmp_path / "a.tar", "does not hold the layers of AnyNet")


@pytest.mark.parametrize("content", [{"model": 1}, [1, 2], {"state_dict": 3}])
def test_plain_data_that_is_no_checkpoint_is_refused(tmp_path: Path, content: object) -> None:
    torch.save(content, tmp_path / "a.tar")
    refused(tmp_path / "a.tar", "not a released AnyNet checkpoint")


def test_a_folder_or_nothing_is_wrong_use(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="it is a folder"):
        load(tmp_path)
    with pytest.raises(UsageError, match="there is no such file"):
        load(tmp_path / "nothing")


def test_a_failed_save_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    save(build(FULL), path, UNTRAINED)
    before = path.read_bytes()
    network = build(FULL)
    network.register_buffer("shared", network.get_parameter(STEM).data)  # two names, one memory
    with pytest.raises(RuntimeError, match="share memory"):
        save(network, path, UNTRAINED)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
