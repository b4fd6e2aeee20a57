"""Training of the generator that paints goals into failed frames.

Usage::

    python recipes/train_generator.py --environment navigate-2m --out runs/generator   # as shipped, two minutes
    python recipes/train_generator.py --preset pebble                                  # the same for the pebble
    python recipes/train_generator.py --preset adversarial                             # some ten minutes
    python recipes/train_generator.py --preset paper                                   # the paper's appendix, days
    python recipes/train_generator.py --out runs/generator --resume                    # goes on where it was stopped

The default is matte regression: agents have learned fastest with it (``results/generators.md``). It needs a goal with a
colour of its own. Adversarial training looks at no colours and comes nearer to the truth where the goal is in view.

Two sets of images are collected first. *Near-goal* frames are the last states of successful rollouts of a scripted
driver that knows where the goal is; it plays a person who shows the goal a few dozen times. *Failed* frames are
of uniformly random actions. No frame is paired with the same frame without the goal, and no image is picked by hand.

Every run writes a folder: ``config.json``, ``metrics.csv``, ``generator.safetensors`` with its manifest,
``state.safetensors`` to resume from, and ``hallucinations.png`` (held-out poses without goal, truly rendered, and
hallucinated). All are written at every evaluation, so that a run that is stopped keeps its latest. Metrics, one row an
evaluation:

==================================  ===================================================================
``steps``, ``seconds``              steps made; wall time of training
``truth/mask_overlap``              intersection over union of the pixels that goals change in truth and as painted
``truth/centroid_error``            median distance between the centres of the two [pixels]
``truth/outside_change``            mean change where nothing should change [levels of 255]
``mattes/loss``                     of matte regression
``adversarial/critic_gap``          by how much real images score better than fakes; it grows where the critic overfits
``adversarial/wrong_pose_gap``      by how much real images score better than under another configuration
``adversarial/slope``               mean squared slope of the critic at real images
``adversarial/extent``              how much of the images the generator changes
``paper/critic_distance``           estimate of the Wasserstein distance
``paper/auxiliary_real``            mean square error of the regressed configuration; ``.../auxiliary_fake``
``paper/change``                    mean square of H
==================================  ===================================================================

Losses are the last step's. The simulator's truth is measured and drawn only; training never sees it.

Differences from the paper (Sahni et al., NeurIPS 2019, appendix); ``--preset paper`` undoes all but 7:

1. The generator paints by coordinates (``CoordinateGenerator``) instead of by upsampling convolutions. Its output is a
   matte, colour and opacity, which changes nothing where it paints nothing, instead of tanh(s + H).
2. The configuration is the whole relative pose (x, y, sin yaw, cos yaw), standardised, instead of distance and bearing.
3. The generator is fitted to the colours that only near-goal frames show; nothing is trained adversarially. In
   ``--preset adversarial`` a critic judges images under a configuration instead of regressing it, and more besides: see
   ``halgan_rl.hallucination.training.adversarial``.
4. Configurations are those of near-goal frames instead of a kernel density's, with the same noise.
5. Frames are mirrored left to right, and their configurations with them.
6. Failed frames are 5,000 instead of 10,000, and up to 80 frames of the way to each goal are kept instead of 32 (the
   paper gives no number).
7. The near-goal frames come from a scripted driver, and are 2,000 for all tasks (the paper: 2,000 to 6,840).
"""

from functools import partial

import halgan_envs
from halgan_rl.experiment.generator_run import DataConfig, GeneratorRunConfig, prepare, run
from halgan_rl.experiment.presets import changed, parse_config
from halgan_rl.hallucination.generators.config import GeneratorConfig
from halgan_rl.hallucination.training.adversarial import AdversarialConfig
from halgan_rl.hallucination.training.matte_regression import MatteConfig
from halgan_rl.hallucination.training.paper import PaperTrainingConfig
from halgan_rl.hallucination.training.steps import GeneratorTrainingConfig

HELD_OUT_SEED = 20_000
"""Seed of the rollouts that training never sees."""

DEFAULT = GeneratorRunConfig()
PRESETS = {
    "default": DEFAULT,
    "adversarial": GeneratorRunConfig(
        preset="adversarial", training=GeneratorTrainingConfig(MatteConfig(steps=0), AdversarialConfig())
    ),
    # The pebble is small beside the places where it counts as reached: latents with little noise say which it is.
    "pebble": changed(DEFAULT, {"preset": "pebble", "environment": "pebble", "training.mattes.latent_noise": 0.05}),
    "paper": GeneratorRunConfig(
        preset="paper",
        data=DataConfig(steps_before_goal=32, failed_frames=10_000),
        generator=GeneratorConfig(kind="paper", composition="dimming", configuration="polar", standardise=False),
        training=GeneratorTrainingConfig(
            MatteConfig(steps=0), AdversarialConfig(steps=0), PaperTrainingConfig(), mirror=False
        ),
    ),
}


def main(config: GeneratorRunConfig) -> None:
    """Collects frames, trains, compares with the truth, and writes everything into `config.out`."""
    prepare(config)
    domain, data = halgan_envs.domain(config.environment), config.data

    # Frames near the goal and of failures, and held-out ones beside the truth.
    collect = partial(halgan_envs.near_goal_frames, domain.name, steps_before_goal=data.steps_before_goal)
    near_goal = collect(data.near_goal_frames, seed=config.seed)
    failed = halgan_envs.failed_frames(domain.name, data.failed_frames, seed=config.seed + 1)
    held_out = halgan_envs.near_goal_frames(domain.name, 8 * data.held_out_frames, seed=HELD_OUT_SEED)
    few = {name: entry[::8] for name, entry in held_out.items()}
    truth = halgan_envs.with_truth(few, domain.goal_renderer())

    metrics = run(config, domain, near_goal=near_goal, failed=failed, held_out=truth)
    print(
        f"mask overlap {metrics['truth/mask_overlap']:.2f}, centre {metrics['truth/centroid_error']:.1f} pixels off, "
        f"after {metrics['seconds'] / 60:.1f} minutes\nlook at {config.out / 'hallucinations.png'}\n"
        f"and pass {config.out / 'generator.safetensors'} to a recipe for agents as --painter.weights"
    )


if __name__ == "__main__":
    main(parse_config(PRESETS, description=__doc__))
