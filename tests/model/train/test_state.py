"""The training state: what is saved continues, bit by bit; what is broken is refused."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from rts2.model.arch import Arch
from rts2.model.checkpoint import build, save
from rts2.model.errors import Rts2Error
from rts2.model.train.recipe import recipe_from
from rts2.model.train.state import Standing, read_standing, restore, save_state
from rts2.model.train.trainer import lay_out

RECIPE = recipe_from({"dataset": "folder", "steps": 9, "arch": {"c": 1}})


def standing(updates: int) -> Standing:
    return Standing(
        recipe=RECIPE,
        step=4,
        updates=updates,
        samples=7,
        digest="0" * 64,
        class_shares=[0.1, 1 / 3],
        scaler={"scale": 65536.0},
        seconds=1.5,
    )


def learner() -> tuple[torch.nn.Module, torch.optim.Adam]:
    network = build(RECIPE.arch).train()
    lay_out(network)
    return network, torch.optim.Adam(network.parameters())


def step(network: torch.nn.Module, optimizer: torch.optim.Adam, times: int) -> torch.Tensor:
    images = torch.rand(2, 2, 3, 64, 64)
    for _ in range(times):
        optimizer.zero_grad()
        network(*images)[-1].best.sum().backward()
        optimizer.step()
    return torch.cat([p.detach().flatten() for p in network.parameters()])


def test_a_restored_run_takes_the_same_steps(tmp_path: Path) -> None:
    network, optimizer = learner()
    step(network, optimizer, 2)
    save_state(tmp_path / "s", standing(2), network, optimizer)
    wanted = step(network, optimizer, 3)
    torch.manual_seed(1)
    other, fresh = learner()
    restore(tmp_path / "s", 2, other, fresh)
    assert torch.equal(step(other, fresh, 3), wanted)  # its random images included
    for mine, its in zip(other.buffers(), network.buffers(), strict=True):
        assert torch.equal(mine, its)
    for parameter in other.parameters():
        moment = fresh.state[parameter]["exp_avg"]
        assert moment.stride() == parameter.stride()


def test_the_header_comes_back(tmp_path: Path) -> None:
    network, optimizer = learner()
    save_state(tmp_path / "s", standing(0), network, optimizer)
    assert read_standing(tmp_path / "s") == standing(0)


def test_loss_scaling_goes_on(tmp_path: Path) -> None:
    """Its counts are whole numbers, as torch's update takes nothing else."""
    network, optimizer = learner()
    scaler = torch.amp.GradScaler("cpu", init_scale=1024.0, growth_interval=2)

    def update(one: torch.amp.GradScaler) -> float:
        weight = torch.nn.Parameter(torch.ones(1))
        moved = torch.optim.SGD([weight])
        one.scale(weight.sum()).backward()
        one.step(moved)
        one.update()
        return one.get_scale()

    assert update(scaler) == 1024
    told = standing(1).model_copy(update={"scaler": scaler.state_dict()})
    save_state(tmp_path / "s", told, network, optimizer)
    found = read_standing(tmp_path / "s").scaler
    assert found == scaler.state_dict()
    assert [type(value) for value in found.values()] == [float, float, float, int, int]
    again = torch.amp.GradScaler("cpu")
    again.load_state_dict(found)
    assert update(again) == 2048  # the second step in a row that was finite


def test_broken_and_foreign_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "s"
    network, optimizer = learner()
    step(network, optimizer, 1)
    save_state(path, standing(1), network, optimizer)
    whole = path.read_bytes()
    for length in (0, 5, 3000, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(Rts2Error, match="truncated or no safetensors file"):
            read_standing(path)
    save(build(RECIPE.arch), path, "a test")
    with pytest.raises(Rts2Error, match="holds no training state"):
        read_standing(path)
    save_file({"x": torch.zeros(1)}, path, {"rts2-train": "{}"})
    with pytest.raises(Rts2Error, match=r"the header of .*Field required"):
        read_standing(path)


def test_a_state_of_other_weights_does_not_fit(tmp_path: Path) -> None:
    network, optimizer = learner()
    save_state(tmp_path / "s", standing(0), network, optimizer)
    other = build(Arch(c=2))
    with pytest.raises(Rts2Error, match="does not fit its recipe"):
        restore(tmp_path / "s", 0, other, torch.optim.Adam(other.parameters()))
