"""Rows of an episode that still goes on, and the future of those whose future is known."""

from collections import deque
from typing import NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

Layout = dict[NestedKey, tuple[torch.dtype, torch.Size]]
"""Dtype and shape of each entry of a row."""


class Steps(NamedTuple):
    """What hindsight needs to know of consecutive rows ``[..., T]`` of one environment."""

    pose: Tensor
    """``[..., T, P]`` pose at t."""
    next_pose: Tensor
    """``[..., T, P]`` pose at t+1."""
    reward: Tensor
    """``[..., T]`` reward of the row."""
    last: Tensor
    """``[..., T]`` bool: the row ends its episode."""
    solved: Tensor
    """``[..., T]`` bool: the row is a success, so its next pose is no failure's."""
    turned: Tensor
    """``[..., T]`` bool: another goal is pursued after the row: the one before is reached."""


def future_poses(steps: Steps, count: int, max_distance: int) -> tuple[Tensor, Tensor]:
    """Returns the future of the first ``count`` of T consecutive rows.

    Args:
        steps: The rows, ``[T]``.
        count: How many of them to stamp; those after them serve as their future only.
        max_distance: D, steps to look ahead.

    Returns:
        Poses ``[count, D, P]``, and the horizon ``[count, 1]`` int64: how many of them may serve as a goal.
    """
    total = len(steps.last)
    time = torch.arange(total, device=steps.last.device)
    end = episode_end(steps)[:count]
    solved = _first_at_or_after(torch.where(steps.solved, time, total))[:count]
    turned = _first_at_or_after(torch.where(steps.turned, time, total))[:count]
    now = time[:count]
    horizon = torch.minimum(torch.minimum(end, turned) + 1, solved).sub_(now).clamp_(max=max_distance)
    ahead = torch.arange(max_distance, device=now.device)
    poses = steps.next_pose[torch.minimum(now[:, None] + ahead, end[:, None])]
    return poses, horizon[:, None]


def episode_end(steps: Steps) -> Tensor:
    """Returns, for each of T rows, the place of the last one of its episode, int64 ``[T]``: T - 1 if it goes on."""
    total = len(steps.last)
    return _first_at_or_after(torch.where(steps.last, torch.arange(total, device=steps.last.device), total - 1))


def _first_at_or_after(time: Tensor) -> Tensor:
    """Returns, for each position, the smallest entry from there on."""
    return time.flip(0).cummin(0).values.flip(0)


class UnfinishedEpisode:
    """One environment's latest rows, whose future is not known yet.

    A queue of chunks, so that a row's images are copied once, however few rows come at a time.
    """

    def __init__(self) -> None:
        self.chunks: deque[TensorDictBase] = deque()
        self.steps: Steps
        self.layout: Layout

    @property
    def count(self) -> int:
        """Rows held."""
        return len(self.steps.last) if self.chunks else 0

    def copy(self) -> "UnfinishedEpisode":
        """Returns one that holds the same rows; no tensor is copied, for none is ever written into."""
        twin = UnfinishedEpisode()
        if self.chunks:
            twin.chunks, twin.steps, twin.layout = self.chunks.copy(), self.steps, self.layout
        return twin

    def count_known(self, max_distance: int) -> int:
        """Rows, from the first on, whose next ``max_distance`` poses are known, or all those to their episode's end."""
        ended = self.steps.last.nonzero()
        return max(int(ended[-1]) + 1 if len(ended) else 0, self.count - max_distance + 1, 0)

    def append(self, rows: TensorDictBase, steps: Steps, layout: Layout) -> None:
        """Adds rows ``[T]`` of a layout."""
        held = (self.steps, steps) if self.chunks else (steps,)
        self.steps = Steps(*(torch.cat(entries) for entries in zip(*held, strict=True)))
        self.chunks.append(rows)
        self.layout = layout

    def pop(self, count: int) -> list[TensorDictBase]:
        """Takes the first ``count`` rows away, as consecutive chunks."""
        popped = []
        self.steps = Steps(*(entry[count:].clone() for entry in self.steps))
        while count:
            chunk = self.chunks.popleft()
            if len(chunk) > count:
                self.chunks.appendleft(chunk[count:])
            popped.append(chunk[:count])
            count -= len(popped[-1])
        return popped

    def own_last_chunk(self) -> None:
        """Copies the newest rows: collectors may write their next batch into the same memory."""
        if self.chunks:
            self.chunks[-1] = self.chunks[-1].clone()


def concatenate(chunks: list[TensorDictBase]) -> TensorDictBase | None:
    """Joins chunks of rows; None if there are none.

    A TensorDict's device is a label that may be missing, and collectors set it only from their second batch on: chunks
    with different labels all get one.
    """
    if len(chunks) < 2:
        return chunks[0] if chunks else None
    labels = {label for chunk in chunks for label in _devices(chunk)}
    if len(labels) > 1:
        device = next(label for label in labels if label is not None)
        chunks = [chunk.to(device) for chunk in chunks]
    return torch.cat(chunks)


def _devices(rows: TensorDictBase) -> set[torch.device | None]:
    """Returns the device labels of a TensorDict and of those inside it."""
    labels = {rows.device}
    for value in rows.values():
        if isinstance(value, TensorDictBase):
            labels |= _devices(value)
    return labels
