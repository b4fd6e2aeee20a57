"""Endless transitions without an environment, no two frames of which are equal."""

import torch
from tensordict import TensorDict
from torch import Tensor

EPISODE = 100
"""Steps an episode."""


class Rows:
    """Writes transitions of episodes of :data:`EPISODE` steps, each frame with its number in its first bytes.

    Within an episode a row's next frame is the root frame of the next row, as in any environment.

    Args:
        side: height and width [pixels].
    """

    def __init__(self, side: int) -> None:
        self.side = side
        self.count = 0
        self._noise = torch.randint(0, 256, (997, side, side, 3), generator=torch.Generator().manual_seed(0)).byte()

    def take(self, count: int) -> TensorDict:
        """Return the next transitions ``[count]``, with poses but without the stamps of hindsight."""
        step = torch.arange(self.count, self.count + count)
        self.count += count
        frame = step + step // EPISODE  # the last frame of an episode is no row's root
        done = (step % EPISODE == EPISODE - 1).unsqueeze(1)
        following = {
            "pixels": self._frames(frame + 1),
            "pose": _poses(frame + 1),
            "reward": torch.zeros(count, 1),
            "done": done,
            "terminated": torch.zeros_like(done),
            "truncated": done.clone(),
        }
        root = {"pixels": self._frames(frame), "pose": _poses(frame), "action": torch.zeros(count, 2)}
        return TensorDict({**root, "next": following}, batch_size=[count])

    def _frames(self, number: Tensor) -> Tensor:
        frames = self._noise[number % len(self._noise)]
        frames.flatten(1)[:, :8] = number.unsqueeze(1).view(torch.uint8)
        return frames


def _poses(number: Tensor) -> Tensor:
    return torch.stack([0.05 * number, torch.zeros(len(number)), torch.zeros(len(number))], -1)


def plain(rows: TensorDict) -> TensorDict:
    """Return only what DDPG needs, which is what Stable-Baselines3 keeps."""
    return rows.select("pixels", "action", *(("next", name) for name in ("pixels", "reward", "done", "terminated")))


def channels_first(pixels: Tensor) -> Tensor:
    """Return images ``[N, 3, H, W]``, copied, of ``[N, H, W, 3]``."""
    return pixels.permute(0, 3, 1, 2).contiguous()
