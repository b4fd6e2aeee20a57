"""Where goals are painted and where they truly are, by distance and bearing of the goal."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from halgan_rl.hallucination.judging import fidelity


def mask_overlaps(
    frames: Tensor,
    truth: Tensor,
    painted: Tensor,
    polar: Tensor,
    *,
    distances: Sequence[float],
    bearings: Sequence[float],
    near: float = 1.0,
) -> dict[str, dict[str, Any]]:
    """Compares painted goals with true ones, band by band.

    Args:
        frames: uint8 ``[N, H, W, C]`` without a goal.
        truth: the same with the goal rendered.
        painted: the same with the goal painted in.
        polar: bearing [rad] and distance [m] of the goals, ``[N, 2]``.

    Keyword Args:
        distances: bounds of the bands of distance [m].
        bearings: bounds of the bands of bearing, to either side [degrees].
        near: a goal nearer than this is near [m].

    Returns:
        ``mask``, ``mask_by_distance`` and ``mask_by_bearing``: for each band the ``overlap`` of the pixels that goals
        change in truth and as painted (intersection over union, NaN without frames) and the number of ``frames`` with
        the goal in view. ``no_op``: the mean changes, of 255, ``outside_the_mask`` and in frames in which the goal is
        ``out_of_view``, and the number of the latter.
    """
    seen = fidelity.changed(frames, truth).flatten(1).any(1)
    distance, degrees = polar[:, 1], polar[:, 0].rad2deg().abs()

    def judge(rows: Tensor) -> dict[str, float]:
        """Returns the overlap in some of the frames."""
        rows = rows & seen
        overlap = fidelity.compare(frames[rows], truth[rows], painted[rows]).mask_overlap if rows.any() else torch.nan
        return {"overlap": overlap, "frames": int(rows.sum())}

    def judge_bands(values: Tensor, bounds: Sequence[float], unit: str) -> dict[str, dict[str, float]]:
        """Returns the overlap for each band of some values."""
        return {f"{low:g}-{high:g} {unit}": judge((values >= low) & (values < high)) for low, high in pairwise(bounds)}

    return {
        "mask_by_distance": judge_bands(distance, distances, "m"),
        "mask_by_bearing": judge_bands(degrees, bearings, "degrees"),
        "mask": {f"within {near:g} m": judge(distance < near), "all": judge(seen)},
        "no_op": {
            "outside_the_mask": fidelity.compare(frames[seen], truth[seen], painted[seen]).outside_change,
            "out_of_view": float((painted[~seen].float() - frames[~seen].float()).abs().mean()),
            "frames_out_of_view": int((~seen).sum()),
        },
    }
