"""Training of HALGAN, the generator that paints goals into failed frames.

Usage::

    python recipes/train_halgan.py --environment navigate-2m --out runs/halgan   # as shipped, 2 minutes
    python recipes/train_halgan.py --preset paper --iterations 50000             # the paper's appendix, days

Two sets of images are collected first: *near-goal* frames, the last states of successful rollouts of a scripted driver
that knows where the box is (it stands in for a person who shows the goal a few dozen times; no image is picked by
hand), and *failed* frames of uniformly random actions. No frame is ever paired with the same frame without the goal.

The run's folder gets ``config.json``, ``metrics.csv``, ``generator.safetensors`` with its manifest ``generator.json``,
and ``hallucinations.png``: the same held-out poses without goal, truly rendered, and hallucinated. Weights and picture
are written at every evaluation, so that a run that is stopped keeps its latest.

Metrics, one row an evaluation:

==============================  ====================================================================
``steps``, ``seconds``          steps so far, those of the warm start included; wall time of training
``truth/mask_overlap``          intersection over union of the pixels that goals truly change, and are painted in
``truth/centroid_error``        median distance between the centres of the two [pixels]
``truth/outside_change``        mean change where nothing should change [levels of 255]
``warm_start/loss``             mean since the last evaluation
``game/critic_distance``        estimate of the Wasserstein distance, last step
``game/auxiliary_real``, fake   mean square error of the regressed configuration, last step
``game/change``                 mean square change of the image by the generator, last step
==============================  ====================================================================

The simulator's truth is measured and drawn only; training never sees it.

Differences from the paper (Sahni et al., NeurIPS 2019, appendix), all undone by ``--preset paper``:

1. The generator paints by coordinates (`CoordinateGenerator`) instead of by upsampling convolutions.
2. It paints a matte, colour and opacity, which is the identity where it paints nothing, instead of tanh(s + H).
3. The configuration is the whole relative pose (x, y, sin yaw, cos yaw), standardised, instead of distance and bearing.
4. A warm start fits the generator to the colours that only near-goal frames show (`halgan_rl.hallucination.training.matte_regression`), and the
   game is not played after it: in two minutes it gets to a mask overlap of 0.80 (2 m room), which six minutes of the
   game bring down to 0.19. Without warm start the game with the deviations below gets to 0.26 in eight minutes, the
   paper's loop to 0.21 in thirty (`benchmarks.halgan_ablation`).
   ``--iterations 1000`` plays it, ``--warm-start-steps 0`` starts it from scratch.
5. The discriminator's first convolution has stride 2, the gradient penalty is applied at every 4th step, weighted 4
   times, and there is 1 discriminator step instead of 5 for each generator step.
6. Batch 32, learning rate 3e-4 for the discriminator, a moving average of the generator's weights.
7. Configurations of fakes stay ten times as close to those of real frames as Scott's rule has it.
8. Frames are mirrored left to right, and their configurations with them.
"""

import dataclasses
import shlex
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, Literal

import halgan_envs
import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from halgan_rl.experiment import pictures
from halgan_rl.experiment.presets import parse_config
from halgan_rl.experiment.run_folder import RunFolder, versions
from halgan_rl.hallucination.generators.coordinates import CoordinateGenerator
from halgan_rl.hallucination.generators.paper import Discriminator, HallucinationGenerator, PaperGenerator
from halgan_rl.hallucination.hallucinators import GanHallucinator
from halgan_rl.hallucination.judging import fidelity
from halgan_rl.hallucination.training.adversarial import GanSettings, HalganTrainer
from halgan_rl.hallucination.training.matte_regression import warm_start
from halgan_rl.hallucination.weights import save_weights

COLUMNS = (
    "steps",
    "seconds",
    "truth/mask_overlap",
    "truth/centroid_error",
    "truth/outside_change",
    "warm_start/loss",
    "game/critic_distance",
    "game/auxiliary_real",
    "game/auxiliary_fake",
    "game/change",
)
HELD_OUT_SEED = 20_000
"""Seed of the rollouts that training never sees."""


@dataclasses.dataclass(frozen=True)
class Config:
    """Training of HALGAN, the generator that paints goals into failed frames."""

    preset: Literal["default", "paper"] = "default"
    """Where the other values come from: what learns fastest on two cores, or the paper's appendix."""
    environment: str = "navigate-2m"
    """One of `halgan_envs.NAMES`."""
    seed: int = 0
    """Seed of everything random in the run."""
    iterations: int = 0
    """Generator steps of the game, after the warm start."""
    minutes: float | None = None
    """Stop training after this long, whatever is left to do; what is kept then depends on the machine's speed."""
    near_goal_frames: int = 2_000
    """Size of R, the near-goal frames."""
    steps_before_goal: int = 80
    """Frames of R from each rollout, but for its last; what is farther from the goal must be guessed."""
    failed_frames: int = 5_000
    """Frames of failed episodes to paint goals into."""
    out: Path = Path("runs/train_halgan")
    """Folder of the run; must not hold one yet."""

    generator: Literal["coordinates", "paper"] = "coordinates"
    """By coordinates with a matte, or the paper's convolutions."""
    composition: Literal["dimming", "difference"] = "difference"
    """How the paper's generator changes an image: tanh(s + H), or s + tanh(s + H) - tanh(s), the identity at H = 0."""
    configuration: Literal["planar", "polar"] = "planar"
    """The whole relative pose, or the paper's distance and bearing."""
    standardise: bool = True
    """Scale the configuration's features to mean 0 and variance 1."""
    warm_start_steps: int = 2_500
    """Steps of the warm start before the game; needs the generator by coordinates."""
    latent_noise: float = 0.7
    """Share of noise in the warm start's latents; goals that are small beside the places where they count as reached,
    as the pebble, need less of it."""
    discriminator_stride: Literal[1, 2] = 2
    """Stride of the discriminator's first convolution."""
    game: GanSettings = dataclasses.field(
        default_factory=lambda: GanSettings(
            batch_size=32,
            critic_steps=1,
            discriminator_learning_rate=3e-4,
            penalty_interval=4,
            bandwidth=0.1,
            mirror=True,
            average_decay=0.99,
            discriminator_steps_ahead=300,
        )
    )
    """The game between generator and discriminator."""

    evaluate_every: int = 250
    """Steps between comparisons with the truth."""
    held_out_frames: int = 128
    """Frames of these comparisons."""

    def __post_init__(self) -> None:
        for name in ("near_goal_frames", "failed_frames", "held_out_frames", "evaluate_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)} must be at least 1")
        for name in ("iterations", "warm_start_steps", "steps_before_goal"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name}={getattr(self, name)} must not be negative")
        if self.minutes is not None and not self.minutes > 0:
            raise ValueError(f"minutes={self.minutes} must be positive")
        if not 0 <= self.latent_noise <= 1:
            raise ValueError(f"latent_noise={self.latent_noise} must be within [0, 1]")
        if self.warm_start_steps and self.generator == "paper":
            raise ValueError(
                f"warm_start_steps={self.warm_start_steps} needs --generator coordinates: "
                "the paper's has no opacity to fit"
            )


PRESETS = {
    "default": Config(),
    "paper": Config(
        preset="paper",
        steps_before_goal=32,
        iterations=50_000,
        failed_frames=10_000,
        generator="paper",
        composition="dimming",
        configuration="polar",
        standardise=False,
        warm_start_steps=0,
        discriminator_stride=1,
        game=GanSettings(),
    ),
}


def main(config: Config) -> None:
    """Collect frames, train, compare with the truth, and write everything into `config.out`."""
    halgan_envs.named(config.environment)  # refuses an unknown one before the folder is made
    folder = RunFolder(config.out, columns=COLUMNS)
    folder.write_config(dataclasses.asdict(config))
    torch.manual_seed(config.seed)  # initial weights
    rng = torch.Generator().manual_seed(config.seed)

    # Data: near-goal and failed frames, and held-out poses with the truth about them.
    collect_near_goal = partial(halgan_envs.collect_near_goal, steps_before_goal=config.steps_before_goal)
    near_goal = collect(config, collect_near_goal, config.near_goal_frames, config.seed)
    failed = collect(config, halgan_envs.collect_failed, config.failed_frames, config.seed + 1)
    truth = render_truth(config)

    # The generator.
    generator = make_generator(config, pose_size=near_goal["pose"].shape[-1])
    if config.standardise:
        generator.encoding.standardise(generator.encoding.labels(near_goal["pose"], near_goal["goal_pose"]))

    # Training, warm start first.
    started = time.perf_counter()
    metrics = dict.fromkeys(COLUMNS, float("nan"))
    progress = tqdm(total=config.warm_start_steps + config.iterations, unit="step", dynamic_ncols=True)
    for kept, losses in train(config, generator, near_goal, failed, rng):
        metrics.update(losses)
        progress.update()
        seconds = time.perf_counter() - started
        over = progress.n == progress.total or (config.minutes is not None and seconds > 60 * config.minutes)
        if over or progress.n % config.evaluate_every == 0:
            metrics.update(compare_with_truth(config, kept, truth, folder.file("hallucinations.png")))
            metrics.update(steps=progress.n, seconds=seconds)
            folder.write_metrics(metrics)
            save_weights(folder.file("generator.safetensors"), kept, make_manifest(config, generator, metrics))
            progress.set_postfix(overlap=f"{metrics['truth/mask_overlap']:.2f}", refresh=False)
        if over:
            break
    progress.close()

    print(
        f"mask overlap {metrics['truth/mask_overlap']:.2f}, centre {metrics['truth/centroid_error']:.1f} pixels off, "
        f"after {metrics['seconds'] / 60:.1f} minutes\nlook at {folder.file('hallucinations.png')}\n"
        f"next: python recipes/ddpg_navigate.py --environment {config.environment} "
        f"--weights {folder.file('generator.safetensors')}"
    )


def train(
    config: Config,
    generator: HallucinationGenerator,
    near_goal: dict[str, Tensor],
    failed: dict[str, Tensor],
    rng: torch.Generator,
) -> Iterator[tuple[HallucinationGenerator, dict[str, float]]]:
    """Yield after each step, of the warm start and then of the game, the generator worth keeping and the losses."""
    data = {"near_goal": near_goal, "failed": failed}
    if isinstance(generator, CoordinateGenerator):
        settings = {"mirror": config.game.mirror, "latent_noise": config.latent_noise}
        for loss in warm_start(generator, **data, steps=config.warm_start_steps, **settings, rng=rng):
            yield generator, {"warm_start/loss": loss}
    discriminator = Discriminator(generator.encoding.size, config.discriminator_stride)
    trainer = HalganTrainer(generator, discriminator, **data, settings=config.game, rng=rng)
    for _ in range(config.iterations):
        losses = trainer.step()
        yield trainer.average, {f"game/{name}": float(value) for name, value in losses.items()}


def collect(config: Config, collector: Any, count: int, seed: int) -> dict[str, Tensor]:
    """Collect `count` frames in an environment of their own, as tensors."""
    environment = halgan_envs.named(config.environment)(random_state=seed)
    data = collector(environment, count, np.random.RandomState(seed))
    environment.close()
    return {name: torch.from_numpy(array) for name, array in data.items()}


def render_truth(config: Config) -> dict[str, Tensor]:
    """Return held-out poses with the frames seen from them: without goal, and with the goal rendered."""
    data = collect(config, halgan_envs.collect_near_goal, 8 * config.held_out_frames, HELD_OUT_SEED)
    data = {name: tensor[::8] for name, tensor in data.items()}
    renderer = halgan_envs.GoalRenderer(config.environment)
    data["empty"] = torch.from_numpy(np.stack([renderer.render_without_goal(pose) for pose in data["pose"].numpy()]))
    data["truth"] = renderer(*(data[name].unsqueeze(1) for name in ("empty", "pose", "goal_pose"))).squeeze(1)
    renderer.close()
    return data


def make_generator(config: Config, *, pose_size: int) -> HallucinationGenerator:
    """Return the untrained generator."""
    if config.generator == "coordinates":
        return CoordinateGenerator(config.configuration, pose_size)
    return PaperGenerator(config.configuration, pose_size, composition=config.composition)


def compare_with_truth(
    config: Config, generator: HallucinationGenerator, truth: dict[str, Tensor], picture: Path
) -> dict[str, float]:
    """Hallucinate at the held-out poses; return the comparison with the truth, and draw it."""
    hallucinate = GanHallucinator(generator, rng=torch.Generator().manual_seed(HELD_OUT_SEED))
    painted = hallucinate(*(truth[name].unsqueeze(1) for name in ("empty", "pose", "goal_pose"))).squeeze(1)
    chosen = torch.linspace(0, len(painted) - 1, min(16, len(painted))).long()
    rows = {"failed": truth["empty"], "true goal": truth["truth"], "hallucinated": painted}
    title = f"{config.environment}, seed {config.seed}: held-out poses"
    pictures.draw_frame_grid(picture, {label: frames[chosen] for label, frames in rows.items()}, title=title)
    figures = fidelity.compare(truth["empty"], truth["truth"], painted)
    return {f"truth/{name}": value for name, value in dataclasses.asdict(figures).items()}


def make_manifest(config: Config, generator: HallucinationGenerator, metrics: dict[str, float]) -> dict[str, Any]:
    """Return what has to be known to rebuild the generator, to trust it and to make it again."""
    return {
        "kind": config.generator,
        "arguments": generator.arguments,
        **halgan_envs.fingerprint(config.environment),
        "command": shlex.join(["python", *sys.argv]),
        "config": dataclasses.asdict(config),
        "metrics": metrics,
        "versions": versions(),
    }


if __name__ == "__main__":
    main(parse_config(PRESETS, description=__doc__))
