"""Prioritised replay with hindsight, where PyTorch and TorchRL fit together well enough to have it."""

import pytest
import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.data import PrioritizedSampler, TensorDictReplayBuffer
from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss

from halgan_rl.replay.frame_storage import FrameStorage
from halgan_rl.transforms import HindsightConfig, pipelines
from tests import toy
from tests.transforms.rows import always, assert_identical, random_source
from tests.transforms.test_pipelines import collect

ALPHA, EPSILON = 0.7, 1e-6
"""How much priorities count, and what is added to them."""
KEY = "td_error"
"""Where TorchRL's losses write priorities."""


def why_missing() -> str:
    """Returns why prioritised replay cannot be had here, or nothing."""
    try:
        PrioritizedSampler(2, ALPHA, 1.0)
    except (ImportError, RuntimeError) as error:
        return (
            f"this TorchRL's extension does not fit PyTorch {torch.__version__} ({error}): TorchRL 0.14.1 from PyPI is "
            "built for PyTorch 2.14"
        )
    return ""


pytestmark = pytest.mark.skipif(bool(why_missing()), reason=why_missing() or "prioritised replay is there")


def make_buffer(probability: float, capacity: int = 400) -> TensorDictReplayBuffer:
    hindsight = pipelines.halgan(
        toy.hallucinate, rng=random_source(3), config=HindsightConfig(always(probability), max_distance=6)
    )
    return TensorDictReplayBuffer(
        storage=FrameStorage(capacity, extra_frames=100),
        sampler=PrioritizedSampler(capacity, ALPHA, 1.0, eps=EPSILON),
        transform=hindsight,
        priority_key=KEY,
        generator=random_source(7),
        batch_size=64,
    )


def filled(probability: float = 1.0) -> TensorDictReplayBuffer:
    buffer = make_buffer(probability)
    for batch in collect(315)[:10]:
        buffer.extend(batch)
    return buffer


def priorities(buffer: TensorDictReplayBuffer) -> torch.Tensor:
    """Returns the priority of each row, as it was given."""
    kept = torch.tensor([buffer.sampler._sum_tree[row] for row in range(len(buffer))])
    return kept.pow(1 / ALPHA) - EPSILON


def make_loss() -> DQNLoss:
    torch.manual_seed(0)
    network = QValueActor(nn.Linear(3, 3), in_keys=["pose"], action_space="categorical")
    return DQNLoss(network, action_space="categorical", loss_function="l2", delay_value=False)


def step(buffer: TensorDictReplayBuffer, loss: DQNLoss) -> TensorDictBase:
    """Does what prioritised training does with a batch, except to learn."""
    batch = buffer.sample()
    loss(batch)
    buffer.update_tensordict_priority(batch)
    return batch


def test_rows_are_drawn_in_proportion_to_their_priorities() -> None:
    buffer = filled(probability=0.0)
    buffer.update_priority(torch.arange(len(buffer)), torch.zeros(len(buffer)))
    buffer.update_priority(torch.tensor([5, 20]), torch.tensor([1.0, 4.0]))
    drawn = torch.cat([buffer.sample()["index"].flatten() for _ in range(60)])
    count = torch.bincount(drawn, minlength=len(buffer))
    assert count[[5, 20]].sum() == pytest.approx(len(drawn), rel=0.02)
    assert count[20] / count[5] == pytest.approx(4**ALPHA, rel=0.15)


def test_without_hindsight_the_rows_drawn_are_those_stored() -> None:
    buffer = filled(probability=0.0)
    batch = buffer.sample()
    stored = buffer.storage[batch["index"].flatten()]
    assert_identical(
        batch.select("pixels", "pose", "next", "hindsight"), stored.select("pixels", "pose", "next", "hindsight")
    )


def test_a_loss_sets_the_priorities_of_the_rows_it_saw_and_of_no_others() -> None:
    buffer = filled()
    before = priorities(buffer)
    batch = step(buffer, make_loss())
    seen = batch["index"].flatten()
    others = torch.ones(len(buffer), dtype=torch.bool).index_fill_(0, seen, False)
    assert others.any()
    after = priorities(buffer)
    torch.testing.assert_close(after[others], before[others])
    torch.testing.assert_close(after[seen], last_error(batch, len(buffer))[seen], atol=1e-4, rtol=1e-3)


def last_error(batch: TensorDictBase, rows: int) -> torch.Tensor:
    """Returns for each row its last error in a batch, which may hold it twice, with two goals."""
    errors = torch.zeros(rows)
    for row, error in zip(batch["index"].flatten().tolist(), batch[KEY].flatten(), strict=True):
        errors[row] = error
    return errors


def test_a_relabelled_row_gets_the_priority_of_its_error_with_the_goal_in_hindsight() -> None:
    buffer, loss = filled(), make_loss()
    batch = step(buffer, loss)
    relabelled = buffer.transform.relabelled(batch).flatten()
    assert relabelled.any()
    assert not relabelled.all()
    stored = buffer.storage[batch["index"].flatten()]
    loss(stored)
    rewarded = (batch["next", "reward"] != stored["next", "reward"]).flatten()
    assert rewarded.any()
    assert (batch[KEY][rewarded] != stored[KEY][rewarded]).all()
    same = ~rewarded & (batch["next", "terminated"] == stored["next", "terminated"]).flatten()
    torch.testing.assert_close(batch[KEY][same], stored[KEY][same])


def test_rows_that_come_later_are_drawn_at_least_as_readily_as_any() -> None:
    buffer, loss = filled(), make_loss()
    for _ in range(5):
        step(buffer, loss)
    before = len(buffer)
    for batch in collect(315)[10:]:
        buffer.extend(batch)
    kept = priorities(buffer)
    assert len(buffer) > before
    assert (kept[before:] >= kept[:before].max() - 1e-4).all()


def test_a_state_gives_the_batches_and_priorities_that_it_would_have_given() -> None:
    buffer, loss = filled(), make_loss()
    for _ in range(3):
        step(buffer, loss)
    state = buffer.state_dict()
    restored = make_buffer(1.0)
    restored.load_state_dict(state)
    torch.testing.assert_close(priorities(restored), priorities(buffer), atol=0, rtol=0)
    for each in (buffer, restored):
        each.set_rng(random_source(11))
        each.transform[1].rng.manual_seed(12)
    for _ in range(3):
        assert_identical(step(restored, loss), step(buffer, loss))
        torch.testing.assert_close(priorities(restored), priorities(buffer), atol=0, rtol=0)
