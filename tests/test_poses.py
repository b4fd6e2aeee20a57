import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from halgan_rl.poses import PoseTolerance, relative_pose, wrap_angle

METRES = st.floats(-5, 5)
ANGLES = st.floats(-math.pi, math.pi)
POSES = st.tuples(METRES, METRES, ANGLES)


def test_a_goal_due_north_of_a_robot_facing_east_lies_to_its_left() -> None:
    relative = relative_pose(torch.tensor([1.0, 1.0, 0.0]), torch.tensor([1.0, 4.0, 0.5]))
    torch.testing.assert_close(relative, torch.tensor([0.0, 3.0, 0.5]))


def test_a_goal_due_north_of_a_robot_facing_north_lies_ahead() -> None:
    relative = relative_pose(torch.tensor([1.0, 1.0, math.pi / 2]), torch.tensor([1.0, 4.0, math.pi / 2 - 0.2]))
    torch.testing.assert_close(relative, torch.tensor([3.0, 0.0, -0.2]), atol=1e-6, rtol=0)


def test_the_yaw_difference_takes_the_short_way_round() -> None:
    relative = relative_pose(torch.tensor([0.0, 0.0, 3.0]), torch.tensor([0.0, 0.0, -3.0]))
    torch.testing.assert_close(relative[2], torch.tensor(2 * math.pi - 6.0))


@given(POSES, POSES)
def test_walking_along_the_relative_pose_arrives_at_the_goal(pose: tuple, goal: tuple) -> None:
    ahead, left, turn = relative_pose(torch.tensor(pose).double(), torch.tensor(goal).double()).tolist()
    x, y, yaw = pose
    assert x + ahead * math.cos(yaw) - left * math.sin(yaw) == pytest.approx(goal[0], abs=1e-4)
    assert y + ahead * math.sin(yaw) + left * math.cos(yaw) == pytest.approx(goal[1], abs=1e-4)
    assert math.cos(yaw + turn) == pytest.approx(math.cos(goal[2]), abs=1e-4)
    assert math.sin(yaw + turn) == pytest.approx(math.sin(goal[2]), abs=1e-4)


@given(st.floats(-50, 50))
def test_angles_are_wrapped_to_one_turn(angle: float) -> None:
    wrapped = wrap_angle(torch.tensor(angle, dtype=torch.float64)).item()
    assert -math.pi <= wrapped <= math.pi
    assert math.cos(wrapped - angle) == pytest.approx(1.0)


def test_half_a_turn_is_wrapped_to_plus_pi() -> None:
    wrapped = wrap_angle(torch.tensor([math.pi, -math.pi], dtype=torch.float64))
    torch.testing.assert_close(wrapped, torch.full((2,), math.pi, dtype=torch.float64))


def test_one_goal_broadcasts_over_the_frames_of_a_row() -> None:
    pose, goal = torch.rand(5, 2, 4), torch.rand(5, 1, 4)
    relative = relative_pose(pose, goal)
    assert relative.shape == (5, 2, 3)
    torch.testing.assert_close(relative[3, 1], relative_pose(pose[3, 1], goal[3, 0]))


@pytest.mark.parametrize(
    ("offset", "reached"),
    [
        ([0.0, 0.0, 0.0], True),
        ([0.009, 0.0, 0.09], True),
        ([0.011, 0.0, 0.0], False),
        ([0.008, 0.008, 0.0], False),
        ([0.0, 0.0, 0.11], False),
        ([0.0, 0.0, -0.11], False),
        ([0.0, 0.0, 2 * math.pi - 0.05], True),
    ],
)
def test_the_default_tolerance_is_the_papers(offset: list[float], reached: bool) -> None:
    pose = torch.tensor([0.5, -0.25, 1.0])
    assert PoseTolerance()(pose, pose + torch.tensor(offset)).item() is reached


def test_task_flags_do_not_keep_a_goal_from_being_reached() -> None:
    assert PoseTolerance()(torch.tensor([0.0, 0.0, 0.0, 1.0]), torch.zeros(4)).item()


@pytest.mark.parametrize("name", ["distance", "angle"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan])
def test_a_tolerance_that_nothing_meets_is_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{name} must be positive, got {value}"):
        PoseTolerance(**{name: value})


@pytest.mark.parametrize(("name", "poses"), [("pose", (2, 3)), ("goal_pose", (3, 2))])
def test_a_pose_without_yaw_is_refused(name: str, poses: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match=rf"^{name} has shape \(7, 2\)"):
        relative_pose(torch.zeros(7, poses[0]), torch.zeros(7, poses[1]))
