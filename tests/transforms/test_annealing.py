import pytest

from halgan_rl.transforms.annealing import Annealing


@pytest.mark.parametrize(("frames", "value"), [(0, 0.3), (25, 0.275), (100, 0.2), (101, 0.2), (10_000, 0.2)])
def test_the_value_moves_linearly_and_then_stays(frames: int, value: float) -> None:
    assert Annealing(0.3, 0.2, 100).at(frames) == pytest.approx(value)


def test_a_value_may_rise() -> None:
    assert Annealing(0.25, 0.75, 4).at(1) == 0.375


@pytest.mark.parametrize("frames", [0, -5])
def test_annealing_over_no_frames_is_refused(frames: int) -> None:
    with pytest.raises(ValueError, match=f"frames must be at least 1 environment frame, got {frames}"):
        Annealing(0.3, 0.0, frames)
