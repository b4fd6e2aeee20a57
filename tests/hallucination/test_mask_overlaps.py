import math

import pytest
import torch

from halgan_rl.hallucination.judging.mask_overlaps import mask_overlaps

FRAMES = torch.full((3, 32, 32, 3), 100, dtype=torch.uint8)
POLAR = torch.tensor([[0.05, 0.5], [-0.4, 1.5], [2.0, 0.2]])
"""Bearing and distance: near ahead, far to the right, and out of view."""


def square(row: int, column: int) -> torch.Tensor:
    """Returns the frames with the goal in the first two, in the second one at a column."""
    frames = FRAMES.clone()
    frames[0, row : row + 8, 4:12] = 200
    frames[1, row : row + 8, column : column + 8] = 200
    return frames


def test_overlaps_are_told_apart_by_distance_and_bearing() -> None:
    found = mask_overlaps(FRAMES, square(4, 10), square(4, 14), POLAR, distances=(0, 1, 2, 3), bearings=(0, 10, 30))
    assert found["mask_by_distance"]["0-1 m"] == {"overlap": 1, "frames": 1}
    assert found["mask_by_distance"]["1-2 m"] == {"overlap": pytest.approx(1 / 3), "frames": 1}
    assert found["mask_by_bearing"]["10-30 degrees"]["overlap"] == pytest.approx(1 / 3)
    assert found["mask"]["within 1 m"]["overlap"] == 1
    assert found["mask"]["all"] == {"overlap": pytest.approx(2 / 3), "frames": 2}


def test_a_band_without_frames_has_no_overlap() -> None:
    found = mask_overlaps(FRAMES, square(4, 10), square(4, 10), POLAR, distances=(3, 4), bearings=(0, 1))
    assert math.isnan(found["mask_by_distance"]["3-4 m"]["overlap"])


def test_changes_where_no_goal_is_are_measured() -> None:
    painted = square(4, 10)
    painted[2] += 3
    found = mask_overlaps(FRAMES, square(4, 10), painted, POLAR, distances=(0, 1), bearings=(0, 1))["no_op"]
    assert found == {"outside_the_mask": 0, "out_of_view": 3, "frames_out_of_view": 1}
