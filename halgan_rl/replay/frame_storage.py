"""A replay storage that keeps each frame once."""

import logging
from collections.abc import Sequence
from multiprocessing.context import get_spawning_popen
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import LazyTensorStorage

from halgan_rl.keys import Keys, dotted
from halgan_rl.replay.frame_checkpointer import FrameStorageCheckpointer
from halgan_rl.replay.frame_columns import make_columns, select
from halgan_rl.replay.frame_table import OVERHEAD, FrameTable, FrameTableFullError, gather
from halgan_rl.replay.free_room import check_room, readable
from halgan_rl.replay.refused_write import call_transforms, undo_write
from halgan_rl.replay.row_memory import allocate, map_files

_LOGGER = logging.getLogger(__name__)

CHUNK = 1_024
"""Rows of a checkpoint that are restored at a time."""

Places = int | slice | range | Sequence[int] | Tensor
"""Which rows: a number, or what indexes the first dimension of a tensor."""


class FrameStorage(LazyTensorStorage):
    """A TorchRL storage in which each frame is kept once, though two rows show it.

    What one row sees after its action is, within an episode, what the next row sees before its own. TorchRL's storages
    keep both. Here a row holds the *numbers* of its two frames in a
    :class:`~halgan_rl.replay.frame_table.FrameTable`, which keeps equal frames once; TorchRL stores its other
    entries as ever. Frames are told apart by their bytes, never by the rows' positions, so what is read is what was
    written, bit for bit: in whatever order rows are written, with several environments interleaved, across the ends of
    episodes and the ring's wrap. A frame is released with the last row that shows it.

    There is room for a frame a row, and for ``extra_frames`` more: those that no row shows before its action, which are
    the last of each episode and the newest of each environment. Their memory is touched only when they are needed.

    Takes the place of TorchRL's ``LazyTensorStorage`` or, with a ``scratch_dir``, of its ``LazyMemmapStorage``, with
    these differences:

    * Rows that are read are copies, those of a slice too. So writing into them does not reach the storage, and
      ``buffer.set_at_``, ``set_`` and ``update_`` have no effect: write whole rows, ``buffer[index] = rows``.
    * Samplers of slices read ``storage[:]`` to find trajectories, which copies every frame: they are slow.
    * Rows are ``[N]``, and all have the entries of the first, with its shapes and dtypes.
    * Files in ``scratch_dir`` are unlinked as soon as they are mapped, so none is left, however the process ends.
      For a checkpoint use ``dumps`` and ``loads``, or the state dict: numbers only, nothing is unpickled.
    * It belongs to one process. Threads need a lock around it, such as replay buffers hold.

    Args:
        max_size: Rows.

    Keyword Args:
        scratch_dir: Folder on whose disk rows and frames are mapped; None keeps them in memory.
        extra_frames: Frames beyond one a row; by default a tenth of ``max_size`` or 64, whichever is more: enough
            for episodes that on average are longer than ten steps. As many as ``max_size`` are always enough.
        keys: Where rows keep their frames, of any shape, uint8, at the root and under ``"next"``; only ``keys.pixels``
            is read.

    Attributes:
        bytes_per_row: Size of a row [bytes]: a frame, the other entries, the bookkeeping.
        nbytes: Size of all [bytes]: ``max_size`` rows and ``extra_frames`` frames. Like ``bytes_per_row`` it is 0
            until the first rows tell the shapes, and logged before anything is allocated.

    Raises:
        ValueError: If ``max_size`` is less than 1 or ``extra_frames`` negative; on writing, if frames are not uint8 or
            rows do not fit those stored.
        KeyError: On writing, if a row lacks a key, or has one that those stored lack.
        MemoryError: On the first writing, if memory or disk have no room for ``nbytes``.
        RuntimeError: On writing, if frames exceed ``extra_frames``; on reading, if nothing has been written.
        IndexError: On writing beyond ``max_size``; on reading a row that was never written.

    A batch that is refused is refused whole, and all stays as it was: the storage, the cursor of the buffer's writer
    (TorchRL's default ones), and the rows that a transform held back, if it has a method ``undo_write()``, as
    ``StampFuturePoses`` does. ``replay_buffer.empty()`` also drops the rows held back, by a method
    ``drop_held_rows()``. (A ``TensorDictMaxValueWriter`` ranks rows before it writes them, and keeps the ranks of those
    refused.)

    Examples:
        >>> from torchrl.data import TensorDictReplayBuffer
        >>> storage = FrameStorage(100)
        >>> buffer = TensorDictReplayBuffer(storage=storage, batch_size=4)
        >>> frames = torch.arange(6, dtype=torch.uint8)[:, None, None, None].expand(6, 64, 64, 3)
        >>> index = buffer.extend(TensorDict({"pixels": frames[:-1], "next": {"pixels": frames[1:]}}, batch_size=[5]))
        >>> buffer.sample()["next", "pixels"].shape
        torch.Size([4, 64, 64, 3])
        >>> storage.frames_kept  # of ten that the five rows show
        6
    """

    _default_checkpointer = FrameStorageCheckpointer

    def __init__(
        self,
        max_size: int,
        *,
        scratch_dir: str | Path | None = None,
        extra_frames: int | None = None,
        keys: Keys = Keys(),
    ) -> None:
        if max_size < 1:
            raise ValueError(f"max_size must be at least 1 row, got {max_size}")
        if extra_frames is not None and extra_frames < 0:
            raise ValueError(f"extra_frames must not be negative, got {extra_frames}")
        super().__init__(max_size)
        self.device = None  # All is in CPU memory: a buffer would only spend a quarter of a sample's time on moving it.
        self.scratch_dir = None if scratch_dir is None else Path(scratch_dir)
        self.extra_frames = min(max(max_size // 10, 64), max_size) if extra_frames is None else extra_frames
        self.bytes_per_row = 0
        self.nbytes = 0
        self._keys = (unravel_key(keys.pixels), keys.next("pixels"))
        self._table: FrameTable
        self._frame_shape: torch.Size

    @property
    def frames_kept(self) -> int:
        """Different frames kept at present, at most ``max_size + extra_frames``."""
        return len(self._table) if self.initialized else 0

    def set(self, cursor: Places, data: TensorDictBase | list[TensorDictBase], *, set_cursor: bool = True) -> None:
        """Writes rows.

        Args:
            cursor: Where to. Of several rows for one place the last is kept.
            data: Rows ``[N]``, or ``[]`` if ``cursor`` is a number.
            set_cursor: Whether the length grows so as to include the rows; a buffer's writer wants that.
        """
        was_initialized = self.initialized
        try:
            places = self._write(cursor, data)
        except Exception:
            if not was_initialized:
                self._free()
            undo_write(self._attached_entities, cursor, writer_moved=set_cursor)
            raise
        if not places:
            return
        if set_cursor:
            self._set_last_cursor(cursor)
            self._len = max(len(self), max(places) + 1)
        self._bump_mutation_revision()

    def get(self, index: Places) -> TensorDictBase:
        """Returns copies of rows, with their frames."""
        if not self.initialized:
            raise RuntimeError("FrameStorage holds no rows yet: write some before reading any")
        if isinstance(index, Tensor) and index.ndim == 1 and index.dtype == torch.int64:  # as samplers draw it
            try:
                return select(self._columns, index)
            except IndexError:  # counted from the end, or never written: told apart below
                pass
        stored = self._storage[: len(self)]
        rows = stored[index]
        if _share_memory(rows.get(self._keys[0]), stored.get(self._keys[0])):
            rows = rows.clone()
        return self._put_frames(rows, self._table.frames, self._frame_shape)

    def state_dict(self) -> dict[str, Any]:
        """Returns rows and frames as tensors. They are the storage's own: copy what must not change with it."""
        if not len(self):
            return {}
        frames = self._table.frames[: self._table.used].unflatten(1, self._frame_shape)
        return {"rows": self._storage[: len(self)].to_dict(), "frames": frames}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Replaces all rows by those of a state, which may come from a storage of another size.

        Raises:
            ValueError: if the state is no FrameStorage's, is damaged, or does not fit; the rows stay as they were.
        """
        if not state_dict:
            return self._forget_rows()
        rows, frames = self._read_state(state_dict)
        self._forget_rows()
        for places in torch.arange(len(rows)).split(CHUNK):
            part = self._put_frames(rows[places], frames.flatten(1), frames.shape[1:])
            self.set(places, part, set_cursor=False)
        self._len = len(rows)
        return None

    def _empty(self) -> None:
        """Forgets all rows, those that transforms hold back too; the memory stays allocated."""
        self._forget_rows()
        for buffer in self._attached_entities:
            call_transforms(buffer, "drop_held_rows")

    def _forget_rows(self) -> None:
        self._len = 0
        if self.initialized:
            self._table.clear()
            self._slots.fill_(-1)
        self._bump_mutation_revision()

    def _write(self, cursor: Places, data: TensorDictBase | list[TensorDictBase]) -> list[int]:
        """Writes rows, or raises and changes no row. Returns their places."""
        places, rows = self._read_rows(cursor, data)
        if not places:
            return places
        frames = self._read_frames(rows)
        if not self.initialized:
            self._allocate(rows[0].exclude(*self._keys).to("cpu"), frames[0].shape[1:])
        entries = self._read_entries(rows)
        self._check_fit(entries, frames[0].shape[1:])
        index = torch.tensor(places, dtype=torch.int64)
        self._slots.index_copy_(1, index, self._exchange(frames, index))
        for key, value in entries.items():
            self._entries[key].index_copy_(0, index, value)
        return places

    def _read_rows(
        self, cursor: Places, data: TensorDictBase | list[TensorDictBase]
    ) -> tuple[list[int], TensorDictBase]:
        """Returns N places, all different, and the rows ``[N]`` for them."""
        rows = torch.stack(data) if isinstance(data, list) else data
        if not isinstance(rows, TensorDictBase):
            raise TypeError(f"FrameStorage keeps TensorDicts, got a {type(data).__name__}: make one of it")
        if isinstance(cursor, slice):
            cursor = range(*cursor.indices(self.max_size))
        places = torch.as_tensor(list(cursor) if isinstance(cursor, range) else cursor).cpu()
        if places.dtype == torch.bool:
            places = places.nonzero().squeeze(1)
        if places.ndim == 0:
            places, rows = places[None], rows.unsqueeze(0)
        if places.shape != rows.batch_size:
            raise ValueError(
                f"FrameStorage got rows of batch size {tuple(rows.batch_size)} for places {tuple(places.shape)}: write "
                "rows [N], such as replay_buffer.extend(rows.reshape(-1)), not by add()"
            )
        last: dict[int, int] = {}
        for position, place in enumerate(places.tolist()):
            if not -self.max_size <= place < self.max_size:
                raise IndexError(f"row {place} is beyond max_size={self.max_size}: make it larger")
            last[place % self.max_size] = position
        if len(last) < len(places):
            rows = rows[torch.tensor(list(last.values()))]
        return list(last), rows

    def _read_frames(self, rows: TensorDictBase) -> list[Tensor]:
        """Returns the frames before and after, each ``[N, ...]``."""
        frames = []
        for key in self._keys:
            value = rows.get(key, None)
            if value is None:
                raise KeyError(
                    f"FrameStorage misses the key {dotted(key)}, set by keys=Keys(pixels={self._keys[0]!r}). The rows "
                    f"hold {_names(rows.keys(True, True))}."
                )
            if value.dtype != torch.uint8:
                raise ValueError(
                    f"FrameStorage keeps frames of uint8, but the entry {dotted(key)} is {value.dtype}: write what the "
                    "camera gives, and convert it when it is sampled"
                )
            frames.append(value.cpu())
        if frames[0].shape != frames[1].shape:
            raise ValueError(
                f"frames before and after an action must have one shape, got {tuple(frames[0].shape)} and "
                f"{tuple(frames[1].shape)} for {dotted(self._keys[0])} and {dotted(self._keys[1])}"
            )
        return frames

    def _read_entries(self, rows: TensorDictBase) -> dict[NestedKey, Tensor]:
        """Returns the entries that are no frames."""
        return {key: value.cpu() for key, value in rows.items(True, True) if key not in self._keys}

    def _put_frames(self, rows: TensorDictBase, frames: Tensor, shape: torch.Size) -> TensorDictBase:
        """Sets the frames in place of their numbers; takes them from ``frames`` ``[slots, bytes]``."""
        for key in self._keys:
            slots = rows.get(key)
            if (slots < 0).any():
                raise IndexError("some of these rows have never been written: read rows below len(storage) only")
            rows.set(key, gather(frames, slots).unflatten(-1, shape))
        return rows

    def _allocate(self, row: TensorDictBase, shape: torch.Size) -> None:
        """Makes room for ``max_size`` rows like ``row`` and their frames, if there is any."""
        size, slots = shape.numel(), self.max_size + self.extra_frames
        entries = sum(value.nbytes for value in row.values(True, True))
        bytes_per_row = entries + 2 * torch.int64.itemsize + size + OVERHEAD
        nbytes = self.max_size * bytes_per_row + self.extra_frames * (size + OVERHEAD)
        remedy = f"max_size={self.max_size} rows of {bytes_per_row} bytes, extra_frames={self.extra_frames}"
        _LOGGER.info("FrameStorage takes %s: %s", readable(nbytes), remedy)
        check_room(nbytes, slots * OVERHEAD, self.scratch_dir, remedy)
        if self.scratch_dir is None:
            self._storage, self._slots, frames = allocate(row, self.max_size, slots, size)
        else:
            self._storage, self._slots, frames = map_files(row, self.max_size, slots, size, self.scratch_dir)
        self.initialized = True
        self.bytes_per_row, self.nbytes = bytes_per_row, nbytes
        self._frame_shape, self._table = shape, FrameTable(frames)
        self._set_views()

    def _free(self) -> None:
        """Gives the memory back, so that the next rows may have other entries."""
        self.initialized = False
        self.bytes_per_row = self.nbytes = 0
        for name in ("_storage", "_slots", "_table", "_entries", "_columns"):
            self.__dict__.pop(name, None)

    def _set_views(self) -> None:
        """Sets what rows are written into, ``_entries``, and read from, ``_columns``: views of the same memory."""
        self._entries = self._read_entries(self._storage)
        for key, numbers in zip(self._keys, self._slots, strict=True):
            self._storage.set(key, numbers)
        self._columns = make_columns(self._storage, self._keys, self._table.frames.unflatten(1, self._frame_shape))

    def _check_fit(self, entries: dict[NestedKey, Tensor], shape: torch.Size) -> None:
        """Refuses rows ``[N]`` with other entries or frames than those stored."""
        if shape != self._frame_shape:
            raise ValueError(
                f"FrameStorage holds frames of shape {tuple(self._frame_shape)}, these are {tuple(shape)}: write one "
                "shape only, or into another storage"
            )
        stored = self._entries
        if stored.keys() != entries.keys():
            added, lacking = _names(entries.keys() - stored.keys()), _names(stored.keys() - entries.keys())
            raise KeyError(
                f"these rows have {added} and lack {lacking}, unlike those that FrameStorage holds: write the "
                "same entries always"
            )
        for key, value in entries.items():
            kept = stored[key]
            if (value.shape[1:], value.dtype) != (kept.shape[1:], kept.dtype):
                raise ValueError(
                    f"FrameStorage holds {dotted(key)} as {kept.dtype} {tuple(kept.shape[1:])}, in these rows it is "
                    f"{value.dtype} {tuple(value.shape[1:])}: write one dtype and shape only"
                )

    def _exchange(self, frames: list[Tensor], places: Tensor) -> Tensor:
        """Takes frames, two ``[N, ...]``, in and lets go of those at ``places`` ``[N]``. Returns slots ``[2, N]``."""
        dropped = self._slots.index_select(1, places)
        try:
            slots = self._table.exchange(*(each.flatten(1) for each in frames), dropped=dropped[dropped >= 0])
        except FrameTableFullError as error:
            raise RuntimeError(
                f"FrameStorage has no room for the frames of these {len(places)} rows, none of which was written: with "
                f"extra_frames={self.extra_frames} it keeps {self.max_size + self.extra_frames}. Frames that no row "
                "shows before its action, such as the last of each episode, need room beyond one a row: pass "
                f"extra_frames={self.extra_frames + error.missing} or more; max_size={self.max_size} is always enough"
            ) from error
        return slots.view(-1, 2).T

    def _read_state(self, state: dict[str, Any]) -> tuple[TensorDictBase, Tensor]:
        """Returns a state's rows ``[N]``, with slots, and its frames ``[slots, ...]``, as copies where need be."""
        if state.keys() != {"rows", "frames"}:
            raise ValueError(f"this is no state of a FrameStorage: it holds {sorted(state)}, not 'rows' and 'frames'")
        frames, rows = state["frames"], TensorDict.from_dict(state["rows"], batch_dims=1).clone()
        slots = torch.stack([rows.get(key) for key in self._keys])
        if len(rows) > self.max_size:
            raise ValueError(f"the state holds {len(rows)} rows, more than max_size={self.max_size}: make it larger")
        if slots.dtype != torch.int64 or slots.ndim != 2 or frames.dtype != torch.uint8:
            raise ValueError("the state is damaged: its rows hold no numbers of frames, or its frames are not uint8")
        if slots.min() < 0 or slots.max() >= len(frames):
            raise ValueError(f"the state is damaged: its rows refer to frames that it lacks, of {len(frames)}")
        missing = len(slots.unique()) - self.max_size - self.extra_frames
        if missing > 0:
            raise ValueError(
                f"the state holds {missing} frames too many for max_size={self.max_size} and extra_frames="
                f"{self.extra_frames}: pass extra_frames={self.extra_frames + missing}"
            )
        if self.initialized:
            self._check_fit(self._read_entries(rows), frames.shape[1:])
            if _share_memory(frames, self._table.frames):
                frames = frames.clone()
        return rows, frames

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({len(self)} of max_size={self.max_size} rows, {self.frames_kept} frames, "
            f"extra_frames={self.extra_frames}, {readable(self.nbytes)})"
        )

    def __getstate__(self) -> dict[str, Any]:
        if get_spawning_popen() is not None:
            raise RuntimeError("FrameStorage belongs to one process: build the buffer in the process that uses it")
        return super().__getstate__()

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        if self.initialized:
            self._set_views()  # those of a copy are of its own memory


def _share_memory(one: Tensor, other: Tensor) -> bool:
    return one.untyped_storage().data_ptr() == other.untyped_storage().data_ptr()


def _names(keys: Any) -> str:
    return ", ".join(sorted(map(dotted, keys))) or "nothing"
