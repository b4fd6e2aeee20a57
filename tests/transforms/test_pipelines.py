import functools
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers import SamplerWithoutReplacement, SliceSampler
from torchrl.envs import Compose, SerialEnv

from halgan_rl.poses import PoseTolerance, relative_pose
from halgan_rl.transforms import DrawHindsightGoal, HallucinateGoal, HindsightReward, StampFuturePoses, pipelines
from tests import toy
from tests.transforms.rows import RENAMED, assert_identical, invert, leaves, random_source, rename, stamped_by_reference

DISTANCE = 6
NAMED = {"halgan": pipelines.halgan, "oracle": pipelines.oracle}
EVERY = pytest.mark.parametrize("pipeline", NAMED.values(), ids=NAMED.keys())


@functools.cache
def collect(frames: int, count: int | None = 3, length: int = 7, seed: int = 0) -> list[TensorDictBase]:
    """Batches from a real collector with a random policy; 7 steps at a time split the episodes of 18."""
    torch.manual_seed(seed)
    environment = toy.Parking(count, seed=seed)
    collector = Collector(environment, None, frames_per_batch=length * (count or 1), total_frames=frames)
    batches = [batch.exclude("collector") for batch in collector]
    collector.shutdown()
    return batches


def buffer_with(transform: Compose | StampFuturePoses, **options: object) -> TensorDictReplayBuffer:
    options = {"storage": LazyTensorStorage(1_000), "batch_size": 64, **options}
    return TensorDictReplayBuffer(transform=transform, generator=random_source(7), **options)


def make(pipeline: Callable = pipelines.halgan, probability: float = 1.0, **options: object) -> Compose:
    return pipeline(
        toy.hallucinate, generator=random_source(), probability=probability, max_distance=DISTANCE, **options
    )


def filled(transform: Compose, frames: int = 420, **options: object) -> TensorDictReplayBuffer:
    buffer = buffer_with(transform, **options)
    for batch in collect(frames):
        buffer.extend(batch)
    return buffer


@EVERY
def test_the_parts_come_in_order(pipeline: Callable) -> None:
    parts = [StampFuturePoses, DrawHindsightGoal, HallucinateGoal, HindsightReward]
    assert [type(part) for part in make(pipeline)] == parts


@EVERY
def test_probability_zero_is_the_identity_bit_for_bit(pipeline: Callable) -> None:
    plain = filled(StampFuturePoses(DISTANCE))
    relabelling = filled(make(pipeline, probability=0.0))
    for _ in range(5):
        assert_identical(relabelling.sample().exclude("goal"), plain.sample())


@EVERY
def test_unmasked_rows_are_untouched_and_masked_ones_are_not(pipeline: Callable) -> None:
    plain, relabelled = filled(StampFuturePoses(DISTANCE)).sample(), filled(make(pipeline, probability=0.5)).sample()
    mask = relabelled["goal", "mask"].flatten()
    assert 10 < mask.sum() < 54
    assert_identical(relabelled[~mask].exclude("goal"), plain[~mask])
    changed = relabelled["pixels"] != plain["pixels"]
    assert changed.flatten(1).any(1)[mask].float().mean() > 0.9
    assert_identical(*(each.select("pose", "action", "hindsight", ("next", "pose")) for each in (relabelled, plain)))


def test_a_relabelled_row_shows_and_rewards_its_goal() -> None:
    sample = filled(make()).sample()
    for row in sample[sample["goal", "mask"].flatten()]:
        goal, after = row["goal", "pose"], row["next"]
        assert torch.equal(row["pixels"], toy.render(row["pose"], goal))
        assert torch.equal(after["pixels"], toy.render(after["pose"], goal))
        reached = torch.equal(after["pixels"], toy.render(goal, goal))
        assert (after["reward"].item(), after["terminated"].item()) == (float(reached), reached)
        assert after["done"].item() == (reached or after["truncated"].item())
    assert sample["next", "terminated"].sum() > 3


def paint_what_is_ahead(pixels: Tensor, pose: Tensor, goal_pose: Tensor) -> Tensor:
    """The exact hallucinator for a car that sees nothing beside it or behind."""
    ahead = relative_pose(pose, goal_pose)[..., 0] > 0.5
    return torch.where(ahead[..., None, None, None], toy.hallucinate(pixels, pose, goal_pose), pixels)


@pytest.mark.parametrize("fixed_shape", [False, True])
def test_unseen_goals_leave_no_trace_and_all_seen_ones_are_pursued(fixed_shape: bool) -> None:
    plain = filled(StampFuturePoses(DISTANCE)).sample(2_000)
    options = {"max_distance": DISTANCE, "probability": 1.0, "fixed_shape": fixed_shape}
    drawn, relabelled = (
        filled(pipelines.halgan(paint_what_is_ahead, generator=random_source(), pursue_unseen=unseen, **options))
        for unseen in (True, False)
    )
    drawn, relabelled = drawn.sample(2_000)["goal"], relabelled.sample(2_000)
    seen = drawn["mask"] & (relative_pose(plain["pose"], drawn["pose"])[:, :1] > 0.5)
    assert torch.equal(relabelled["goal", "mask"], seen)
    assert 200 < seen.sum() < drawn["mask"].sum() - 200
    assert_identical(relabelled[~seen.flatten()].exclude("goal"), plain[~seen.flatten()])
    assert relabelled["next", "terminated"][seen].any()


def test_rows_from_a_collector_hold_their_own_futures() -> None:
    stream = torch.cat(collect(420), dim=1)
    stream["id"] = torch.arange(420).reshape(3, 140, 1)
    stamp = StampFuturePoses(DISTANCE)
    out = [each for each in (*map(stamp.inv, stream.split(7, dim=1)), stamp.flush()) if each is not None]
    stamped = torch.cat(out)
    stamped = stamped[stamped["id"].flatten().argsort()]
    assert stream["next", "done"].sum() >= 3 * 7
    assert_identical(stamped, torch.cat([stamped_by_reference(each, DISTANCE) for each in stream]))


@pytest.mark.parametrize("count", [None, 1, 3])
def test_one_and_several_environments_are_taken_from_a_collector(count: int | None) -> None:
    buffer = buffer_with(make())
    for batch in collect(210, count):
        buffer.extend(batch)
    rest = buffer._transform[0].flush()
    assert len(buffer) + (0 if rest is None else len(rest)) == 210


def test_a_batch_of_separate_environments_is_taken_too() -> None:
    environment = SerialEnv(2, [lambda: toy.Parking(seed=1), lambda: toy.Parking(seed=2)])
    environment.set_seed(0)
    rows = environment.rollout(25, break_when_any_done=False)
    buffer = buffer_with(make())
    buffer.extend(rows)
    assert len(buffer) == 2 * (25 - DISTANCE + 1)


def test_prefetched_batches_are_relabelled_without_gradients() -> None:
    buffer = filled(make(), prefetch=2)
    for _ in range(4):
        sample = buffer.sample()
        assert sample["goal", "mask"].float().mean() > 0.8
        assert all(value.grad_fn is None for value in leaves(sample).values())
        mask = sample["goal", "mask"].flatten()
        assert torch.equal(sample["pixels"][mask], toy.render(sample["pose"], sample["goal", "pose"])[mask])


def test_memory_mapped_storage_gives_the_same_rows(tmp_path: Path) -> None:
    mapped = filled(make(), storage=LazyMemmapStorage(1_000, scratch_dir=tmp_path))
    assert_identical(mapped.sample(), filled(make()).sample())


def test_a_sampler_without_replacement_gives_relabelled_rows() -> None:
    sample = filled(make(), sampler=SamplerWithoutReplacement()).sample()
    assert sample["goal", "mask"].any()
    assert sample["next", "terminated"].any()


def test_slices_are_relabelled_row_by_row() -> None:
    sampler = SliceSampler(num_slices=8, end_key=("next", "done"), truncated_key=None)
    sample = filled(make(), sampler=sampler).sample()
    reached = PoseTolerance()(sample["next", "pose"], sample["goal", "pose"])[:, None] & sample["goal", "mask"]
    assert reached.any()
    assert sample["next", "terminated"][reached].all()


def test_nested_keys_do_the_same() -> None:
    keys = {f"{name}_key": key for name, key in RENAMED.items()}
    flat, nested = buffer_with(make()), buffer_with(make(**keys))
    for batch in collect(210):
        flat.extend(batch)
        nested.extend(rename(batch))
    assert_identical(nested.sample().exclude("index"), rename(flat.sample().exclude("index")))


def test_both_paths_of_hallucination_give_equal_samples() -> None:
    assert_identical(filled(make(probability=0.5, fixed_shape=True)).sample(), filled(make(probability=0.5)).sample())


def test_the_same_seeds_give_the_same_samples_whatever_the_global_seed() -> None:
    first, second = filled(make(probability=0.5)), filled(make(probability=0.5))
    samples = []
    for buffer, seed in ((first, 1), (second, 2)):
        torch.manual_seed(seed)
        samples.append([buffer.sample() for _ in range(3)])
    for one, other in zip(*samples, strict=True):
        assert_identical(one, other)


def test_a_checkpoint_resumes_with_the_same_samples(tmp_path: Path) -> None:
    buffer = filled(make(probability=0.9, annealing_steps=100))
    buffer._transform[1].step(30)
    buffer.sample()
    buffer.dumps(tmp_path)
    restored = buffer_with(make(probability=0.9, annealing_steps=100))
    restored.loads(tmp_path)
    assert_identical(restored.sample(), buffer.sample())


def test_options_reach_the_parts() -> None:
    tolerance = PoseTolerance(0.2, 0.3)
    pipeline = make(
        probability=0.8,
        final_probability=0.1,
        annealing_steps=50,
        tolerance=tolerance,
        success_reward=3.0,
        pursue_unseen=False,
        fixed_shape=True,
    )
    stamp, draw, paint, reward = pipeline
    assert stamp.max_distance == DISTANCE
    assert (draw.probability.item(), draw.final_probability, draw.annealing_steps) == (pytest.approx(0.8), 0.1, 50)
    assert (draw.tolerance, reward.tolerance, reward.success_reward) == (tolerance, tolerance, 3.0)
    assert not paint.pursue_unseen
    assert paint.fixed_shape


def test_defaults_are_those_of_the_parts() -> None:
    stamp, draw, paint, reward = pipelines.halgan(invert, generator=random_source())
    alone = DrawHindsightGoal(generator=random_source())
    for name in ("initial_probability", "final_probability", "annealing_steps", "tolerance"):
        assert getattr(draw, name) == getattr(alone, name)
    names = ("max_distance", "pursue_unseen", "fixed_shape", "success_reward", "tolerance")
    for part, other in ((stamp, StampFuturePoses()), (paint, HallucinateGoal(invert)), (reward, HindsightReward())):
        for name, value in vars(other).items():
            if name.endswith("_key") or name in names:
                assert getattr(part, name) == value


@EVERY
def test_an_unknown_option_is_named(pipeline: Callable) -> None:
    with pytest.raises(TypeError, match="'probabilty'"):
        pipeline(invert, generator=random_source(), probabilty=0.3)
