"""Named pipelines: the same few transforms, combined. Append one to a replay buffer."""

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Compose

from halgan_rl.keys import Keys
from halgan_rl.poses import PlanarPoses, Poses
from halgan_rl.transforms.annealing import Annealing
from halgan_rl.transforms.draw_hindsight_goal import DrawHindsightGoal
from halgan_rl.transforms.hallucinate_goal import HallucinateGoal, Hallucinator
from halgan_rl.transforms.hindsight_reward import HindsightReward
from halgan_rl.transforms.stamp_future_poses import StampFuturePoses


class Hindsight(Compose):
    """A ``Compose`` that anneals its goal drawing and says which rows of a batch it relabelled.

    Args:
        *transforms: in the order of the sample path; one of them is a ``DrawHindsightGoal``.
        keys: where rows keep what.
    """

    def __init__(self, *transforms: Any, keys: Keys = Keys()) -> None:  # noqa: B008 (frozen)
        super().__init__(*transforms)
        self.keys = keys

    @property
    def probability(self) -> float:
        """The present fraction of rows to relabel."""
        return self._draw.probability

    def step(self, frames: int = 1) -> None:
        """Anneals the probability by so many environment frames."""
        self._draw.step(frames)

    def relabelled(self, batch: TensorDictBase) -> Tensor:
        """Returns bool ``[N, 1]``: which rows of a sampled batch ``[N]`` have a goal in hindsight."""
        return batch.get(self.keys.goal_mask)

    @property
    def _draw(self) -> DrawHindsightGoal:
        return next(transform for transform in self.transforms if isinstance(transform, DrawHindsightGoal))


def halgan(
    hallucinator: Hallucinator,
    *,
    rng: torch.Generator,
    max_distance: int = 32,
    probability: Annealing = Annealing(0.3, 0.0, 60_000),  # noqa: B008 (frozen)
    nearness: float = 1.0,
    pursue_unseen: bool = True,
    success_reward: float = 1.0,
    poses: Poses = PlanarPoses(),  # noqa: B008 (frozen)
    keys: Keys = Keys(),  # noqa: B008 (frozen)
    fixed_shape: bool = False,
) -> Hindsight:
    """HALGAN (Sahni et al. 2019, algorithm 1): failures replayed as successes at hallucinated goals.

    Args:
        hallucinator: Paints the goal into the images: a trained GAN, or anything that keeps the protocol.
        rng: Draws which rows are relabelled, and their goals.
        max_distance: Furthest goal, in steps.
        probability: Fraction of sampled rows for which a goal is drawn, by the frames of ``pipeline.step(frames)``.
        nearness: Preference for near goals; 1 draws them uniformly, as the paper does.
        pursue_unseen: Whether goals are pursued that the image does not show, as in the paper.
        success_reward: Added to the reward of a relabelled row that reaches its goal.
        poses: What the entries of a pose mean, and when one is the goal pose.
        keys: Where rows keep what.
        fixed_shape: Whether to hallucinate all rows, so that no shape depends on the data.

    Returns:
        ``StampFuturePoses``, ``DrawHindsightGoal``, ``HallucinateGoal`` and ``HindsightReward``, composed.

    Raises:
        ValueError: If a value is out of range.
    """
    return Hindsight(
        StampFuturePoses(max_distance, poses=poses, keys=keys),
        DrawHindsightGoal(probability, rng=rng, nearness=nearness, poses=poses, keys=keys),
        HallucinateGoal(hallucinator, pursue_unseen=pursue_unseen, fixed_shape=fixed_shape, keys=keys),
        HindsightReward(success_reward=success_reward, poses=poses, keys=keys),
        keys=keys,
    )


def oracle(renderer: Hallucinator, **options: Any) -> Hindsight:
    """Perfect hallucinations: :func:`halgan` with the goal rendered by the simulator itself.

    Args:
        renderer: Adds to each image what the simulator shows of a goal where hindsight puts it.
        **options: Those of :func:`halgan`, ``rng`` among them.

    Returns:
        What :func:`halgan` returns.
    """
    return halgan(renderer, **options)
