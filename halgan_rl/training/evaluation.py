"""Evaluation of a policy on fixed starts."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from halgan_rl.keys import Keys, dotted
from halgan_rl.poses import PlanarPoses

HEIGHT_ALONE = 256
"""Height of a film that shows only what the agent sees [pixels]."""


@dataclass(frozen=True)
class Evaluation:
    """What one evaluation measured, averaged over its episodes.

    Attributes:
        success_rate: fraction of the episodes that succeeded, in [0, 1]: that *terminated*, for running out of time is
            no success, or, if ``keys.success`` is given, in which that flag was set.
        episode_return: mean undiscounted sum of rewards.
        episode_length: mean number of steps.
        flags: by the name of each of the pose's flags, fraction of the episodes that ended with it set.
    """

    success_rate: float
    episode_return: float
    episode_length: float
    flags: Mapping[str, float] = field(default_factory=dict)

    def metrics(self, prefix: str = "eval") -> dict[str, float]:
        """Returns the metrics under ``prefix/``, ready for a logger."""
        return {
            f"{prefix}/success_rate": self.success_rate,
            f"{prefix}/return": self.episode_return,
            f"{prefix}/episode_length": self.episode_length,
            **{f"{prefix}/{flag}": fraction for flag, fraction in self.flags.items()},
        }


@torch.no_grad()
def evaluate(
    env: EnvBase,
    policy: TensorDictModuleBase,
    *,
    seeds: Sequence[int],
    max_steps: int = 1_000,
    poses: PlanarPoses = PlanarPoses(),
    keys: Keys = Keys(),
) -> Evaluation:
    """Runs the deterministic policy once from each start.

    Args:
        env: an unbatched environment; it is re-seeded before each episode, so give evaluation one of its own.
        policy: reads the environment's observations and writes its action.
        seeds: one seed a start; the same seeds are the same starts.
        max_steps: bound on an episode's length, if the environment does not end it before.
        poses: its flags are reported: how often each is set in the end. Without flags, no pose is read.
        keys: where the environment writes what.

    Raises:
        ValueError: if ``seeds`` is empty, or the poses are not such poses.
        KeyError: if the environment does not write a key.
    """
    if not seeds:
        raise ValueError("seeds is empty: give one seed for each start to evaluate")
    successes, returns, lengths, last_flags = [], [], [], []
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for seed in seeds:
            env.set_seed(seed)
            episode = env.rollout(max_steps, policy, break_when_any_done=True)
            successes.append(_succeeded(episode, keys))
            returns.append(float(_read_next(episode, "reward", keys).sum()))
            lengths.append(len(episode))
            if poses.flags:
                pose = _read_next(episode, "pose", keys)[-1]
                poses.check(pose, dotted(keys.next("pose")))
                last_flags.append(poses.flag_part(pose))
    n = len(seeds)
    fractions = torch.stack(last_flags).mean(0).tolist() if poses.flags else []
    flags = dict(zip(poses.flags, fractions, strict=True))
    return Evaluation(sum(successes) / n, sum(returns) / n, sum(lengths) / n, flags)


def _succeeded(episode: TensorDictBase, keys: Keys) -> bool:
    """Returns whether an episode ``[T]`` terminated or, if ``keys.success`` is given, set that flag at any step."""
    if keys.success is not None:
        return bool(_read_next(episode, "success", keys).any())
    return bool(_read_next(episode, "terminated", keys)[-1].any())


def _read_next(episode: TensorDictBase, name: str, keys: Keys) -> Tensor:
    """Returns the entry of a field of ``keys`` one step later; a missing one is named, with the field to set."""
    key = keys.next(name)
    value = episode.get(key, None)
    if value is None:
        present = ", ".join(sorted(map(dotted, episode.keys(True, True))))
        raise KeyError(
            f"evaluation misses the key {dotted(key)}, set by keys=Keys({name}={getattr(keys, name)!r}). "
            f"The environment writes {present}."
        )
    return value


@torch.no_grad()
def record(
    env: EnvBase,
    policy: TensorDictModuleBase,
    overview: Callable[[], np.ndarray] | None = None,
    *,
    seeds: Sequence[int],
    max_steps: int = 1_000,
    keys: Keys = Keys(),
    frame_stack: int = 1,
) -> list[np.ndarray]:
    """Films the deterministic policy: what the agent sees, to the right of a view from outside if there is one.

    Args:
        env: as for :func:`evaluate`; its images are uint8 ``[H, W, C]``.
        policy: as for :func:`evaluate`.
        overview: returns the view from outside, uint8 ``[H', W', 3]``; the agent's image is scaled to its height, or,
            if there is none, to 256 pixels.
        seeds: one seed a start.
        max_steps: bound on an episode's length.
        keys: where the environment writes what.
        frame_stack: frames stacked along C, of which the last is shown: C is ``frame_stack`` times 1 (grey) or 3 (RGB).

    Returns:
        Frames uint8 ``[H', W' + W H' / H, 3]`` of all episodes, one after the other.

    Raises:
        ValueError: if the environment's images are no such images.
    """
    frames: list[np.ndarray] = []

    def film(state: TensorDictBase) -> None:
        """Takes a picture of where the episode is."""
        seen = _last_frame(state[keys.pixels], frame_stack, keys)
        outside = [] if overview is None else [overview()]
        height = outside[0].shape[0] if outside else HEIGHT_ALONE
        frames.append(np.concatenate([*outside, _scale(seen, height)], axis=1))

    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for seed in seeds:
            env.set_seed(seed)
            state = env.reset()
            for _ in range(max_steps):
                film(state)
                step = env.step(policy(state))
                state = step_mdp(step)
                if step[keys.next("done")].any():
                    break
            film(state)
    return frames


def _last_frame(pixels: Tensor, frame_stack: int, keys: Keys) -> np.ndarray:
    """Returns the last of the frames stacked in an image ``[H, W, C]``, in RGB ``[H, W, 3]``."""
    if pixels.dtype != torch.uint8 or pixels.ndim != 3 or pixels.shape[-1] not in (frame_stack, 3 * frame_stack):
        raise ValueError(
            f"{dotted(keys.pixels)} is {pixels.dtype} {tuple(pixels.shape)}; a film needs uint8 [H, W, C] with C = "
            f"frame_stack * 1 or frame_stack * 3, and frame_stack={frame_stack}."
        )
    channels = pixels.shape[-1] // frame_stack
    return pixels[..., -channels:].expand(*pixels.shape[:2], 3).cpu().numpy()


def _scale(image: np.ndarray, height: int) -> np.ndarray:
    """Returns an image ``[H, W, 3]`` scaled to a height by the nearest pixel, which keeps pixels sharp."""
    rows, columns = image.shape[:2]
    width = round(columns * height / rows)
    return image[np.arange(height) * rows // height][:, np.arange(width) * columns // width]
