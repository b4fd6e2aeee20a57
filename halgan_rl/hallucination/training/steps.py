"""The steps of a generator's training: matte regression first, then adversarial training."""

from collections.abc import Iterator
from typing import Literal

import torch

from halgan_rl.hallucination.generators.base import HallucinationGenerator
from halgan_rl.hallucination.training.adversarial import AdversarialConfig, AdversarialTrainer
from halgan_rl.hallucination.training.data import Frames, check_data
from halgan_rl.hallucination.training.discriminator import Discriminator
from halgan_rl.hallucination.training.matte_regression import MatteConfig, fit_mattes
from halgan_rl.poses import PlanarPoses

LOSSES = (
    "mattes/loss",
    "adversarial/critic_distance",
    "adversarial/auxiliary_real",
    "adversarial/auxiliary_fake",
    "adversarial/change",
)
"""Names of all losses, see :func:`train_generator`."""


def train_generator(
    generator: HallucinationGenerator,
    *,
    near_goal: Frames,
    failed: Frames,
    rng: torch.Generator,
    mattes: MatteConfig,
    adversarial: AdversarialConfig,
    poses: PlanarPoses = PlanarPoses(),
    standardise: bool = True,
    mirror: bool = True,
    latent_noise: float = 0.7,
    discriminator_stride: Literal[1, 2] = 1,
) -> Iterator[tuple[HallucinationGenerator, dict[str, float]]]:
    """Trains a generator step by step.

    Args:
        generator: is trained in place.

    Keyword Args:
        near_goal: see :func:`~halgan_rl.hallucination.training.matte_regression.fit_mattes`.
        failed: likewise.
        rng: draws everything that is random, except the discriminator's first weights (PyTorch's global generator).
        mattes: matte regression; with steps it needs a ``CoordinateGenerator``.
        adversarial: adversarial training, after it.
        poses: which entries of a pose are flags.
        standardise: whether to scale the configuration's features to mean 0 and variance 1 first.
        mirror: whether half of the frames are mirrored left to right.
        latent_noise: fraction of noise in the latents of matte regression.
        discriminator_stride: of its first convolution.

    Yields:
        After each step the generator worth keeping, and the losses by the names of ``LOSSES``: those of one kind.

    Raises:
        KeyError: if an entry of the frames is missing.
        ValueError: if frames or poses are other than the generator's.
    """
    check_data(generator, near_goal, failed, poses)
    if standardise:
        generator.encoding.standardise(generator.encoding.labels(near_goal["pose"], near_goal["goal_pose"]))
    data: dict[str, Frames] = {"near_goal": near_goal, "failed": failed}
    if mattes.steps:
        losses = fit_mattes(
            generator, **data, rng=rng, config=mattes, poses=poses, mirror=mirror, latent_noise=latent_noise
        )
        for loss in losses:
            yield generator, {"mattes/loss": loss}
    if adversarial.steps:
        discriminator = Discriminator(
            generator.encoding.size, image_shape=generator.image_shape, first_stride=discriminator_stride
        )
        trainer = AdversarialTrainer(
            generator, discriminator, **data, config=adversarial, rng=rng, poses=poses, mirror=mirror
        )
        for _ in range(adversarial.steps):
            step = trainer.step()
            yield trainer.average, {f"adversarial/{name}": float(value) for name, value in step.items()}
