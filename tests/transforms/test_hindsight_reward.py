import pytest
import torch

from halgan_rl.poses import PlanarPoses
from halgan_rl.transforms import HindsightReward
from tests.transforms.rows import assert_identical, sampled_rows

UNMASKED_AT_GOAL, NOT_THERE, AT_TIME_LIMIT, ROOT_AT_GOAL, THERE, SOLVED = range(6)


def test_reaching_the_goal_adds_to_the_reward_and_terminates() -> None:
    rows = sampled_rows(6)
    after = HindsightReward(success_reward=2.0)(rows)["next"][THERE]
    assert after["reward"].item() == pytest.approx(rows["next", "reward"][THERE].item() + 2.0)
    assert after["terminated"].item()
    assert after["done"].item()
    assert not after["truncated"].item()


def test_reaching_the_goal_at_the_time_limit_terminates_rather_than_truncates() -> None:
    rows = sampled_rows(6)
    assert rows["next", "truncated"][AT_TIME_LIMIT].item()
    after = HindsightReward()(rows)["next"][AT_TIME_LIMIT]
    assert (after["terminated"].item(), after["truncated"].item(), after["done"].item()) == (True, False, True)


@pytest.mark.parametrize("kind", [UNMASKED_AT_GOAL, NOT_THERE, ROOT_AT_GOAL, SOLVED])
def test_every_other_row_stays_as_it_is(kind: int) -> None:
    rows = sampled_rows(6)
    assert_identical(HindsightReward()(rows)[kind], rows[kind])


def test_a_relabelled_row_cut_by_the_time_limit_short_of_its_goal_stays_truncated() -> None:
    rows = sampled_rows(6)
    rows["goal", "pose"][AT_TIME_LIMIT] += 1
    assert HindsightReward()(rows)["next", "truncated"][AT_TIME_LIMIT].item()
    assert not HindsightReward()(rows)["next", "terminated"][AT_TIME_LIMIT].item()


def test_the_tolerance_decides_what_is_near_enough() -> None:
    rows = sampled_rows(6)
    rows["goal", "pose"][THERE, 0] += 0.05
    assert not HindsightReward()(rows)["next", "terminated"][THERE].item()
    assert HindsightReward(poses=PlanarPoses(distance=0.06))(rows)["next", "terminated"][THERE].item()


def test_rewards_and_flags_without_a_trailing_dimension_are_not_broadcast() -> None:
    rows = sampled_rows(6)
    flat = rows.clone()
    for name in ("reward", "done", "terminated", "truncated"):
        flat["next", name] = rows["next", name].squeeze(-1)
    assert torch.equal(HindsightReward()(flat)["next", "reward"], HindsightReward()(rows)["next", "reward"].squeeze(-1))


ENDINGS = ("reward", "done", "terminated", "truncated")


@pytest.mark.parametrize("name", ENDINGS)
def test_an_environment_without_one_of_the_flags_is_refused_when_rows_are_written(name: str) -> None:
    rows = sampled_rows(6).exclude("goal", "hindsight", ("next", name))
    with pytest.raises(KeyError, match=rf"misses the key next\.{name}, set by keys=Keys\({name}='{name}'\)"):
        HindsightReward().inv(rows)


def test_an_environment_without_a_time_limit_learns_the_remedy() -> None:
    with pytest.raises(KeyError, match=r"StepCounter\(max_steps=\.\.\.\), appended to the environment"):
        HindsightReward().inv(sampled_rows(6).exclude(("next", "truncated")))


@pytest.mark.parametrize("name", ENDINGS)
def test_entries_of_another_shape_are_refused_when_rows_are_written(name: str) -> None:
    rows = sampled_rows(6)
    rows["next", name] = rows["next", name].expand(6, 2)
    with pytest.raises(ValueError, match=rf"the entry next\.{name} is .* \(6, 2\); it must hold .* a row, \(6, 1\)"):
        HindsightReward().inv(rows)


@pytest.mark.parametrize("name", ENDINGS[1:])
def test_flags_that_are_no_bools_are_refused_when_rows_are_written(name: str) -> None:
    rows = sampled_rows(6)
    rows["next", name] = rows["next", name].float()
    with pytest.raises(ValueError, match=rf"the entry next\.{name} is torch\.float32 .*bool"):
        HindsightReward().inv(rows)


def test_rows_with_and_without_a_trailing_dimension_may_be_written() -> None:
    rows = sampled_rows(6)
    flat = rows.clone()
    for name in ENDINGS:
        flat["next", name] = rows["next", name].squeeze(-1)
    for each in (rows, flat, rows.reshape(2, 3)):
        assert_identical(HindsightReward().inv(each), each)
