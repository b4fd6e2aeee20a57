"""States of trainings come back from disk as they were, and damaged files are refused by name."""

from pathlib import Path

import pytest
import torch
from torch import nn

from halgan_rl.experiment.state_file import load_state, save_state


def test_an_optimizers_state_goes_to_disk_and_back_exactly(tmp_path: Path) -> None:
    def step(network: nn.Module, optimizer: torch.optim.Optimizer) -> None:
        optimizer.zero_grad()
        network(torch.ones(4, 3)).square().sum().backward()
        optimizer.step()

    torch.manual_seed(0)
    networks = [nn.Linear(3, 2) for _ in range(2)]
    optimizers = [torch.optim.Adam(network.parameters(), lr=0.1) for network in networks]
    step(networks[0], optimizers[0])
    state = {"network": networks[0].state_dict(), "optimizer": optimizers[0].state_dict(), "steps": 3, "none": None}
    save_state(tmp_path / "state.safetensors", state)
    step(networks[0], optimizers[0])
    loaded = load_state(tmp_path / "state.safetensors")
    assert (loaded["steps"], loaded["none"]) == (3, None)
    networks[1].load_state_dict(loaded["network"])
    optimizers[1].load_state_dict(loaded["optimizer"])
    step(networks[1], optimizers[1])
    assert torch.equal(networks[0].weight, networks[1].weight)
    assert [path.name for path in tmp_path.iterdir()] == ["state.safetensors"]


def test_what_a_file_does_not_hold_is_named(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=r"state\.there\.1 is a set"):
        save_state(tmp_path / "state.safetensors", {"there": [1, {2}]})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("damage", ["cut", "noise", "foreign"])
def test_a_damaged_file_is_refused(damage: str, tmp_path: Path) -> None:
    path = tmp_path / "state.safetensors"
    save_state(path, {"numbers": torch.arange(100)})
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:-20])
    elif damage == "noise":
        path.write_bytes(b"\xff" * 100)
    else:
        from safetensors.torch import save_file

        save_file({"numbers": torch.arange(3)}, path)
    with pytest.raises(ValueError, match=r"state\.safetensors is damaged, or no state"):
        load_state(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"state\.safetensors: there is nothing to go on from"):
        load_state(tmp_path / "state.safetensors")
