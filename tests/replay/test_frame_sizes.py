"""Images of other sizes and channels."""

from pathlib import Path

import pytest
import torch
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import Compose

from halgan_rl.replay.frame_storage import FrameStorage
from halgan_rl.transforms import DrawHindsightGoal, HallucinateGoal, HindsightReward, StampFuturePoses
from tests.replay.test_refused_write import trajectory
from tests.transforms.rows import always, assert_identical, random_source

SIZES = [(84, 84, 3), (64, 64, 1), (64, 64, 12), (48, 96, 4)]


def mark(pixels: Tensor, pose: Tensor, goal_pose: Tensor) -> Tensor:
    """Paints into one corner of every channel."""
    painted = pixels.clone()
    painted[..., :2, -3:, :] = 255
    return painted


@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("mapped", [False, True])
def test_images_of_any_size_are_kept_once_and_sampled_bit_for_bit(size: tuple, mapped: bool, tmp_path: Path) -> None:
    frames = torch.randint(0, 256, (31, *size), dtype=torch.uint8, generator=random_source())
    rows = trajectory(30)
    rows["pixels"], rows["next", "pixels"] = frames[:-1], frames[1:]
    storage = FrameStorage(40, scratch_dir=tmp_path if mapped else None)
    transform = [
        StampFuturePoses(6),
        DrawHindsightGoal(always(0.5), rng=random_source()),
        HallucinateGoal(mark),
        HindsightReward(),
    ]
    buffer = TensorDictReplayBuffer(storage=storage, batch_size=64, transform=Compose(*transform))
    buffer.extend(rows.clone())
    assert storage.frames_kept == 31
    assert storage.bytes_per_row < 1.02 * torch.Size(size).numel() + 1_000
    assert_identical(storage[:].exclude("index", "hindsight"), rows)
    sample = buffer.sample()
    relabelled = sample["goal", "mask"].flatten()
    assert 10 < relabelled.sum() < 54
    for pixels, kept in ((sample["pixels"], frames[:-1]), (sample["next", "pixels"], frames[1:])):
        expected = kept[sample["index"]]
        assert torch.equal(pixels[~relabelled], expected[~relabelled])
        assert torch.equal(pixels[relabelled], mark(expected[relabelled], sample["pose"], sample["pose"]))
