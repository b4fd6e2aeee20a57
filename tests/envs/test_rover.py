import numpy as np
import pytest

import halgan_envs
from halgan_envs.robots.rover import Rover, wrap_angle


def test_full_speed_forward_moves_5_cm_a_step(stage):
    stage.place((-0.5, 0.3, 0.0))
    stage.step(forward=1.0)  # Gets up to speed.
    before = stage.pose()
    stage.step(forward=1.0)
    np.testing.assert_allclose(stage.pose() - before, [0.05, 0.0, 0.0], atol=1e-4)


def test_no_step_moves_farther_than_5_cm(stage):
    stage.place((-0.5, 0.3, 0.0))
    before = stage.pose()
    stage.step(forward=1.0)
    assert 0.045 < (stage.pose() - before)[0] <= 0.05


def test_a_full_turn_is_10_degrees_to_the_left(stage):
    stage.place((0.2, 0.3, 0.0))
    stage.step(turn=1.0)
    before = stage.pose()
    stage.step(turn=1.0)
    np.testing.assert_allclose(np.rad2deg(stage.pose() - before), [0.0, 0.0, 10.0], atol=1e-2)


def test_wheels_do_not_slide_sideways_in_a_curve(stage):
    stage.place((0.0, 0.0, 0.0))
    for _ in range(9):
        stage.step(forward=1.0, turn=1.0)
    forward = np.array([np.cos(stage.pose()[2]), np.sin(stage.pose()[2])])
    velocity = stage.physics.data.qvel[:2]
    assert np.hypot(*velocity) > 0.45
    assert velocity @ forward / np.hypot(*velocity) > 0.99


def test_speeds_of_zero_stop_the_robot(stage):
    stage.place((0.0, 0.0, 0.0))
    stage.step(forward=1.0, turn=1.0)
    stage.step()
    before = stage.pose()
    stage.step()
    np.testing.assert_allclose(stage.pose(), before, atol=1e-4)


def test_yaw_is_wrapped(stage):
    stage.place((0.0, 0.0, np.pi - 0.01))
    stage.step(turn=1.0)
    stage.step(turn=1.0)
    assert -np.pi < stage.pose()[2] < -np.pi + 0.5


def test_wrapped_angles_include_pi_and_exclude_minus_pi():
    assert wrap_angle(-np.pi) == pytest.approx(np.pi)
    assert wrap_angle(3 * np.pi) == pytest.approx(np.pi)


def test_a_wall_stops_the_robot(stage):
    stage.place((0.6, 0.1, 0.0))
    for _ in range(20):
        stage.step(forward=1.0)
    assert stage.pose()[0] + stage.robot.radius == pytest.approx(1.0, abs=2e-3)


@pytest.mark.parametrize("heading", np.linspace(-3.0, 3.0, 7))
def test_no_action_leaves_the_room(stage, heading):
    stage.place((0.3, 0.2, heading))
    for _ in range(60):
        stage.step(forward=1.0, turn=0.05)
        assert np.abs(stage.pose()[:2]).max() + stage.robot.radius < 1.01


@pytest.mark.parametrize("heading", np.linspace(-3.0, 3.0, 9))
def test_the_box_stops_the_robot_and_stays_put(stage, heading):
    stage.place((-0.3 * np.cos(heading), -0.3 * np.sin(heading), heading), box=(0.0, 0.0))
    for _ in range(15):
        if stage.step(forward=1.0, turn=0.03).last():
            break
        gap = np.hypot(*np.maximum(np.abs(stage.pose()[:2]) - stage.box.size / 2, 0)) - stage.robot.radius
        assert gap > -0.01
    np.testing.assert_array_equal(stage.box.position(stage.physics), [0.0, 0.0])


def test_the_robot_does_not_see_itself(stage):
    hidden = stage.physics.model.ptr.geom_rgba
    stage.place((0.1, -0.2, 0.7))
    seen = stage.robot.camera.render(stage.physics)
    robot = [i for i in range(len(hidden)) if stage.physics.model.ptr.geom(i).name.startswith("rover/")]
    colours = hidden[robot].copy()
    hidden[robot, 3] = 0.0
    unseen = stage.robot.camera.render(stage.physics)
    hidden[robot] = colours
    assert len(robot) > 4
    np.testing.assert_array_equal(seen, unseen)


def test_others_do_see_the_robot():
    env = halgan_envs.ComposerEnv(halgan_envs.navigate_2m(random_state=5))
    env.reset()
    before = env.render_overview()
    env.robot.set_pose(env.environment.physics, np.array([0.0, 0.0, 1.0]))
    env.environment.physics.forward()
    after = env.render_overview()
    env.close()
    assert (before != after).any()


@pytest.mark.parametrize(("reverse_speed", "backward"), [(0.0, 0.0), (0.2, 0.02)])
def test_the_lowest_action_brakes_or_reverses(reverse_speed, backward):
    environment = halgan_envs.navigate_2m(random_state=0, reverse_speed=reverse_speed)
    start = environment.reset().observation["pose"]
    environment.step(np.array([-1.0, 0.0]))
    before = environment.step(np.array([-1.0, 0.0])).observation["pose"]
    after = environment.step(np.array([-1.0, 0.0])).observation["pose"]
    environment.close()
    heading = np.array([np.cos(start[2]), np.sin(start[2])])
    assert -heading @ (after - before)[:2] == pytest.approx(backward, abs=1e-3)


@pytest.mark.parametrize(("reverse_speed", "middle"), [(0.0, 0.25), (0.5, 0.0), (0.1, 0.2)])
def test_actions_are_linear_in_the_speeds_and_invert(reverse_speed, middle):
    rover = Rover(reverse_speed=reverse_speed)
    assert rover.velocities(np.array([0.0, 0.5])) == pytest.approx((middle, np.deg2rad(50)))
    for action in ([-1.0, 1.0], [0.3, -0.2], [1.0, 0.0]):
        np.testing.assert_allclose(rover.action_for(*rover.velocities(np.array(action))), action, atol=1e-12)
    np.testing.assert_array_equal(rover.action_for(9.0, -9.0), [1.0, -1.0])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"reverse_speed": -0.6}, "reverse_speed >= 0.*-0.6"),
        ({"max_turn_rate": 0.0}, "max_turn_rate must be positive; got 0.0"),
        ({"body_height": 0.07}, "see its own body.*raise camera_height"),
    ],
)
def test_bad_robots_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Rover(**arguments)
