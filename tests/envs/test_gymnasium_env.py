import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from tensordict import TensorDict

import halgan_envs

BRAKE = np.array([-1.0, 0.0], np.float32)
IDS = {name: halgan_envs.gymnasium_id(name) for name in halgan_envs.NAMES}
ID = IDS["navigate-2m"]


@pytest.fixture(scope="module")
def env():
    env = gymnasium.make(ID, render_mode="rgb_array")
    yield env
    env.close()


def box_of(env):
    environment = env.unwrapped.environment
    return environment.task.goals["box"].prop.position(environment.physics)


@pytest.mark.parametrize("name", sorted(halgan_envs.NAMES))
def test_every_named_environment_passes_gymnasium_s_check_without_a_warning(name):
    env = gymnasium.make(IDS[name], render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
    env.close()


def test_every_name_has_an_id_by_one_rule():
    assert IDS == {
        "camouflage-2m": "halgan_rl/Camouflage2m-v0",
        "navigate-2m": "halgan_rl/Navigate2m-v0",
        "navigate-4m": "halgan_rl/Navigate4m-v0",
        "pebble": "halgan_rl/Pebble-v0",
        "pick-and-place-2m": "halgan_rl/PickAndPlace2m-v0",
    }
    registered = {id_ for id_ in gymnasium.registry if id_.startswith("halgan_rl/")}
    assert registered == set(IDS.values())
    assert {gymnasium.spec(id_).kwargs["name"] for id_ in registered} == set(halgan_envs.NAMES)


def test_gymnasium_imports_the_package_itself_if_asked_to():
    env = gymnasium.make(f"halgan_envs:{ID}")
    assert env.spec.id == ID
    env.close()


@pytest.mark.parametrize("name", sorted(halgan_envs.NAMES))
def test_spaces_are_those_of_the_data_contract(name):
    env = gymnasium.make(IDS[name])
    pixels, pose = env.observation_space["pixels"], env.observation_space["pose"]
    assert (pixels.shape, pixels.dtype, pixels.low.min(), pixels.high.max()) == ((64, 64, 3), np.uint8, 0, 255)
    task = env.unwrapped.environment.task
    half, flags = task.arena.half_extent, [1.0] * len(task.flags)
    assert (pose.dtype, pose.high.tolist()) == (np.float32, pytest.approx([*half, np.pi, *flags]))
    assert pose.low.tolist() == pytest.approx([*-half, -np.pi, *(0 * flag for flag in flags)])
    two_speeds = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    assert env.action_space == (gymnasium.spaces.Discrete(4) if name == "pebble" else two_speeds)
    assert env.metadata["render_fps"] == (4 if name == "pebble" else 10)
    env.close()


@pytest.mark.parametrize("name", sorted(halgan_envs.NAMES))
def test_equal_seeds_give_equal_episodes_and_those_of_the_torchrl_adapter(name):
    env, twin = gymnasium.make(IDS[name]), halgan_envs.make(name, seed=7)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(12)]
    episodes = [gymnasium_episode(env, seed, actions) for seed in (7, 7, 8)]
    expected = torchrl_episode(twin, actions)
    env.close()
    twin.close()
    for ours, again, theirs in zip(episodes[0], episodes[1], expected, strict=True):
        np.testing.assert_array_equal(ours, again)
        np.testing.assert_array_equal(ours, theirs)
    assert (episodes[0][1][0] != episodes[2][1][0]).any()


def gymnasium_episode(env, seed, actions):
    observations, rewards, flags = [env.reset(seed=seed)[0]], [], []
    for action in actions:
        observation, reward, *ends, _ = env.step(action)
        observations.append(observation)
        rewards.append(np.float32(reward))
        flags.append(ends)
    return [o["pixels"] for o in observations], [o["pose"] for o in observations], rewards, flags


def torchrl_episode(env, actions):
    start = env.reset()
    encoded = [env.action_spec.encode(action) for action in actions]
    steps = [env.step(TensorDict({"action": action}, []))["next"] for action in encoded]
    observations = [start, *steps]
    return (
        [o["pixels"].numpy() for o in observations],
        [o["pose"].numpy() for o in observations],
        [s["reward"].item() for s in steps],
        [[s["terminated"].item(), s["truncated"].item()] for s in steps],
    )


def test_later_episodes_of_a_seed_repeat_too(env):
    first = [env.reset(seed=5)[0]["pose"], env.reset()[0]["pose"]]
    again = [env.reset(seed=5)[0]["pose"], env.reset()[0]["pose"]]
    np.testing.assert_array_equal(first, again)
    assert (first[0] != first[1]).any()


def test_observations_share_no_memory(env):
    observations = [env.reset(seed=0)[0], env.step(BRAKE)[0], env.step(BRAKE)[0], env.reset()[0]]
    for key in ("pixels", "pose"):
        for i, one in enumerate(observations):
            assert not any(np.shares_memory(one[key], other[key]) for other in observations[:i])


def test_a_fixed_start_is_where_it_was_asked_for(env):
    observation, info = env.reset(options={"pose": [0.1, -0.2, 0.7], "box": [0.5, 0.3]})
    np.testing.assert_allclose(observation["pose"], [0.1, -0.2, 0.7], atol=1e-6)
    np.testing.assert_allclose(box_of(env), [0.5, 0.3])
    assert info == {"is_success": False}
    shown = observation["pixels"]
    elsewhere = env.reset(options={"pose": [0.1, -0.2, 0.7], "box": [-0.5, -0.3]})[0]["pixels"]
    assert (shown != elsewhere).any()


def test_only_the_next_episode_starts_there(env):
    env.reset(options={"pose": [0.1, -0.2, 0.7], "box": [0.5, 0.3]})
    observation, _ = env.reset()
    assert abs(observation["pose"] - np.float32([0.1, -0.2, 0.7])).max() > 1e-3
    assert abs(box_of(env) - [0.5, 0.3]).max() > 1e-3


def test_what_is_not_given_is_drawn_by_the_seed_and_as_far_apart_as_usual(env):
    task = env.unwrapped.environment.task
    boxes, poses = [], []
    for seed in range(30):
        observation, _ = env.reset(seed=seed, options={"pose": [0.3, 0.1, -2.0]})
        np.testing.assert_allclose(observation["pose"], [0.3, 0.1, -2.0], atol=1e-6)
        boxes.append(box_of(env))
        poses.append(env.reset(seed=seed, options={"box": (-0.2, 0.4)})[0]["pose"])
        np.testing.assert_allclose(box_of(env), [-0.2, 0.4])
    assert np.hypot(*(np.array(boxes) - [0.3, 0.1]).T).min() >= task.min_start_distance
    assert np.hypot(*(np.array(poses)[:, :2] - [-0.2, 0.4]).T).min() >= task.min_start_distance - 1e-6
    assert len(np.unique(boxes, axis=0)) == len(np.unique(poses, axis=0)) == 30
    np.testing.assert_array_equal(env.reset(seed=29, options={"box": (-0.2, 0.4)})[0]["pose"], poses[29])


def test_no_options_draw_what_a_plain_reset_draws(env):
    plain, _ = env.reset(seed=4)
    np.testing.assert_array_equal(env.reset(seed=4, options={})[0]["pose"], plain["pose"])


def test_driving_up_to_the_box_is_a_success(env):
    env.reset(options={"pose": [-0.2, 0.1, 0.0], "box": [0.1, 0.1]})
    for _ in range(20):
        observation, reward, terminated, truncated, info = env.step(np.float32([0.0, 0.0]))
        if terminated:
            break
        assert (reward < 0, truncated, info) == (True, False, {"is_success": False})
    assert (terminated, truncated, info) == (True, False, {"is_success": True})
    assert reward == pytest.approx(1.0, abs=0.004)
    assert 0.1 - observation["pose"][0] <= 0.16 + 1e-6


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"goal": [0.1, 0.2]}, "Unknown start option 'goal': choose among pose, box"),
        ({"pose": [0.1, 0.2]}, r"pose=\[0.1, 0.2\] must be 3 finite numbers, x \[m\], y \[m\], yaw \[rad\]"),
        ({"box": [0.1, 0.2, 0.0]}, r"box=\[0.1, 0.2, 0.0\] must be 2 finite numbers.*leave it out"),
        ({"pose": [0.1, float("nan"), 0.0]}, "nan.*must be 3 finite numbers"),
        ({"pose": [0.1, 0.2, float("inf")]}, "inf.*must be 3 finite numbers"),
        ({"box": "corner"}, "box='corner' must be 2 finite numbers"),
        ({"box": None}, "box=None must be 2 finite numbers"),
        ({"box": [[0.1], [0.1, 0.2]]}, "must be 2 finite numbers"),
        ({"pose": [0.96, 0.0, 0.0]}, r"pose=\[0.96, 0.0, 0.0\] is not inside the room of 2.0 m.*\[-0.95, 0.95\]"),
        ({"box": [0.0, -1.5]}, r"box=\[0.0, -1.5\] is not inside the room of 2.0 m.*\[-0.96, 0.96\]"),
        ({"pose": [0.0, 0.0, 0.0], "box": [0.08, 0.0]}, r"overlap by 0.010 m: move them apart, 0.107 m"),
    ],
)
def test_impossible_options_are_refused_and_the_episode_goes_on(env, options, message):
    env.reset(options={"pose": [0.1, -0.2, 0.7], "box": [0.5, 0.3]})
    with pytest.raises(ValueError, match=message):
        env.reset(options=options)
    np.testing.assert_allclose(env.step(BRAKE)[0]["pose"], [0.1, -0.2, 0.7], atol=1e-3)
    env.reset()
    assert abs(box_of(env) - [0.5, 0.3]).max() > 1e-3


@pytest.mark.parametrize("action", [4, -1, 1.0, [0], [1, 0, 0, 0]])
def test_numbers_of_no_discrete_action_are_refused(action):
    env = gymnasium.make(IDS["pebble"])
    env.reset()
    with pytest.raises(ValueError, match="one of the integers 0 to 3; got"):
        env.unwrapped.step(action)
    env.close()


@pytest.mark.parametrize(
    ("action", "message"),
    [
        ([float("nan"), 0.0], r"must lie in \[-1, 1\]; got \[nan, 0.0\]"),
        ([0.0, 1.5], r"must lie in \[-1, 1\]"),
        ([0.0, 0.0, 0.0], "two entries"),
    ],
)
def test_bad_actions_are_refused(env, action, message):
    env.reset()
    with pytest.raises(ValueError, match=message):
        env.unwrapped.step(np.array(action))


def test_a_step_after_the_end_asks_for_a_reset(env):
    env.reset(options={"pose": [0.0, 0.1, 0.0], "box": [0.14, 0.1]})
    assert env.step(BRAKE)[2]
    with pytest.raises(RuntimeError, match="call reset"):
        env.step(BRAKE)


def test_the_time_limit_truncates():
    env = gymnasium.make(ID, time_limit=0.5)
    env.reset(seed=0)
    flags = [env.step(BRAKE)[2:] for _ in range(5)]
    env.close()
    assert flags == [(False, False, {"is_success": False})] * 4 + [(False, True, {"is_success": False})]


def test_the_view_shows_the_room_from_outside(env):
    env.reset(options={"pose": [0.1, -0.2, 0.7], "box": [0.5, 0.3]})
    view = env.render()
    assert (view.shape, view.dtype) == ((240, 320, 3), np.uint8)
    assert view.std() > 10
    env.reset(options={"pose": [0.1, 0.4, 0.7], "box": [0.5, 0.3]})
    assert (env.render() != view).any()


def test_without_a_render_mode_there_is_no_view():
    env = halgan_envs.GymnasiumEnv("navigate-2m")
    env.reset(seed=0)
    assert env.render() is None
    env.close()


def test_an_unknown_render_mode_is_refused():
    with pytest.raises(ValueError, match=r"Unknown render_mode 'ansi': choose None or one of \['rgb_array'\]"):
        halgan_envs.GymnasiumEnv("navigate-2m", render_mode="ansi")


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(ValueError, match=r"'navigate-3m'.*navigate-2m, navigate-4m"):
        halgan_envs.GymnasiumEnv("navigate-3m")


def test_close_frees_both_cameras_and_may_be_repeated():
    env = halgan_envs.GymnasiumEnv("navigate-2m", render_mode="rgb_array")
    env.reset(seed=0)
    env.render()
    cameras = [env.environment.task.robot.camera, env.environment._overview]
    env.close()
    env.close()
    for camera in cameras:
        with pytest.raises(RuntimeError, match="closed"):
            camera.render(None)


def test_it_runs_vectorised_in_spawned_processes():
    many = gymnasium.make_vec(ID, num_envs=2, vectorization_mode="async", vector_kwargs={"context": "spawn"})
    try:
        start, _ = many.reset(seed=3)
        observations, rewards, *_, infos = many.step(np.array([BRAKE, -BRAKE]))
    finally:
        many.close()
    assert observations["pixels"].shape == (2, 64, 64, 3)
    assert rewards.shape == (2,)
    assert infos["is_success"].tolist() == [False, False]
    alone = gymnasium.make(ID)
    for row, seed in enumerate((3, 4)):
        np.testing.assert_array_equal(alone.reset(seed=seed)[0]["pixels"], start["pixels"][row])
    alone.close()
