"""Batches for updates are sampled together."""

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer

from halgan_rl.training import loop as training


@pytest.mark.parametrize(("count", "samples"), [(0, []), (1, [1]), (16, [16]), (37, [16, 16, 5])])
def test_batches_are_sampled_together_as_many_as_asked_for(
    count: int, samples: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100))
    buffer.extend(TensorDict({"row": torch.arange(100)}, batch_size=[100]))
    asked, sample = [], buffer.sample
    monkeypatch.setattr(buffer, "sample", lambda size: asked.append(size) or sample(size))
    rows = [batch["row"] for batch in training.draw_batches(buffer, count, 4)]
    assert asked == [4 * number for number in samples]
    assert [len(batch) for batch in rows] == [4] * count
    if count == 37:
        assert len(torch.cat(rows).unique()) > 60  # of 148 rows drawn from 100


def test_a_batch_is_drawn_by_the_same_draws_as_alone() -> None:
    buffers = []
    for _ in range(2):
        buffers.append(TensorDictReplayBuffer(storage=LazyTensorStorage(100)))
        buffers[-1].extend(TensorDict({"row": torch.arange(100)}, batch_size=[100]))
    torch.manual_seed(0)
    together = torch.cat([batch["row"] for batch in training.draw_batches(buffers[0], 3, 4)])
    torch.manual_seed(0)
    assert torch.equal(together, torch.cat([buffers[1].sample(4)["row"] for _ in range(3)]))


@pytest.mark.parametrize(
    ("options", "asked", "gave"),
    [({"sampler": SamplerWithoutReplacement()}, 128, 100), ({"prefetch": 2, "batch_size": 8}, 32, 128)],
    ids=["without replacement", "prefetch"],
)
def test_buffers_that_give_another_number_of_rows_are_refused(options: dict[str, Any], asked: int, gave: int) -> None:
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100), **options)
    buffer.extend(TensorDict({"row": torch.arange(100)}, batch_size=[100]))
    with pytest.raises(ValueError, match=f"asked for {asked} rows, the replay buffer gave {gave}:"):
        list(training.draw_batches(buffer, 20, 8))
