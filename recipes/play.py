"""Plays a saved policy and reports its success rate.

Usage::

    python recipes/play.py --run runs/ddpg_navigate                  # 100 starts that training never evaluated on
    python recipes/play.py --run runs/ddpg_navigate --gif agent.gif  # and films the first five
"""

import dataclasses
from functools import partial
from pathlib import Path

import torch
import tyro

import halgan_envs
from halgan_rl.experiment import pictures
from halgan_rl.experiment.policy import load_policy
from halgan_rl.training.evaluation import evaluate, record


@dataclasses.dataclass(frozen=True)
class Config:
    """Plays a saved policy and reports its success rate."""

    run: Path
    """Folder of a run, which holds `policy.safetensors`."""
    starts: int = 100
    """Episodes to play, each from a start of its own."""
    first_seed: int = 20_000
    """Seed of the first start; the starts of training's own evaluations lie below."""
    gif: Path | None = None
    """Film the first five episodes into this file."""


def main(config: Config) -> None:
    """Evaluates the policy of a run, and films it if a file is given."""
    torch.set_num_threads(1)  # as in training: more do not help networks this small
    path = config.run / "policy.safetensors"
    policy, manifest = load_policy(path)
    domain = halgan_envs.domain(manifest["environment"])
    env = domain.make()

    seeds = range(config.first_seed, config.first_seed + config.starts)
    result = evaluate(env, policy, seeds=seeds, poses=domain.poses, keys=domain.keys)
    print(
        f"{path} in {domain.name}: success rate {result.success_rate:.1%} over {config.starts} starts, "
        f"mean return {result.episode_return:.3f}, mean episode {result.episode_length:.1f} steps"
    )
    if config.gif is not None:
        overview = domain.overview and partial(domain.overview, env, 256, 320)
        film = record(env, policy, overview, seeds=seeds[:5], keys=domain.keys, frame_stack=domain.frame_stack)
        pictures.write_gif(config.gif, film)
        print(f"film: {config.gif}")
    env.close()


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
