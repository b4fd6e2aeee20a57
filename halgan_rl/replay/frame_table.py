"""Frames, each kept once, however many rows of a replay buffer show it."""

from collections import Counter

import numpy as np
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
        self._counts = np.zeros(len(frames), dtype=np.int64)
        self._hashes = np.zeros(len(frames), dtype=np.int64)
        self.clear()

    def __len__(self) -> int:
        """Frames kept."""
        return self.used - len(self._freed)

    def clear(self) -> None:
        """Drops all references."""
        self._counts.fill(0)
        self._slot_of: dict[int, int] = {}  # by hash
        self._freed: list[int] = []
        self.used = 0

    def exchange(self, *frames: Tensor, dropped: Tensor | None = None) -> Tensor:
        """Takes a reference to each of ``frames`` and drops one to each slot of ``dropped``.

        Args:
            frames: ``[N, bytes]`` uint8. The rows of several are taken by turns: the first of each, the second of
                each, ... A row like the one before it costs least.
            dropped: slots, int64 ``[M]``; one that occurs twice loses two references.

        Returns:
            The slots of all rows, in this order, int64.

        Raises:
            FrameTableFullError: if they do not fit; nothing has changed then.
        """
        given = [row for rows in zip(*(each.numpy() for each in frames), strict=True) for row in rows]
        found, new = self._find(given)
        references = Counter(found)
        references.subtract([] if dropped is None else dropped.tolist())
        self._change_counts({slot: change for slot, change in references.items() if slot >= 0}, room_for=len(new))
        stored = self._store(new, references)
        return torch.tensor([slot if slot >= 0 else stored[-1 - slot] for slot in found], dtype=torch.int64)

    def _find(self, frames: list[np.ndarray]) -> tuple[list[int], list[tuple[np.ndarray, int]]]:
        """Returns the slots of frames, -1 - k for the k-th new one; the new ones and their hashes."""
        slots: list[int] = []
        new: list[tuple[np.ndarray, int]] = []
        places: dict[int, int] = {}  # of new frames, by hash
        kept, last = self.frames.numpy(), None
        for frame in frames:
            content = frame.tobytes()
            if content == last:  # compared in a tenth of the time of hashing
                slots.append(slots[-1])
                continue
            key, last = hash(content), content
            slot = self._slot_of.get(key, -1)
            if slot < 0 or kept[slot].tobytes() != content:
                place = places.setdefault(key, len(new))
                if place < len(new) and new[place][0].tobytes() != content:
                    place = len(new)  # another frame with the same hash
                if place == len(new):
                    new.append((frame, key))
                slot = -1 - place
            slots.append(slot)
        return slots, new

    def _change_counts(self, changes: dict[int, int], room_for: int) -> None:
        """Changes the counts of slots in use and frees those without a reference, if there is room then."""
        idle = [slot for slot, change in changes.items() if self._counts.item(slot) + change == 0]
        missing = room_for - (len(self.frames) - len(self)) - len(idle)
        if missing > 0:
            raise FrameTableFullError(missing)
        for slot, change in changes.items():
            self._counts[slot] += change
        for slot in idle:
            self._freed.append(slot)
            key = self._hashes.item(slot)
            if self._slot_of.get(key) == slot:
                del self._slot_of[key]

    def _store(self, new: list[tuple[np.ndarray, int]], references: Counter[int]) -> list[int]:
        """Copies frames, with their hashes, into free slots, which it returns; there must be enough of them."""
        slots = []
        kept = self.frames.numpy()
        for place, (frame, key) in enumerate(new):
            if self._freed:
                slot = self._freed.pop()
            else:
                slot, self.used = self.used, self.used + 1
            kept[slot] = frame
            self._counts[slot], self._hashes[slot] = references[-1 - place], key
            self._slot_of.setdefault(key, slot)
            slots.append(slot)
        return slots
