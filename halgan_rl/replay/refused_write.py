"""Undoing what a replay buffer has done of a write before its storage refused the rows."""

from collections.abc import Iterable
from typing import Any

from torch import Tensor
from torchrl.data.replay_buffers.writers import RoundRobinWriter


def undo_write(buffers: Iterable[Any], cursor: Any, *, writer_moved: bool) -> None:
    """Puts the buffer that writes at present back to where it was before.

    TorchRL's buffers run their transforms, then move the writer's cursor, then call the storage. So a storage that
    refuses rows must undo the first two, or the next write leaves a hole and rows that a transform held back are lost.

    Args:
        buffers: Buffers on the storage. The one that writes is the one whose lock this thread holds; if none is, the
            storage was written directly and there is nothing to undo.
        cursor: Where the rows were to go.
        writer_moved: Whether the buffer's writer said so, which moves its own cursor.
    """
    for buffer in buffers:
        if not _writes(buffer):
            continue
        if writer_moved and isinstance(buffer._writer, RoundRobinWriter):
            first, count = (int(cursor[0]), len(cursor)) if isinstance(cursor, Tensor) else (int(cursor), 1)
            buffer._writer._cursor = first
            buffer._writer._write_count -= count
        call_transforms(buffer, "undo_write")


def call_transforms(buffer: Any, method: str) -> None:
    """Calls a method of those of a buffer's transforms that have it, such as ``StampFuturePoses.undo_write``."""
    transform = getattr(buffer, "_transform", None)
    for part in () if transform is None else transform.modules():
        if hasattr(type(part), method):
            getattr(part, method)()


def _writes(buffer: Any) -> bool:
    lock = getattr(buffer, "_replay_lock", None)
    return lock is not None and lock._is_owned()
