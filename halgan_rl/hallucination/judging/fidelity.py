"""How far hallucinated frames are from the truth: unlike in the paper, the simulator shows it."""

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


def compare(frames: Tensor, truth: Tensor, hallucinated: Tensor, *, frame_stack: int = 1) -> Fidelity:
    """Compares goals painted into frames with the same goals truly rendered.

    Args:
        frames: uint8 ``[N, H, W, C]`` without a goal.
        truth: the same with the goal rendered.
        hallucinated: the same with the goal painted in.

    Keyword Args:
        frame_stack: how many frames are stacked along the channels; each is compared by itself.

    Raises:
        ValueError: if shapes or dtypes differ, or the images are not uint8 ``[N, H, W, C]``.
    """
    frames, truth, hallucinated = _frames(frame_stack, frames=frames, truth=truth, hallucinated=hallucinated)
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
    """Returns the mask ``[N, H, W]`` of the pixels in which two uint8 ``[N, H, W, C]`` visibly differ."""
    return (others.to(torch.int16) - frames.to(torch.int16)).abs().amax(-1) > VISIBLE


def _frames(frame_stack: int, **images: Tensor) -> list[Tensor]:
    """Returns the single frames ``[N * S, H, W, c]`` of images ``[N, H, W, S * c]``."""
    first = images["frames"]
    for name, pixels in images.items():
        if pixels.dtype != torch.uint8 or pixels.ndim != 4 or pixels.shape != first.shape:
            raise ValueError(
                f"{name} is {pixels.dtype} {list(pixels.shape)}; it must be torch.uint8 [N, H, W, C], of the shape of "
                f"frames, {list(first.shape)}."
            )
    if first.shape[-1] % frame_stack:
        raise ValueError(f"frames {list(first.shape)} do not hold frame_stack={frame_stack} frames each.")
    return [
        pixels.unflatten(-1, (frame_stack, -1)).movedim(-2, 1).flatten(0, 1) if frame_stack > 1 else pixels
        for pixels in images.values()
    ]


def _centroid(mask: Tensor) -> Tensor:
    """Returns the mean row and column ``[N, 2]`` of masks ``[N, H, W]``; NaN if one is empty."""
    rows, columns = (torch.arange(size, dtype=torch.float32) for size in mask.shape[1:])
    weight = mask.sum((1, 2)).float()
    return torch.stack([mask.sum(2).float() @ rows, mask.sum(1).float() @ columns], -1) / weight[:, None]
