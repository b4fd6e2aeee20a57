"""Rows for agents, as a replay buffer gives them: every key differs between root and next."""

from collections.abc import Sequence

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import TensorSpec

from halgan_rl.keys import Keys


def frames(*leading: int, image_shape: Sequence[int] = (64, 64, 3), seed: int = 0) -> Tensor:
    """Returns images of noise, uint8 ``[*leading, H, W, C]``."""
    rng = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (*leading, *image_shape), dtype=torch.uint8, generator=rng)


def make_rows(
    action_spec: TensorSpec,
    image_shape: Sequence[int] = (64, 64, 3),
    *,
    count: int = 6,
    seed: int = 0,
    keys: Keys = Keys(),
) -> TensorDict:
    """Returns a batch ``[count]`` with random images, rewards and ends; actions are the spec's."""
    rng = torch.Generator().manual_seed(seed)
    pixels = frames(2, count, image_shape=image_shape, seed=seed)
    terminated = torch.rand(count, 1, generator=rng) < 0.3
    rows = TensorDict({}, batch_size=[count])
    entries = {
        keys.pixels: pixels[0],
        keys.action: action_spec.rand((count,)),
        keys.next("pixels"): pixels[1],
        keys.next("reward"): torch.randn(count, 1, generator=rng),
        keys.next("done"): terminated,
        keys.next("terminated"): terminated,
    }
    for key, value in entries.items():
        rows.set(key, value)
    return rows
