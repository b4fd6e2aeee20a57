import functools
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers import SamplerWithoutReplacement
from torchrl.envs import Compose, SerialEnv

from halgan_rl.keys import Keys
from halgan_rl.poses import PlanarPoses, relative_pose
from halgan_rl.transforms import (
    Annealing,
    DrawHindsightGoal,
    HallucinateGoal,
    Hallucinator,
    HindsightConfig,
    HindsightReward,
    ReplayTransform,
    StampFuturePoses,
    pipelines,
)
from tests import toy
from tests.transforms.rows import (
    NESTED,
    always,
    assert_identical,
    invert,
    leaves,
    random_source,
    rename,
    stamped_by_reference,
)

DISTANCE = 6
NAMED = {"halgan": pipelines.halgan, "her": pipelines.her}
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


def make(
    method: Callable = pipelines.halgan,
    probability: float | Annealing = 1.0,
    *,
    painter: Hallucinator = toy.hallucinate,
    poses: PlanarPoses = PlanarPoses(),
    keys: Keys = Keys(),
    discount: float | None = None,
    **options: object,
) -> pipelines.Hindsight:
    annealing = probability if isinstance(probability, Annealing) else always(probability)
    config = HindsightConfig(annealing, **{"max_distance": DISTANCE, "nearness": 1.0, **options})
    painters = (painter,) if method is pipelines.halgan else ()
    return method(*painters, rng=random_source(), config=config, discount=discount, poses=poses, keys=keys)


def filled(transform: Compose, frames: int = 420, **options: object) -> TensorDictReplayBuffer:
    buffer = buffer_with(transform, **options)
    for batch in collect(frames):
        buffer.extend(batch)
    return buffer


def test_the_parts_come_in_order() -> None:
    stamp, draw, paint, reward = StampFuturePoses, DrawHindsightGoal, HallucinateGoal, HindsightReward
    assert [type(part) for part in make(pipelines.halgan)] == [stamp, draw, paint, reward]
    assert [type(part) for part in make(pipelines.her)] == [stamp, draw, reward]


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
    assert (relabelled["next", "reward"] != plain["next", "reward"])[mask].any()
    assert_identical(*(each.select("pose", "action", "hindsight", ("next", "pose")) for each in (relabelled, plain)))


def test_only_a_pipeline_with_a_painter_changes_images() -> None:
    plain, painted, blind = (filled(each).sample() for each in (make(probability=0.0), make(), make(pipelines.her)))
    mask = painted["goal", "mask"].flatten()
    assert torch.equal(blind["goal", "mask"], painted["goal", "mask"])
    assert (painted["pixels"] != plain["pixels"]).flatten(1).any(1)[mask].float().mean() > 0.9
    assert torch.equal(blind["pixels"], plain["pixels"])
    assert torch.equal(blind["next", "reward"], painted["next", "reward"])


def test_plain_replay_relabels_nothing() -> None:
    pipeline = pipelines.none()
    buffer = buffer_with(pipeline)
    buffer.extend(collect(70, None)[0])
    pipeline.step(100)
    sample = buffer.sample()
    assert (len(pipeline), pipeline.probability, pipeline.hallucinator) == (0, 0.0, None)
    assert pipeline.relabelled(sample).shape == (64, 1)
    assert not pipeline.relabelled(sample).any()


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


def test_a_row_of_several_steps_shows_its_goal_before_the_first_and_after_the_last() -> None:
    sample = filled(make(n_steps=3, discount=0.9)).sample()
    sample = sample[sample["goal", "mask"].flatten()]
    goal, after = sample["goal", "pose"], sample["next"]
    assert (sample["steps_to_next_obs"] == 3).any()
    assert torch.equal(sample["pixels"], toy.render(sample["pose"], goal))
    assert torch.equal(after["pixels"], toy.render(after["pose"], goal))


def paint_what_is_ahead(pixels: Tensor, pose: Tensor, goal_pose: Tensor) -> Tensor:
    """The exact hallucinator for a car that sees nothing beside it or behind."""
    ahead = relative_pose(pose, goal_pose)[..., 0] > 0.5
    return torch.where(ahead[..., None, None, None], toy.hallucinate(pixels, pose, goal_pose), pixels)


@pytest.mark.parametrize("fixed_shape", [False, True])
def test_unseen_goals_leave_no_trace_and_all_seen_ones_are_pursued(fixed_shape: bool) -> None:
    plain = filled(StampFuturePoses(DISTANCE)).sample(2_000)
    drawn, relabelled = (
        filled(make(painter=paint_what_is_ahead, pursue_unseen=unseen, fixed_shape=fixed_shape))
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


def test_no_goal_crosses_an_episode_after_the_ring_has_wrapped() -> None:
    stream = torch.cat(collect(420), dim=1)
    episode = torch.cat([torch.zeros(3, 1), stream["next", "done"].squeeze(-1).cumsum(1)[:, :-1]], 1)
    stream["id"] = torch.stack([torch.arange(3)[:, None].expand(3, 140), episode, torch.arange(140).expand(3, 140)], -1)
    buffer = buffer_with(make(), storage=LazyTensorStorage(100))
    for batch in stream.split(7, dim=1):
        buffer.extend(batch)
    sample = buffer.sample(500)
    sample = sample[sample["goal", "mask"].flatten()]
    for row in sample:
        car, of, time = row["id"].long().tolist()
        ahead = stream["next", "pose"][car, time : time + DISTANCE][episode[car, time : time + DISTANCE] == of]
        assert (ahead == row["goal", "pose"]).all(1).any()
    assert len(sample) > 300


def test_memory_mapped_storage_gives_the_same_rows(tmp_path: Path) -> None:
    mapped = filled(make(), storage=LazyMemmapStorage(1_000, scratch_dir=tmp_path))
    assert_identical(mapped.sample(), filled(make()).sample())


def test_a_sampler_without_replacement_gives_relabelled_rows() -> None:
    sample = filled(make(), sampler=SamplerWithoutReplacement()).sample()
    assert sample["goal", "mask"].any()
    assert sample["next", "terminated"].any()


def test_nested_keys_do_the_same() -> None:
    flat, nested = buffer_with(make()), buffer_with(make(keys=NESTED))
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
    annealing = Annealing(0.9, 0.0, 100)
    buffer = filled(make(probability=annealing))
    buffer._transform.step(30)
    buffer.sample()
    buffer.dumps(tmp_path)
    restored = buffer_with(make(probability=annealing))
    restored.loads(tmp_path)
    assert_identical(restored.sample(), buffer.sample())


def test_options_reach_the_parts() -> None:
    poses, annealing = PlanarPoses(distance=0.2, angle=0.3), Annealing(0.8, 0.1, 50)
    stamp, draw, paint, reward = make(
        probability=annealing,
        nearness=2.0,
        success_reward=3.0,
        success_threshold=0.25,
        max_step=0.75,
        n_steps=2,
        discount=0.9,
        pursue_unseen=False,
        fixed_shape=True,
        poses=poses,
        keys=NESTED,
    )
    assert all(part.keys is NESTED for part in (stamp, draw, paint, reward))
    assert stamp.poses is draw.poses is reward.poses is poses
    assert (stamp.max_distance, stamp.success_threshold, stamp.max_step) == (DISTANCE, 0.25, 0.75)
    assert (stamp.n_steps, stamp.discount) == (reward.n_steps, reward.discount) == (2, 0.9)
    assert (draw.annealing, draw.nearness) == (annealing, 2.0)
    assert (paint.pursue_unseen, paint.fixed_shape) == (False, True)
    assert reward.success_reward == 3.0


def test_defaults_are_those_of_the_parts_unless_others_learn_faster() -> None:
    pipeline = pipelines.halgan(invert, rng=random_source())
    alone = (
        StampFuturePoses(96),
        DrawHindsightGoal(rng=random_source(), nearness=2.0),
        HallucinateGoal(invert),
        HindsightReward(),
    )
    for part, other in zip(pipeline, alone, strict=True):
        assert settings(part) == settings(other)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_distance": 0}, "max_distance must be at least 1 step"),
        ({"n_steps": 0}, "n_steps must be at least 1"),
        ({"max_distance": 3, "n_steps": 4}, "max_distance must be at least .* n_steps=4"),
        ({"nearness": 0.5}, "nearness must be at least 1"),
    ],
)
def test_a_configuration_that_would_fail_later_is_refused(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        HindsightConfig(**options)


def settings(transform: ReplayTransform) -> dict[str, object]:
    """The public attributes that the transform set itself."""
    inherited = vars(ReplayTransform(Keys())).keys() - {"keys"}
    return {
        name: value for name, value in vars(transform).items() if name not in {*inherited, "rng"} and name[0] != "_"
    }


def test_a_pipeline_anneals_itself() -> None:
    pipeline = make(probability=Annealing(0.4, 0.0, 100))
    pipeline.step(25)
    assert pipeline.probability == pytest.approx(0.3)


def test_a_pipeline_says_which_rows_it_relabelled() -> None:
    pipeline = make(probability=0.5, keys=NESTED)
    buffer = buffer_with(pipeline)
    for batch in collect(210):
        buffer.extend(rename(batch))
    sample = buffer.sample()
    mask = pipeline.relabelled(sample)
    assert torch.equal(mask, sample["extras", "goal", "mask"])
    assert 0 < mask.sum() < 64
