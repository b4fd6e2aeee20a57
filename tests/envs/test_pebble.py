import mujoco
import numpy as np
import pytest
import torch
from dm_control.composer import EpisodeInitializationError

import halgan_envs
from halgan_envs.adapters.transition import read
from halgan_envs.arenas.arena import WALL_GROUP
from halgan_envs.arenas.road import Road
from halgan_envs.near_goal import NoisyDriver, collect_failed, collect_near_goal
from halgan_envs.props.pebble import Pebble
from halgan_envs.robots.turtlebot import BACKWARD, BODY_GROUP, FAST, FORWARD, LEFT, RIGHT, TurtleBot
from halgan_envs.tasks.pebble import FindPebble


@pytest.fixture(scope="module")
def road():
    environment = halgan_envs.find_pebble(random_state=0)
    yield environment
    environment.close()


@pytest.fixture(scope="module")
def renderer():
    renderer = halgan_envs.GoalRenderer("pebble")
    yield renderer
    renderer.close()


def make_task(length=6.0, width=3.0, **arguments):
    return FindPebble(TurtleBot(), Road(length=length, width=width), Pebble(), **arguments)


def start(road, pose, pebble):
    return read(road.reset_to({"pose": pose, "pebble": pebble}))


def step(road, action):
    return read(road.step(action))


def sandy(image):
    """Where an image has the colour of the pebble, clearly warmer than asphalt and paint."""
    red, _, blue = image.astype(int).transpose(2, 0, 1)
    return (red > 100) & (red - blue > 35)


def test_driving_up_to_the_pebble_pays_one_and_terminates(road):
    start(road, (-0.5, 0.4, 0.0), pebble=(0.5, 0.4))
    steps = [step(road, FORWARD) for _ in range(6)]
    assert [s.reward for s in steps] == [0.0] * 5 + [1.0]
    assert [(s.terminated, s.truncated) for s in steps] == [(False, False)] * 5 + [(True, False)]
    assert 0.34 <= 0.5 - steps[-1].pose[0] <= 0.45


@pytest.mark.parametrize(
    ("pebble", "why"),
    [
        ((0.50, 0.0), "too far"),
        ((0.30, 0.0), "so close that it is out of view"),
        ((0.40, 0.09), "to the left"),
        ((0.40, -0.09), "to the right"),
        ((-0.40, 0.0), "behind"),
    ],
)
def test_no_success_when_the_pebble_is(road, pebble, why):
    task = road.task
    assert not task.is_success(np.zeros(3), np.array(pebble)), why
    assert task.is_success(np.zeros(3), np.array((0.4, 0.04)))


def test_turning_towards_the_pebble_succeeds_and_away_does_not(road):
    for turn, succeeds in ((LEFT, True), (RIGHT, False)):
        start(road, (0.0, 0.0, 0.0), pebble=(0.4, 0.1))
        assert step(road, turn).terminated is succeeds


@pytest.mark.parametrize(("action", "ahead"), [(FORWARD, 0.5), (FAST, 0.54)])
def test_driving_up_to_the_pebble_succeeds(road, action, ahead):
    start(road, (0.0, 0.0, 0.0), pebble=(ahead, 0.0))
    assert step(road, action).terminated


@pytest.fixture(scope="module")
def reversing_road():
    environment = halgan_envs.find_pebble(random_state=0, reverse_speed=0.4)
    yield environment
    environment.close()


def test_one_that_is_too_close_backs_up_to_success_if_it_has_a_reverse_gear(reversing_road):
    start(reversing_road, (0.0, 0.0, 0.0), pebble=(0.28, 0.0))
    assert step(reversing_road, BACKWARD).terminated


@pytest.mark.parametrize("seed", [0, 1])
def test_episodes_start_0_6_to_1_5_m_from_the_pebble(road, seed):
    random_state = np.random.RandomState(seed)
    starts = [road.task.draw_start(random_state) for _ in range(2000)]
    distances = [np.hypot(*(drawn["pose"][:2] - drawn["pebble"])) for drawn in starts]
    assert 0.6 <= min(distances) < 0.65
    assert 1.45 < max(distances) <= 1.5


@pytest.mark.parametrize("fixed", [{"pose": (2.8, 1.3, 0.0)}, {"pebble": (2.97, 1.47)}, {"pose": (0.0, 0.0, 0.0)}])
def test_what_is_not_fixed_is_drawn_within_reach_even_in_a_corner(road, fixed):
    (name, place), random_state = *fixed.items(), np.random.RandomState(0)
    for _ in range(300):
        drawn = road.task.draw_start(random_state, {name: np.array(place)})
        assert np.array_equal(drawn[name], place)
        assert 0.6 <= np.hypot(*(drawn["pose"][:2] - drawn["pebble"])) <= 1.5


def test_a_fixed_start_may_be_farther_from_the_pebble(road):
    assert start(road, (-2.0, 0.0, 0.0), pebble=(2.0, 0.0)).pose[0] == pytest.approx(-2.0)


def test_start_distances_that_are_never_drawn_are_reported():
    task = make_task(max_start_distance=np.nextafter(0.6, 1.0))
    with pytest.raises(EpisodeInitializationError, match=r"robot and goal 0.6 to 0.60.* m apart.*in 10000 draws"):
        task.draw_start(np.random.RandomState(0))


def test_the_pebble_does_not_block(road):
    start(road, (0.0, 0.0, 0.0), pebble=(0.25, 0.0))
    for _ in range(8):
        pose = step(road, FORWARD).pose
    assert pose[0] > 0.7
    np.testing.assert_allclose(pose[1:], 0.0, atol=1e-4)


def test_the_time_limit_truncates_after_100_steps(road):
    start(road, (0.0, 0.0, 0.0), pebble=(-2.0, 0.0))
    steps = [step(road, LEFT) for _ in range(100)]
    assert [s.truncated for s in steps] == [False] * 99 + [True]
    assert not any(s.terminated or s.reward for s in steps)


def test_equal_seeds_give_equal_episodes():
    first, again, other = (episode(seed) for seed in (7, 7, 8))
    for one, two in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.pixels, two.pixels)
        np.testing.assert_array_equal(one.pose, two.pose)
    assert (first[0].pose != other[0].pose).any()


def episode(seed):
    environment = halgan_envs.find_pebble(random_state=seed)
    actions = np.random.RandomState(0).randint(4, size=10)
    transitions = [read(environment.reset()), *(step(environment, action) for action in actions)]
    environment.close()
    return transitions


def test_observations_share_no_memory(road):
    observations = [read(road.reset()), step(road, FORWARD), step(road, LEFT), read(road.reset())]
    for key in ("pixels", "pose"):
        for i, one in enumerate(observations):
            assert not any(np.shares_memory(getattr(one, key), getattr(other, key)) for other in observations[:i])


def test_the_pebble_is_in_the_image_of_every_success(road):
    for ahead in (0.345, 0.45):
        for left in (-0.05, 0.05):
            image = start(road, (-0.5, 0.3, 0.0), pebble=(-0.5 + ahead, 0.3 + left)).pixels
            without = start(road, (-0.5, 0.3, 0.0), pebble=(-2.0, -0.5)).pixels
            assert sandy(image).sum() - sandy(without).sum() > 25


@pytest.mark.parametrize("yaw", [0.0, 1.0, 2.6, -1.4])
def test_the_pebble_is_seen_from_1_5_m(renderer, yaw):
    heading = np.array([np.cos(yaw), np.sin(yaw)])
    pose = np.array([*-0.7 * heading, yaw])
    shown, empty = (renderer.render(pose, place).astype(int) for place in (0.8 * heading, None))
    assert np.abs(shown - empty).max() > 40


def test_the_asphalt_is_no_pebble(road):
    camera = road.task.robot.camera
    camera.options.geomgroup[WALL_GROUP] = False
    for heading in np.linspace(-3, 3, 20):
        start(road, (0.8 * heading, 0.4 * heading, heading), pebble=(-2.0, -0.5))
        road.task.show(road.physics, road.task.pose(road.physics), None)
        mujoco.mj_forward(road.physics.model.ptr, road.physics.data.ptr)
        assert not sandy(camera.render(road.physics)[24:]).any()
    camera.options.geomgroup[WALL_GROUP] = True


def test_roads_of_equal_seed_look_equal_and_others_do_not():
    first, again, other = (overview(Road(seed=seed)) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert (first != other).mean() > 0.3


def overview(arena):
    environment = halgan_envs.Environment(FindPebble(TurtleBot(), arena, Pebble()), time_limit=25.0, random_state=0)
    environment.reset()
    picture = environment.render_overview()
    environment.close()
    return picture


def test_the_light_is_uneven(road):
    brightness = {}
    for x in (-1.5, 0.0, 2.5):
        start(road, (-0.5 + x, 0.8, 0.0), pebble=(-2.0, -0.5))
        camera = road.task.robot.camera
        camera.options.geomgroup[WALL_GROUP] = False
        brightness[x] = camera.render(road.physics)[40:].mean()
        camera.options.geomgroup[WALL_GROUP] = True
    assert brightness[-1.5] > 1.15 * brightness[2.5]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"box": [0.1, 0.2]}, "Unknown start option 'box': choose among pose, pebble"),
        ({"pose": [0.0, 1.4, 0.0]}, r"not inside the road of 6.0 m x 3.0 m.*y in \[-1.323, 1.323\]"),
        ({"pebble": [3.1, 0.0]}, r"pebble=\[3.1, 0.0\] is not inside.*x in \[-2.97, 2.97\]"),
        ({"pose": [0.0, 0.0, 0.0], "pebble": [0.1, 0.0]}, "overlap by 0.107 m"),
    ],
)
def test_impossible_starts_are_refused(road, options, message):
    with pytest.raises(ValueError, match=message):
        road.reset_to(options)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"nearest": 0.5}, "nearest=0.5 m must lie between 0 and success_distance=0.45 m"),
        ({"nearest": -0.1}, "nearest=-0.1 m"),
        ({"min_start_distance": 0.4}, "min_start_distance=0.4 m must exceed 0.45 m"),
        ({"max_start_distance": 0.6}, "max_start_distance=0.6 m must exceed min_start_distance=0.6 m"),
        ({"max_start_distance": float("nan")}, "max_start_distance=nan m"),
        ({"success_distance": 0.2, "nearest": 0.1}, "success_distance=0.2 m cannot be reached"),
        ({"width": 1.0}, "A road of 6.0 m x 1.0 m is too small"),
        ({"length": -1.0}, "must be positive; got -1.0 m and 3.0 m"),
    ],
)
def test_bad_tasks_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        make_task(**arguments)


def test_a_pebble_without_size_is_refused():
    with pytest.raises(ValueError, match=r"size must be positive; got 0.0 m"):
        Pebble(size=0.0)


def test_everything_fits_into_the_camera_s_scene(road):
    road.reset()
    assert road.physics.model.ngeom < 100
    scene = road.task.robot.camera._scene
    assert scene.ngeom < scene.maxgeom


# The oracle.


def test_the_oracle_renders_what_the_environment_shows(renderer, road):
    """All but what the sub-millimetre springs of the wheels move."""
    shown = start(road, (0.3, -0.2, 2.0), pebble=(-0.2, 0.7))
    for action in (FORWARD, LEFT, FORWARD):
        shown = step(road, action)
    frame = renderer.render(road.task.robot.pose(road.physics), np.array((-0.2, 0.7)))
    difference = np.abs(frame.astype(int) - shown.pixels).max(-1)
    assert np.median(difference) <= 2
    assert (difference > 25).mean() < 0.03


def test_the_oracle_shows_the_pebble_only_where_asked(renderer):
    pixels = torch.full((1, 2, 64, 64, 3), 77, dtype=torch.uint8)
    pose = torch.tensor([[[0.0, 0.0, 0.3], [0.3, 0.0, np.pi]]])
    images = renderer(pixels, pose, torch.tensor([[[0.2, 0.0, 0.0]]]))
    painted = (images != 77).any(-1)[0]
    _, columns = painted[0].nonzero(as_tuple=True)
    assert 4 < painted[0].sum() < 150
    assert columns.float().mean() > 32  # To the right of a robot that is turned to the left.
    assert (images[0, 0][painted[0]][:, 0] > images[0, 0][painted[0]][:, 2]).all()
    assert not painted[1].any()  # Behind.


def test_a_goal_pose_sees_its_pebble_in_the_middle_of_the_success_zone(renderer, road):
    goal = np.array([0.5, -0.3, 1.1])
    position = renderer.goal_position(goal, goal)
    assert road.task.is_success(goal, position)
    np.testing.assert_allclose(np.hypot(*(position - goal[:2])), (0.45 + 0.34) / 2)


def test_no_kerb_hides_the_oracle_s_pebble(renderer):
    empty = torch.zeros(1, 1, 64, 64, 3, dtype=torch.uint8)
    pose, goal = torch.tensor([[[0.0, 0.9, np.pi / 2]]]), torch.tensor([[[0.0, 1.3, np.pi / 2]]])
    assert renderer(empty, pose, goal).any()


# Frames near the goal and away from it.


@pytest.fixture(scope="module")
def near_goal():
    environment = halgan_envs.find_pebble(random_state=1)
    snapshots = collect_near_goal(environment, 120, np.random.RandomState(2), steps_before_goal=16)
    environment.close()
    return snapshots


def drive(environment, pose, pebble, steps):
    """Whether the scripted driver reaches the pebble, and after how many steps."""
    driver = NoisyDriver(environment, np.random.RandomState(0), noise=(0.0, 0.0))
    state = start(environment, pose, pebble)
    for count in range(1, steps + 1):
        state = step(environment, driver.act(state.pose))
        if state.terminated:
            return True, count
    return False, steps


@pytest.mark.parametrize("yaw", [0.0, 0.4, -1.6, 3.0])
def test_the_driver_goes_round_when_it_is_too_close(road, yaw):
    reached, count = drive(road, (0.0, 0.0, yaw), pebble=(0.3, 0.05), steps=40)
    assert reached
    assert count > 5


def test_the_driver_goes_round_even_before_a_kerb(road):
    assert drive(road, (0.2, 1.2, 1.5), pebble=(0.2, 0.87), steps=40)[0]


def noisiest_actions(environment, ahead):
    driver = NoisyDriver(environment, np.random.RandomState(0), noise=(1.0, 1.0))
    pose = start(environment, (0.0, 0.0, 0.0), pebble=(ahead, 0.08)).pose
    return {driver.act(pose) for _ in range(100)}


def test_the_noisiest_driver_does_not_come_too_close(road):
    assert noisiest_actions(road, 0.6) == {FORWARD, LEFT, RIGHT, FAST}
    assert noisiest_actions(road, 0.45) == {FORWARD, LEFT, RIGHT}
    assert noisiest_actions(road, 0.36) == {LEFT, RIGHT}


def test_the_noisiest_driver_drives_on_when_it_is_too_close(road):
    assert noisiest_actions(road, 0.3) == {FAST}


def test_the_noisiest_driver_may_come_too_close_if_it_has_a_reverse_gear(reversing_road):
    assert noisiest_actions(reversing_road, 0.3) == {FORWARD, LEFT, RIGHT, BACKWARD}


def test_the_driver_backs_up_when_it_is_too_close_and_can(reversing_road):
    assert drive(reversing_road, (0.0, 0.0, 0.0), pebble=(0.3, 0.0), steps=40) == (True, 1)


def test_near_goal_frames_end_at_the_pebble(near_goal, road):
    assert near_goal["pixels"].shape == (120, 64, 64, 3)
    final = (near_goal["pose"] == near_goal["goal_pose"]).all(axis=1)
    assert final.sum() >= 3
    for image in near_goal["pixels"][final]:
        assert sandy(image[32:]).sum() > 20


def test_near_goal_poses_are_within_reach_of_the_goal_pose(near_goal):
    distance = np.hypot(*(near_goal["pose"] - near_goal["goal_pose"])[:, :2].T)
    assert (distance <= 16 * 0.101).all()
    assert (distance > 0.3).any()


def test_failed_walks_move_and_turn_and_never_succeed(road):
    failed = collect_failed(road, 150, np.random.RandomState(0))
    assert failed["pixels"].shape == (150, 64, 64, 3)
    steps = np.diff(failed["pose"], axis=0)
    jumps = (np.hypot(*steps[:, :2].T) > 0.17).nonzero()[0]
    assert jumps.tolist() == [100]  # One whole episode, and the beginning of the next.
    assert np.hypot(*steps[:, :2].T).max() > 0.05
    assert np.abs(steps[:100, 2]).max() > 0.1


def test_the_body_of_the_robot_is_in_no_image(near_goal):
    environment = halgan_envs.find_pebble(random_state=1)
    environment.reset()
    assert not environment.task.robot.camera.options.geomgroup[BODY_GROUP]
    environment.close()
