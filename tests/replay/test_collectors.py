"""TorchRL's collectors write into a buffer themselves."""

import itertools
from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase, SerialEnv, StepCounter, TransformedEnv

from halgan_rl.replay.frame_storage import FrameStorage
from tests import toy
from tests.replay.parking import DISTANCE, relabelling
from tests.transforms.rows import assert_identical, leaves, stamped_by_reference

ENVIRONMENTS = {
    "one": lambda: toy.Parking(seed=1),
    "three": lambda: toy.Parking(3, seed=1),
    "SerialEnv": lambda: SerialEnv(2, toy.Parking),
    "TransformedEnv": lambda: TransformedEnv(toy.Parking(2, seed=1), StepCounter()),
}


def collect(
    make: Callable[[], EnvBase], frames_per_batch: int, buffer: TensorDictReplayBuffer | None = None, frames: int = 126
) -> list[TensorDictBase]:
    """Collects by a random policy; into the buffer, if there is one."""
    torch.manual_seed(4)
    options = {} if buffer is None else {"replay_buffer": buffer}
    collector = Collector(make(), None, frames_per_batch=frames_per_batch, total_frames=frames, **options)
    batches = [None if batch is None else batch.clone() for batch in collector]
    collector.shutdown()
    return batches


@pytest.mark.parametrize(
    ("make", "storage"),
    [*((make, FrameStorage) for make in ENVIRONMENTS.values()), (ENVIRONMENTS["three"], LazyTensorStorage)],
    ids=[*ENVIRONMENTS, "three into LazyTensorStorage"],
)
@pytest.mark.parametrize("frames_per_batch", [6, 42])
def test_a_collector_fills_a_buffer_batch_after_batch(
    frames_per_batch: int, make: Callable[[], EnvBase], storage: type
) -> None:
    buffer = TensorDictReplayBuffer(storage=storage(500), transform=relabelling(0.0), batch_size=16)
    assert len(collect(make, frames_per_batch, buffer)) == 126 // frames_per_batch
    stream = torch.cat(collect(make, frames_per_batch), dim=-1)
    stream = stream.reshape(-1, stream.shape[-1])
    expected = torch.cat([stamped_by_reference(each, DISTANCE) for each in stream])
    kept = buffer.storage[:]
    written = {row_bytes(row) for row in kept.unbind(0)}
    assert len(kept) == 126 - sum(each["count"] for each in buffer._transform[0].get_extra_state()["waiting"] if each)
    assert written <= {row_bytes(row) for row in expected.unbind(0)}
    assert len(buffer.sample()) == 16


def row_bytes(row: TensorDictBase) -> tuple:
    """All that is in a row but its place and the collector's own entries."""
    entries = leaves(row.exclude("index", "collector"))
    return tuple((key, (entries[key] + 0).numpy().tobytes()) for key in sorted(entries))  # + 0: no negative zeros


@pytest.mark.parametrize("labels", itertools.product([None, "cpu"], repeat=3))
def test_a_frame_storage_takes_any_mixture_of_device_labels(labels: tuple) -> None:
    batches = collect(ENVIRONMENTS["three"], 42)
    buffer, reference = (
        TensorDictReplayBuffer(storage=FrameStorage(500), transform=relabelling(0.0), batch_size=16) for _ in range(2)
    )
    for batch, label in zip(batches, labels, strict=True):
        reference.extend(batch.clone())
        buffer.extend(batch.to("cpu") if label else batch.clone().clear_device_())
    assert_identical(buffer.storage[:], reference.storage[:])
