import math

import torch

from halgan_rl.hallucination.judging.pose_probe import polar_goal, train_probe
from tests.synthetic import near_goal


def test_the_goal_stands_ahead_of_its_goal_pose() -> None:
    pose = torch.tensor([1.0, 0.0, math.pi / 2])
    goal_pose = torch.tensor([1.0, 0.5, math.pi])
    bearing, distance = polar_goal(pose, goal_pose, goal_offset=0.5).tolist()
    assert math.isclose(bearing, math.pi / 4, rel_tol=1e-5)
    assert math.isclose(distance, math.hypot(0.5, 0.5), rel_tol=1e-5)


def test_a_probe_learns_where_the_goal_is_from_frames_it_has_not_seen() -> None:
    torch.manual_seed(0)
    offset = 0.3
    data, held_out = (near_goal(512, seed=seed) for seed in (0, 1))
    polar, truth = (polar_goal(part["pose"], part["goal_pose"], goal_offset=offset) for part in (data, held_out))
    probe = train_probe(data["pixels"], polar, rng=torch.Generator().manual_seed(0), steps=300)
    with torch.no_grad():
        error = (probe(held_out["pixels"]) - truth).abs().mean(0)
    guess = (polar.mean(0) - truth).abs().mean(0)
    assert (error < 0.4 * guess).all()
    mirrored = held_out["pixels"].flip(2)
    with torch.no_grad():
        bearing = probe(mirrored)[:, 0]
    assert torch.corrcoef(torch.stack([bearing, -truth[:, 0]]))[0, 1] > 0.9
