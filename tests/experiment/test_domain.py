"""A domain that does not describe its environment is refused before anything is collected."""

import dataclasses
from pathlib import Path

import pytest
from torchrl.data import Bounded
from torchrl.envs import EnvBase

import halgan_envs
from halgan_rl.experiment import run
from halgan_rl.experiment.config import RunConfig
from halgan_rl.experiment.domain import Domain
from halgan_rl.experiment.methods import make_hindsight
from halgan_rl.experiment.presets import changed
from halgan_rl.experiment.run import Run, make_agent, make_buffer
from halgan_rl.keys import Keys
from halgan_rl.poses import PlanarPoses
from tests.recipes import TINY
from tests.room import room_domain

WRONG = {
    "size": ({"image_shape": (84, 84, 3)}, r"pixels of the environment is \(64, 64, 3\).*'room' says \(84, 84, 3\)"),
    "channels first": ({"image_shape": (3, 64, 64)}, r"says \(3, 64, 64\).*height, width, channels"),
    "pose": ({"poses": PlanarPoses(flags=("held",))}, r"pose of the environment is \(3,\).*says \(4,\)"),
    "action": ({"action_spec": Bounded(-1.0, 1.0, (3,))}, r"action of the environment is \(2,\).*says \(3,\)"),
    "key": ({"keys": Keys(pixels="rgb")}, r"no rgb, set by keys=Keys\(pixels='rgb'\); it has action, pixels, pose"),
}


def wrong_domain(changes: dict) -> Domain:
    return dataclasses.replace(room_domain(), **changes)


@pytest.mark.parametrize(("changes", "message"), WRONG.values(), ids=WRONG)
def test_what_differs_is_named(changes: dict, message: str) -> None:
    domain = wrong_domain(changes)
    with pytest.raises(ValueError, match=message):
        domain.check(domain.make(seed=0))


def test_a_run_refuses_it_before_the_folder_is_made(tmp_path: Path) -> None:
    config = changed(RunConfig(method="none", out=tmp_path / "run"), TINY)
    domain = wrong_domain({"image_shape": (84, 84, 3)})
    hindsight = make_hindsight(config, domain)
    buffer = make_buffer(config.training, hindsight, seed=0)
    with (
        pytest.raises(ValueError, match="correct the domain"),
        Run(config, domain, make_agent(config, domain), buffer, hindsight),
    ):
        pass
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", halgan_envs.NAMES)
def test_ours_describe_their_environments(name: str) -> None:
    domain = halgan_envs.domain(name)
    env = domain.make(seed=0)
    domain.check(env)
    env.close()


def test_an_image_that_is_no_stack_of_frames_is_refused() -> None:
    with pytest.raises(ValueError, match="a multiple of frame_stack=4"):
        room_domain((64, 64, 3), frame_stack=4)


@pytest.mark.parametrize("fault", ["evaluation", "domain"])
def test_a_run_that_cannot_start_closes_its_environment(
    fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether its evaluation fails to start, or the environment is not what the domain says."""
    closed = []
    domain = room_domain()

    def make(seed: int | None) -> EnvBase:
        env = room_domain().make(seed=seed)
        monkeypatch.setattr(env, "close", lambda **_: closed.append(env))
        return env

    def fail(*_: object) -> None:
        raise OSError("no process left")

    config = changed(RunConfig(method="none", out=tmp_path / "run"), TINY)
    hindsight = make_hindsight(config, domain)
    buffer, agent = make_buffer(config.training, hindsight, seed=0), make_agent(config, domain)
    domain = dataclasses.replace(domain, make=make)
    if fault == "evaluation":
        monkeypatch.setattr(run, "make_evaluator", fail)
    else:
        domain = dataclasses.replace(domain, image_shape=(84, 84, 3))
    with pytest.raises((OSError, ValueError)), Run(config, domain, agent, buffer, hindsight):
        pass
    assert len(closed) == 1
