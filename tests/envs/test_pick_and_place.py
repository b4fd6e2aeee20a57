from collections.abc import Iterator

import numpy as np
import pytest
import torch

import halgan_envs
from halgan_envs.arenas.walled_room import WalledRoom
from halgan_envs.near_goal import collect_failed, collect_near_goal
from halgan_envs.props.goal_box import GREEN, GoalBox
from halgan_envs.robots.rover import Rover
from halgan_envs.tasks.pick_and_place import PickAndPlace

FULL_SPEED, HALF_SPEED, BRAKE = np.array([1.0, 0.0]), np.array([0.0, 0.0]), np.array([-1.0, 0.0])


def make_task(size=2.0, **arguments):
    boxes = GoalBox(size=0.04, name="red_box"), GoalBox(size=0.08, rgba=GREEN, name="green_box")
    return PickAndPlace(Rover(), WalledRoom(size=size), *boxes, **arguments)


@pytest.fixture(scope="module")
def environment() -> Iterator[halgan_envs.Environment]:
    environment = halgan_envs.pick_and_place_2m(random_state=0)
    yield environment
    environment.close()


@pytest.fixture(scope="module")
def renderer() -> Iterator[halgan_envs.GoalRenderer]:
    renderer = halgan_envs.GoalRenderer("pick-and-place-2m")
    yield renderer
    renderer.close()


def drive(environment, action, steps):
    """Steps until the episode ends or time is up."""
    timesteps = []
    while len(timesteps) < steps and not (timesteps and timesteps[-1].last()):
        timesteps.append(environment.step(action))
    return timesteps


def held(timesteps):
    return [int(timestep.observation["pose"][3]) for timestep in timesteps]


def box_position(environment, name):
    return environment.task.goals[name].prop.position(environment.physics)


def red(image):
    image = image.astype(int)
    return (image[..., 0] > 100) & (image[..., 1:].max(axis=-1) < 60)


def green(image):
    image = image.astype(int)
    return (image[..., 1] > 70) & (image[..., ::2].max(axis=-1) < 40)


# Two stages, driven.


def test_one_drive_picks_up_the_red_box_and_delivers_it_to_the_green_one(environment):
    environment.reset_to({"pose": [-0.5, 0.1, 0.0], "red_box": [-0.1, 0.115], "green_box": [0.5, 0.09]})
    timesteps = drive(environment, HALF_SPEED, 60)
    flags = held(timesteps)
    assert flags == sorted(flags)
    assert 0 < sum(flags) < len(flags)
    assert timesteps[-1].discount == 0.0
    assert timesteps[-1].reward == pytest.approx(1.0, abs=0.004)
    # Picked up and delivered as soon as it was close, and no sooner.
    x = np.array([timestep.observation["pose"][0] for timestep in timesteps])
    first = flags.index(1)
    assert -0.1 - x[first] <= 0.13 < -0.1 - x[first - 1]
    assert 0.5 - x[-1] <= 0.16 < 0.5 - x[-2]


def test_the_pick_up_pays_nothing_and_ends_nothing(environment):
    environment.reset_to({"pose": [-0.3, 0.1, 0.0], "red_box": [-0.19, 0.1], "green_box": [0.5, -0.4]})
    timestep = environment.step(BRAKE)
    assert held([timestep]) == [1]
    assert timestep.reward == 0.0
    assert timestep.discount == 1.0
    assert not timestep.last()


def test_each_step_costs_the_norm_of_its_action_before_and_after_the_pick_up(environment):
    for flag in (0, 1):
        environment.reset_to({"pose": [-0.3, 0.1, 0.0], "green_box": [0.5, -0.4], "held": flag})
        assert environment.step(np.array([0.2, -0.8])).reward == pytest.approx(-0.0025)


def test_without_the_red_box_the_green_one_pays_nothing_and_ends_nothing(environment):
    environment.reset_to({"pose": [0.1, 0.2, 0.0], "red_box": [-0.5, -0.3], "green_box": [0.24, 0.2]})
    (timestep,) = drive(environment, BRAKE, 1)
    assert (timestep.reward, timestep.discount, timestep.last(), held([timestep])) == (0.0, 1.0, False, [0])


def test_with_it_the_same_place_is_the_goal(environment):
    environment.reset_to({"pose": [0.1, 0.2, 0.0], "green_box": [0.24, 0.2], "held": 1})
    (timestep,) = drive(environment, BRAKE, 1)
    assert (timestep.reward, timestep.discount, timestep.last(), held([timestep])) == (1.0, 0.0, True, [1])


@pytest.mark.parametrize(
    ("pose", "flag", "why"),
    [
        ((0.06, 0.2, 0.0), 0, "14 cm away"),
        ((0.1, 0.175, 0.0), 0, "2.5 cm beside the optical axis"),
        ((0.1, 0.2, np.pi), 0, "behind"),
        ((0.03, 0.2, 0.0), 1, "17 cm away"),
        ((0.1, 0.175, 0.0), 1, "2.5 cm beside the optical axis"),
        ((0.1, 0.2, np.pi), 1, "behind"),
    ],
)
def test_no_goal_is_reached_when_its_box_is(environment, pose, flag, why):
    start = {"green_box": [0.2, 0.2], "held": 1} if flag else {"red_box": [0.2, 0.2], "green_box": [-0.5, 0.4]}
    environment.reset_to({"pose": pose, **start})
    (timestep,) = drive(environment, BRAKE, 1)
    assert (held([timestep]), timestep.last()) == ([flag], False), why


def test_the_time_limit_truncates_after_400_steps(environment):
    environment.reset_to({"pose": [0.1, 0.2, 0.0], "red_box": [-0.6, 0.2], "green_box": [-0.2, -0.5]})
    timesteps = drive(environment, np.array([-1.0, 0.3]), 500)
    assert len(timesteps) == 400
    assert timesteps[-1].discount == 1.0


def test_a_new_episode_starts_without_the_red_box(environment):
    environment.reset_to({"held": 1})
    assert environment.reset().observation["pose"][3] == 0
    assert np.abs(box_position(environment, "red_box") - environment.task.pose(environment.physics)[:2]).max() > 0.3


# The carried box.


def test_the_carried_box_moves_with_the_robot(environment):
    environment.reset_to({"pose": [-0.4, 0.1, 0.3], "green_box": [0.5, -0.6], "held": 1})
    for _ in range(12):
        x, y, yaw, _ = environment.step(np.array([0.6, 0.7])).observation["pose"]
        ahead = np.array([np.cos(yaw), np.sin(yaw)])
        np.testing.assert_allclose(box_position(environment, "red_box"), [x, y] + 0.03 * ahead, atol=1e-6)


def test_the_carried_box_is_seen_at_the_lower_edge_and_nowhere_else(environment):
    images = [
        environment.reset_to({"pose": [-0.2, 0.1, 0.4], "green_box": [-0.5, -0.6], "held": 1}).observation["pixels"]
    ]
    images += [timestep.observation["pixels"] for timestep in drive(environment, np.array([1.0, 0.8]), 8)]
    for image in images:
        assert red(image)[-4:, 12:52].all()
        assert not red(image)[:-8].any()


def test_the_image_of_the_pick_up_shows_the_box_carried_already(environment):
    start = {"pose": [-0.3, 0.1, 0.0], "red_box": [-0.16, 0.1], "green_box": [0.5, -0.4]}
    before = environment.reset_to(start).observation["pixels"]
    timestep = environment.step(FULL_SPEED)
    assert held([timestep]) == [1]
    assert red(before)[40].any()
    assert not red(timestep.observation["pixels"])[:-8].any()
    assert red(timestep.observation["pixels"])[-4:, 12:52].all()


def test_the_carried_box_is_seen_before_a_wall_too(environment):
    environment.reset_to({"pose": [0.8, 0.1, 0.0], "green_box": [-0.5, -0.6], "held": 1})
    timestep = drive(environment, FULL_SPEED, 10)[-1]
    assert timestep.observation["pose"][0] == pytest.approx(0.95, abs=2e-3)
    assert red(timestep.observation["pixels"])[-4:, 12:52].all()


def test_the_carried_box_leaves_the_green_one_in_view(environment):
    pixels = environment.reset_to({"pose": [0.1, 0.2, 0.0], "green_box": [0.24, 0.2], "held": 1}).observation["pixels"]
    assert green(pixels).mean() > 0.3


@pytest.mark.parametrize(
    "start", [{"held": 1}, {"red_box": [-0.18, 0.1]}], ids=["carried from the start", "picked up on the way"]
)
def test_the_carried_box_pushes_nothing(environment, start):
    environment.reset_to({"pose": [-0.3, 0.1, 0.0], "green_box": [-0.5, -0.6], **start})
    timesteps = drive(environment, FULL_SPEED, 8)
    poses = np.array([timestep.observation["pose"] for timestep in timesteps])
    assert held(timesteps) == [1] * 8
    np.testing.assert_allclose(np.diff(poses[:, :3], axis=0), np.tile([0.05, 0, 0], (7, 1)), atol=1e-4)


def test_the_standing_box_is_solid_also_after_an_episode_in_which_it_was_carried(environment):
    environment.reset_to({"held": 1})
    # So far beside the axis that it is not picked up, and so near to it that the robot must give way.
    environment.reset_to({"pose": [-0.3, 0.1, 0.0], "red_box": [-0.1, 0.13], "green_box": [-0.5, -0.6]})
    timesteps = drive(environment, FULL_SPEED, 12)
    assert held(timesteps)[-1] == 0
    assert min(timestep.observation["pose"][1] for timestep in timesteps) < 0.08


def test_a_reset_never_recompiles(environment):
    environment.reset()
    model, camera = environment.physics.model.ptr, environment.task.robot.camera
    for start in ({}, {"held": 1}, {}):
        environment.reset_to(start)
        assert environment.physics.model.ptr is model
        assert environment.task.robot.camera is camera


# Starts.


def test_drawn_starts_are_apart_from_each_other_and_from_the_walls(environment):
    random_state = np.random.RandomState(0)
    starts = [environment.task.draw_start(random_state) for _ in range(1000)]
    pose, red_box, green_box = (np.array([start[key] for start in starts]) for key in ("pose", "red_box", "green_box"))
    assert np.hypot(*(pose[:, :2] - red_box).T).min() >= 0.5
    assert np.hypot(*(pose[:, :2] - green_box).T).min() >= 0.5
    assert 0.4 <= np.hypot(*(red_box - green_box).T).min() < 0.5
    assert 0.7 < np.abs([red_box, green_box]).max() <= 1 - 0.16 - 0.05


def test_no_box_starts_farther_from_the_robot_than_asked_for():
    task, random_state = make_task(max_start_distance=0.9), np.random.RandomState(0)
    starts = [task.draw_start(random_state) for _ in range(500)]
    farthest = {name: max(np.hypot(*(drawn["pose"][:2] - drawn[name])) for drawn in starts) for name in task.goals}
    assert all(0.85 < distance <= 0.9 for distance in farthest.values())


def test_equal_seeds_give_equal_episodes():
    first, again, other = (run_episode(seed) for seed in (7, 7, 8))
    for one, same in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, same)
    assert (first[1] != other[1]).any()


def run_episode(seed):
    environment = halgan_envs.pick_and_place_2m(random_state=seed)
    actions = np.random.RandomState(0)
    observations = [environment.reset().observation]
    observations += [environment.step(actions.uniform(-1, 1, size=2)).observation for _ in range(10)]
    environment.close()
    return tuple(np.stack([o[name] for o in observations]) for name in ("pixels", "pose"))


def test_what_is_fixed_is_where_it_was_asked_for_and_the_rest_is_drawn(environment):
    fixed = {"pose": [0.1, -0.2, 0.7], "red_box": [0.5, 0.3], "green_box": [-0.4, 0.1]}
    for name in fixed:
        seen = set()
        for _ in range(5):
            pose = environment.reset_to({key: value for key, value in fixed.items() if key != name}).observation["pose"]
            places = {key: box_position(environment, key) for key in ("red_box", "green_box")} | {"pose": pose[:3]}
            seen.add(tuple(places.pop(name)))
            for key, place in places.items():
                np.testing.assert_allclose(place, fixed[key], atol=1e-6)
        assert len(seen) == 5


@pytest.mark.parametrize(
    ("start", "message"),
    [
        ({"box": [0.1, 0.2]}, "Unknown start option 'box': choose among pose, red_box, green_box, held"),
        ({"pose": [0.1, 0.2, 0.0, 1.0]}, r"pose=\[0.1, 0.2, 0.0, 1.0\] must be 3 finite numbers"),
        ({"held": 2}, "held=2 must be 0 or 1"),
        ({"held": None}, "held=None must be one finite number, 0 or 1; leave it out"),
        ({"held": [0, 1]}, r"held=\[0, 1\] must be one finite number"),
        ({"held": 1, "red_box": [0.1, 0.2]}, r"red_box=\[0.1, 0.2\] cannot be fixed with held=1.*leave out one"),
        ({"red_box": [0.99, 0.0]}, r"red_box=\[0.99, 0.0\] is not inside the room of 2.0 m.*\[-0.98, 0.98\]"),
        ({"green_box": [0.0, -0.97]}, r"green_box=\[0.0, -0.97\] is not inside.*\[-0.96, 0.96\]"),
        ({"pose": [0.0, 0.0, 0.0], "red_box": [0.06, 0.0]}, r"pose=.* and red_box=.*overlap by 0.010 m.*0.078 m"),
        ({"pose": [0.0, 0.0, 0.0], "green_box": [0.08, 0.0]}, r"pose=.* and green_box=.*overlap by 0.010 m.*0.107 m"),
        ({"red_box": [0.0, 0.0], "green_box": [0.03, 0.05]}, r"red_box=.* and green_box=.*overlap: .*0.060 m along"),
    ],
)
def test_impossible_starts_are_refused_and_the_episode_goes_on(environment, start, message):
    environment.reset_to({"pose": [0.1, -0.2, 0.7], "green_box": [0.5, 0.3], "held": True})
    with pytest.raises(ValueError, match=message):
        environment.reset_to(start)
    np.testing.assert_allclose(environment.step(BRAKE).observation["pose"], [0.1, -0.2, 0.7, 1.0], atol=1e-3)
    assert environment.reset().observation["pose"][3] == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"size": 0.7}, "room of 0.7 m is too small for min_start_distance=0.5"),
        ({"min_box_distance": 1.9}, "room of 2.0 m is too small for min_box_distance=1.9"),
        ({"min_box_distance": float("nan")}, "min_box_distance=nan"),
        ({"min_start_distance": 0.15}, "min_start_distance=0.15 m must exceed 0.16 m"),
        ({"min_box_distance": 0.29}, r"min_box_distance=0.29 m must exceed .* = 0.29 m, or the pick-up may deliver"),
        ({"pick_up_distance": 0.07}, "pick_up_distance=0.07 m cannot be reached: robot and goal touch at 0.070 m"),
        ({"delivery_distance": 0.08}, "delivery_distance=0.08 m cannot be reached: robot and goal touch at 0.090 m"),
        ({"pick_up_tolerance": 0.0}, "pick_up_tolerance must be positive; got 0.0 m"),
        ({"delivery_tolerance": -0.1}, "delivery_tolerance must be positive; got -0.1 m"),
        ({"carry_height": -0.01}, "carry_height must not be negative; got -0.01 m"),
    ],
)
def test_bad_tasks_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        make_task(**arguments)


# The oracle.


@pytest.mark.parametrize(("flag", "name"), [(0, "red_box"), (1, "green_box")])
def test_it_renders_what_the_environment_shows_while_the_other_goal_is_out_of_view(environment, renderer, flag, name):
    start = {"pose": [-0.2, 0.1, 0.0], name: [0.15, 0.12], "held": flag}
    environment.reset_to(start if flag else {**start, "green_box": [-0.6, -0.3]})
    observation = environment.step(np.array([0.7, -0.4])).observation
    task, physics = environment.task, environment.physics
    frame = renderer.render(task.pose(physics), task.goal_position(physics))
    np.testing.assert_array_equal(frame, observation["pixels"])
    np.testing.assert_allclose(task.goal_position(physics), [0.15, 0.12])


@pytest.mark.parametrize(("flag", "paint", "other"), [(0.0, red, green), (1.0, green, red)])
def test_only_pixels_of_the_goal_that_the_flag_selects_are_painted(renderer, flag, paint, other):
    pixels = torch.full((1, 1, 64, 64, 3), 77, dtype=torch.uint8)
    pose, goal = torch.tensor([[[-0.1, 0.0, 0.3, flag]]]), torch.tensor([[[0.1, 0.0, 0.1, 1 - flag]]])
    image = renderer(pixels, pose, goal)[0, 0].numpy()
    changed = (image != 77).any(-1)
    assert changed.mean() > 0.01
    assert paint(image)[changed].mean() > 0.9
    assert not other(image).any()


def test_the_goal_stands_farther_ahead_of_its_goal_pose_if_its_box_is_larger(renderer):
    goal_pose = np.array([0.2, 0.3, 0.5 * np.pi, 0.0])
    for flag, y in ((0.0, 0.41), (1.0, 0.44)):
        position = renderer.goal_position(np.array([0.5, 0.0, 0.7, flag]), goal_pose)
        np.testing.assert_allclose(position, [0.2, y], atol=1e-9)


def test_without_goal_the_carried_box_stays(renderer):
    images = [renderer.render_without_goal(np.array([0.3, 0.0, 0.3, flag])) for flag in (0.0, 1.0, 0.0)]
    assert [red(image).any() for image in images] == [False, True, False]
    assert not any(green(image).any() for image in images)


def test_poses_without_the_flag_are_refused(renderer):
    with pytest.raises(ValueError, match=r"x, y, yaw, held; this one has size 3"):
        renderer(torch.zeros(1, 1, 64, 64, 3, dtype=torch.uint8), torch.zeros(1, 1, 3), torch.zeros(1, 1, 4))
    with pytest.raises(ValueError, match=r"x, y, yaw, held; this one has size 3"):
        renderer.render(np.zeros(3))


# Data for hallucinators.


@pytest.fixture(scope="module")
def near_goal():
    environment = halgan_envs.pick_and_place_2m(random_state=1)
    snapshots = collect_near_goal(environment, 300, np.random.RandomState(2), steps_before_goal=40)
    environment.close()
    return snapshots


def test_near_goal_snapshots_come_from_both_stages_alike(near_goal):
    assert {key: value.shape for key, value in near_goal.items()} == {
        "pixels": (300, 64, 64, 3),
        "pose": (300, 4),
        "goal_pose": (300, 4),
    }
    assert set(near_goal["pose"][:, 3]) == {0.0, 1.0}
    assert 0.4 < near_goal["pose"][:, 3].mean() < 0.6


def test_a_near_goal_snapshot_and_its_goal_pose_have_one_flag_and_are_near_each_other(near_goal):
    pose, goal_pose = near_goal["pose"], near_goal["goal_pose"]
    np.testing.assert_array_equal(pose[:, 3], goal_pose[:, 3])
    assert (np.hypot(*(pose - goal_pose)[:, :2].T) <= 41 * 0.05 + 1e-6).all()
    # The delivery is among its snapshots; the pick-up is not: there the red box is carried already.
    same = (pose == goal_pose).all(axis=1)
    assert set(pose[same, 3]) == {1.0}


def test_each_stage_shows_its_goal_where_the_goal_pose_says(near_goal, renderer):
    found = {0.0: 0, 1.0: 0}
    for pixels, pose, goal_pose in zip(*near_goal.values(), strict=True):
        flag = float(pose[3])
        colour = green if flag else red
        expected = colour(renderer.render(pose, renderer.goal_position(pose, goal_pose)))[:-8]
        if expected.sum() > 40:
            found[flag] += 1
            centres = [np.argwhere(mask).mean(axis=0) for mask in (expected, colour(pixels)[:-8])]
            assert np.abs(centres[0] - centres[1]).max() < 12  # Pixels; a goal's offset is an average.
    assert min(found.values()) > 20


def test_failed_snapshots_come_from_both_stages_and_show_the_carried_box(environment):
    failed = collect_failed(environment, 60, np.random.RandomState(0))
    assert {key: value.shape for key, value in failed.items()} == {
        "pixels": (60, 64, 64, 3),
        "pose": (60, 4),
        "episode": (60,),
    }
    assert failed["pose"][:, 3].tolist() == [0.0] * 30 + [1.0] * 30
    assert all(red(image)[-4:, 12:52].all() for image in failed["pixels"][30:])


# The faces.


def test_the_flag_reaches_torchrl_and_gymnasium():
    env = halgan_envs.make("pick-and-place-2m", seed=0)
    assert env.reset()["pose"].shape == env.observation_spec["pose"].shape == (4,)
    env.close()
    adapter = halgan_envs.GymnasiumEnv("pick-and-place-2m")
    observation, info = adapter.reset(seed=0, options={"pose": [0.1, 0.2, 0.0], "green_box": [0.24, 0.2], "held": 1})
    assert observation["pose"][3] == 1.0
    assert info == {"is_success": False}
    assert adapter.step(BRAKE)[2:] == (True, False, {"is_success": True})
    adapter.close()
