from types import SimpleNamespace

import matplotlib

matplotlib.use("Agg")

import numpy as np
import pytest
from matplotlib import pyplot as plt
from matplotlib.backend_bases import KeyEvent

import halgan_envs
from halgan_envs import drive
from halgan_envs.robots.rover import Rover
from halgan_envs.robots.turtlebot import BACKWARD, FORWARD, LEFT, RIGHT, TurtleBot, motions_for


def held(*names):
    keys = drive.ArrowKeys()
    for name in names:
        keys.press(SimpleNamespace(key=name))
    return keys


@pytest.mark.parametrize(
    ("names", "speed", "turn_rate"),
    [
        ((), 0.0, 0.0),
        (("up",), 0.5, 0.0),
        (("down",), -0.2, 0.0),
        (("left",), 0.0, np.deg2rad(100)),
        (("up", "right"), 0.5, -np.deg2rad(100)),
        (("up", "down", "left", "right"), 0.0, 0.0),
        (("w", None), 0.0, 0.0),
    ],
)
def test_the_arrows_that_are_held_say_where_to_drive(names, speed, turn_rate):
    rover = Rover(reverse_speed=0.2)
    assert rover.velocities(held(*names).action(rover)) == pytest.approx((speed, turn_rate))


@pytest.mark.parametrize(
    ("names", "motion"), [(("up",), FORWARD), (("down",), BACKWARD), (("left",), LEFT), (("right",), RIGHT)]
)
def test_the_arrows_choose_among_discrete_actions(names, motion):
    assert held(*names).action(TurtleBot(motions=motions_for(0.4))) == motion


def test_a_robot_that_cannot_stand_still_waits_for_a_key():
    assert held().action(TurtleBot()) is None
    environment = halgan_envs.find_pebble(random_state=0)
    cockpit = drive.Cockpit(environment)
    cockpit.tick()
    first = environment.task.robot.pose(environment.physics)
    cockpit.tick()
    np.testing.assert_array_equal(environment.task.robot.pose(environment.physics), first)
    assert len(shown(cockpit)) == 2
    plt.close(cockpit.figure)
    environment.close()


def test_a_robot_without_reverse_gear_stands_still_on_down():
    assert Rover().velocities(held("down").action(Rover())) == (0.0, 0.0)


def test_one_that_can_neither_reverse_nor_stand_still_waits_on_down():
    assert held("down").action(TurtleBot()) is None


def test_a_released_key_drives_no_more():
    keys = held("up", "left")
    keys.release(SimpleNamespace(key="up"))
    keys.release(SimpleNamespace(key="x"))
    assert Rover().velocities(keys.action(Rover())) == pytest.approx((0.0, np.deg2rad(100)))


def test_keys_of_the_figure_move_the_robot_and_the_pictures(stage):
    stage.place((0.0, 0.0, 0.0))
    cockpit = drive.Cockpit(stage.environment)
    canvas = cockpit.figure.canvas
    canvas.callbacks.process("key_press_event", KeyEvent("key_press_event", canvas, "up"))
    cockpit.tick()
    before, first = stage.pose(), shown(cockpit)
    cockpit.tick()
    plt.close(cockpit.figure)
    np.testing.assert_allclose(stage.pose() - before, [0.05, 0.0, 0.0], atol=1e-4)
    assert [image.shape for image in first] == [(64, 64, 3), (240, 320, 3)]
    assert all((one != two).any() for one, two in zip(first, shown(cockpit), strict=True))


def shown(cockpit):
    return [axes.images[0].get_array().data for axes in cockpit.figure.axes]


def test_without_a_display_it_says_so():
    with pytest.raises(RuntimeError, match=r"(?i)'agg' opens no window"):
        drive.main("navigate-2m")
    plt.close("all")
