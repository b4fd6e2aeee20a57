"""The paper's adversarial training: a Wasserstein GAN whose critic also regresses the configuration.

Source: Sahni et al., NeurIPS 2019, section 3 and appendix, and the authors' code where these say nothing: the critic
regresses the configurations of fakes as well, and sees fakes that are made with BatchNorm's running statistics.
Gradient penalty: Gulrajani et al., NeurIPS 2017.
"""

from dataclasses import dataclass
from typing import Any, Literal, cast

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from halgan_rl.hallucination.generators.base import HallucinationGenerator
from halgan_rl.hallucination.training.data import Frames, check_data, matching_settings
from halgan_rl.hallucination.training.paper_discriminator import Discriminator
from halgan_rl.poses import PlanarPoses
from halgan_rl.transforms.pixels import to_float


@dataclass(frozen=True)
class PaperTrainingConfig:
    """How the paper trains generators; the defaults are its values.

    Raises:
        ValueError: if a count is out of range.
    """

    steps: int = 50_000
    """Generator steps; 0 leaves the paper's training out."""
    batch_size: int = 64
    """Images of a batch, real ones and fake ones each."""
    critic_steps: int = 5
    """Discriminator steps before each generator step."""
    generator_learning_rate: float = 1e-4
    """Learning rate of the generator (Adam)."""
    discriminator_learning_rate: float = 1e-4
    """Learning rate of the discriminator (Adam)."""
    betas: tuple[float, float] = (0.5, 0.9)
    """Adam's decay rates."""
    auxiliary_weight: float = 10.0
    """Weight of the regression of the configuration."""
    penalty_weight: float = 10.0
    """Weight of the gradient penalty."""
    penalty_interval: int = 1
    """Discriminator steps from one gradient penalty to the next; its weight grows as much (StyleGAN2's trick)."""
    change_weight: float = 1.0
    """Weight of the mean square of H, the generator's output."""
    label_noise: tuple[float, float] = (0.01, 0.02)
    """Standard deviation of the noise on the labels of real images: lengths [m], angles [rad]."""
    bandwidth: float = 1.0
    """Width of the kernel density from which configurations of fakes are drawn, in units of Scott's rule."""
    average_decay: float = 0.0
    """Decay of the moving average of the generator's weights, which is what is kept; 0 keeps the last ones."""
    discriminator_stride: Literal[1, 2] = 1
    """Stride of the discriminator's first convolution."""

    def __post_init__(self) -> None:
        """Refuses values that make no sense."""
        for name, least in (("steps", 0), ("batch_size", 1), ("critic_steps", 1), ("penalty_interval", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}={getattr(self, name)} must be at least {least}.")


class PaperTrainer:
    """Trains generator and discriminator against each other, one generator step a call.

    Args:
        generator: learns to draw the goal; its encoding is used as it is.

    Keyword Args:
        near_goal: ``pixels`` uint8 ``[N, H, W, C]``, ``pose`` and ``goal_pose`` ``[N, P]`` of near-goal frames.
        failed: ``pixels`` uint8 ``[M, H, W, C]`` and ``pose`` ``[M, P]`` of failed frames, into which goals are
            painted: those that the poses' flags select.
        config: hyper-parameters.
        rng: draws everything that is random, except the discriminator's first weights (PyTorch's global generator).
        poses: which entries of a pose are flags; each setting of them has a goal of its own.
        mirror: mirror half of the real images left to right, and their labels with them.

    Raises:
        KeyError: if an entry of the frames is missing.
        ValueError: if frames or poses are other than the generator's.
    """

    def __init__(
        self,
        generator: HallucinationGenerator,
        *,
        near_goal: Frames,
        failed: Frames,
        config: PaperTrainingConfig,
        rng: torch.Generator,
        poses: PlanarPoses = PlanarPoses(),
        mirror: bool = False,
    ) -> None:
        check_data(generator, near_goal, failed, poses)
        self.generator, self.config, self.rng, self._mirror = generator, config, rng, mirror
        self.discriminator = Discriminator(
            generator.encoding.size, image_shape=generator.image_shape, first_stride=config.discriminator_stride
        )
        self._encoding = generator.encoding
        self._real_pixels, self._failed_pixels = near_goal["pixels"], failed["pixels"]
        self._real_settings, self._failed_settings = matching_settings(near_goal, failed, poses)
        self._labels = self._encoding.labels(near_goal["pose"], near_goal["goal_pose"])
        self._noise = self._encoding.noise(*config.label_noise)
        self._kernel = config.bandwidth * scott_kernel(self._labels, flags=self._encoding.flags)
        self._generator_optimizer, self._discriminator_optimizer = (
            torch.optim.Adam(network.parameters(), lr=rate, betas=config.betas)
            for network, rate in (
                (generator, config.generator_learning_rate),
                (self.discriminator, config.discriminator_learning_rate),
            )
        )
        average = get_ema_multi_avg_fn(config.average_decay)
        self._average = AveragedModel(generator, multi_avg_fn=average, use_buffers=True)
        self._penalty_countdown = 0

    @property
    def average(self) -> HallucinationGenerator:
        """The generator whose weights are worth keeping: the moving average."""
        return cast(HallucinationGenerator, self._average.module)

    def step(self) -> dict[str, Tensor]:
        """Trains the discriminator, then the generator.

        Returns:
            Scalars: ``critic_distance``, the estimate of the Wasserstein distance; ``auxiliary_real`` and
            ``auxiliary_fake``, mean square errors of the regressed features; ``change``, the mean square of H.
        """
        metrics: dict[str, Tensor] = {}
        for _ in range(self.config.critic_steps):
            metrics |= self._train_discriminator()
        metrics |= self._train_generator()
        self._average.update_parameters(self.generator)
        return metrics

    def state_dict(self) -> dict[str, Any]:
        """Returns all that training goes on from."""
        parts = {name: part.state_dict() for name, part in self._parts().items()}
        return {**parts, "penalty_countdown": self._penalty_countdown, "rng": self.rng.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on from a state; the data, the configuration and the networks' shapes must be the same."""
        for name, part in self._parts().items():
            part.load_state_dict(state[name])
        self._penalty_countdown = state["penalty_countdown"]
        self.rng.set_state(state["rng"])

    def _parts(self) -> dict[str, Any]:
        return {
            "generator": self.generator,
            "discriminator": self.discriminator,
            "average": self._average,
            "generator_optimizer": self._generator_optimizer,
            "discriminator_optimizer": self._discriminator_optimizer,
        }

    def _train_discriminator(self) -> dict[str, Tensor]:
        """Tells real from fake, and regresses the configurations of both."""
        config = self.config
        real, real_features = self._draw_real()
        images, fake_features, latent = self._draw_fake()
        with torch.no_grad():
            fake = self.generator.compose(images, self._infer(fake_features, latent))
        real_score, real_guess = self.discriminator(real)
        fake_score, fake_guess = self.discriminator(fake)
        distance = real_score.mean() - fake_score.mean()
        auxiliary = nn.functional.mse_loss(real_guess, real_features)
        fake_auxiliary = nn.functional.mse_loss(fake_guess, fake_features)
        loss = config.auxiliary_weight * (auxiliary + fake_auxiliary) - distance
        if self._penalty_countdown == 0:
            self._penalty_countdown = config.penalty_interval
            penalty = self._gradient_penalty(real, fake)
            loss = loss + config.penalty_interval * config.penalty_weight * penalty
        self._penalty_countdown -= 1
        _descend(self._discriminator_optimizer, loss)
        return {"critic_distance": distance.detach(), "auxiliary_real": auxiliary.detach()}

    def _train_generator(self) -> dict[str, Tensor]:
        """Makes goals that the critic takes for real, at their configurations, with a small H."""
        config = self.config
        images, features, latent = self._draw_fake()
        change = self.generator(features, latent)
        score, guess = self.discriminator(self.generator.compose(images, change))
        auxiliary = nn.functional.mse_loss(guess, features)
        size = change.square().mean()
        loss = config.auxiliary_weight * auxiliary + config.change_weight * size - score.mean()
        _descend(self._generator_optimizer, loss)
        return {"auxiliary_fake": auxiliary.detach(), "change": size.detach()}

    def _infer(self, features: Tensor, latent: Tensor) -> Tensor:
        """Returns H with the running statistics of BatchNorm."""
        self.generator.eval()
        change = self.generator(features, latent)
        self.generator.train()
        return change

    def _gradient_penalty(self, real: Tensor, fake: Tensor) -> Tensor:
        """Returns the mean square deviation from 1 of the critic's slope between real and fake images."""
        mix = torch.rand(len(real), 1, 1, 1, generator=self.rng)
        between = torch.lerp(real, fake, mix).requires_grad_()
        score, _ = self.discriminator(between)
        (slope,) = torch.autograd.grad(score.sum(), between, create_graph=True)
        return (slope.flatten(1).norm(dim=1) - 1).square().mean()

    def _draw_real(self) -> tuple[Tensor, Tensor]:
        """Draws near-goal images and the features of their noisy labels."""
        rows, flip = self._draw_rows()
        images, labels = to_float(self._real_pixels[rows]), self._mirror_labels(rows, flip)
        images = torch.where(flip[:, None, None, None], images.flip(3), images)
        return images, self._encoding(labels + self._noise * torch.randn(labels.shape, generator=self.rng))

    def _draw_fake(self) -> tuple[Tensor, Tensor, Tensor]:
        """Draws failed images, features from the kernel density, and latents."""
        rows, flip = self._draw_rows()
        labels = self._mirror_labels(rows, flip)
        features = self._encoding(labels + torch.randn(labels.shape, generator=self.rng) @ self._kernel.T)
        same_goal = self._real_settings[rows, None] == self._failed_settings
        images = to_float(self._failed_pixels[same_goal.float().multinomial(1, generator=self.rng).squeeze(1)])
        return images, features, self.generator.sample_latent(len(labels), self.rng)

    def _draw_rows(self) -> tuple[Tensor, Tensor]:
        """Draws rows of the near-goal data, and which of them to mirror."""
        size = (self.config.batch_size,)
        rows = torch.randint(len(self._labels), size, generator=self.rng)
        return rows, (torch.rand(size, generator=self.rng) < 0.5) & self._mirror

    def _mirror_labels(self, rows: Tensor, flip: Tensor) -> Tensor:
        labels = self._labels[rows]
        return torch.where(flip[:, None], self._encoding.mirror(labels), labels)


def scott_kernel(labels: Tensor, *, flags: int = 0) -> Tensor:
    """Returns a factor of the covariance of a Gaussian kernel density by Scott's rule.

    Args:
        labels: ``[N, L]``.
        flags: how many of them, at the end, are flags, which the kernel leaves as they are.

    Returns:
        ``[L, L]`` such that ``label + kernel @ standard_normal`` draws from the density, label being any of the N.
    """
    count, size = len(labels), labels.shape[1] - flags
    covariance = torch.cov(labels[:, :size].T).reshape(size, size) + 1e-12 * torch.eye(size)
    factor = count ** (-1 / (size + 4)) * torch.linalg.cholesky(covariance)
    return nn.functional.pad(factor, (0, flags, 0, flags))


def _descend(optimizer: torch.optim.Optimizer, loss: Tensor) -> None:
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
