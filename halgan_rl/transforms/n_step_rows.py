"""Rows that span several steps: n-step returns."""

import torch
from tensordict import TensorDictBase
from torch import Tensor

from halgan_rl.keys import Keys
from halgan_rl.transforms.unfinished_episode import Steps, episode_end

STEPS_KEY = "steps_to_next_obs"
"""Where TorchRL's losses read how many steps a row spans, int64 ``[N]``; its discount is to the power of that."""


def n_step_rows(
    rows: TensorDictBase, steps: Steps, count: int, n_steps: int, discount: float, keys: Keys
) -> TensorDictBase:
    """Returns the first ``count`` of T consecutive rows, each of which then spans up to ``n_steps`` steps.

    What follows a row becomes what follows the last step it spans, flags included, so that a row is terminated if its
    episode terminates within its steps. Its reward becomes the discounted sum of the rewards of its steps.

    Args:
        rows: Rows ``[T]`` of one environment.
        steps: What hindsight knows of them.
        count: How many of them to return.
        n_steps: Steps that a row spans, fewer at the end of its episode.
        discount: Discount of a step.
        keys: Where rows keep what.

    Returns:
        New rows ``[count]``, which also hold ``"steps_to_next_obs"``.
    """
    now = torch.arange(count, device=steps.last.device)
    last = torch.minimum(now + n_steps - 1, episode_end(steps)[:count])
    spanned = rows[:count].set("next", rows.get("next")[last])
    powers = discount ** torch.arange(n_steps, device=steps.last.device)
    reward = rows.get(keys.next("reward"))[:count]
    total = (future_rewards(steps, count, n_steps) * powers).sum(-1)
    spanned.set(keys.next("reward"), total.to(reward.dtype).reshape(reward.shape))
    return spanned.set(STEPS_KEY, last - now + 1)


def future_rewards(steps: Steps, count: int, n_steps: int) -> Tensor:
    """Returns the rewards of the next ``n_steps`` steps of rows, float32 ``[count, n_steps]``: 0 beyond an episode."""
    now = torch.arange(count, device=steps.last.device)[:, None]
    at = now + torch.arange(n_steps, device=steps.last.device)
    end = episode_end(steps)[:count, None]
    return torch.where(at <= end, steps.reward[torch.minimum(at, end)].float(), 0.0)
