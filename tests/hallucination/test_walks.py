import torch

from halgan_rl.hallucination.judging.walks import draw_goals


def test_goals_are_later_poses_of_the_same_walk() -> None:
    steps = torch.arange(40.0)
    pose = torch.stack([0.1 * steps, torch.zeros(40), steps], -1)  # two walks of 20 poses
    episode = (steps >= 20).long()
    start, goal = draw_goals(pose, episode, 200, rng=torch.Generator().manual_seed(0), most_steps=12)
    ahead = goal[:, 2] - start[:, 2]
    assert len(start) == 200
    assert (ahead >= 1).all()
    assert ahead.max() <= 12
    assert ((start[:, 2] < 20) == (goal[:, 2] < 20)).all()
    assert ahead.median() < 4  # near ones more often
