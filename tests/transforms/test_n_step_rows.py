"""Rows that span several steps, against a plain-Python reference."""

from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, MultiStepTransform

from halgan_rl.keys import Keys
from halgan_rl.replay.frame_storage import FrameStorage
from halgan_rl.transforms import StampFuturePoses
from tests import toy
from tests.transforms.rows import NESTED, assert_identical, random_source, rename, stamped_by_reference
from tests.transforms.test_stamp_future_poses import (
    ENDS,
    REWARDED,
    SOLVED,
    STEP,
    TERMINATED,
    TRUNCATED,
    Environment,
    batches,
    rows,
    stamping,
)

DISCOUNT = 0.75
"""Powers of it are exact."""


def n_step_by_reference(stream: TensorDictBase, distance: int, n_steps: int) -> TensorDictBase:
    """The reference, in plain Python: all rows ``[T]`` of one environment, with hindsight, each spanning n steps."""
    last = stream["next", "done"].flatten().tolist()
    reward = stream["next", "reward"].flatten().tolist()
    spanned = []
    for start, row in enumerate(stamped_by_reference(stream, distance)):
        rewards = [reward[start]]
        while len(rewards) < n_steps and start + len(rewards) < len(stream) and not last[start + len(rewards) - 1]:
            rewards.append(reward[start + len(rewards)])
        steps = len(rewards)
        row = row.clone()
        row["next"] = stream[start + steps - 1]["next"].clone()
        row["next", "reward"] = torch.tensor([sum(DISCOUNT**k * r for k, r in enumerate(rewards))])
        row["hindsight", "reward"] = torch.tensor(rewards + [0.0] * (n_steps - steps))
        row["steps_to_next_obs"] = torch.tensor(steps)
        spanned.append(row)
    return torch.stack(spanned)


def spanning(distance: int, n_steps: int, **options: object) -> StampFuturePoses:
    return stamping(distance, n_steps=n_steps, discount=DISCOUNT, **options)


def test_a_row_spans_steps_up_to_its_episodes_end() -> None:
    out = spanning(4, 3).inv(rows(STEP, REWARDED, STEP, STEP, SOLVED))
    assert out["steps_to_next_obs"].tolist() == [3, 3, 3, 2, 1]
    assert (out["next", "pose"][:, 2] * 100).round().int().tolist() == [3, 4, 5, 5, 5]
    assert out["next", "reward"].flatten().tolist() == [
        -0.5 + 0.75 - 0.5 * 0.75**2,
        1 - 0.5 * 0.75 - 0.5 * 0.75**2,
        -0.5 - 0.5 * 0.75 + 0.75**2,
        -0.5 + 0.75,
        1,
    ]
    assert out["hindsight", "reward"].tolist() == [
        [-0.5, 1, -0.5],
        [1, -0.5, -0.5],
        [-0.5, -0.5, 1],
        [-0.5, 1, 0],
        [1, 0, 0],
    ]
    assert out["hindsight", "reward"].dtype == torch.float32
    assert out["steps_to_next_obs"].dtype == torch.int64


@pytest.mark.parametrize("end", ENDS)
def test_a_row_ends_as_the_last_of_its_steps_ends(end: str) -> None:
    out = spanning(4, 3).inv(rows(STEP, STEP, STEP, STEP, end))["next"]
    for flag, is_set in (("done", True), ("terminated", end != TRUNCATED), ("truncated", end == TRUNCATED)):
        assert out[flag].flatten().tolist() == [False, False, is_set, is_set, is_set]


def test_one_step_is_what_it_is_without() -> None:
    stream = rows(STEP, REWARDED, STEP, TRUNCATED)
    assert_identical(stamping(3, n_steps=1, discount=0.5).inv(stream), stamping(3).inv(stream))


@settings(max_examples=40, deadline=None)
@given(batches(), st.integers(2, 5), st.integers(0, 3))
def test_any_stream_in_any_batches_spans_steps_like_the_reference(
    batches: list[TensorDict], n_steps: int, slack: int
) -> None:
    distance = n_steps + slack
    stamp = spanning(distance, n_steps)
    out = [each for each in (*map(stamp.inv, batches), stamp.flush()) if each is not None]
    stream = torch.cat(batches, dim=1)
    for environment in stream:
        mine = torch.cat([each[each["id"][:, 0] // 1000 == environment["id"][0] // 1000] for each in out])
        assert_identical(mine, n_step_by_reference(environment, distance, n_steps))


@pytest.mark.parametrize("count", [None, 3])
def test_a_collectors_rows_span_steps_in_a_frame_storage(count: int | None) -> None:
    seen: list[TensorDictBase] = []
    stamp = StampFuturePoses(6, n_steps=4, discount=DISCOUNT)
    buffer = TensorDictReplayBuffer(storage=FrameStorage(400), transform=stamp, batch_size=64)
    torch.manual_seed(0)
    environment = toy.Parking(count, seed=3)
    collector = Collector(environment, None, frames_per_batch=21, total_frames=210, replay_buffer=buffer)
    collector.post_collect_hook = lambda batch: seen.append(batch.exclude("collector").clone())
    for _ in collector:
        pass
    collector.shutdown()
    buffer.extend(stamp.flush())
    stream = torch.cat(seen, dim=-1).reshape(count or 1, -1)
    kept = buffer.storage[:].exclude("index", "collector")
    expected = torch.cat([n_step_by_reference(each, 6, 4) for each in stream])
    for reference in expected:
        same = (kept["pose"] == reference["pose"]).all(1) & (kept["action"] == reference["action"])
        assert any(
            all(torch.equal(row[key], reference[key]) for key in reference.keys(True, True)) for row in kept[same]
        )
    assert len(kept) == len(expected) == 210
    assert buffer.storage.frames_kept <= 210 + 10 + int(stream["next", "done"].sum())


def test_rows_held_back_survive_a_checkpoint(tmp_path: Path) -> None:
    def make() -> TensorDictReplayBuffer:
        return TensorDictReplayBuffer(storage=LazyTensorStorage(20), transform=spanning(4, 3), batch_size=2)

    environment, buffer, restored = Environment(), make(), make()
    buffer.extend(rows(STEP, STEP, STEP, REWARDED, STEP, environment=environment))
    buffer.dumps(tmp_path)
    restored.loads(tmp_path)
    rest = rows(STEP, TERMINATED, environment=environment)
    for each in (buffer, restored):
        each.extend(rest.clone())
    assert len(restored) == 7
    assert_identical(restored[:], buffer[:])


def test_nested_keys_work() -> None:
    stream = rows(STEP, REWARDED, STEP, STEP, SOLVED)
    plain, nested = spanning(4, 3).inv(stream), spanning(4, 3, keys=NESTED).inv(rename(stream))
    assert_identical(nested, rename(plain))
    assert nested["extras", "hindsight", "reward"].shape == (5, 3)


def test_flushed_rows_are_written_as_they_are() -> None:
    stamp = spanning(4, 3)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(9), transform=stamp, batch_size=2)
    stream = rows(STEP, STEP, REWARDED)
    buffer.extend(stream.clone())
    buffer.extend(stamp.flush())
    assert_identical(buffer[:].exclude("index"), n_step_by_reference(stream, 4, 3))


# Other ways to n-step returns


@pytest.mark.parametrize("n_steps", [1, 3])
@pytest.mark.parametrize("nested", [False, True])
@pytest.mark.parametrize("first", [False, True])
def test_multi_step_transforms_are_refused_wherever_they_are(first: bool, nested: bool, n_steps: int) -> None:
    stamp = spanning(6, n_steps)
    inner = Compose(stamp) if nested else stamp
    parts = (MultiStepTransform(3, DISCOUNT), inner) if first else (inner, MultiStepTransform(3, DISCOUNT))
    buffer = TensorDictReplayBuffer(storage=FrameStorage(20), transform=Compose(*parts), batch_size=2)
    with pytest.raises(ValueError, match=r"MultiStepTransform .*Remove it: .*n_steps=n, discount=g\)"):
        buffer.extend(rows(*[STEP] * 8))
    assert (len(buffer), stamp.flush()) == (0, None)


def test_what_multi_step_transforms_get_wrong() -> None:
    """Why they are refused: a row that terminates within its steps would bootstrap from beyond the end."""
    multi_step = MultiStepTransform(3, DISCOUNT)
    out = multi_step.inv(rows(STEP, STEP, SOLVED, STEP, STEP, STEP))
    assert out["next", "terminated"].flatten().tolist() == [False, False, True]
    assert out["steps_to_next_obs"].tolist() == [3, 2, 1]
    with pytest.raises(TypeError):
        multi_step.inv(None)  # as when every row is held back


def test_the_reward_of_hindsight_has_its_own_key() -> None:
    assert Keys(hindsight=("a", "b")).hindsight_reward == ("a", "b", "reward")


def test_random_rewards_are_summed_as_by_the_reference() -> None:
    stream = rows(*[STEP] * 12, TRUNCATED)
    stream["next", "reward"] = -torch.rand(13, 1, generator=random_source())
    out, expected = spanning(6, 5).inv(stream), n_step_by_reference(stream, 6, 5)
    torch.testing.assert_close(out["next", "reward"], expected["next", "reward"])
    assert torch.equal(out["hindsight", "reward"], expected["hindsight", "reward"])
