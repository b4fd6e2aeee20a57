import time

import numpy as np
import pytest

import halgan_envs
from halgan_envs.adapters.transition import random_action
from halgan_envs.arenas.walled_room import WalledRoom
from halgan_envs.props.goal_box import GoalBox
from halgan_envs.robots.rover import Rover
from halgan_envs.tasks.navigate import Navigate
from halgan_rl.hallucination.judging.fidelity import changed
from halgan_rl.hallucination.training.matte_regression import colour_index, goal_colours


def make_task(size=2.0, **arguments):
    return Navigate(Rover(), WalledRoom(size=size), GoalBox(), **arguments)


def test_standing_before_the_box_pays_one_and_terminates(stage):
    stage.place((0.1, 0.2, 0.0), box=(0.1 + 0.14, 0.2))
    timestep = stage.step()
    assert timestep.reward == 1.0
    assert timestep.last()
    assert timestep.discount == 0.0


def test_the_cost_of_an_action_is_its_norm(stage):
    stage.place((0.1, 0.2, 0.0))
    timestep = stage.step(forward=0.6, turn=-0.8)
    assert timestep.reward == pytest.approx(-0.0025)
    assert not timestep.last()
    assert timestep.discount == 1.0


@pytest.mark.parametrize(
    ("pose", "why"),
    [
        ((0.07, 0.2, 0.0), "17 cm away"),
        ((0.1, 0.2 - 0.025, 0.0), "2.5 cm beside the optical axis"),
        ((0.1, 0.2, np.pi), "behind"),
        ((0.1, 0.2, 0.3), "turned away"),
    ],
)
def test_no_success_when_the_box_is(stage, pose, why):
    stage.place(pose, box=(0.24, 0.2))
    assert not stage.step().last(), why


def test_the_time_limit_truncates_after_200_steps(stage):
    stage.place((0.1, 0.2, 0.0))
    steps = 0
    last = False
    while not last:
        timestep = stage.step(turn=0.3)
        steps, last = steps + 1, timestep.last()
    assert steps == 200
    assert timestep.discount == 1.0


def test_starts_are_far_apart_free_and_reachable(named_environment):
    task, random_state = named_environment.task, np.random.RandomState(0)
    half, nearest = task.arena.half_extent, {1.0: 0.5, 2.0: 1.0, 3.0: 0.6}[task.arena.half_extent[0]]
    for _ in range(2000):
        start = task.draw_start(random_state)
        pose = start["pose"]
        assert (np.abs(pose[:2]) <= half - task.robot.radius).all()
        assert -np.pi <= pose[2] <= np.pi
        for name, goal in task.goals.items():
            assert np.hypot(*(pose[:2] - start[name])) >= nearest
            # Room for the robot between box and wall.
            assert (np.abs(start[name]) <= half - goal.prop.radius - 2 * task.robot.radius).all()


def test_episodes_start_without_contact_but_for_wheels_on_the_ground(named_environment):
    for _ in range(30):
        named_environment.reset()
        model, data = named_environment.physics.model, named_environment.physics.data
        touched = [model.id2name(contact.geom1, "geom") for contact in data.contact]
        assert set(touched) <= {"asphalt"}


def test_every_named_environment_keeps_its_spec(named_environment):
    spec = named_environment.observation_spec()
    random_state = np.random.RandomState(1)
    timestep = named_environment.reset()
    assert {name: (s.shape, s.dtype) for name, s in spec.items()} == {
        "pixels": ((64, 64, 3), np.uint8),
        "pose": ((3 + len(named_environment.task.flags),), np.float32),
    }
    for _ in range(20):
        for name, value in timestep.observation.items():
            spec[name].validate(value)
        timestep = named_environment.step(random_action(named_environment.action_spec(), random_state))
        assert -0.0025 * np.sqrt(2) <= timestep.reward <= 1.0


def test_the_rooms_have_the_paper_s_size_and_the_small_one():
    sizes = {}
    for name, build in halgan_envs.NAMES.items():
        environment = build(random_state=0)
        task = environment.task
        sizes[name] = (*2 * task.arena.half_extent, *(goal.tolerance for goal in task.goals.values()))
        environment.close()
    assert sizes == {
        "camouflage-2m": (2.0, 2.0, 0.01),
        "navigate-4m": (4.0, 4.0, 0.01),
        "navigate-2m": (2.0, 2.0, 0.01),
        "pebble": (6.0, 3.0, 0.05),
        "pick-and-place-2m": (2.0, 2.0, 0.02, 0.02),
    }


def test_a_camouflaged_box_has_colours_that_failed_frames_show_as_well():
    """A mask of colours that only near-goal frames show, with which matte regression starts, misses most of it."""
    found = {}
    for name in ("camouflage-2m", "navigate-2m"):
        near, failed = halgan_envs.near_goal_frames(name, 300, seed=0), halgan_envs.failed_frames(name, 600, seed=1)
        few = {entry: value[::6] for entry, value in near.items()}
        frames = halgan_envs.with_truth(few, halgan_envs.domain(name).goal_renderer())
        box = changed(frames["pixels"], frames["truth"])
        is_goal = goal_colours(near["pixels"], failed["pixels"])[colour_index(few["pixels"])]
        found[name] = float((is_goal & box).sum() / box.sum())
    assert found["camouflage-2m"] < 0.4
    assert found["navigate-2m"] > 0.8


def test_a_reset_never_recompiles(room_2m):
    room_2m.reset()
    model, camera = room_2m.physics.model.ptr, room_2m.task.robot.camera
    start = time.perf_counter()
    for _ in range(20):
        room_2m.reset()
    assert room_2m.physics.model.ptr is model
    assert room_2m.task.robot.camera is camera
    assert (time.perf_counter() - start) / 20 < 0.03


def test_equal_seeds_give_equal_episodes():
    first, second = (run_episode(halgan_envs.navigate_2m(random_state=7)) for _ in range(2))
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_array_equal(first[1], second[1])
    other = run_episode(halgan_envs.navigate_2m(random_state=8))
    assert (first[1] != other[1]).any()


def run_episode(environment):
    actions = np.random.RandomState(0)
    observations = [environment.reset().observation]
    observations += [environment.step(actions.uniform(-1, 1, size=2)).observation for _ in range(10)]
    environment.close()
    return tuple(np.stack([o[name] for o in observations]) for name in ("pixels", "pose"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"size": 1.0}, "room of 1.0 m is too small for min_start_distance=1.0"),
        ({"size": 0.3, "min_start_distance": 0.2}, "too small"),
        ({"success_distance": 0.05}, "success_distance=0.05 m cannot be reached"),
        ({"centring_tolerance": 0.0}, "centring_tolerance must be positive; got 0.0"),
        ({"min_start_distance": 0.1}, "min_start_distance=0.1 m must exceed 0.16 m"),
        ({"min_start_distance": float("nan")}, "min_start_distance=nan"),
    ],
)
def test_bad_tasks_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        make_task(**arguments)


@pytest.mark.parametrize("build", [lambda: WalledRoom(size=0.0), lambda: GoalBox(size=-1.0)])
def test_bad_sizes_are_refused(build):
    with pytest.raises(ValueError, match="must be positive; got"):
        build()


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(ValueError, match=r"'navigate-3m'.*navigate-2m, navigate-4m"):
        halgan_envs.make("navigate-3m")
