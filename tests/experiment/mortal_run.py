"""A run with both kinds of child processes, to be killed: ``python -m tests.experiment.mortal_run FOLDER``."""

import sys
from pathlib import Path

import torch

from halgan_rl.experiment.config import RunConfig
from halgan_rl.experiment.methods import make_hindsight
from halgan_rl.experiment.presets import changed
from halgan_rl.experiment.run import Run, make_agent, make_buffer
from tests.recipes import TINY
from tests.room import room_domain

ENDLESS = {
    **TINY,
    "total_frames": 1_600_000,
    "method": "her",
    "evaluation.background": True,
    "training.background_collection": True,
}


def main() -> None:
    torch.set_num_threads(1)
    config, domain = changed(RunConfig(out=Path(sys.argv[1])), ENDLESS), room_domain((32, 32, 3))
    agent, hindsight = make_agent(config, domain), make_hindsight(config, domain)
    buffer = make_buffer(config.training, hindsight, seed=0)
    with Run(config, domain, agent, buffer, hindsight) as run:
        run.train()


if __name__ == "__main__":
    main()
