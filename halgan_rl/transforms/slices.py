"""Slices: consecutive rows of a storage, in a sampled batch."""

import torch
from tensordict import TensorDictBase
from torch import Tensor

MANY = 8
"""As many neighbours in a batch are seldom neighbours in the storage, unless a sampler puts them there."""


def first_of_slice(pose: Tensor, futures: Tensor) -> Tensor:
    """Returns, for each of N rows, the first of the consecutive rows that it belongs to.

    Args:
        pose: ``[N, P]``.
        futures: The poses that follow, ``[N, D, P]``. A row follows another if it is, and sees, the other's future.

    Returns:
        int64 ``[N]``.

    Examples:
        >>> x = torch.tensor([[0.0], [1.0], [2.0], [7.0], [8.0]])  # steps of 1, but for one jump
        >>> first_of_slice(x, torch.stack([x + 1, x + 2], dim=1)).tolist()
        [0, 0, 0, 3, 3]
    """
    follows = (torch.cat([pose.unsqueeze(1), futures[:, :-1]], 1)[1:] == futures[:-1]).flatten(1).all(1)
    start = torch.arange(len(pose), device=pose.device)
    start[1:] *= ~follows
    return start.cummax(0).values


def refuse_slices(rows: TensorDictBase) -> None:
    """Refuses sampled rows ``[...]`` that evidently are slices of the storage, by their ``"index"``.

    Rows of which most follow each other are slices, unless *all* do, as in ``buffer[:]``, or many come twice, as in
    random samples of a tiny buffer.
    """
    index = rows.get("index", None)
    if index is None or index.shape != rows.shape:
        return
    index = index.flatten()
    pairs = len(index) - 1
    following = int((index.diff() == 1).sum()) if pairs > 0 else 0
    if not max(MANY, pairs / 2) <= following < pairs or 2 * len(index.unique()) <= len(index):
        return
    raise ValueError(
        f"{following} of {pairs + 1} rows follow the row before them in the storage: these are slices, and a goal for "
        "each row would show one slice several goals. Give DrawHindsightGoal(per_slice=True) and "
        "SliceSampler(..., truncated_key=None, init_key=None), or sample rows at random."
    )
