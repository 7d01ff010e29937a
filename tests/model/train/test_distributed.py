"""Several processes as one: the environment's word, the shares, the norm over all of them."""

import os
import sys
from collections.abc import Iterator
from multiprocessing import get_context
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
from torch import nn

from rts2.model.arch import Arch
from rts2.model.checkpoint import build
from rts2.model.errors import Rts2Error, UsageError
from rts2.model.train import distributed
from rts2.model.train.distributed import (
    Everywhere,
    GlobalNorm,
    Lost,
    World,
    join,
    require_divides,
    share_norms,
    world_of_environment,
)


def test_without_torchrun_there_is_one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE"):
        monkeypatch.delenv(name, raising=False)
    assert world_of_environment() == World(0, 1, 0, 1)
    assert world_of_environment().first
    assert World().total([3, 4]) == [3, 4]
    assert World().gathered("a") == ["a"]


def test_torchrun_says_who_one_is(monkeypatch: pytest.MonkeyPatch) -> None:
    told = {"RANK": "5", "WORLD_SIZE": "8", "LOCAL_RANK": "1", "LOCAL_WORLD_SIZE": "4"}
    for name, value in told.items():
        monkeypatch.setenv(name, value)
    assert world_of_environment() == World(5, 8, 1, 4)
    assert not world_of_environment().first
    monkeypatch.setenv("WORLD_SIZE", "5")
    with pytest.raises(UsageError, match="it is 5 of 5"):
        world_of_environment()
    monkeypatch.setenv("WORLD_SIZE", "two")
    with pytest.raises(UsageError, match="must be whole numbers, not 5, two"):
        world_of_environment()


def test_a_batch_must_divide_among_the_processes() -> None:
    require_divides(World(0, 3), 6, 2)
    with pytest.raises(Everywhere, match=r"6 samples among 4; start one of 1, 2, 3, 6 ") as caught:
        require_divides(World(0, 4), 6, 1)
    assert caught.value.exit_code == UsageError.exit_code
    with pytest.raises(Everywhere, match=r"3 samples \(a batch of 6 in 2 micro-batches\) among 2"):
        require_divides(World(0, 2), 6, 2)


def in_two(rank: int, folder: str) -> None:
    """Process `rank` of two; it writes down what `together` came to."""
    store = dist.FileStore(f"{folder}/meet", 2)
    dist.init_process_group("gloo", store=store, rank=rank, world_size=2)
    world = World(rank, 2)

    def work(*failing: int) -> int:
        if rank in failing:
            raise UsageError("it is wrong")
        return rank + 10

    def told(*failing: int) -> str:
        try:
            return str(world.together(lambda: work(*failing)))
        except Everywhere as error:
            return f"{error} ({error.exit_code})"

    found = [told(), told(1), told(0), told(0, 1)]
    if rank == 1:  # leaves without a word, as a process that was killed
        Path(folder, f"{rank}").write_text("\n".join(found))
        os._exit(0)
    try:
        world.gathered(1)
    except Lost as error:
        found.append(str(error))
    Path(folder, f"{rank}").write_text("\n".join(found))


@pytest.mark.skipif(sys.platform == "win32", reason="Gloo meets through a file")
def test_what_fails_in_one_process_ends_all_and_names_it(tmp_path: Path) -> None:
    context = get_context("spawn")
    both = [context.Process(target=in_two, args=(rank, str(tmp_path))) for rank in range(2)]
    for process in both:
        process.start()
    for process in both:
        process.join(60)
    found = [Path(tmp_path, str(rank)).read_text().split("\n") for rank in range(2)]
    shared = ["process 1: it is wrong (2)", "process 0: it is wrong (2)", "it is wrong (2)"]
    assert found[1] == ["11", *shared]
    assert found[0][:4] == ["10", *shared]
    assert found[0][4].startswith("process 0 lost the others (")
    assert len(found[0]) == 5


def test_alone_an_error_stays_what_it_is() -> None:
    def fails() -> None:
        raise UsageError("it is wrong")

    assert World().together(lambda: 3) == 3
    with pytest.raises(UsageError, match=r"^it is wrong$"):
        World().together(fails)
    error = Rts2Error("it is broken")
    assert World().everywhere(error) is error
    assert isinstance(World(1, 2).everywhere(error), Everywhere)


PLACES = {
    "nothing said": ({}, r"MASTER_ADDR expected, but not set"),
    "a port of letters": ({"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "x"}, r"'x'"),
    "nobody there": ({"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "1"}, r"127\.0\.0\.1"),
}


@pytest.mark.parametrize("place", PLACES)
def test_processes_that_cannot_meet_are_told_of_torchrun(
    place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    told, text = PLACES[place]
    for name in ("MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    for name, value in told.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(distributed, "MEETING_SECONDS", 1)
    with pytest.raises(UsageError, match=rf"cannot meet: .*{text}.*torchrun") as caught:
        join(World(1, 2, 1, 2), torch.device("cpu"))
    assert "\n" not in str(caught.value)


@pytest.fixture
def alone(tmp_path: Path) -> Iterator[None]:
    """A group of one process, which needs no network."""
    dist.init_process_group("gloo", init_method=f"file://{tmp_path}/meet", rank=0, world_size=1)
    yield
    dist.destroy_process_group()


NORMS = {
    "2d": (lambda: nn.BatchNorm2d(3), (4, 3, 5, 6)),
    "3d": (lambda: nn.BatchNorm3d(3), (2, 3, 4, 5, 6)),
    "one value": (lambda: nn.BatchNorm2d(3, momentum=0.3), (2, 3, 1, 1)),
}


@pytest.mark.skipif(sys.platform == "win32", reason="Gloo meets through a file")
@pytest.mark.parametrize("kind", NORMS)
def test_the_norm_of_one_process_is_torch_s(kind: str, alone: None) -> None:
    make, shape = NORMS[kind]
    norm, twin = make(), make()
    with torch.no_grad():
        norm.weight.copy_(torch.rand(3))
        norm.bias.copy_(torch.rand(3))
        twin.load_state_dict(norm.state_dict())
    shared = GlobalNorm.around(twin)
    assert shared.state_dict().keys() == norm.state_dict().keys()
    for _ in range(3):
        values = (3 + 2 * torch.randn(shape)).requires_grad_()
        weights = torch.randn(shape)
        outcomes = []
        for layer in (norm, shared):
            values.grad = None
            layer.zero_grad()
            output = layer(values)
            (output * weights).sum().backward()
            assert values.grad is not None
            outcomes.append((output, values.grad.clone(), layer.weight.grad, layer.bias.grad))
        for wanted, found in zip(*outcomes, strict=True):
            torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-5)
    for name, value in norm.state_dict().items():
        torch.testing.assert_close(shared.state_dict()[name], value)
    values = torch.randn(shape)
    torch.testing.assert_close(shared.eval()(values), norm.eval()(values))


def test_shared_norms_keep_the_weights_and_their_names() -> None:
    network = build(Arch(c=1))
    before = dict(network.state_dict())
    norms = sum(isinstance(m, nn.BatchNorm2d | nn.BatchNorm3d) for m in network.modules())
    share_norms(network)
    assert sum(isinstance(m, GlobalNorm) for m in network.modules()) == norms
    assert not any(isinstance(m, nn.BatchNorm2d | nn.BatchNorm3d) for m in network.modules())
    after = network.state_dict()
    assert list(after) == list(before)
    assert all(after[name].data_ptr() == before[name].data_ptr() for name in before)
