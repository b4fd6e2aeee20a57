"""Memory for rows, the numbers of their frames, and the frames: in memory or on a disk."""

from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor


class RowMemory(NamedTuple):
    """Room for some rows and frames."""

    rows: TensorDictBase
    """``[max_size]``: all but the frames; not initialized."""
    slots: Tensor
    """int64 ``[2, max_size]``: which frames a row shows; all -1, which is none."""
    frames: Tensor
    """uint8 ``[slots, bytes]``; not initialized."""


def allocate(row: TensorDictBase, max_size: int, slots: int, size: int) -> RowMemory:
    """Returns room in memory for ``max_size`` rows like ``row``, and for frames ``[slots, size]``."""
    # NumPy asks the system for huge pages: random reads are a tenth faster than from PyTorch's memory, though the
    # first writing is slower.
    frames = torch.from_numpy(np.empty((slots, size), dtype=np.uint8))
    empty = partial(torch.empty_like, memory_format=torch.contiguous_format)
    numbers = torch.full((2, max_size), -1, dtype=torch.int64)
    return RowMemory(row.expand(max_size).apply(empty), numbers, frames)


def map_files(row: TensorDictBase, max_size: int, slots: int, size: int, folder: Path) -> RowMemory:
    """Returns the same, mapped to files in ``folder`` that are gone when this returns: their content stays."""
    with TemporaryDirectory(dir=folder, prefix="frame_storage-") as temporary:
        rows = row.expand(max_size).memmap_like(Path(temporary, "rows"))
        frames = torch.from_file(str(Path(temporary, "frames")), True, slots * size, dtype=torch.uint8)
        numbers = torch.from_file(str(Path(temporary, "slots")), True, 2 * max_size, dtype=torch.int64)
    return RowMemory(rows.apply(_as_tensor), numbers.fill_(-1).view(2, -1), frames.view(slots, size))


def _as_tensor(mapped: Tensor) -> Tensor:
    """The same memory without tensordict's subclass, whose file is gone and which is slow to index."""
    return mapped.as_subclass(Tensor)
