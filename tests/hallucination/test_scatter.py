import math

import torch

from halgan_rl.hallucination.judging.pose_probe import PoseProbe
from halgan_rl.hallucination.judging.scatter import cut_stretches, positions, scatter

POSE = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, math.pi / 2]])


def probe_that_reads(*polar: tuple[float, float]) -> PoseProbe:
    probe = PoseProbe((16, 16, 1))
    probe.read = lambda pixels, **_: torch.tensor(polar)  # type: ignore[method-assign, misc]
    return probe


def test_what_is_seen_is_carried_over_into_the_room() -> None:
    seen = torch.tensor([[math.pi / 2, 2.0], [math.pi / 2, 1.0]])
    torch.testing.assert_close(positions(POSE, seen), torch.tensor([[0.0, 2.0], [0.0, 0.0]]), atol=1e-6, rtol=0)


def test_a_goal_that_stays_in_its_place_does_not_scatter() -> None:
    assert scatter(probe_that_reads((0.0, 1.0), (0.0, 1e-6)), [(POSE, torch.zeros(2))]) < 1e-5


def test_scatter_is_the_root_mean_square_about_the_mean() -> None:
    """The goal is seen at x = 0 and at x = 1, half a metre from their mean."""
    probe = probe_that_reads((0.0, 0.0), (0.0, 0.0))
    assert math.isclose(scatter(probe, [(POSE, torch.zeros(2))]), 0.5)


def test_nothing_seen_is_no_scatter() -> None:
    assert math.isnan(scatter(probe_that_reads(), []))


def test_stretches_neither_cross_rollouts_nor_hold_frames_that_do_not_fit() -> None:
    goal = torch.tensor([0, 0, 0, 0, 1, 1, 1, 1, 1, 1])
    data = {"goal_pose": goal[:, None].expand(-1, 3), "row": torch.arange(10)}
    fits = torch.ones(10, dtype=torch.bool)
    fits[7] = False
    found = cut_stretches(data, fits, length=3)
    assert [stretch["row"].tolist() for stretch in found] == [[0, 1, 2]]
