from dataclasses import FrozenInstanceError

import pytest

from halgan_rl.keys import Keys, dotted, next_key

NESTED = Keys(pose=("robot", "pose"), hindsight=("extras", "future"), goal=("extras", "goal"))


@pytest.mark.parametrize(("key", "following"), [("pose", ("next", "pose")), (("a", "b"), ("next", "a", "b"))])
def test_one_step_later_stands_under_next(key: object, following: tuple[str, ...]) -> None:
    assert next_key(key) == following


def test_fields_are_found_by_name_one_step_later() -> None:
    assert NESTED.next("pose") == ("next", "robot", "pose")


def test_keys_within_hindsight_and_goal_follow_their_fields() -> None:
    assert NESTED.hindsight_pose == ("extras", "future", "pose")
    assert NESTED.hindsight_horizon == ("extras", "future", "horizon")
    assert NESTED.goal_mask == ("extras", "goal", "mask")
    assert NESTED.goal_pose == ("extras", "goal", "pose")


@pytest.mark.parametrize(("key", "written"), [("pose", "pose"), (("next", "robot", "pose"), "next.robot.pose")])
def test_people_read_keys_with_dots(key: object, written: str) -> None:
    assert dotted(key) == written


def test_keys_are_equal_by_value_and_cannot_be_changed() -> None:
    assert Keys(pose=("robot", "pose")) == Keys(pose=("robot", "pose")) != Keys()
    with pytest.raises(FrozenInstanceError):
        Keys().pose = "position"  # type: ignore[misc]
