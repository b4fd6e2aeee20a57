"""Visual navigation with SAC and hindsight: the task of ``ddpg_navigate.py``, another algorithm.

Usage::

    python recipes/sac_navigate.py                     # HALGAN, 2 m room, shipped weights
    python recipes/sac_navigate.py --method oracle     # the simulator itself paints the goal

Folder and metrics are those of ``ddpg_navigate.py``; ``train/entropy`` and ``train/entropy_coefficient`` take the place
of ``train/q_value``. The paper has no SAC, so there is no ``paper`` preset.
"""

from pathlib import Path

import halgan_envs
from halgan_rl.agents.sac import SACConfig
from halgan_rl.experiment.config import RunConfig
from halgan_rl.experiment.methods import make_hindsight
from halgan_rl.experiment.presets import parse_config
from halgan_rl.experiment.run import Run, make_agent, make_buffer, prepare
from halgan_rl.transforms.hindsight_config import HindsightConfig

DEFAULT = RunConfig(
    out=Path("runs/sac_navigate"),
    agent=SACConfig(tau=1e-1),
    hindsight=HindsightConfig(pursue_unseen=False),
)
PRESETS = {"default": DEFAULT}


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
