"""A generator's training: a folder in which a generator is trained, compared with the truth, and shown."""

import dataclasses
import shlex
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor
from tqdm import tqdm

from halgan_rl.experiment import pictures
from halgan_rl.experiment.domain import Domain
from halgan_rl.experiment.run_folder import RunFolder, versions
from halgan_rl.hallucination.generators.base import HallucinationGenerator
from halgan_rl.hallucination.generators.config import GeneratorConfig
from halgan_rl.hallucination.hallucinators import GeneratorHallucinator
from halgan_rl.hallucination.judging import fidelity
from halgan_rl.hallucination.judging.painting import paint_each
from halgan_rl.hallucination.training.adversarial import AdversarialConfig
from halgan_rl.hallucination.training.data import Frames, check_images
from halgan_rl.hallucination.training.matte_regression import MatteConfig
from halgan_rl.hallucination.training.steps import LOSSES, train_generator
from halgan_rl.hallucination.weights import save_weights

COLUMNS = ("steps", "seconds", "truth/mask_overlap", "truth/centroid_error", "truth/outside_change", *LOSSES)
LATENT_SEED = 20_000
"""Seed of the latents with which held-out poses are painted."""
LIGHT: dict[str, Any] = {
    "steps": 0,
    "batch_size": 32,
    "critic_steps": 1,
    "discriminator_learning_rate": 3e-4,
    "penalty_interval": 4,
    "bandwidth": 0.1,
    "average_decay": 0.99,
    "discriminator_steps_ahead": 300,
}
"""Adversarial training that two cores can afford; left out by default."""


@dataclasses.dataclass(frozen=True)
class GeneratorRunConfig:
    """Configuration of a generator's training; the defaults are what learns fastest on two cores."""

    preset: Literal["default", "paper"] = "default"
    """Where the other values come from: what learns fastest on two cores, or the paper's appendix."""
    environment: str = "navigate-2m"
    """Name of the environment."""
    seed: int = 0
    """Seed of everything random in the run."""
    minutes: float | None = None
    """Stop training after this long, whatever is left to do; what is kept then depends on the machine's speed."""
    evaluate_every: int = 250
    """Steps between comparisons with the truth."""
    out: Path = Path("runs/train_generator")
    """Folder of the run; must not hold one yet."""
    mirror: bool = True
    """Mirror half of the frames left to right."""
    latent_noise: float | None = None
    """Fraction of noise in the latents of matte regression; None: what suits the environment."""
    discriminator_stride: Literal[1, 2] = 2
    """Stride of the discriminator's first convolution."""
    generator: GeneratorConfig = dataclasses.field(default_factory=GeneratorConfig)
    """Which generator."""
    mattes: MatteConfig = dataclasses.field(default_factory=MatteConfig)
    """Matte regression, for a generator by coordinates."""
    adversarial: AdversarialConfig = dataclasses.field(default_factory=partial(AdversarialConfig, **LIGHT))
    """Adversarial training, after matte regression."""

    def __post_init__(self) -> None:
        """Refuses values that would fail only later."""
        if self.evaluate_every < 1:
            raise ValueError(f"evaluate_every={self.evaluate_every} must be at least 1")
        if self.minutes is not None and not self.minutes > 0:
            raise ValueError(f"minutes={self.minutes} must be positive")
        if self.latent_noise is not None and not 0 <= self.latent_noise <= 1:
            raise ValueError(f"latent_noise={self.latent_noise} must be within [0, 1]: it is a fraction")
        if self.mattes.steps and self.generator.kind == "paper":
            raise ValueError("generator.kind='paper' has no mattes to fit: pass --mattes.steps 0")
        if not self.mattes.steps + self.adversarial.steps:
            raise ValueError("mattes.steps and adversarial.steps are both 0: there is nothing to train")


def run(
    config: GeneratorRunConfig, domain: Domain, *, near_goal: Frames, failed: Frames, held_out: Frames | None = None
) -> dict[str, float]:
    """Trains a generator, compares it with the truth, and writes everything into `config.out`.

    Args:
        config: what to do.
        domain: of what environment the frames are.

    Keyword Args:
        near_goal: ``pixels`` uint8 ``[N, H, W, C]``, ``pose`` and ``goal_pose`` ``[N, P]``.
        failed: ``pixels`` and ``pose`` of failed frames.
        held_out: ``pixels`` without a goal, ``pose``, ``goal_pose``, and ``truth``, the same images with the goal.
            Without them nothing is compared, and the metrics of the truth are NaN.

    Returns:
        The last metrics, by the names of ``COLUMNS``.

    Raises:
        FileExistsError: if the folder of the run already holds anything.
        ValueError: if the frames do not fit the domain.
    """
    if held_out is not None:
        for name in ("pixels", "truth"):
            check_images(f"held_out[{name!r}]", held_out[name], domain.image_shape)
    folder = RunFolder(config.out, columns=COLUMNS)
    folder.write_config(dataclasses.asdict(config))
    torch.manual_seed(config.seed)  # initial weights
    generator = config.generator.make(
        image_shape=domain.image_shape, frame_stack=domain.frame_stack, pose_size=domain.poses.size
    )
    steps = train_generator(
        generator,
        near_goal=near_goal,
        failed=failed,
        rng=torch.Generator().manual_seed(config.seed),
        mattes=config.mattes,
        adversarial=config.adversarial,
        poses=domain.poses,
        standardise=config.generator.standardise,
        mirror=config.mirror,
        latent_noise=0.7 if config.latent_noise is None else config.latent_noise,
        discriminator_stride=config.discriminator_stride,
    )
    started = time.perf_counter()
    metrics = dict.fromkeys(COLUMNS, float("nan"))
    progress = tqdm(total=config.mattes.steps + config.adversarial.steps, unit="step", dynamic_ncols=True)
    for kept, losses in steps:
        metrics |= losses
        progress.update()
        seconds = time.perf_counter() - started
        over = progress.n == progress.total or (config.minutes is not None and seconds > 60 * config.minutes)
        if over or progress.n % config.evaluate_every == 0:
            metrics |= {"steps": progress.n, "seconds": seconds}
            if held_out is not None:
                metrics |= compare_with_truth(config, domain, kept, held_out, folder.file("hallucinations.png"))
            folder.write_metrics(metrics)
            save_weights(folder.file("generator.safetensors"), kept, make_manifest(config, domain, kept, metrics))
            progress.set_postfix(overlap=f"{metrics['truth/mask_overlap']:.2f}", refresh=False)
        if over:
            break
    progress.close()
    return metrics


def compare_with_truth(
    config: GeneratorRunConfig, domain: Domain, generator: HallucinationGenerator, held_out: Frames, picture: Path
) -> dict[str, float]:
    """Hallucinates at held-out poses; returns the comparison with the truth, and draws it."""
    painter = GeneratorHallucinator(generator, rng=torch.Generator().manual_seed(LATENT_SEED))
    rows: dict[str, Tensor] = {
        "failed": held_out["pixels"],
        "true goal": held_out["truth"],
        "hallucinated": paint_each(painter, held_out),
    }
    chosen = torch.linspace(0, len(held_out["pose"]) - 1, min(16, len(held_out["pose"]))).long()
    title = f"{domain.name}, seed {config.seed}: held-out poses"
    few = {label: frames[chosen] for label, frames in rows.items()}
    pictures.draw_frame_grid(picture, few, title=title, frame_stack=domain.frame_stack)
    found = fidelity.compare(*rows.values(), frame_stack=domain.frame_stack)
    return {f"truth/{name}": value for name, value in dataclasses.asdict(found).items()}


def make_manifest(
    config: GeneratorRunConfig, domain: Domain, generator: HallucinationGenerator, metrics: dict[str, float]
) -> dict[str, Any]:
    """Returns what has to be known to rebuild the generator, to trust it and to make it again."""
    return {
        "kind": config.generator.kind,
        "arguments": generator.arguments,
        **domain.fingerprint,
        "command": shlex.join(["python", *sys.argv]),
        "config": dataclasses.asdict(config),
        "metrics": metrics,
        "versions": versions(),
    }
