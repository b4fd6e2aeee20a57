import functools

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs import ParallelEnv
from torchrl.envs.utils import check_env_specs
from torchrl.modules import EGreedyModule, QValueActor

import halgan_envs


@pytest.fixture(scope="module")
def env():
    env = halgan_envs.make("navigate-2m", seed=0)
    yield env
    env.close()


@pytest.fixture(scope="module")
def pebble_env():
    env = halgan_envs.make("pebble", seed=0)
    yield env
    env.close()


def place(env, pose, box):
    env.reset()
    env.robot.set_pose(env.environment.physics, np.array(pose))
    env.environment.task.goals["box"].prop.set_position(env.environment.physics, np.array(box))
    env.environment.physics.forward()


def act(*action):
    return TensorDict({"action": torch.tensor(action, dtype=torch.float32)}, [])


@pytest.mark.parametrize("name", sorted(halgan_envs.NAMES))
def test_every_named_environment_passes_torchrl_s_check(name):
    env = halgan_envs.make(name, seed=0)
    check_env_specs(env)
    env.close()


def test_success_is_terminated_not_truncated(env):
    place(env, (0.0, 0.1, 0.0), box=(0.14, 0.1))
    out = env.step(act(-1.0, 0.0))["next"]
    assert out["reward"].item() == 1.0
    assert (out["done"].item(), out["terminated"].item(), out["truncated"].item()) == (True, True, False)


def test_the_time_limit_is_truncated_not_terminated():
    env = halgan_envs.make("navigate-2m", seed=0, time_limit=0.5)
    out = env.rollout(20)["next"]
    env.close()
    assert len(out) == 5
    assert out["truncated"].squeeze().tolist() == [False] * 4 + [True]
    assert out["done"].squeeze().tolist() == [False] * 4 + [True]
    assert not out["terminated"].any()


def test_set_seed_repeats_everything(env):
    def rollout(seed):
        env.set_seed(seed)
        torch.manual_seed(0)
        return env.rollout(8)

    first, again, other = rollout(5), rollout(5), rollout(6)
    assert (first == again).all()
    assert (first["pose"] != other["pose"]).any()


def test_seeding_at_construction_and_later_is_the_same(env):
    fresh = halgan_envs.make("navigate-2m", seed=11)
    env.set_seed(11)
    assert torch.equal(fresh.reset()["pose"], env.reset()["pose"])
    fresh.close()


def test_observations_share_no_memory(env):
    first = env.reset()
    second = env.step(act(1.0, 0.5))["next"]
    third = env.step(act(1.0, 0.5))["next"]
    for key in ("pixels", "pose"):
        addresses = {td[key].untyped_storage().data_ptr() for td in (first, second, third)}
        assert len(addresses) == 3


def test_an_image_keeps_its_content_while_the_env_goes_on(env):
    image = env.reset()["pixels"]
    copy = image.clone()
    env.rollout(5)
    assert torch.equal(image, copy)


@pytest.mark.parametrize("action", [(float("nan"), 0.0), (0.0, 1.5), (-float("inf"), 0.0)])
def test_bad_actions_are_refused(env, action):
    env.reset()
    with pytest.raises(ValueError, match=r"must lie in \[-1, 1\]; got"):
        env.step(act(*action))


@pytest.mark.parametrize("action", [(1, 1, 0, 0), (0, 0, 0, 0), (0, 2, 0, 0), (0, 2, -1, 0)])
def test_discrete_actions_that_are_not_one_hot_are_refused(pebble_env, action):
    pebble_env.reset()
    with pytest.raises(ValueError, match=r"one-hot.*got"):
        pebble_env.step(TensorDict({"action": torch.tensor(action)}, []))


@pytest.mark.parametrize(("motion", "moved"), [(0, 0.1), (3, 0.16)])
def test_the_place_of_the_one_tells_the_motion(pebble_env, motion, moved):
    action = TensorDict({"action": torch.eye(4, dtype=torch.int64)[motion]}, [])
    pebble_env.environment.reset_to({"pose": (0.0, 0.3, 0.0), "pebble": (2.0, -0.5)})
    pebble_env.step(action)
    before = pebble_env.step(action)["next", "pose"]
    after = pebble_env.step(action)["next", "pose"]
    assert (after - before)[0].item() == pytest.approx(moved, abs=1e-3)


def test_torchrl_s_q_actors_act_in_it(pebble_env):
    network = torch.nn.Sequential(torch.nn.Flatten(-3), torch.nn.Linear(64 * 64 * 3, 4))
    scaled = TensorDictModule(lambda pixels: pixels / 255.0, in_keys=["pixels"], out_keys=["scaled"])
    greedy = QValueActor(network, in_keys=["scaled"], spec=pebble_env.action_spec)
    policy = TensorDictSequential(scaled, greedy, EGreedyModule(pebble_env.action_spec, annealing_num_steps=2))
    out = pebble_env.rollout(6, policy)
    assert out["action"].shape == (6, 4)
    assert (out["action"].sum(-1) == 1).all()


def test_rounding_overshoot_is_clipped(env):
    place(env, (-0.3, 0.1, 0.0), box=(0.5, 0.5))
    out = env.step(act(1.0 + 1e-6, 0.0))["next"]
    assert out["reward"].item() == pytest.approx(-0.0025)


def test_a_step_after_the_end_asks_for_a_reset(env):
    place(env, (0.0, 0.1, 0.0), box=(0.14, 0.1))
    env.step(act(0.0, 0.0))
    with pytest.raises(RuntimeError, match="call reset"):
        env.step(act(0.0, 0.0))


def test_the_overview_is_a_picture_of_the_asked_size(env):
    env.reset()
    picture = env.render_overview(height=90, width=120)
    assert picture.shape == (90, 120, 3)
    assert picture.dtype == np.uint8
    assert picture.std() > 10


def test_the_overview_does_not_disturb_the_agent_s_images(env):
    env.set_seed(3)
    before = env.reset()["pixels"]
    env.render_overview()
    env.set_seed(3)
    assert torch.equal(env.reset()["pixels"], before)


def test_two_environments_in_one_process_do_not_mix():
    first, second = halgan_envs.make("navigate-2m", seed=1), halgan_envs.make("navigate-4m", seed=2)
    alone = halgan_envs.make("navigate-2m", seed=1)
    expected = alone.reset()["pixels"]
    second.reset()
    image = first.reset()["pixels"]
    assert torch.equal(image, expected)
    for env in (alone, second, first):
        env.close()


def test_it_runs_in_parallel_under_spawn():
    make = functools.partial(halgan_envs.make, "navigate-2m")
    env = ParallelEnv(2, [functools.partial(make, seed=s) for s in (0, 1)], mp_start_method="spawn")
    try:
        out = env.rollout(4)
    finally:
        env.close()
    assert out.shape == (2, 4)
    assert (out["pose"][0] != out["pose"][1]).any()
    alone = make(seed=0)
    torch.testing.assert_close(out["pixels"][0, 0], alone.reset()["pixels"])
    alone.close()


def test_a_collector_resets_it_by_itself():
    collector = Collector(
        functools.partial(halgan_envs.make, "navigate-2m", seed=0, time_limit=0.5),
        None,
        frames_per_batch=12,
        total_frames=12,
    )
    (batch,) = list(collector)
    collector.shutdown()
    assert batch["next", "truncated"].squeeze().nonzero().squeeze().tolist() == [4, 9]
    assert torch.equal(batch["next", "pose"][0], batch["pose"][1])
    assert not torch.equal(batch["next", "pose"][4], batch["pose"][5])
