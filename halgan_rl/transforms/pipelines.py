"""Named pipelines: the same few transforms, combined. Append one to a replay buffer.

Each is a plain function that returns a :class:`torchrl.envs.Compose`; its members are reached by index, for instance
``pipeline[1].step(frames)`` to anneal the share of relabelled rows.
"""

from typing import Any

import torch
from tensordict import NestedKey
from torchrl.envs import Compose

from halgan_rl.poses import PoseTolerance
from halgan_rl.transforms import DrawHindsightGoal, HallucinateGoal, Hallucinator, HindsightReward, StampFuturePoses


def halgan(
    hallucinator: Hallucinator,
    *,
    generator: torch.Generator,
    max_distance: int = 32,
    probability: float = 0.3,
    final_probability: float = 0.0,
    annealing_steps: int = 60_000,
    nearness: float = 1.0,
    tolerance: PoseTolerance = PoseTolerance(),  # noqa: B008 (frozen)
    success_reward: float = 1.0,
    pursue_unseen: bool = True,
    fixed_shape: bool = False,
    pixels_key: NestedKey = "pixels",
    pose_key: NestedKey = "pose",
    reward_key: NestedKey = "reward",
    done_key: NestedKey = "done",
    terminated_key: NestedKey = "terminated",
    truncated_key: NestedKey = "truncated",
    hindsight_key: NestedKey = "hindsight",
    goal_key: NestedKey = "goal",
) -> Compose:
    """HALGAN (Sahni et al. 2019, algorithm 1): failures replayed as successes at hallucinated goals.

    Args:
        hallucinator: Paints the goal into the images: a trained GAN, or anything that keeps the protocol.
        generator: Draws which rows are relabelled, and their goals.
        max_distance: Furthest goal, in steps.
        probability: Share of sampled rows for which a goal is drawn at first, in [0, 1].
        final_probability: That share after ``annealing_steps`` frames.
        annealing_steps: Frames from the one share to the other, counted by ``pipeline[1].step(frames)``.
        nearness: Preference for near goals; 1 draws them uniformly, as the paper does.
        tolerance: When a pose is the goal pose.
        success_reward: Added to the reward of a relabelled row that reaches its goal.
        pursue_unseen: Whether goals are pursued that the image does not show, as in the paper.
        fixed_shape: Whether to hallucinate all rows, so that no shape depends on the data.
        pixels_key: Images uint8 ``[H, W, 3]``.
        pose_key: Pose ``[P]``: x [m], y [m], yaw [rad], flags.
        reward_key: Reward ``[1]``, under ``"next"``.
        done_key: End-of-episode flag ``[1]``, under ``"next"``.
        terminated_key: Termination flag ``[1]``, under ``"next"``.
        truncated_key: Time-limit flag ``[1]``, under ``"next"``.
        hindsight_key: Where each row's future poses are stored.
        goal_key: Where a sampled row's goal is written.

    Returns:
        ``Compose(StampFuturePoses, DrawHindsightGoal, HallucinateGoal, HindsightReward)``.

    Raises:
        ValueError: If a value is out of range.
    """
    return Compose(
        StampFuturePoses(
            max_distance,
            pose_key=pose_key,
            reward_key=reward_key,
            done_key=done_key,
            terminated_key=terminated_key,
            hindsight_key=hindsight_key,
        ),
        DrawHindsightGoal(
            probability,
            final_probability,
            annealing_steps,
            generator=generator,
            nearness=nearness,
            tolerance=tolerance,
            pose_key=pose_key,
            hindsight_key=hindsight_key,
            goal_key=goal_key,
        ),
        HallucinateGoal(
            hallucinator,
            pixels_key=pixels_key,
            pose_key=pose_key,
            goal_key=goal_key,
            pursue_unseen=pursue_unseen,
            fixed_shape=fixed_shape,
        ),
        HindsightReward(
            success_reward=success_reward,
            tolerance=tolerance,
            pose_key=pose_key,
            goal_key=goal_key,
            reward_key=reward_key,
            done_key=done_key,
            terminated_key=terminated_key,
            truncated_key=truncated_key,
        ),
    )


def oracle(renderer: Hallucinator, **options: Any) -> Compose:
    """Perfect hallucinations: :func:`halgan` with the goal rendered by the simulator itself.

    Args:
        renderer: Adds to each image what the simulator shows of a goal where hindsight puts it.
        **options: Those of :func:`halgan`, ``generator`` among them.

    Returns:
        What :func:`halgan` returns.
    """
    return halgan(renderer, **options)
