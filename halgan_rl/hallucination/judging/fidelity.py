"""How far hallucinated frames are from the truth: unlike the paper, we can ask the simulator."""

from dataclasses import dataclass

import torch
from torch import Tensor

VISIBLE = 24
"""A pixel is changed if a channel of it differs by more than this, of 255."""


@dataclass(frozen=True)
class Fidelity:
    """What one comparison measured, averaged over frames.

    Attributes:
        mask_overlap: intersection over union of the pixels that truth and hallucination change, in [0, 1], over
            frames in which the goal is in view.
        centroid_error: median distance between the centres of those pixels [pixels], over frames in which both change
            some; NaN if there are none.
        outside_change: mean absolute change where the truth changes nothing [levels of 255].
    """

    mask_overlap: float
    centroid_error: float
    outside_change: float


def compare(frames: Tensor, truth: Tensor, hallucinated: Tensor) -> Fidelity:
    """Compare goals painted into frames with the same goals truly rendered.

    Args:
        frames: uint8 ``[N, H, W, 3]`` without a goal.
        truth: the same with the goal rendered.
        hallucinated: the same with the goal painted in.
    """
    true_mask, mask = changed(frames, truth), changed(frames, hallucinated)
    union, both = (true_mask | mask).sum((1, 2)), (true_mask & mask).sum((1, 2))
    in_view, painted = true_mask.any(2).any(1), mask.any(2).any(1)
    distance = (_centroid(mask) - _centroid(true_mask)).norm(dim=-1)[in_view & painted]
    change = (hallucinated.float() - frames.float()).abs().mean(-1)
    return Fidelity(
        mask_overlap=float((both / union.clamp_min(1))[in_view].mean()),
        centroid_error=float(distance.median()) if len(distance) else float("nan"),
        outside_change=float(change[~true_mask].mean()),
    )


def changed(frames: Tensor, others: Tensor) -> Tensor:
    """Return the mask ``[N, H, W]`` of the pixels in which two uint8 ``[N, H, W, 3]`` visibly differ."""
    return (others.to(torch.int16) - frames.to(torch.int16)).abs().amax(-1) > VISIBLE


def _centroid(mask: Tensor) -> Tensor:
    """Return the mean row and column ``[N, 2]`` of masks ``[N, H, W]``; NaN if one is empty."""
    rows, columns = (torch.arange(size, dtype=torch.float32) for size in mask.shape[1:])
    weight = mask.sum((1, 2)).float()
    return torch.stack([mask.sum(2).float() @ rows, mask.sum(1).float() @ columns], -1) / weight[:, None]
