"""Frames, each kept once, however many rows of a replay buffer show it."""

import torch
from torch import Tensor

OVERHEAD = 8 + 8 + 192
"""Bytes that a slot needs beside its frame: a count, a hash, and at most this much of a dictionary."""


def gather(frames: Tensor, slots: Tensor) -> Tensor:
    """Returns copies of rows of ``frames`` ``[slots, bytes]``: for slots int64 ``[...]`` uint8 ``[..., bytes]``."""
    return frames.index_select(0, slots.flatten()).view(*slots.shape, frames.shape[1])


class FrameTableFullError(RuntimeError):
    """More different frames than slots.

    Attributes:
        missing: slots that were missing.
    """

    def __init__(self, missing: int) -> None:
        super().__init__(f"the table of frames lacks {missing} slots")
        self.missing = missing


class FrameTable:
    """Keeps each frame in one slot for as long as somebody refers to it.

    A frame that comes in is looked up by its hash and compared byte by byte. If it is there already, its slot gets one
    more reference; otherwise it takes a free slot. A slot becomes free when its last reference is dropped, and only
    then may another frame take it: a slot that somebody refers to never changes.

    Args:
        frames: where to keep them, ``[slots, bytes]`` uint8; its content is ignored.

    Attributes:
        used: slots that have ever been used, the first ones; the memory of the others has not been touched yet.

    Examples:
        >>> table = FrameTable(torch.empty(3, 4, dtype=torch.uint8))
        >>> black, white = torch.zeros(1, 4, dtype=torch.uint8), torch.full((1, 4), 255, dtype=torch.uint8)
        >>> table.exchange(torch.cat([black, white, black])).tolist()
        [0, 1, 0]
        >>> table.exchange(black, dropped=torch.tensor([1])).tolist()
        [0]
        >>> len(table)
        1
    """

    def __init__(self, frames: Tensor) -> None:
        self.frames = frames
        self._counts = torch.zeros(len(frames), dtype=torch.int64)
        self._hashes = torch.zeros(len(frames), dtype=torch.int64)
        self.clear()

    def __len__(self) -> int:
        """Frames kept."""
        return self.used - len(self._freed)

    def clear(self) -> None:
        """Drops all references."""
        self._counts.zero_()
        self._slot_of: dict[int, int] = {}  # by hash
        self._freed: list[int] = []
        self.used = 0

    def exchange(self, frames: Tensor, dropped: Tensor | None = None) -> Tensor:
        """Takes a reference to each of ``frames`` and drops one to each slot of ``dropped``.

        Args:
            frames: ``[N, bytes]`` uint8.
            dropped: slots, int64 ``[M]``; one that occurs twice loses two references.

        Returns:
            The frames' slots, int64 ``[N]``.

        Raises:
            FrameTableFullError: if they do not fit; nothing has changed then.
        """
        slots, new, hashes = self._find(frames)
        known = slots >= 0
        self._drop_and_take(slots[:0] if dropped is None else dropped, slots[known], room_for=len(new))
        places = -1 - slots[~known]
        stored = self._store(frames.index_select(0, new), hashes)
        self._counts[stored] = places.bincount(minlength=len(new))
        slots[~known] = stored[places]
        return slots

    def _find(self, frames: Tensor) -> tuple[Tensor, Tensor, list[int]]:
        """Returns the slots of frames, -1 - k for the k-th new one; positions and hashes of the new ones."""
        slots: list[int] = []
        new: list[int] = []
        hashes: list[int] = []
        places: dict[int, int] = {}  # of new frames, by hash
        kept, given = self.frames.numpy(), frames.numpy()
        for position, frame in enumerate(given):
            content = frame.tobytes()
            key = hash(content)
            slot = self._slot_of.get(key, -1)
            if slot < 0 or kept[slot].tobytes() != content:
                place = places.setdefault(key, len(new))
                if place < len(new) and given[new[place]].tobytes() != content:
                    place = len(new)  # another frame with the same hash
                if place == len(new):
                    new.append(position)
                    hashes.append(key)
                slot = -1 - place
            slots.append(slot)
        return torch.tensor(slots, dtype=torch.int64), torch.tensor(new, dtype=torch.int64), hashes

    def _drop_and_take(self, dropped: Tensor, taken: Tensor, room_for: int) -> None:
        """Updates the counts of slots in use and frees those without a reference, if there is room then."""
        slots, place = torch.cat([dropped, taken]).unique(return_inverse=True)
        change = torch.cat([-torch.ones_like(dropped), torch.ones_like(taken)])
        counts = self._counts[slots].index_add(0, place, change)
        idle = slots[counts == 0]
        missing = room_for - (len(self.frames) - len(self)) - len(idle)
        if missing > 0:
            raise FrameTableFullError(missing)
        self._counts[slots] = counts
        for slot, key in zip(idle.tolist(), self._hashes[idle].tolist(), strict=True):
            self._freed.append(slot)
            if self._slot_of.get(key) == slot:
                del self._slot_of[key]

    def _store(self, frames: Tensor, hashes: list[int]) -> Tensor:
        """Copies frames into free slots, which it returns; there must be enough of them."""
        again = [self._freed.pop() for _ in range(min(len(hashes), len(self._freed)))]
        fresh = range(self.used, self.used + len(hashes) - len(again))
        self.used += len(fresh)
        numbers = [*again, *fresh]
        for slot, key in zip(numbers, hashes, strict=True):
            self._slot_of.setdefault(key, slot)
        slots = torch.tensor(numbers, dtype=torch.int64)
        self.frames.index_copy_(0, slots, frames)
        self._hashes[slots] = torch.tensor(hashes, dtype=torch.int64)
        return slots
