"""Evaluation of a policy on fixed starts."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp


@dataclass(frozen=True)
class Evaluation:
    """What one evaluation measured, averaged over its episodes.

    Attributes:
        success_rate: share of the episodes that *terminated*, in [0, 1]; running out of time is no success.
        episode_return: mean undiscounted sum of rewards.
        episode_length: mean number of steps.
    """

    success_rate: float
    episode_return: float
    episode_length: float

    def metrics(self, prefix: str = "eval") -> dict[str, float]:
        """Return the figures under ``prefix/``, ready for a logger."""
        return {
            f"{prefix}/success_rate": self.success_rate,
            f"{prefix}/return": self.episode_return,
            f"{prefix}/episode_length": self.episode_length,
        }


@torch.no_grad()
def evaluate(env: EnvBase, policy: TensorDictModuleBase, *, seeds: Sequence[int], max_steps: int = 1_000) -> Evaluation:
    """Run the deterministic policy once from each start.

    Args:
        env: an unbatched environment; it is re-seeded before each episode, so give evaluation one of its own.
        policy: reads the environment's observations and writes ``action``.
        seeds: one seed a start; the same seeds are the same starts.
        max_steps: bound on an episode's length, if the environment does not end it before.

    Raises:
        ValueError: if ``seeds`` is empty.
    """
    if not seeds:
        raise ValueError("seeds is empty: give one seed for each start to evaluate")
    successes, returns, lengths = [], [], []
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for seed in seeds:
            env.set_seed(seed)
            episode = env.rollout(max_steps, policy, break_when_any_done=True)
            successes.append(float(episode["next", "terminated"][-1]))
            returns.append(float(episode["next", "reward"].sum()))
            lengths.append(len(episode))
    n = len(seeds)
    return Evaluation(sum(successes) / n, sum(returns) / n, sum(lengths) / n)


@torch.no_grad()
def record(
    env: EnvBase,
    policy: TensorDictModuleBase,
    render: Callable[[], np.ndarray],
    *,
    seeds: Sequence[int],
    max_steps: int = 1_000,
    pixels_key: NestedKey = "pixels",
) -> list[np.ndarray]:
    """Film the deterministic policy: a view from outside beside what the agent sees.

    Args:
        env: as for :func:`evaluate`.
        policy: as for :func:`evaluate`.
        render: returns the view from outside, ``[K * H, W', 3]`` uint8, K times as high as the agent's image.
        seeds: one seed a start.
        max_steps: bound on an episode's length.
        pixels_key: the agent's own image ``[H, W, 3]`` uint8.

    Returns:
        Frames ``[K * H, W' + K * W, 3]`` uint8 of all episodes, one after the other.
    """
    frames: list[np.ndarray] = []
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for seed in seeds:
            env.set_seed(seed)
            state = env.reset()
            for _ in range(max_steps):
                frames.append(_side_by_side(render(), state[pixels_key].numpy()))
                step = env.step(policy(state))
                state = step_mdp(step)
                if step["next", "done"].any():
                    break
            frames.append(_side_by_side(render(), state[pixels_key].numpy()))
    return frames


def _side_by_side(outside: np.ndarray, own: np.ndarray) -> np.ndarray:
    scale = outside.shape[0] // own.shape[0]
    return np.concatenate([outside, own.repeat(scale, 0).repeat(scale, 1)], axis=1)
