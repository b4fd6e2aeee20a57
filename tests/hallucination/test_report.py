"""A report prefers the truth to nothing, and counts what is in view."""

import math

import torch
from torch import Tensor

from halgan_rl.hallucination.judging.pose_probe import PoseProbe
from halgan_rl.hallucination.judging.report import View, as_text, judge
from halgan_rl.poses import PlanarPoses
from tests import synthetic

POSES = PlanarPoses(goal_offsets=(0.2,))


def report_of(kind: str) -> dict:
    """Judges a painter that paints the truth, or nothing, on synthetic frames."""
    data = synthetic.near_goal(64)
    rows = {float(pose.sum()): image for pose, image in zip(data["pose"], data["pixels"], strict=True)}

    def truth(pixels: Tensor, pose: Tensor, goal_pose: Tensor) -> Tensor:
        return torch.stack([torch.stack([rows[float(each.sum())] for each in row]) for row in pose])

    walks = {"pixels": data["empty"], "pose": data["pose"], "goal_pose": data["goal_pose"]}
    painter = truth if kind == "truth" else lambda pixels, pose, goal_pose: pixels
    torch.manual_seed(0)
    return judge(
        painter, truth, probe=PoseProbe(), view=View(POSES), near_goal=data, rollouts=data, walks=walks
    )  # fmt: skip


def test_the_truth_overlaps_itself_and_nothing_does_not() -> None:
    truth, nothing = report_of("truth"), report_of("nothing")
    assert truth["mask"]["all"]["overlap"] == 1
    assert truth["probe"]["ratio"] == {"bearing": 1.0, "distance": 1.0}
    assert nothing["mask"]["all"]["overlap"] == 0
    assert nothing["probe"]["ratio"]["bearing"] != 1.0
    assert nothing["no_op"]["outside_the_mask"] == 0
    assert "mask overlap" in as_text(truth)


def test_a_view_holds_what_is_near_and_ahead() -> None:
    pose = torch.zeros(3, 3)
    goal_pose = torch.tensor([[0.5, 0.0, 0.0], [0.0, 0.5, math.pi / 2], [3.0, 0.0, 0.0]])
    frames = {"pose": pose, "goal_pose": goal_pose}
    assert View(POSES).holds(frames).tolist() == [True, False, False]
    assert View(POSES, widest=2.0, farthest=4.0).holds(frames).tolist() == [True, True, True]
    assert len(View(POSES).select(frames)["pose"]) == 1
