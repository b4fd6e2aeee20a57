"""Named pipelines: the same few transforms, combined. Append one to a replay buffer.

Any sampler of single rows will do. What a sampler of slices needs, :class:`DrawHindsightGoal` documents, and
:func:`check_sampler` checks. With prioritised replay, DDPG's and DQN's losses write priorities for all rows of a batch,
relabelled ones too: a stored row's priority then comes from its temporal-difference error under *another* goal, images
and reward than those it is sampled with next. It prefers rows that are surprising under some goal. A loop that wants
the priorities of real rows only leaves out the rows of ``hindsight.relabelled(batch)`` when it writes them.
"""

from collections.abc import Iterator
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import ReplayBuffer
from torchrl.data.replay_buffers import SliceSampler
from torchrl.envs import Compose, Transform

from halgan_rl.keys import Keys
from halgan_rl.poses import PlanarPoses, Poses
from halgan_rl.transforms.draw_hindsight_goal import DrawHindsightGoal
from halgan_rl.transforms.hallucinate_goal import HallucinateGoal, Hallucinator
from halgan_rl.transforms.hindsight_config import HindsightConfig
from halgan_rl.transforms.hindsight_reward import HindsightReward
from halgan_rl.transforms.stamp_future_poses import StampFuturePoses


class Hindsight(Compose):
    """A ``Compose`` that anneals its goal drawing and says which rows of a batch it relabelled.

    Args:
        *transforms: in the order of the sample path, each at most once; none for plain replay.
        keys: where rows keep what.
    """

    def __init__(self, *transforms: Transform, keys: Keys = Keys()) -> None:
        super().__init__(*transforms)
        self.keys = keys

    @property
    def probability(self) -> float:
        """The present fraction of rows to relabel."""
        draw = _find(self, DrawHindsightGoal)
        return 0.0 if draw is None else draw.probability

    @property
    def hallucinator(self) -> Hallucinator | None:
        """What paints goals; None if nothing does."""
        paint = _find(self, HallucinateGoal)
        return None if paint is None else paint.hallucinator

    def step(self, frames: int = 1) -> None:
        """Anneals the probability by so many environment frames."""
        draw = _find(self, DrawHindsightGoal)
        if draw is not None:
            draw.step(frames)

    def relabelled(self, batch: TensorDictBase) -> Tensor:
        """Returns bool ``[N, 1]``: which rows of a sampled batch ``[N]`` have a goal in hindsight."""
        if _find(self, DrawHindsightGoal) is None:
            return torch.zeros(*batch.shape, 1, dtype=torch.bool, device=batch.device)
        return batch.get(self.keys.goal_mask)


def halgan(
    hallucinator: Hallucinator,
    *,
    rng: torch.Generator,
    config: HindsightConfig = HindsightConfig(),
    discount: float | None = None,
    poses: Poses = PlanarPoses(),
    keys: Keys = Keys(),
) -> Hindsight:
    """HALGAN (Sahni et al. 2019, algorithm 1): failures replayed as successes at hallucinated goals.

    Args:
        hallucinator: paints the goal into the images: a trained GAN, the simulator itself as an oracle, or anything
            else that keeps the protocol.
        rng: draws which rows are relabelled, and their goals.
        config: how often, how far, how well rewarded.
        discount: discount of a step; needed for n-step returns only, and then that of the loss.
        poses: what the entries of a pose mean, and when one is the goal pose.
        keys: where rows keep what.

    Returns:
        ``StampFuturePoses``, ``DrawHindsightGoal``, ``HallucinateGoal`` and ``HindsightReward``, composed.

    Raises:
        ValueError: if values do not go together.
    """
    paint = HallucinateGoal(hallucinator, pursue_unseen=config.pursue_unseen, fixed_shape=config.fixed_shape, keys=keys)
    return _relabelling(paint, rng=rng, config=config, discount=discount, poses=poses, keys=keys)


def her(
    *,
    rng: torch.Generator,
    config: HindsightConfig = HindsightConfig(),
    discount: float | None = None,
    poses: Poses = PlanarPoses(),
    keys: Keys = Keys(),
) -> Hindsight:
    """Naive hindsight experience replay: the reward of a goal that the images do not show.

    Args:
        rng: draws which rows are relabelled, and their goals.
        config: as of :func:`halgan`; ``pursue_unseen`` and ``fixed_shape`` mean nothing here.
        discount: discount of a step; needed for n-step returns only, and then that of the loss.
        poses: what the entries of a pose mean, and when one is the goal pose.
        keys: where rows keep what.

    Returns:
        ``StampFuturePoses``, ``DrawHindsightGoal`` and ``HindsightReward``, composed.
    """
    return _relabelling(rng=rng, config=config, discount=discount, poses=poses, keys=keys)


def none(*, keys: Keys = Keys()) -> Hindsight:
    """Plain replay: no transform, nothing relabelled."""
    return Hindsight(keys=keys)


def check_sampler(buffer: ReplayBuffer) -> None:
    """Checks that a buffer's sampler and its hindsight go together. Call it before the first sample.

    A ``SliceSampler`` writes its own flags into a batch after the transforms ran, which would undo the terminations in
    hindsight; and hindsight must know that it gets slices. A transform sees neither.

    Raises:
        ValueError: if they do not; says how to build the sampler.
    """
    draw, sampler = _find(buffer.transform, DrawHindsightGoal), buffer.sampler
    if draw is None or not isinstance(sampler, SliceSampler):
        return
    if not draw.per_slice:
        raise ValueError(
            "The sampler gives slices, and a goal for each row would show one slice several goals: give "
            "DrawHindsightGoal(per_slice=True), or sample rows at random."
        )
    for name in ("truncated_key", "init_key"):
        if getattr(sampler, name, None) is not None:
            raise ValueError(
                f"{type(sampler).__name__}({name}={getattr(sampler, name)!r}) overwrites flags that hindsight sets: "
                f"build it with {name}=None."
            )


def _relabelling(
    *painters: Transform,
    rng: torch.Generator,
    config: HindsightConfig,
    discount: float | None,
    poses: Poses,
    keys: Keys,
) -> Hindsight:
    """Composes what all pipelines share around what paints."""
    stamp = StampFuturePoses(
        config.max_distance,
        success_threshold=config.success_threshold,
        max_step=config.max_step,
        n_steps=config.n_steps,
        discount=discount,
        poses=poses,
        keys=keys,
    )
    draw = DrawHindsightGoal(config.probability, rng=rng, nearness=config.nearness, poses=poses, keys=keys)
    reward = HindsightReward(
        success_reward=config.success_reward, n_steps=config.n_steps, discount=discount, poses=poses, keys=keys
    )
    return Hindsight(stamp, draw, *painters, reward, keys=keys)


def _find(transform: Transform, kind: type) -> Any:
    """Returns the one part of a kind, or None."""
    return next((part for part in _parts(transform) if isinstance(part, kind)), None)


def _parts(transform: Transform) -> Iterator[Transform]:
    """Yields the parts of a transform, nested ones too."""
    if isinstance(transform, Compose):
        for part in transform.transforms:
            yield from _parts(part)
    elif transform is not None:
        yield transform
