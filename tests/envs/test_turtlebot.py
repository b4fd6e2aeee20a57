import mujoco
import numpy as np
import pytest

import halgan_envs
from halgan_envs.robots.turtlebot import (
    BACKWARD,
    BODY_GROUP,
    FAST,
    FORWARD,
    LEFT,
    MOTIONS,
    RIGHT,
    WHEEL_BASE,
    WHEEL_RADIUS,
    TurtleBot,
    motions_for,
    wheel_speeds,
)


@pytest.fixture(scope="module")
def road():
    environment = halgan_envs.find_pebble(random_state=0)
    environment.reset()
    yield environment
    environment.close()


def place(road, *pose):
    road.reset()
    task, physics = road.task, road.physics
    task.show(physics, np.array(pose), None)
    mujoco.mj_forward(physics.model.ptr, physics.data.ptr)


def poses(road, *actions):
    """The poses [len(actions) + 1, 3] before, between and after actions."""
    robot, physics = road.task.robot, road.physics
    visited = [robot.pose(physics)]
    for action in actions:
        assert not road.step(action).last()
        visited.append(robot.pose(physics))
    return np.array(visited)


def wheel_angles(road):
    names = ("turtlebot/left", "turtlebot/right")
    return np.array([road.physics.data.ptr.joint(name).qpos[0] for name in names])


def tilt(road):
    """Between the robot's axis and the vertical [degrees]."""
    return np.rad2deg(np.arccos(min(road.physics.data.ptr.body("turtlebot/").xmat[8], 1.0)))


def test_a_step_forward_is_10_cm_straight_ahead(road):
    place(road, -1.0, 0.5, 0.3)
    first, *_, last, after = poses(road, *[FORWARD] * 4)
    heading = np.array([np.cos(0.3), np.sin(0.3)])
    np.testing.assert_allclose((after - last)[:2], 0.1 * heading, atol=1e-3)
    assert np.array([-heading[1], heading[0]]) @ (after - first)[:2] == pytest.approx(0.0, abs=1e-4)
    assert after[2] == pytest.approx(0.3, abs=1e-4)


def test_it_gets_up_to_speed_within_the_first_step(road):
    place(road, -1.0, 0.5, 0.0)
    start, first, *_ = poses(road, FORWARD)
    assert 0.06 < first[0] - start[0] < 0.09


@pytest.mark.parametrize(("action", "degrees"), [(LEFT, 24.0), (RIGHT, -12.0)])
def test_a_turn_is_24_degrees_to_the_left_or_12_to_the_right_on_the_spot(road, action, degrees):
    place(road, 0.4, -0.2, 1.0)
    *_, last, after = poses(road, *[action] * 3)
    assert np.rad2deg(after[2] - last[2]) == pytest.approx(degrees, abs=0.1)
    np.testing.assert_allclose(after[:2], [0.4, -0.2], atol=1e-3)


def test_a_fast_step_is_16_cm_without_turning(road):
    place(road, 1.0, 0.5, 0.0)
    *_, last, after = poses(road, *[FAST] * 3)
    np.testing.assert_allclose(after - last, [0.16, 0.0, 0.0], atol=1e-3)


def test_with_a_reverse_gear_the_fourth_action_drives_backward():
    environment = halgan_envs.find_pebble(random_state=0, reverse_speed=0.3)
    environment.reset()
    place(environment, 1.0, 0.5, 0.0)
    *_, last, after = poses(environment, *[BACKWARD] * 3)
    environment.close()
    np.testing.assert_allclose(after - last, [-0.075, 0.0, 0.0], atol=1e-3)


def test_by_default_no_action_drives_backward():
    assert all(speed >= 0 for speed, _ in MOTIONS)
    assert TurtleBot().reverse_speed == 0.0


def test_a_reverse_gear_replaces_driving_fast_only():
    robot = TurtleBot(motions=motions_for(0.3))
    assert [robot.velocities(action) for action in range(4)] == [*MOTIONS[:3], (-0.3, 0.0)]
    assert robot.reverse_speed == 0.3


@pytest.mark.parametrize("reverse_speed", [-0.1, float("nan")])
def test_a_reverse_speed_that_is_no_speed_is_refused(reverse_speed):
    with pytest.raises(ValueError, match=f"reverse_speed must not be negative; got {reverse_speed} m/s"):
        motions_for(reverse_speed)


def test_it_moves_as_far_as_its_wheels_roll(road):
    place(road, -1.5, -0.5, 0.0)
    start, *_, end = poses(road, *[FORWARD] * 8)
    left, right = WHEEL_RADIUS * wheel_angles(road)
    assert end[0] - start[0] == pytest.approx(left, rel=0.01)
    assert left == pytest.approx(right)


def test_it_turns_as_far_as_its_wheels_roll(road):
    place(road, -1.5, -0.5, 0.0)
    start, *_, end = poses(road, *[RIGHT] * 8)
    left, right = WHEEL_RADIUS * wheel_angles(road)
    assert end[2] - start[2] == pytest.approx((right - left) / WHEEL_BASE, rel=0.01)
    assert left == pytest.approx(-right)


def test_without_friction_it_goes_nowhere():
    environment = halgan_envs.find_pebble(random_state=0)
    environment.reset()
    environment.physics.model.ptr.geom_friction[:] = 1e-5
    start, *_, end = poses(environment, *[FORWARD] * 8)
    environment.close()
    assert np.hypot(*(end - start)[:2]) < 0.1


def test_it_stays_upright_on_its_wheels_whatever_it_does(road):
    random_state = np.random.RandomState(0)
    place(road, 0.0, 0.0, 0.0)
    for _ in range(99):
        poses(road, random_state.randint(4))
        assert abs(road.physics.data.ptr.body("turtlebot/").xpos[2]) < 1e-3
        assert tilt(road) < 0.5


@pytest.mark.parametrize("heading", np.linspace(-3.1, 3.1, 7))
def test_kerbs_and_barriers_stop_it_upright(road, heading):
    place(road, 1.2 * np.cos(heading), 0.3 * np.sin(heading), heading)
    visited = poses(road, *[FORWARD] * 40)
    outside = np.abs(visited[:, :2]) + road.task.robot.radius - road.task.arena.half_extent
    assert -0.01 < outside.max() < 0.01
    np.testing.assert_allclose(visited[-1], visited[-2], atol=1e-3)
    assert tilt(road) < 0.5


def test_it_turns_away_from_a_kerb(road):
    place(road, 0.0, 1.2, 1.2)
    poses(road, *[FORWARD] * 5, *[RIGHT] * 12, *[FORWARD] * 8)
    assert road.task.robot.pose(road.physics)[1] < 1.0


@pytest.mark.parametrize("yaw", [0.7, -2.0])
def test_a_pose_that_is_set_is_read_again_and_at_rest(road, yaw):
    place(road, 0.0, 0.0, 0.0)
    poses(road, FORWARD, LEFT)
    place(road, 0.3, -0.4, yaw)
    np.testing.assert_allclose(road.task.robot.pose(road.physics), [0.3, -0.4, yaw], atol=1e-12)
    assert not road.physics.data.qvel.any()
    road.physics.data.ptr.ctrl[:] = 0.0
    road.physics.step(100)
    np.testing.assert_allclose(road.task.robot.pose(road.physics), [0.3, -0.4, yaw], atol=1e-4)
    assert abs(road.physics.data.ptr.body("turtlebot/").xpos[2]) < 5e-4


@pytest.mark.parametrize("action", range(4))
def test_it_never_sees_itself(road, action):
    place(road, -0.4, 0.2, 0.6)
    poses(road, action)
    camera = road.task.robot.camera
    without = camera.render(road.physics)
    camera.options.geomgroup[BODY_GROUP] = True
    with_body = camera.render(road.physics)
    camera.options.geomgroup[BODY_GROUP] = False
    np.testing.assert_array_equal(with_body, without)


def test_others_do_see_it(road):
    place(road, -0.4, 0.2, 0.6)
    here = road.render_overview()
    place(road, 1.4, 0.2, 0.6)
    assert (np.abs(road.render_overview().astype(int) - here).max(-1) > 30).mean() > 0.005


def test_it_weighs_what_a_turtlebot_2_does(road):
    model = road.physics.model.ptr
    assert model.body_subtreemass[model.body("turtlebot/").id] == pytest.approx(6.3, abs=1e-3)


@pytest.mark.parametrize("action", range(4))
def test_the_action_for_a_motion_is_that_motion(action):
    assert TurtleBot().action_for(*MOTIONS[action]) == action


@pytest.mark.parametrize(
    ("speed", "turn_rate", "action"),
    [(0.3, 0.4, FORWARD), (0.1, 1.2, LEFT), (9.0, -0.1, FAST), (0.1, -0.9, RIGHT), (0.2, 0.0, FORWARD)],
)
def test_the_action_for_any_other_motion_is_the_nearest(speed, turn_rate, action):
    assert TurtleBot().action_for(speed, turn_rate) == action


def test_the_action_for_a_motion_backward_is_backward_where_there_is_a_reverse_gear():
    assert TurtleBot(motions=motions_for(0.4)).action_for(-0.3, 0.0) == BACKWARD


def test_actions_are_as_many_as_motions():
    robot = TurtleBot(motions=[(0.5, 0.0), (0.0, 1.0), (0.0, -1.0), (0.3, 0.5), (0.3, -0.5)])
    assert robot.action_spec.num_values == 5
    assert robot.velocities(3) == (0.3, 0.5)
    assert robot.reverse_speed == 0.0


def test_the_inner_wheel_turns_backward_on_the_spot():
    np.testing.assert_allclose(wheel_speeds(0.0, 1.0), np.array([-0.115, 0.115]) / 0.038)


@pytest.mark.parametrize(
    ("motions", "message"),
    [
        ([(0.8, 0.0), (0.0, 1.0)], r"reaches 0.7 m/s.*\[0.8, 0.0\]"),
        ([(0.4, 0.0), (0.0, 4.0)], r"3.142 rad/s; got"),
        ([(0.4, 0.0)], "some must turn"),
        ([(0.0, 1.0)], "must drive"),
        ([0.4, 1.0], "pair of speed"),
        ([(float("nan"), 1.0), (0.1, 1.0)], "nan"),
    ],
)
def test_impossible_motions_are_refused(motions, message):
    with pytest.raises(ValueError, match=message):
        TurtleBot(motions=motions)
