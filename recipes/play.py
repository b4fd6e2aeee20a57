"""Play a saved policy and report its success rate.

Usage::

    python recipes/play.py --run runs/ddpg_navigate                  # 100 starts that training never evaluated on
    python recipes/play.py --run runs/ddpg_navigate --gif agent.gif  # and film the first five
"""

import dataclasses
from functools import partial
from pathlib import Path

import halgan_envs
import torch
import tyro

from halgan_rl.agents.networks import Actor, QNetwork, deterministic_policy, greedy_policy
from halgan_rl.experiment import pictures
from halgan_rl.hallucination.weights import load_module, read_manifest
from halgan_rl.training.evaluation import evaluate, record

POLICIES = {Actor.kind: (Actor, deterministic_policy), QNetwork.kind: (QNetwork, greedy_policy)}
"""Kind of a saved network: how it is rebuilt, and how it acts."""
FIRST_SEED = 20_000
"""Seed of the first start; the starts of training's own evaluations lie below."""


@dataclasses.dataclass(frozen=True)
class Config:
    """Play a saved policy and report its success rate."""

    run: Path
    """Folder of a run, which holds `policy.safetensors`."""
    starts: int = 100
    """Episodes to play, each from a start of its own."""
    first_seed: int = FIRST_SEED
    """Seed of the first start."""
    gif: Path | None = None
    """Film the first five episodes into this file."""


def main(config: Config) -> None:
    """Evaluate the policy of a run, and film it if asked to."""
    torch.set_num_threads(1)  # as in training: more do not help networks this small
    path = config.run / "policy.safetensors"
    build, make_policy = POLICIES[read_manifest(path)["kind"]]
    network, manifest = load_module(path, build)
    policy = make_policy(network)
    env = halgan_envs.make(manifest["environment"])
    seeds = range(config.first_seed, config.first_seed + config.starts)
    result = evaluate(env, policy, seeds=seeds)
    print(
        f"{path} in {manifest['environment']}: success rate {result.success_rate:.1%} over {config.starts} starts, "
        f"mean return {result.episode_return:.3f}, mean episode {result.episode_length:.1f} steps"
    )
    if config.gif is not None:
        film = record(env, policy, partial(env.render_overview, 256, 320), seeds=seeds[:5])
        pictures.write_gif(config.gif, film)
        print(f"film: {config.gif}")
    env.close()


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
