"""Pick & place with DDPG and hindsight: find the small red box and pick it up, then find the green one with it.

Usage::

    python recipes/ddpg_pick_place.py                    # HALGAN paints both boxes, shipped weights
    python recipes/ddpg_pick_place.py --method oracle    # the simulator itself paints them
    python recipes/ddpg_pick_place.py --method none      # plain DDPG: never sees a reward
    python recipes/ddpg_pick_place.py --preset paper     # the paper's appendix

There is one reward, for the delivery. The pose has a fourth entry, ``held``. While it is 0, hindsight paints the red
box, and being where the robot was later, or where it picked the box up, counts as success. While it is 1, the same
holds for the green box.

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
``eval/held``                   fraction of the fixed starts in which the red box was picked up
``train/epsilon``               fraction of uniformly random actions
==============================  ====================================================================

Differences from the paper (Sahni et al., NeurIPS 2019, appendix), all undone by ``--preset paper``:

1. The row's ``held`` flag selects the box that is painted. The authors draw it at random.
2. There is one update every 2 frames instead of every frame.
3. Convolutions have stride 2 instead of max-pooling. The paper gives neither; the parameters are as many.
4. Learning rates are 1e-4 and 1e-3 instead of 1e-5 and 1e-4.
5. The discount is 0.95 instead of 0.99, tau 2e-2 instead of 1e-3.
6. Targets are clipped to [-1, 1], the range of any return.
7. The square of the actor's pre-activations has a penalty weight of 1e-3. Without it the tanh saturates.
8. Goals lie up to 96 steps ahead instead of 16, and near ones are preferred (steps to the goal: uniform squared).
9. Epsilon falls from 1 to 0.4 over 33,000 frames instead of to 0.5 over 250,000. The warm-up has 2,000 frames instead
   of 10,000.
10. Relabelling decays over 300,000 frames instead of 250,000. The paper does not give the span; its preset has that of
    its epsilon.
11. The generator is this library's (``recipes/train_generator.py``). Its output is tabulated once and looked up. Both
    images of a row show one latent's goal; the paper's preset draws a latent for each image.
12. The actor's last layer starts near zero, as in DDPG's own paper.
13. A moving average of the actor's weights, over some 500 updates, is evaluated and saved.
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
    environment="pick-and-place-2m",
    total_frames=60_000,
    out=Path("runs/ddpg_pick_place"),
    agent=DDPGConfig(epsilon=Annealing(1.0, 0.4, 33_000)),
    hindsight=HindsightConfig(probability=Annealing(0.3, 0.0, 300_000)),
    training=TrainingConfig(frames_per_update=2),
)
PAPER_RUN = RunConfig(
    preset="paper",
    environment="pick-and-place-2m",
    total_frames=500_000,
    out=DEFAULT.out,
    agent=replace(PAPER, epsilon=Annealing(1.0, 0.5, 250_000)),
    hindsight=HindsightConfig(probability=Annealing(0.3, 0.0, 250_000), max_distance=16, nearness=1.0),
    painter=replace(PAPER_PAINTER, random_flags=True),
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
