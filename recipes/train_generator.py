"""Training of the generator that paints goals into failed frames.

Usage::

    python recipes/train_generator.py --environment navigate-2m --out runs/generator    # as shipped, 2 minutes
    python recipes/train_generator.py --preset paper                                    # the paper's appendix, days

Two sets of images are collected first. *Near-goal* frames are the last states of successful rollouts of a scripted
driver that knows where the goal is; it plays a person who shows the goal a few dozen times. *Failed* frames are
of uniformly random actions. No frame is paired with the same frame without the goal, and no image is picked by hand.

Every run writes a folder: ``config.json``, ``metrics.csv``, ``generator.safetensors`` with its manifest, and
``hallucinations.png`` (held-out poses without goal, truly rendered, and hallucinated). Weights and picture are written
at every evaluation, so that a run that is stopped keeps its latest. Metrics, one row an evaluation:

===============================  ===================================================================
``steps``, ``seconds``           steps of both kinds so far; wall time of training
``truth/mask_overlap``           intersection over union of the pixels that goals change in truth and as painted
``truth/centroid_error``         median distance between the centres of the two [pixels]
``truth/outside_change``         mean change where nothing should change [levels of 255]
``mattes/loss``                  of matte regression, last step
``adversarial/critic_distance``  estimate of the Wasserstein distance, last step
``adversarial/auxiliary_real``   mean square error of the regressed configuration, last step; ``.../auxiliary_fake``
``adversarial/change``           mean square change of the image by the generator, last step
===============================  ===================================================================

The simulator's truth is measured and drawn only; training never sees it.

Differences from the paper (Sahni et al., NeurIPS 2019, appendix); ``--preset paper`` undoes all but 9:

1. The generator paints by coordinates (``CoordinateGenerator``) instead of by upsampling convolutions. Its output is a
   matte, colour and opacity, which changes nothing where it paints nothing, instead of tanh(s + H).
2. The configuration is the whole relative pose (x, y, sin yaw, cos yaw), standardised, instead of distance and bearing.
3. Matte regression fits the generator to the colours that only near-goal frames show. Nothing is trained adversarially:
   2 minutes of regression reach a mask overlap of 0.80 (2 m room), and 6 minutes of adversarial training after it bring
   that down to 0.19. Adversarial training alone, with 4 to 7, reaches 0.26 in 8 minutes, the paper's loop 0.21 in 30
   (``benchmarks.halgan_ablation``). ``--adversarial.steps 1000`` adds it, ``--mattes.steps 0`` leaves out regression.
4. The discriminator's first convolution has stride 2, and the gradient penalty is applied at every 4th step, weighted 4
   times. There is 1 discriminator step for each generator step instead of 5, and 300 before the first.
5. Batches are of 32 instead of 64, the discriminator's learning rate is 3e-4 instead of 1e-4, and a moving average of
   the generator's weights (decay 0.99) is kept.
6. Configurations of fakes stay ten times as close to those of real frames as Scott's rule has it.
7. Frames are mirrored left to right, and their configurations with them.
8. Failed frames are 5,000 instead of 10,000, and up to 80 frames of the way to each goal are kept instead of 32 (the
   paper gives no number).
9. The near-goal frames come from a scripted driver, and are 2,000 for all tasks (the paper: 2,000 to 6,840).
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch

import halgan_envs
from halgan_rl.experiment.domain import Domain
from halgan_rl.experiment.generator_run import GeneratorRunConfig, run
from halgan_rl.experiment.presets import parse_config
from halgan_rl.experiment.run_folder import check_unused
from halgan_rl.hallucination.generators.config import GeneratorConfig
from halgan_rl.hallucination.judging.painting import paint_each
from halgan_rl.hallucination.training.adversarial import AdversarialConfig
from halgan_rl.hallucination.training.data import Frames
from halgan_rl.hallucination.training.matte_regression import MatteConfig

LATENT_NOISE = {"pebble": 0.05}
"""Fraction of noise in the latents: a goal that is small beside the places where it counts as reached wants little."""
HELD_OUT_SEED = 20_000
"""Seed of the rollouts that training never sees."""


@dataclasses.dataclass(frozen=True)
class Config(GeneratorRunConfig):
    """Training of the generator that paints goals into failed frames."""

    near_goal_frames: int = 2_000
    """Size of R, the near-goal frames."""
    steps_before_goal: int = 80
    """Frames of R from each rollout, besides its last; what is farther from the goal must be guessed."""
    failed_frames: int = 5_000
    """Frames of failed episodes to paint goals into."""
    held_out_frames: int = 128
    """Frames that are compared with the truth."""

    def __post_init__(self) -> None:
        """Refuses values that would fail only later."""
        super().__post_init__()
        for name, least in (("near_goal_frames", 1), ("failed_frames", 1), ("held_out_frames", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}={getattr(self, name)} must be at least {least}")
        if self.steps_before_goal < 0:
            raise ValueError(f"steps_before_goal={self.steps_before_goal} must not be negative")


PRESETS = {
    "default": Config(),
    "paper": Config(
        preset="paper",
        generator=GeneratorConfig(kind="paper", composition="dimming", configuration="polar", standardise=False),
        mattes=MatteConfig(steps=0),
        adversarial=AdversarialConfig(),
        discriminator_stride=1,
        mirror=False,
        steps_before_goal=32,
        failed_frames=10_000,
    ),
}


def main(config: Config) -> None:
    """Collects frames, trains, compares with the truth, and writes everything into `config.out`."""
    check_unused(config.out)
    domain = halgan_envs.domain(config.environment)
    if config.latent_noise is None:
        config = dataclasses.replace(config, latent_noise=LATENT_NOISE.get(config.environment, 0.7))

    near_goal = partial(halgan_envs.collect_near_goal, steps_before_goal=config.steps_before_goal)
    metrics = run(
        config,
        domain,
        near_goal=collect(config, near_goal, config.near_goal_frames, config.seed),
        failed=collect(config, halgan_envs.collect_failed, config.failed_frames, config.seed + 1),
        held_out=render_truth(config, domain),
    )
    print(
        f"mask overlap {metrics['truth/mask_overlap']:.2f}, centre {metrics['truth/centroid_error']:.1f} pixels off, "
        f"after {metrics['seconds'] / 60:.1f} minutes\nlook at {config.out / 'hallucinations.png'}\n"
        f"and pass {config.out / 'generator.safetensors'} to a recipe for agents as --painter.weights"
    )


def collect(config: Config, collector: Callable[..., dict[str, np.ndarray]], count: int, seed: int) -> Frames:
    """Collects frames in an environment of their own."""
    environment = halgan_envs.named(config.environment)(random_state=seed)
    data = collector(environment, count, np.random.RandomState(seed))
    environment.close()
    return {name: torch.from_numpy(array) for name, array in data.items()}


def render_truth(config: Config, domain: Domain) -> Frames:
    """Returns held-out poses with the frames seen from them, without goal, and the goal truly rendered."""
    data = collect(config, halgan_envs.collect_near_goal, 8 * config.held_out_frames, HELD_OUT_SEED)
    data = {name: tensor[::8] for name, tensor in data.items()}
    renderer: Any = domain.goal_renderer()
    data["pixels"] = torch.from_numpy(np.stack([renderer.render_without_goal(pose) for pose in data["pose"].numpy()]))
    return data | {"truth": paint_each(renderer, data)}


if __name__ == "__main__":
    main(parse_config(PRESETS, description=__doc__))
