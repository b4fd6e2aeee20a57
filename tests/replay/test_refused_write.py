"""A refused batch changes nothing, on the way from the environments to the storage."""

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer
from torchrl.data.replay_buffers import PrioritizedSampler, RandomSampler

from halgan_rl.replay import free_room
from halgan_rl.replay.frame_storage import FrameStorage
from halgan_rl.replay.frame_table import FrameTableFullError
from halgan_rl.transforms import StampFuturePoses
from tests.replay.parking import collect, relabelling
from tests.replay.test_frame_storage import episode, row
from tests.transforms.rows import assert_identical

Batches = list[TensorDictBase]


def trajectory(length: int, first: int = 0, number: int = 0, *, ends: bool = True) -> TensorDictBase:
    """Consecutive steps ``[length]`` of one environment, with frames first ... first + length."""
    time = torch.arange(first, first + length + 1)
    pose = torch.stack([0.5 * time, torch.full_like(time, number) - 0.25 * time, 0.01 * time], dim=1).float()
    last = torch.zeros(length, 1, dtype=torch.bool)
    last[-1] = ends
    pixels = torch.zeros(length + 1, 3, 4, 3, dtype=torch.uint8)
    pixels[:, 1, 2, 0], pixels[:, 2, 3, 1] = time.to(torch.uint8), 100 + number
    following = {
        "pixels": pixels[1:],
        "pose": pose[1:],
        "reward": -0.125 * time[1:, None].float(),
        "done": last,
        "terminated": torch.zeros_like(last),
        "truncated": last.clone(),
    }
    action = 0.5 - 0.01 * time[:-1, None].float()
    rows = {"pixels": pixels[:-1], "pose": pose[:-1], "action": action, "next": following}
    return TensorDict(rows, batch_size=[length])


def both(*batches: TensorDictBase) -> TensorDictBase:
    """Rows ``[E, T]``."""
    return torch.stack(list(batches))


def state_of(buffer: TensorDictReplayBuffer) -> dict:
    """Everything that a refused batch must leave alone."""
    held = [part.get_extra_state() for part in buffer._transform if isinstance(part, StampFuturePoses)]
    return {
        "length": len(buffer),
        "cursor": buffer.writer._cursor,
        "writes": buffer.write_count,
        "frames": buffer.storage.frames_kept,
        "sizes": (buffer.storage.initialized, buffer.storage.bytes_per_row, buffer.storage.nbytes),
        "held": [[each and each["count"] for each in state["waiting"]] for state in held],
    }


def other_key(batch: TensorDictBase) -> TensorDictBase:
    return batch.clone().set("extra", torch.zeros(*batch.shape, 2))


def missing_key(batch: TensorDictBase) -> TensorDictBase:
    return batch.exclude("action")


def other_dtype(batch: TensorDictBase) -> TensorDictBase:
    return batch.clone().set("action", batch["action"].double())


def other_shape(batch: TensorDictBase) -> TensorDictBase:
    return batch.clone().set("action", batch["action"].repeat_interleave(2, -1))


def float_frames(batch: TensorDictBase) -> TensorDictBase:
    return batch.clone().set("pixels", batch["pixels"].float())


def other_frames(batch: TensorDictBase) -> TensorDictBase:
    wide = batch.clone()
    for part in (wide, wide["next"]):
        part["pixels"] = part["pixels"].repeat_interleave(2, -2)
    return wide


def unlike_frames(batch: TensorDictBase) -> TensorDictBase:
    return batch.clone().set("pixels", batch["pixels"].repeat_interleave(2, -2))


def no_frames(batch: TensorDictBase) -> TensorDictBase:
    return batch.exclude(("next", "pixels"))


AT_FIRST = pytest.mark.parametrize("spoil", [float_frames, unlike_frames, no_frames], ids=lambda fault: fault.__name__)
FAULTS = [other_key, missing_key, other_dtype, other_shape, float_frames, other_frames]
EVERY_FAULT = pytest.mark.parametrize("spoil", FAULTS, ids=lambda fault: fault.__name__)


def plain(**options: object) -> TensorDictReplayBuffer:
    return TensorDictReplayBuffer(storage=FrameStorage(40, extra_frames=40), batch_size=16, **options)


def with_hindsight() -> TensorDictReplayBuffer:
    return plain(transform=relabelling(0.0))


def stamping() -> TensorDictReplayBuffer:
    return plain(transform=StampFuturePoses(6))


def assert_same_after(make_buffer: Callable, batches: Batches, spoil: Callable, at: int) -> None:
    """Writes all batches to two buffers, to one of them a spoilt one before the batch ``at`` too."""
    buffer, reference = make_buffer(), make_buffer()
    for position, batch in enumerate(batches):
        if position == at:
            before = state_of(buffer)
            for _ in range(2):
                with pytest.raises((KeyError, ValueError, RuntimeError, MemoryError)):
                    buffer.extend(spoil(batch))
            assert state_of(buffer) == before
        for each in (buffer, reference):
            each.extend(batch.clone())
        assert state_of(buffer) == state_of(reference)
        if len(buffer):
            assert_identical(buffer.storage[:], reference.storage[:])
            buffer.sample()
    restored = make_buffer()
    restored.load_state_dict(buffer.state_dict())
    assert state_of(restored) == state_of(reference)


@EVERY_FAULT
@pytest.mark.parametrize("at", [1, 2])
def test_a_buffer_without_transforms_goes_on_as_if_it_had_not_been(spoil: Callable, at: int) -> None:
    batches = [trajectory(15, 0), trajectory(17, 20), trajectory(21, 60)]  # the third wraps
    assert_same_after(plain, batches, spoil, at)


@EVERY_FAULT
@pytest.mark.parametrize("at", [1, 3])
@pytest.mark.parametrize("make_buffer", [stamping, with_hindsight])
def test_rows_held_back_are_not_lost(make_buffer: Callable, spoil: Callable, at: int) -> None:
    stream = trajectory(30)
    assert_same_after(make_buffer, [stream[:3], stream[3:12], stream[12:20], stream[20:]], spoil, at)


@EVERY_FAULT
def test_rows_held_back_of_several_environments_are_not_lost(spoil: Callable) -> None:
    first, second = torch.cat([trajectory(9), trajectory(11, 30)]), trajectory(20, 100, 1)
    batches = [both(first[at : at + 5], second[at : at + 5]) for at in range(0, 20, 5)]
    assert_same_after(stamping, batches, spoil, 2)


@EVERY_FAULT
@pytest.mark.parametrize("at", [1, 3])
def test_after_an_episodes_end_the_storage_refuses_and_nothing_changes(spoil: Callable, at: int) -> None:
    batches = [trajectory(4), trajectory(5, 10), trajectory(7, 20), trajectory(3, 30)]  # no row is held back
    assert_same_after(stamping, batches, spoil, at)


@AT_FIRST
@pytest.mark.parametrize("make_buffer", [plain, stamping, with_hindsight])
def test_the_first_batch_may_be_refused(make_buffer: Callable, spoil: Callable) -> None:
    stream = trajectory(30)
    assert_same_after(make_buffer, [stream[:9], stream[9:20], stream[20:]], spoil, 0)


def test_a_first_batch_for_whose_frames_there_is_no_room_leaves_no_layout() -> None:
    buffer = TensorDictReplayBuffer(storage=FrameStorage(9, extra_frames=0), batch_size=4)
    before = state_of(buffer)
    with pytest.raises(RuntimeError, match="no room"):
        buffer.extend(other_frames(other_key(torch.cat([trajectory(4), trajectory(5, 20)]))))
    assert state_of(buffer) == before
    buffer.extend(trajectory(8))
    assert_identical(buffer.storage[:].exclude("index"), trajectory(8))


def test_frames_without_room_are_refused_and_nothing_changes() -> None:
    def make_buffer() -> TensorDictReplayBuffer:
        storage = FrameStorage(20, extra_frames=3)
        return TensorDictReplayBuffer(storage=storage, batch_size=16, transform=StampFuturePoses(6))

    def restless(batch: TensorDictBase) -> TensorDictBase:
        """As many rows, each of another episode."""
        return torch.cat([trajectory(1, 150 + 3 * number) for number in range(20)])

    stream = trajectory(30)
    buffer = make_buffer()
    buffer.extend(stream[:3])
    buffer.extend(stream[3:12])
    before, rows = state_of(buffer), buffer.storage[:]
    last = torch.cat([stream[12:13], *(trajectory(1, 50 + 3 * number) for number in range(19))])
    last["next", "done"][0] = True
    with pytest.raises(RuntimeError, match="none of which was written"):
        buffer.extend(last)
    assert state_of(buffer) == before
    assert_identical(buffer.storage[:], rows)
    assert_same_after(make_buffer, [trajectory(4), trajectory(5, 10)], restless, 0)
    assert_same_after(make_buffer, [trajectory(4), trajectory(5, 10)], restless, 1)


def test_too_little_memory_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    buffer, reference = stamping(), stamping()
    stream = trajectory(20)
    for each in (buffer, reference):
        each.extend(stream[:4].clone())
    before = state_of(buffer)
    with monkeypatch.context() as patch:
        patch.setattr(free_room, "free_memory", lambda: 0)
        with pytest.raises(MemoryError):
            buffer.extend(stream[4:9].clone())
    assert state_of(buffer) == before
    for each in (buffer, reference):
        each.extend(stream[4:9].clone())
    assert_identical(buffer.storage[:], reference.storage[:])


def test_rows_that_flush_released_are_held_back_again(monkeypatch: pytest.MonkeyPatch) -> None:
    buffer, reference = stamping(), stamping()
    for each in (buffer, reference):
        each.extend(trajectory(10, ends=False))

    def refuse(*frames: Tensor, dropped: Tensor) -> Tensor:
        raise FrameTableFullError(1)

    before = state_of(buffer)
    with monkeypatch.context() as patch:
        patch.setattr(buffer.storage._table, "exchange", refuse)
        with pytest.raises(RuntimeError, match="none of which was written"):
            buffer.extend(buffer._transform[0].flush())
    assert before["held"] == [[5]]
    assert state_of(buffer) == before
    for each in (buffer, reference):
        each.extend(each._transform[0].flush())
    assert_identical(buffer.storage[:], reference.storage[:])
    assert len(buffer) == 10


@pytest.mark.parametrize("kind", [ReplayBuffer, TensorDictReplayBuffer])
def test_a_row_that_add_cannot_write_changes_nothing(kind: type) -> None:
    buffer = kind(storage=FrameStorage(9), batch_size=4)
    for number in range(3):
        buffer.add(row(number, number, number + 1))
    before = state_of(buffer)
    bad = row(5, 6, 7).set("extra", torch.zeros(2))
    with pytest.raises(KeyError, match="have extra"):
        buffer.add(bad)
    assert state_of(buffer) == before
    buffer.add(row(3, 3, 4))
    assert_identical(buffer.storage[:].exclude("index"), torch.stack([row(n, n, n + 1) for n in range(4)]))


def test_rows_that_are_replaced_at_a_place_change_nothing_if_refused() -> None:
    buffer = plain()
    buffer.extend(episode(6))
    before = state_of(buffer)
    with pytest.raises(KeyError, match="lack action"):
        buffer[torch.arange(4)] = episode(4, first=50).exclude("action")
    assert state_of(buffer) == before


def test_rows_written_directly_move_no_cursor_and_take_nothing_back() -> None:
    buffer = stamping()
    buffer.extend(trajectory(10, ends=False))
    before = state_of(buffer)
    with pytest.raises(KeyError, match="lack action"):
        buffer.storage.set(range(5), buffer.storage[:5].exclude("action"))
    assert state_of(buffer) == before


def test_of_two_buffers_on_one_storage_only_the_one_that_writes_is_put_back() -> None:
    storage = FrameStorage(40)
    one, other = (TensorDictReplayBuffer(storage=storage, batch_size=4) for _ in range(2))
    for each in (one, other):
        each.extend(episode(4))
    with pytest.raises(KeyError):
        one.extend(episode(4).exclude("action"))
    assert (one.writer._cursor, other.writer._cursor) == (4, 4)
    assert (one.write_count, other.write_count) == (4, 4)


@pytest.mark.parametrize("spoil", [other_key, missing_key, other_dtype, other_shape])
def test_torchrls_storages_lose_nothing_either_while_rows_are_held_back(spoil: Callable) -> None:
    def make_buffer() -> TensorDictReplayBuffer:
        return TensorDictReplayBuffer(storage=LazyTensorStorage(40), batch_size=4, transform=StampFuturePoses(6))

    buffer, reference, stream = make_buffer(), make_buffer(), trajectory(20)
    for each in (buffer, reference):
        each.extend(stream[:9].clone())
    with pytest.raises((KeyError, ValueError), match="held back"):
        buffer.extend(spoil(stream[9:]))
    for each in (buffer, reference):
        each.extend(stream[9:].clone())
    assert (len(buffer), buffer.writer._cursor) == (len(reference), reference.writer._cursor) == (20, 20)
    assert_identical(buffer[:], reference[:])


def test_a_batch_of_the_real_collector_is_refused_whole() -> None:
    batches = [batch.clone() for batch in collect(210)]
    assert_same_after(with_hindsight, batches, other_key, 4)


# --- emptying


def test_an_emptied_buffer_gives_back_nothing_of_before() -> None:
    buffer, reference = stamping(), stamping()
    buffer.extend(trajectory(9, ends=False))
    buffer.empty()
    assert state_of(buffer)["held"] == [[]]
    for each in (buffer, reference):
        each.extend(trajectory(9, first=70, number=3))
    assert_identical(buffer.storage[:], reference.storage[:])


def test_an_emptied_buffer_goes_on_in_mid_episode() -> None:
    buffer, stream = stamping(), trajectory(20)
    buffer.extend(stream[:9])
    buffer.empty()
    buffer.extend(stream[9:])
    assert torch.equal(buffer.storage[:]["pose"], stream[9:]["pose"])


def test_loading_a_storages_rows_leaves_rows_held_back_alone() -> None:
    buffer, other = stamping(), stamping()
    for each, number in ((buffer, 0), (other, 3)):
        each.extend(trajectory(9, number=number, ends=False))
    buffer.storage.load_state_dict(other.storage.state_dict())
    assert state_of(buffer)["held"] == [[5]]


@pytest.mark.parametrize("sampler", [RandomSampler, PrioritizedSampler])
def test_samplers_draw_only_rows_that_were_written(sampler: type) -> None:
    try:
        made = sampler(40, 0.7, 0.5) if sampler is PrioritizedSampler else sampler()
    except (ImportError, RuntimeError) as error:
        pytest.skip(f"not in this pair of torch and torchrl: {error}")
    buffer = plain(sampler=made)
    buffer.extend(episode(5))
    with pytest.raises(KeyError):
        buffer.extend(episode(5).exclude("action"))
    buffer.extend(episode(5, first=50))
    assert set(buffer.sample(200)["index"].flatten().tolist()) == set(range(10))
