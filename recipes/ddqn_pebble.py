"""The TurtleBot's pebble with double DQN and hindsight: find a small stone on a road, drive up to it, centre it.

Usage::

    python recipes/ddqn_pebble.py                    # HALGAN, shipped weights
    python recipes/ddqn_pebble.py --method oracle    # the simulator itself paints the pebble
    python recipes/ddqn_pebble.py --method none      # plain DDQN
    python recipes/ddqn_pebble.py --preset paper     # the paper's appendix

Every run writes a folder: ``config.json``, ``metrics.csv``, ``policy.safetensors`` with its manifest, ``curve.png``,
``agent.gif`` and ``hallucinations.png``. ``recipes/play.py`` plays the saved policy. Metrics, one row an evaluation:

==============================  ====================================================================
``frames``, ``seconds``         environment steps; wall time from the start until they were evaluated
``eval/success_rate``           fraction of the fixed starts that the deterministic policy solves
``eval/return``                 mean undiscounted return
``eval/episode_length``         mean steps
``train/success_rate``          fraction of the exploring episodes since the last evaluation that succeed
``train/hallucinated_fraction`` fraction of the sampled rows that were relabelled since the last evaluation
``train/loss``                  mean over the updates since the last evaluation
``train/epsilon``               fraction of uniformly random actions
==============================  ====================================================================

Differences from the paper (Sahni et al., NeurIPS 2019, appendix), all undone by ``--preset paper``:

1. Convolutions have stride 2 instead of max-pooling. The paper gives neither; the parameters are as many.
2. The discount is 0.95 instead of 0.99, tau 2e-2 instead of 1e-3.
3. Targets are clipped to [-1, 1], the range of any return.
4. Half of the sampled rows are relabelled at first, instead of a fifth. The fraction decays over 60,000 frames instead
   of 100,000; the paper does not give the span, its preset has that of its epsilon.
5. Goals lie up to 32 steps ahead instead of 16, so that the pebble is also seen from afar.
6. Epsilon falls from 1 to 0.1 over 20,000 frames instead of to 0.5 over 100,000. The warm-up has 2,000 frames instead
   of 10,000.
7. The generator is this library's (``recipes/train_generator.py``). Its output is tabulated once and looked up. Both
   images of a row show one latent's goal; the paper's preset draws a latent for each image.
8. A moving average of the network's weights, over some 500 updates, is evaluated and saved.

The paper does not say what the four actions do. That decides whether a greedy agent searches or dithers: see
``envs/robots/turtlebot.py``.
"""

from dataclasses import replace
from pathlib import Path

import halgan_envs
from halgan_rl.agents.ddqn import PAPER, DDQNConfig
from halgan_rl.experiment.config import PAPER_PAINTER, PAPER_TRAINING, RunConfig
from halgan_rl.experiment.methods import make_hindsight
from halgan_rl.experiment.presets import parse_config
from halgan_rl.experiment.run import Run, make_agent, make_buffer, prepare
from halgan_rl.transforms.annealing import Annealing
from halgan_rl.transforms.hindsight_config import HindsightConfig

DEFAULT = RunConfig(
    environment="pebble",
    total_frames=30_000,
    out=Path("runs/ddqn_pebble"),
    agent=DDQNConfig(epsilon=Annealing(1.0, 0.1, 20_000)),
    hindsight=HindsightConfig(probability=Annealing(0.5, 0.0, 60_000), max_distance=32, nearness=1.0),
)
PAPER_RUN = RunConfig(
    preset="paper",
    environment="pebble",
    total_frames=250_000,
    out=DEFAULT.out,
    agent=replace(PAPER, epsilon=Annealing(1.0, 0.5, 100_000)),
    hindsight=HindsightConfig(probability=Annealing(0.2, 0.0, 100_000), max_distance=16, nearness=1.0),
    painter=PAPER_PAINTER,
    training=PAPER_TRAINING,
)
PRESETS = {"default": DEFAULT, "paper": PAPER_RUN}


def main(config: RunConfig) -> None:
    """Trains, evaluates, and writes everything into `config.out`."""
    prepare(config)
    domain = halgan_envs.domain(config.environment)

    # The agent, what relabels failed rows, and the replay buffer in which it does.
    agent = make_agent(config, domain)
    hindsight = make_hindsight(config, domain)
    buffer = make_buffer(config.training, hindsight, seed=config.seed)

    # Training, with evaluation beside it; then the pictures.
    with Run(config, domain, agent, buffer, hindsight) as run:
        run.train()
    run.draw()
    print(run.summary())


if __name__ == "__main__":
    main(parse_config(PRESETS, description=__doc__))
