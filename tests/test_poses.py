import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from halgan_rl.poses import PlanarPoses, relative_pose, wrap_angle

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
    assert PlanarPoses().reached(pose, pose + torch.tensor(offset)).item() is reached


def test_task_flags_do_not_keep_a_goal_from_being_reached() -> None:
    assert PlanarPoses().reached(torch.tensor([0.0, 0.0, 0.0, 1.0]), torch.zeros(4)).item()


@pytest.mark.parametrize("name", ["distance", "angle"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan])
def test_a_tolerance_that_nothing_meets_is_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{name} must be positive, got {value}"):
        PlanarPoses(**{name: value})


def held(*flags: str, **options: object) -> PlanarPoses:
    return PlanarPoses(flags=flags or ("held",), **options)


def test_poses_of_the_right_size_and_flags_pass() -> None:
    held("held", "open").check(torch.tensor([[0.3, -7.0, 9.0, 0.0, 1.0], [2.0, 0.0, -1.0, 1.0, 1.0]]), "pose")


@pytest.mark.parametrize(
    "pose",
    [torch.zeros(7, 2), torch.zeros(7, 4), torch.zeros(7, 3, dtype=torch.int64), torch.tensor(1.0)],
    ids=["without yaw", "with an unnamed flag", "integers", "a number"],
)
def test_another_size_or_dtype_is_refused_with_the_remedy(pose: torch.Tensor) -> None:
    with pytest.raises(ValueError, match=rf"^next\.pose is {pose.dtype} .*3 floats: x \[m\], y \[m\], yaw .*flags="):
        PlanarPoses().check(pose, "next.pose")


@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_a_pose_that_is_not_finite_is_refused(number: float) -> None:
    poses = torch.arange(6.0).reshape(2, 3)
    poses[1, 2] = number
    with pytest.raises(ValueError, match=rf"^pose is not finite: \[3\.0, 4\.0, {number}\]"):
        PlanarPoses().check(poses, "pose")


@pytest.mark.parametrize("entry", [0.5, -1.0, 2.0])
def test_a_flag_that_is_neither_0_nor_1_is_refused_with_the_remedy(entry: float) -> None:
    poses = torch.tensor([[0.0, 1.0, 2.0, 1.0], [3.0, 4.0, 5.0, entry]])
    with pytest.raises(ValueError, match=rf"\[3\.0, 4\.0, 5\.0, {entry}\], but its flags \(held\).*another key"):
        held().check(poses, "pose")


def test_the_first_flag_is_the_lowest_bit_of_the_setting() -> None:
    flags = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    assert held("held", "open").setting(torch.cat([torch.rand(4, 3), flags], 1)).tolist() == [0, 1, 2, 3]


def test_a_stage_ends_where_a_flag_changes_and_only_there() -> None:
    before = torch.tensor([[0.0, 1.0, 2.0, 1.0, 0.0]]).expand(3, 5)
    after = before + torch.tensor([[5.0, 5.0, 5.0, 0.0, 0.0], [0.0, 0.0, 0.0, -1.0, 0.0], [0.0, 0.0, 0.0, 0.0, 1.0]])
    assert held("held", "open").stage_changed(before, after).tolist() == [False, True, True]


def test_the_goal_stands_ahead_of_the_goal_pose_as_far_as_the_flags_say() -> None:
    poses = held(goal_offsets=(0.25, 0.5))
    here = torch.tensor([[9.0, 9.0, 9.0, 0.0], [9.0, 9.0, 9.0, 1.0]])
    there = torch.tensor([1.0, 2.0, math.pi / 2, 0.0])
    torch.testing.assert_close(poses.goal_position(here, there), torch.tensor([[1.0, 2.25], [1.0, 2.5]]))


def test_bearing_is_positive_to_the_left() -> None:
    here, there = torch.tensor([1.0, 1.0, math.pi / 2]), torch.tensor([-1.0, 1.0, math.pi])
    polar = PlanarPoses(goal_offsets=(1.0,)).goal_polar(here, there)
    torch.testing.assert_close(polar, torch.tensor([math.pi / 2, 3.0]))


@pytest.mark.parametrize("goal_offsets", [(), (0.1, -0.1)])
def test_a_goal_behind_its_pose_or_nowhere_is_refused(goal_offsets: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="must not be negative"):
        held(goal_offsets=goal_offsets)


def test_offsets_for_other_settings_than_the_flags_have_are_refused() -> None:
    with pytest.raises(ValueError, match=r"has 3 entries, but the flags \('held',\) have 2 settings"):
        held(goal_offsets=(0.1, 0.2, 0.3))
