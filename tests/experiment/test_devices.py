"""A run learns on the device that it is told, or is refused before any work is done."""

import copy
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from halgan_rl.agents import ddpg
from halgan_rl.experiment.presets import changed
from halgan_rl.experiment.run import check_device
from recipes.ddpg_navigate import DEFAULT, main
from tests.recipes import TINY, without_pictures


def test_acting_on_a_copy_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = changed(DEFAULT, {**TINY, "method": "none", "agent.epsilon.start": 0.3})  # so that the copy matters
    policies = []
    for name in ("itself", "copy"):
        if name == "copy":
            monkeypatch.setattr(ddpg, "on_cpu", copy.deepcopy)
        with without_pictures():
            main(changed(config, {"out": tmp_path / name}))
        policies.append(load_file(tmp_path / name / "policy.safetensors"))
    assert all(torch.equal(value, policies[1][name]) for name, value in policies[0].items())


@pytest.mark.parametrize("device", ["moon", "cuda:99", "meta", "privateuseone"])
def test_a_device_that_is_not_there_is_refused(device: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"device='{device}' cannot be used here.*choose 'cpu'"):
        main(changed(DEFAULT, {"device": device, "out": tmp_path / "run"}))
    assert not (tmp_path / "run").exists()
    check_device("cpu")
