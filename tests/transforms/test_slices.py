"""Samplers of slices: TorchRL's own, over buffers in which episodes end by success and by their time limit."""

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer
from torchrl.data.replay_buffers import RandomSampler, SamplerWithoutReplacement, SliceSampler

from halgan_rl.poses import PlanarPoses
from halgan_rl.transforms import (
    DrawHindsightGoal,
    HallucinateGoal,
    HindsightConfig,
    HindsightReward,
    StampFuturePoses,
    pipelines,
)
from tests.transforms.rows import always, random_source

DISTANCE, LENGTH = 6, 8
EPISODES = [11, 20, 9, 1, 14, 30, 8, 40, 25, 10]


def episode(number: int, length: int) -> TensorDict:
    """Rows ``[length]`` of a robot that drives along x; every third episode ends by success."""
    time = torch.arange(length + 1.0)
    pose = torch.stack([0.1 * time + 50 * number, -0.01 * time, torch.zeros(length + 1)], 1)
    end, none = torch.arange(length)[:, None] == length - 1, torch.zeros(length, 1, dtype=torch.bool)
    solved = number % 3 == 0
    following = {
        "pixels": torch.full((length, 4, 5, 3), 100, dtype=torch.uint8),
        "pose": pose[1:],
        "reward": end.float() * solved,
        "done": end,
        "terminated": end if solved else none,
        "truncated": none if solved else end,
    }
    rows = {"pixels": torch.full((length, 4, 5, 3), 50, dtype=torch.uint8), "pose": pose[:-1], "is_init": none}
    return TensorDict({**rows, "next": following}, batch_size=[length])


def paint_goal(pixels: torch.Tensor, pose: torch.Tensor, goal_pose: torch.Tensor) -> torch.Tensor:
    """Writes the goal's place into the images, so that two goals look different."""
    x = (10 * goal_pose[..., 0]).round().long()
    digits = torch.stack([x // 256 % 256, x % 256, torch.full_like(x, 7)], -1).to(torch.uint8)
    return digits[..., None, None, :].expand_as(pixels)


def pipeline(*, probability: float = 1.0, per_slice: bool = True) -> pipelines.Hindsight:
    return pipelines.Hindsight(
        StampFuturePoses(DISTANCE),
        DrawHindsightGoal(always(probability), rng=random_source(), per_slice=per_slice),
        HallucinateGoal(paint_goal),
        HindsightReward(),
    )


def slices(length: int | None = LENGTH, **options: object) -> SliceSampler:
    options = {"slice_len": length, "end_key": ("next", "done"), "truncated_key": None, "init_key": None, **options}
    return SliceSampler(**options)


def filled(
    transform: pipelines.Hindsight, sampler: object, batch_size: int = 16 * LENGTH, kind: type = TensorDictReplayBuffer
) -> ReplayBuffer:
    buffer = kind(
        storage=LazyTensorStorage(500),
        transform=transform,
        sampler=sampler,
        batch_size=batch_size,
        generator=random_source(3),
    )
    torch.manual_seed(0)  # of the sampler of slices
    for number, length in enumerate(EPISODES):
        buffer.extend(episode(number, length))
    return buffer


def goals_of(rows: TensorDictBase) -> set[tuple]:
    return {tuple(goal) for goal in rows["goal", "pose"][rows["goal", "mask"].flatten()].tolist()}


def test_all_frames_of_a_slice_show_one_goal() -> None:
    sample = filled(pipeline(), slices()).sample().reshape(-1, LENGTH)
    assert len(sample) == 16
    assert sum(len(goals_of(each)) == 1 for each in sample) > 8
    assert all(len(goals_of(each)) <= 1 for each in sample)
    for each in sample:
        seen = each["next", "pixels"][:-1][each["goal", "mask"].flatten()[1:]]
        shown = each["pixels"][1:][each["goal", "mask"].flatten()[1:]]
        assert torch.equal(seen, shown)  # the same frame twice, painted alike


def test_goals_of_slices_are_later_poses_of_their_own_failed_episode() -> None:
    sample = filled(pipeline(), slices()).sample().reshape(-1, LENGTH)
    ends = torch.tensor([length - (number % 3 == 0) for number, length in enumerate(EPISODES)])
    for each in sample:
        for x, _, _ in goals_of(each):
            number, start = round(x) // 50, each["pose"][0, 0].item()
            assert round(start) // 50 == number
            assert 0 < round(10 * (x - start)) <= DISTANCE
            assert round(10 * (x - 50 * number)) <= ends[number]


def test_a_slice_is_relabelled_up_to_the_row_that_reaches_its_goal() -> None:
    sample = filled(pipeline(), slices()).sample().reshape(-1, LENGTH)
    plain = filled(pipeline(probability=0.0), slices()).sample().reshape(-1, LENGTH)
    met = 0
    for each, before in zip(sample, plain, strict=True):
        mask = each["goal", "mask"].flatten()
        count = int(mask.sum())
        assert mask.tolist() == [True] * count + [False] * (LENGTH - count)
        reached = PlanarPoses().reached(each["next", "pose"], each["goal", "pose"])
        assert reached.nonzero().flatten().tolist() in ([], [count - 1])
        assert torch.equal(each["next", "terminated"][:count].flatten(), reached[:count])
        assert torch.equal(each["next", "reward"][:count], before["next", "reward"][:count] + reached[:count, None])
        for key in ("pixels", ("next", "pixels"), ("next", "reward"), ("next", "done")):
            assert torch.equal(each[key][count:], before[key][count:])
        met += int(reached.any())
    assert met > 8


def test_a_sequence_starts_anew_at_each_slice_and_behind_each_goal() -> None:
    sample = filled(pipeline(), slices()).sample()
    mask, first = sample["goal", "mask"].flatten(), torch.arange(16 * LENGTH) % LENGTH == 0
    behind = torch.cat([first[:1] & False, mask[:-1] & ~mask[1:]]) & ~first
    assert behind.any()
    assert torch.equal(sample["is_init"].flatten(), first | behind)


def test_slices_of_different_lengths_get_one_goal_each() -> None:
    sample = filled(pipeline(), slices(16, strict_length=False), batch_size=64).sample()
    starts = (sample["pose"][1:] != sample["next", "pose"][:-1]).any(1).nonzero().flatten() + 1
    lengths = torch.diff(starts, prepend=torch.tensor([0]), append=torch.tensor([len(sample)]))
    assert len(lengths.unique()) > 1
    several = [goals_of(each) for each in sample.split(lengths.tolist())]
    assert all(len(each) <= 1 for each in several)
    assert sum(len(each) for each in several) > 3


def test_whole_slices_are_relabelled_at_the_given_rate() -> None:
    sample = filled(pipeline(probability=0.5), slices(), batch_size=400 * LENGTH).sample().reshape(-1, LENGTH)
    first = sample["goal", "mask"][:, 0]
    assert first.float().mean().item() == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("length", [2, 4, LENGTH])
def test_slices_are_refused_where_every_row_gets_its_own_goal(length: int) -> None:
    buffer = filled(pipeline(per_slice=False), slices(length), batch_size=64)
    with pytest.raises(ValueError, match=r"of 64 rows follow .*per_slice=True.*truncated_key=None, init_key=None"):
        buffer.sample()


@pytest.mark.parametrize("rows", [3, 10, 30])
@pytest.mark.parametrize("batch_size", [2, 16, 64])
@pytest.mark.parametrize("sampler", [RandomSampler, SamplerWithoutReplacement])
def test_random_rows_of_tiny_buffers_are_not_refused(rows: int, batch_size: int, sampler: type) -> None:
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(rows),
        transform=pipeline(per_slice=False),
        sampler=sampler(),
        batch_size=batch_size,
        generator=random_source(),
    )
    buffer.extend(episode(1, rows))
    for _ in range(100):
        buffer.sample()


def test_stored_rows_may_be_read_in_their_order() -> None:
    buffer = filled(pipeline(per_slice=False), RandomSampler())
    assert len(buffer[:]) == len(buffer[:60]) + len(buffer[60:]) == sum(EPISODES)


@pytest.mark.parametrize("name", ["truncated_key", "init_key"])
def test_a_sampler_that_overwrites_flags_is_refused_with_the_remedy(name: str) -> None:
    key = {"truncated_key": ("next", "truncated"), "init_key": "is_init"}[name]
    buffer = filled(pipeline(), slices(**{name: key}))
    with pytest.raises(ValueError, match=rf"SliceSampler\({name}=.*overwrites flags .*{name}=None"):
        pipelines.check_sampler(buffer)


def test_a_sampler_that_keeps_truncated_key_undoes_terminations_in_hindsight() -> None:
    """What the check is for."""
    sample = filled(pipeline(), slices(truncated_key=("next", "truncated"))).sample()
    rewarded = sample["next", "reward"] > 0
    assert not sample["next", "terminated"][rewarded & sample["goal", "mask"]].any()


def test_slices_without_a_goal_a_slice_are_refused_before_the_first_sample() -> None:
    with pytest.raises(ValueError, match=r"gives slices.*DrawHindsightGoal\(per_slice=True\)"):
        pipelines.check_sampler(filled(pipeline(per_slice=False), slices()))


@pytest.mark.parametrize(
    ("transform", "sampler"),
    [
        (pipeline(), slices()),
        (pipeline(per_slice=False), RandomSampler()),
        (pipelines.none(), SliceSampler(slice_len=LENGTH)),
        (pipelines.her(rng=random_source(), config=HindsightConfig(max_distance=3)), SamplerWithoutReplacement()),
    ],
    ids=["slices", "rows", "plain slices", "without replacement"],
)
def test_samplers_that_go_together_with_their_hindsight_pass(transform: pipelines.Hindsight, sampler: object) -> None:
    pipelines.check_sampler(
        TensorDictReplayBuffer(storage=LazyTensorStorage(9), transform=transform, sampler=sampler, batch_size=8)
    )


def test_a_goal_a_slice_needs_rows_at_their_goal_to_be_skipped() -> None:
    with pytest.raises(ValueError, match="per_slice=True needs skip_reached=True"):
        DrawHindsightGoal(rng=random_source(), per_slice=True, skip_reached=False)
