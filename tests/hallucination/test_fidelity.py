import math

import torch

from halgan_rl.hallucination.judging.fidelity import compare

EMPTY = torch.full((2, 64, 64, 3), 100, dtype=torch.uint8)


def square(column: int) -> torch.Tensor:
    frames = EMPTY.clone()
    frames[0, 10:20, column : column + 10] = 200
    return frames


def test_the_truth_agrees_with_itself() -> None:
    figures = compare(EMPTY, square(30), square(30))
    assert (figures.mask_overlap, figures.centroid_error, figures.outside_change) == (1, 0, 0)


def test_a_shift_costs_overlap_and_shows_in_pixels() -> None:
    figures = compare(EMPTY, square(30), square(35))
    assert math.isclose(figures.mask_overlap, 50 / 150, rel_tol=1e-6)
    assert figures.centroid_error == 5
    assert math.isclose(figures.outside_change, 100 * 50 / (2 * 64 * 64 - 100), rel_tol=1e-5)


def test_frames_without_a_goal_in_view_count_by_their_change_only() -> None:
    painted = square(30)
    painted[1] += 10
    figures = compare(EMPTY, square(30), painted)
    assert figures.mask_overlap == 1
    assert figures.outside_change > 4.9


def test_nothing_painted_is_no_overlap() -> None:
    figures = compare(EMPTY, square(30), EMPTY)
    assert figures.mask_overlap == 0
    assert math.isnan(figures.centroid_error)
