"""Rows of a frame storage as its samples are read: columns, in which numbers of frames read as frames."""

from collections.abc import Iterable
from functools import reduce
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

_MEMORY = torch.device("cpu")


class FrameColumn:
    """A column of slots that reads as one of frames ``[slots, ...]``."""

    def __init__(self, slots: Tensor, frames: Tensor) -> None:
        self.slots, self.frames = slots, frames

    def index_select(self, dim: int, index: Tensor) -> Tensor:
        """Returns copies of the frames of some rows."""
        return self.frames.index_select(dim, self.slots.index_select(dim, index))


def make_columns(rows: TensorDictBase, keys: Iterable[NestedKey], frames: Tensor) -> dict[str, Any]:
    """Returns the columns of rows ``[N]``, nested like their keys.

    Args:
        rows: Views of what is stored; at ``keys`` they hold slots, int64 ``[N]``.
        keys: Where frames are read in place of their slots.
        frames: ``[slots, ...]``.
    """
    columns = rows.to_dict()
    for key in keys:
        *path, name = key if isinstance(key, tuple) else (key,)
        parent = reduce(dict.__getitem__, path, columns)
        parent[name] = FrameColumn(parent[name], frames)
    return columns


def select(columns: dict[str, Any], index: Tensor) -> TensorDict:
    """Returns copies of rows ``[N]``, several times as fast as indexing the TensorDict: every update waits for it."""
    rows = {
        name: select(column, index) if type(column) is dict else column.index_select(0, index)
        for name, column in columns.items()
    }
    return TensorDict._new_unsafe(rows, batch_size=index.shape, device=_MEMORY)
