"""The TurtleBot's pebble with double DQN and hindsight: find a small stone on a road, drive up to it, centre it.

Usage::

    python recipes/ddqn_pebble.py                       # HALGAN, shipped weights
    python recipes/ddqn_pebble.py --hindsight oracle    # the simulator itself paints the pebble
    python recipes/ddqn_pebble.py --hindsight none      # plain DDQN
    python recipes/ddqn_pebble.py --preset paper        # the paper's appendix

The run's folder and metrics are those of ``ddpg_navigate.py``, but for ``train/loss`` instead of the losses of actor
and critic. Differences from the paper, all undone by ``--preset paper``: those numbered in ``ddpg_navigate.py`` that
concern strides, discount, targets (they follow at 2e-2), warm-up, the average policy and the bank, and three more:

1. Half of the sampled rows are relabelled at first, instead of a fifth; their share decays over 60,000 frames.
2. Goals up to 32 steps ahead instead of 16, so that the pebble is also seen from afar. (No preference for near ones.)
3. Epsilon from 1 to 0.1 over 20,000 frames instead of to 0.5 over 100,000.

What the four actions do, which the paper does not tell, decides whether a greedy agent searches or dithers: see
``envs/robots/turtlebot.py``.
"""

import dataclasses
from pathlib import Path

import halgan_envs

from halgan_rl.agents.ddqn import DDQNConfig, make_agent
from halgan_rl.experiment.config import PAPER
from halgan_rl.experiment.presets import parse_config
from halgan_rl.experiment.run import run


@dataclasses.dataclass(frozen=True)
class Config(DDQNConfig):
    """The TurtleBot's pebble with double DQN and hindsight."""

    environment: str = "pebble"
    """One of `halgan_envs.NAMES`."""
    total_frames: int = 30_000
    """Environment steps."""
    out: Path = Path("runs/ddqn_pebble")
    """Folder of the run; must not hold one yet."""
    hallucination_start: float = 0.5
    """Probability that a goal is drawn for a sampled row, at the start."""
    max_distance: int = 32
    """Longest failed snippet: the goal lies 1 to this many steps ahead."""
    nearness: float = 1.0
    """Preference for near goals: the steps to the goal are uniform to this power; 1 is uniform."""
    epsilon_frames: int = 20_000
    """Frames over which the share of uniformly random actions falls."""


PRESETS = {
    "default": Config(),
    "paper": Config(
        **PAPER,
        preset="paper",
        total_frames=250_000,
        max_distance=16,
        epsilon_frames=100_000,
        hallucination_start=0.2,
        hallucination_frames=100_000,
    ),
}


def main(config: Config) -> None:
    """Train, evaluate, and write everything into `config.out`."""
    success = run(config, make_agent, halgan_envs)
    print(
        f"success rate {success:.0%} after {config.total_frames} frames; pictures and weights in {config.out}\n"
        f"next: python recipes/play.py --run {config.out}"
    )


if __name__ == "__main__":
    main(parse_config(PRESETS, description=__doc__))
