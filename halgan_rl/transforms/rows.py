"""Rows of tensors, replaced."""

import torch
from torch import Tensor


def replace_rows(rows: Tensor, index: Tensor, replacements: Tensor) -> Tensor:
    """Return a copy of rows, some of them replaced: ``rows.index_copy(0, index, replacements)``, but faster.

    PyTorch copies the bytes of uint8 rows one by one in ``index_copy``, and whole rows at once in ``index_select``.

    Args:
        rows: ``[N, ...]``.
        index: which rows to replace, all different, int64 ``[M]``.
        replacements: ``[M, ...]``.

    Examples:
        >>> replace_rows(torch.tensor([1, 2, 3]), torch.tensor([2, 0]), torch.tensor([7, 8]))
        tensor([8, 2, 7])
    """
    count = len(rows)
    source = torch.arange(count, device=rows.device)
    source[index] = torch.arange(count, count + len(index), device=rows.device)
    return torch.cat([rows, replacements]).index_select(0, source)
