"""Visual navigation with DDPG and hindsight: find the red box in the room, drive up to it, centre it.

Usage::

    python recipes/ddpg_navigate.py                                # HALGAN, 2 m room, shipped weights
    python recipes/ddpg_navigate.py --method oracle --seed 1       # the simulator itself paints the goal
    python recipes/ddpg_navigate.py --method none                  # plain DDPG: never sees a reward
    python recipes/ddpg_navigate.py --preset 4m                    # the paper's 4 m room, on two cores
    python recipes/ddpg_navigate.py --preset paper                 # the paper's appendix

Every run writes a folder: ``config.json``, ``metrics.csv``, ``policy.safetensors`` with its manifest, ``curve.png``,
``agent.gif`` and ``hallucinations.png``. ``recipes/play.py`` plays the saved policy. Metrics, one row an evaluation:

==============================  ====================================================================
``frames``, ``seconds``         environment steps; wall time from the start until they were evaluated
``eval/success_rate``           fraction of the fixed starts that the deterministic policy solves
``eval/return``                 mean undiscounted return
``eval/episode_length``         mean steps
``train/success_rate``          fraction of the exploring episodes since the last evaluation that succeed
``train/hallucinated_fraction`` fraction of the sampled rows that were relabelled since the last evaluation
``train/q_value``, ``.../loss`` mean over the updates since the last evaluation
``train/epsilon``               fraction of uniformly random actions
==============================  ====================================================================

Differences from the paper (Sahni et al., NeurIPS 2019, appendix), all undone by ``--preset paper``:

1. The room is 2 m wide and starts are at least 0.5 m from the box, instead of 4 m and 1 m.
2. Convolutions have stride 2 instead of max-pooling. The paper gives neither; the parameters are as many.
3. Learning rates are 1e-4 and 1e-3 instead of 1e-5 and 1e-4.
4. The discount is 0.95 instead of 0.99: a step changes a value by more than the critic's error. Tau is 1e-1 instead of
   1e-3: values spread, and made-up values decay, that much faster (4m: 2e-2).
5. Targets are clipped to [-1, 1], the range of any return.
6. The square of the actor's pre-activations has a penalty weight of 1e-4 (4m: 1e-3). Without it the tanh saturates
   within 500 updates.
7. Goals lie up to 96 steps ahead instead of 32, and near ones are preferred (steps to the goal: uniform squared).
8. Epsilon falls from 1 to 0.1 over 6,000 frames instead of to 0.5 over 100,000 (4m: over 30,000). The warm-up has 2,000
   frames instead of 10,000.
9. Relabelling decays over 60,000 frames instead of 100,000 (4m: 200,000). The paper does not give the span; its preset
   has that of its epsilon.
10. The generator is this library's (``recipes/train_generator.py``). Its output is tabulated once and looked up. Both
    images of a row show one latent's goal; the paper's preset draws a latent for each image.
11. The actor's last layer starts near zero, as in DDPG's own paper.
12. A moving average of the actor's weights, over some 500 updates, is evaluated and saved.
13. Goals that the image does not show are not pursued (4m: they are).
14. In the 4m preset there is one update every 2 frames instead of every frame.

The rover has no reverse gear: action -1 is rest and +1 full speed. A random walk that reverses takes half of its
hindsight goals from behind the robot, where no camera sees them.
"""

from dataclasses import replace
from pathlib import Path

import halgan_envs
from halgan_rl.agents.ddpg import PAPER, DDPGConfig
from halgan_rl.experiment.config import PAPER_PAINTER, PAPER_TRAINING, RunConfig
from halgan_rl.experiment.methods import make_hindsight
from halgan_rl.experiment.presets import parse_config
from halgan_rl.experiment.run import Run, make_agent, make_buffer, prepare
from halgan_rl.training.loop import TrainingConfig
from halgan_rl.transforms.annealing import Annealing
from halgan_rl.transforms.hindsight_config import HindsightConfig

DEFAULT = RunConfig(
    out=Path("runs/ddpg_navigate"),
    agent=DDPGConfig(tau=1e-1, preactivation_weight=1e-4),
    hindsight=HindsightConfig(pursue_unseen=False),
)
LARGE_ROOM = RunConfig(
    preset="4m",
    environment="navigate-4m",
    total_frames=100_000,
    out=DEFAULT.out,
    agent=DDPGConfig(epsilon=Annealing(1.0, 0.1, 30_000)),
    hindsight=HindsightConfig(probability=Annealing(0.3, 0.0, 200_000)),
    training=TrainingConfig(frames_per_update=2),
)
PAPER_RUN = RunConfig(
    preset="paper",
    environment="navigate-4m",
    total_frames=250_000,
    out=DEFAULT.out,
    agent=replace(PAPER, epsilon=Annealing(1.0, 0.5, 100_000)),
    hindsight=HindsightConfig(probability=Annealing(0.3, 0.0, 100_000), max_distance=32, nearness=1.0),
    painter=PAPER_PAINTER,
    training=PAPER_TRAINING,
)
PRESETS = {"default": DEFAULT, "4m": LARGE_ROOM, "paper": PAPER_RUN}


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
