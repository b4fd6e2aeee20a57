"""Evaluation of a policy on fixed starts."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

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
        flags: by the name of each of the pose's flags, share of the episodes that ended with it set.
    """

    success_rate: float
    episode_return: float
    episode_length: float
    flags: Mapping[str, float] = field(default_factory=dict)

    def metrics(self, prefix: str = "eval") -> dict[str, float]:
        """Return the figures under ``prefix/``, ready for a logger."""
        return {
            f"{prefix}/success_rate": self.success_rate,
            f"{prefix}/return": self.episode_return,
            f"{prefix}/episode_length": self.episode_length,
            **{f"{prefix}/{flag}": share for flag, share in self.flags.items()},
        }


@torch.no_grad()
def evaluate(
    env: EnvBase,
    policy: TensorDictModuleBase,
    *,
    seeds: Sequence[int],
    max_steps: int = 1_000,
    flags: Sequence[str] = (),
    pose_key: NestedKey = "pose",
) -> Evaluation:
    """Run the deterministic policy once from each start.

    Args:
        env: an unbatched environment; it is re-seeded before each episode, so give evaluation one of its own.
        policy: reads the environment's observations and writes ``action``.
        seeds: one seed a start; the same seeds are the same starts.
        max_steps: bound on an episode's length, if the environment does not end it before.
        flags: names of the pose's flags, its entries after the third: how often they are set in the end is reported.
        pose_key: where the environment writes the pose.

    Raises:
        ValueError: if ``seeds`` is empty.
    """
    if not seeds:
        raise ValueError("seeds is empty: give one seed for each start to evaluate")
    successes, returns, lengths, last_flags = [], [], [], []
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for seed in seeds:
            env.set_seed(seed)
            episode = env.rollout(max_steps, policy, break_when_any_done=True)
            successes.append(float(episode["next", "terminated"][-1]))
            returns.append(float(episode["next", "reward"].sum()))
            lengths.append(len(episode))
            if flags:
                last_flags.append(episode["next"].get(pose_key)[-1, 3:])
    n = len(seeds)
    shares = dict(zip(flags, torch.stack(last_flags).mean(0).tolist(), strict=True)) if flags else {}
    return Evaluation(sum(successes) / n, sum(returns) / n, sum(lengths) / n, shares)


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
