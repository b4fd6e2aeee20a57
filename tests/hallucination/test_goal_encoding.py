import math

import pytest
import torch

from halgan_rl.hallucination.generators.goal_encoding import GoalEncoding

POSE = torch.tensor([[1.0, 0.0, math.pi / 2], [0.0, 0.0, 0.0]])
GOAL = torch.tensor([[1.0, 2.0, math.pi], [0.0, 0.0, 0.3]])


def test_polar_labels_are_distance_and_bearing_and_the_yaw_where_positions_coincide() -> None:
    labels = GoalEncoding("polar").labels(POSE, GOAL)
    torch.testing.assert_close(labels, torch.tensor([[2.0, 0.0], [0.0, 0.3]]), atol=1e-6, rtol=0)


def test_planar_features_hold_sine_and_cosine_of_the_yaw() -> None:
    encoding = GoalEncoding("planar")
    labels = encoding.labels(POSE, GOAL)
    torch.testing.assert_close(labels[0], torch.tensor([2.0, 0.0, math.pi / 2]), atol=1e-6, rtol=0)
    torch.testing.assert_close(encoding(labels)[0], torch.tensor([2.0, 0.0, 1.0, 0.0]), atol=1e-6, rtol=0)


@pytest.mark.parametrize("kind", ["polar", "planar"])
def test_standardised_features_have_mean_0_and_variance_1(kind: str) -> None:
    encoding = GoalEncoding(kind)  # type: ignore[arg-type]
    labels = torch.randn(500, encoding.lengths + 1, generator=torch.Generator().manual_seed(0)) * 0.3 + 2
    encoding.standardise(labels)
    features = encoding(labels)
    torch.testing.assert_close(features.mean(0), torch.zeros(encoding.size), atol=1e-4, rtol=0)
    torch.testing.assert_close(features.std(0), torch.ones(encoding.size), atol=1e-4, rtol=0)


@pytest.mark.parametrize("kind", ["polar", "planar"])
def test_mirrored_labels_are_those_of_mirrored_poses(kind: str) -> None:
    encoding = GoalEncoding(kind, pose_size=4)  # type: ignore[arg-type]
    pose, goal = torch.tensor([0.3, -0.2, 0.4, 1.0]), torch.tensor([0.9, 0.5, -0.7, 0.0])
    flip = torch.tensor([1.0, -1.0, -1.0, 1.0])
    torch.testing.assert_close(encoding.mirror(encoding.labels(pose, goal)), encoding.labels(pose * flip, goal * flip))


def test_flags_follow_unchanged_and_without_noise() -> None:
    encoding = GoalEncoding("planar", pose_size=5)
    pose = torch.tensor([[0.0, 0.0, 0.0, 1.0, 0.0]])
    labels = encoding.labels(pose, torch.tensor([[1.0, 2.0, 0.5, 0.0, 0.0]]))
    assert labels[0, 3:].tolist() == [1.0, 0.0]
    assert encoding(labels).shape == (1, encoding.size)
    assert encoding.noise(0.01, 0.02).tolist() == pytest.approx([0.01, 0.01, 0.02, 0.0, 0.0])


def test_unknown_kinds_and_short_poses_are_refused() -> None:
    with pytest.raises(ValueError, match="cubic"):
        GoalEncoding("cubic")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="pose_size=2"):
        GoalEncoding("polar", pose_size=2)
