import sys

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from halgan_rl.replay import frame_table
from halgan_rl.replay.frame_table import OVERHEAD, FrameTable, FrameTableFullError, gather


def frames(*numbers: int) -> Tensor:
    """Frames of 3 bytes, each with its number in one of them."""
    return torch.tensor([[7, number, 9] for number in numbers], dtype=torch.uint8).view(-1, 3)


def table(slots: int) -> FrameTable:
    return FrameTable(torch.full((slots, 3), 99, dtype=torch.uint8))


def test_equal_frames_share_a_slot_within_a_batch_and_across_batches() -> None:
    kept = table(4)
    assert kept.exchange(frames(5, 6, 5)).tolist() == [0, 1, 0]
    assert kept.exchange(frames(8, 6)).tolist() == [2, 1]
    assert len(kept) == 3


def test_frames_of_several_tensors_are_taken_by_turns() -> None:
    kept = table(4)
    assert kept.exchange(frames(5, 6, 6), frames(6, 8, 5)).tolist() == [0, 1, 1, 2, 1, 0]
    kept.exchange(frames(), frames(), dropped=torch.tensor([1, 0, 1, 0]))
    assert len(kept) == 2
    assert torch.equal(gather(kept.frames, torch.tensor([1, 2])), frames(6, 8))


def test_a_frame_stays_until_its_last_reference_is_dropped() -> None:
    kept = table(2)
    kept.exchange(frames(5, 5, 6))
    kept.exchange(frames(), dropped=torch.tensor([0]))
    assert len(kept) == 2
    kept.exchange(frames(), dropped=torch.tensor([0]))
    assert len(kept) == 1
    assert torch.equal(gather(kept.frames, kept.exchange(frames(8))), frames(8))
    assert torch.equal(gather(kept.frames, torch.tensor([1])), frames(6))


def test_a_frame_that_is_dropped_and_taken_at_once_keeps_its_slot() -> None:
    kept = table(1)
    slot = kept.exchange(frames(5))
    assert torch.equal(kept.exchange(frames(5), dropped=slot), slot)
    assert len(kept) == 1


def test_a_dropped_frame_makes_room_in_the_same_exchange() -> None:
    kept = table(1)
    slot = kept.exchange(frames(5))
    assert torch.equal(gather(kept.frames, kept.exchange(frames(6), dropped=slot)), frames(6))


def test_a_full_table_names_what_it_lacks_and_stays_as_it_was() -> None:
    kept = table(3)
    slots = kept.exchange(frames(5, 6))
    with pytest.raises(FrameTableFullError, match="lacks 2 slots") as error:
        kept.exchange(frames(1, 2, 3, 4, 6), dropped=slots[:1])
    assert error.value.missing == 2
    assert torch.equal(gather(kept.frames, slots), frames(5, 6))
    kept.exchange(frames(), dropped=slots)
    assert len(kept) == 0


def test_gathered_frames_are_copies_of_the_slots_shape() -> None:
    kept = table(2)
    kept.exchange(frames(5, 6))
    gathered = gather(kept.frames, torch.tensor([[0, 1], [1, 1]]))
    assert torch.equal(gathered, frames(5, 6, 6, 6).view(2, 2, 3))
    gathered.zero_()
    assert torch.equal(kept.frames, frames(5, 6))


def test_memory_is_touched_only_when_it_is_needed() -> None:
    kept = table(10)
    for number in range(20):
        kept.exchange(frames(number), dropped=torch.tensor([0] if number else []).long())
    assert kept.used == 1
    assert (kept.frames[1:] == 99).all()


def test_clearing_forgets_all_frames() -> None:
    kept = table(2)
    kept.exchange(frames(5, 6))
    kept.clear()
    assert len(kept) == 0
    assert kept.exchange(frames(8, 6)).tolist() == [0, 1]


@settings(deadline=None)
@given(
    st.lists(st.tuples(st.lists(st.integers(0, 5), max_size=4), st.integers(0, 3)), max_size=12),
    st.sampled_from([hash, lambda content: 7, lambda content: content[1] % 2]),
)
def test_references_always_find_their_frames_even_if_hashes_collide(
    steps: list[tuple[list[int], int]], hash_function: object
) -> None:
    kept, held = table(60), []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(frame_table, "hash", hash_function, raising=False)
        for numbers, drop in steps:
            dropped, held = held[:drop], held[drop:]
            slots = kept.exchange(frames(*numbers), dropped=torch.tensor([slot for slot, _ in dropped]).long())
            held += zip(slots.tolist(), numbers, strict=True)
            assert torch.equal(
                gather(kept.frames, torch.tensor([slot for slot, _ in held]).long()),
                frames(*(number for _, number in held)),
            )
            if hash_function is hash:
                assert len(kept) == len({number for _, number in held})


def test_the_bookkeeping_takes_no_more_than_stated() -> None:
    slot_of: dict[int, int] = {}
    largest = 0.0
    for number in range(20_000):
        slot_of[hash(bytes([number % 256, number // 256]))] = number
        if number >= 1_000:
            largest = max(largest, sys.getsizeof(slot_of) / len(slot_of))
    numbers = sys.getsizeof(2**62) + sys.getsizeof(2**31)
    kept = table(1)
    assert largest + numbers + kept._counts.itemsize + kept._hashes.itemsize <= OVERHEAD
