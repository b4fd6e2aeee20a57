import math

import pytest
import torch

from halgan_rl.hallucination.judging.fidelity import compare

EMPTY = torch.full((2, 64, 64, 3), 100, dtype=torch.uint8)


def square(column: int) -> torch.Tensor:
    frames = EMPTY.clone()
    frames[0, 10:20, column : column + 10] = 200
    return frames


def test_the_truth_agrees_with_itself() -> None:
    found = compare(EMPTY, square(30), square(30))
    assert (found.mask_overlap, found.centroid_error, found.outside_change) == (1, 0, 0)


def test_a_shift_costs_overlap_and_shows_in_pixels() -> None:
    found = compare(EMPTY, square(30), square(35))
    assert math.isclose(found.mask_overlap, 50 / 150, rel_tol=1e-6)
    assert found.centroid_error == 5
    assert math.isclose(found.outside_change, 100 * 50 / (2 * 64 * 64 - 100), rel_tol=1e-5)


def test_frames_without_a_goal_in_view_count_by_their_change_only() -> None:
    painted = square(30)
    painted[1] += 10
    found = compare(EMPTY, square(30), painted)
    assert found.mask_overlap == 1
    assert found.outside_change > 4.9


def test_nothing_painted_is_no_overlap() -> None:
    found = compare(EMPTY, square(30), EMPTY)
    assert found.mask_overlap == 0
    assert math.isnan(found.centroid_error)


@pytest.mark.parametrize("shape", [(84, 84, 3), (48, 64, 1), (64, 64, 12)])
def test_images_of_any_shape_are_compared(shape: tuple[int, int, int]) -> None:
    empty = torch.full((2, *shape), 100, dtype=torch.uint8)
    truth = empty.clone()
    truth[0, 10:20, 30:40] = 200
    assert compare(empty, truth, truth).mask_overlap == 1
    assert compare(empty, truth, truth.roll(5, 2)).mask_overlap == pytest.approx(50 / 150)


def test_each_frame_of_a_stack_is_compared_by_itself() -> None:
    """A goal that is painted into the wrong one of two stacked frames overlaps with nothing."""
    empty = torch.full((1, 64, 64, 6), 100, dtype=torch.uint8)
    truth, wrong = empty.clone(), empty.clone()
    truth[:, 10:20, 30:40, :3] = 200
    wrong[:, 10:20, 30:40, 3:] = 200
    assert compare(empty, truth, wrong, frame_stack=2).mask_overlap == 0
    assert compare(empty, truth, truth, frame_stack=2).mask_overlap == 1


@pytest.mark.parametrize("painted", [EMPTY.float(), EMPTY[:1], EMPTY[..., :1], EMPTY.permute(0, 3, 1, 2)])
def test_images_that_are_not_alike_are_refused(painted: torch.Tensor) -> None:
    with pytest.raises(ValueError, match="hallucinated is torch"):
        compare(EMPTY, EMPTY, painted)
