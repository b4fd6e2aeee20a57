import pytest
import torch

from halgan_rl.hallucination.judging.pose_probe import PoseProbe, probe_errors, train_probe
from halgan_rl.poses import PlanarPoses
from tests.synthetic import SHAPES, near_goal

AHEAD = PlanarPoses(goal_offsets=(0.3,))


def test_a_probe_learns_where_the_goal_is_from_frames_it_has_not_seen() -> None:
    torch.manual_seed(0)
    data, held_out = (near_goal(512, seed=seed) for seed in (0, 1))
    polar, truth = (AHEAD.goal_polar(part["pose"], part["goal_pose"]) for part in (data, held_out))
    probe = train_probe(data["pixels"], polar, rng=torch.Generator().manual_seed(0), steps=300)
    with torch.no_grad():
        error = (probe(held_out["pixels"]) - truth).abs().mean(0)
    guess = (polar.mean(0) - truth).abs().mean(0)
    assert (error < 0.4 * guess).all()
    mirrored = held_out["pixels"].flip(2)
    with torch.no_grad():
        bearing = probe(mirrored)[:, 0]
    assert torch.corrcoef(torch.stack([bearing, -truth[:, 0]]))[0, 1] > 0.9


@pytest.mark.parametrize("shape", SHAPES)
def test_a_probe_takes_images_of_any_shape(shape: str) -> None:
    image_shape, frame_stack = SHAPES[shape]
    pixels = near_goal(16, image_shape=image_shape, frame_stack=frame_stack)["pixels"]
    probe = train_probe(pixels, torch.rand(16, 2) + 0.1, rng=torch.Generator().manual_seed(0), steps=1, batch_size=4)
    assert probe.read(pixels).shape == (16, 2)


def test_a_probe_is_not_trained_on_nothing() -> None:
    with pytest.raises(ValueError, match=r"\[0, 64, 64, 3\].*with the goal in view"):
        train_probe(torch.zeros(0, 64, 64, 3, dtype=torch.uint8), torch.zeros(0, 2), rng=torch.Generator())


def test_errors_are_those_of_bearing_and_distance_and_their_ratio() -> None:
    probe = PoseProbe((16, 16, 1))
    probe.read = lambda pixels, **_: pixels  # type: ignore[method-assign, misc]
    truth = torch.tensor([[0.0, 1.0], [0.1, 2.0]])
    images = {"real": truth + torch.tensor([0.1, 0.2]), "hallucinated": truth - torch.tensor([0.2, 0.2])}
    errors = probe_errors(probe, truth, images)
    assert errors["real"]["bearing_degrees"] == pytest.approx(5.7296, rel=1e-4)
    assert errors["hallucinated"]["distance_metres"] == pytest.approx(0.2, rel=1e-5)
    assert errors["ratio"] == {"bearing": pytest.approx(2), "distance": pytest.approx(1)}
    assert errors["frames"] == 2
