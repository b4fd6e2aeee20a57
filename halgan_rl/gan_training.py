"""Training of the hallucination generator: a conditional Wasserstein GAN with a regression auxiliary task.

Source: Sahni et al., NeurIPS 2019, section 3 and appendix; gradient penalty from Gulrajani et al., NeurIPS 2017.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from halgan_rl.models.configurations import Configuration, goal_labels, label_features, mirrored
from halgan_rl.models.halgan import Discriminator, HallucinationGenerator
from halgan_rl.models.pixels import to_float


@dataclass(frozen=True)
class GanSettings:
    """Hyper-parameters of the objective; the defaults are the paper's."""

    configuration: Configuration = "polar"
    """How the relative pose is told to the networks."""
    batch_size: int = 64
    """Images of a batch, real ones and fake ones each."""
    critic_steps: int = 5
    """Discriminator steps before each generator step."""
    generator_rate: float = 1e-4
    """Learning rate of the generator (Adam)."""
    discriminator_rate: float = 1e-4
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
    """Weight of the mean square of what the generator changes in the image."""
    label_noise: tuple[float, float] = (0.01, 0.02)
    """Standard deviation of the noise on labels: lengths [m], angles [rad]."""
    bandwidth: float = 1.0
    """Width of the kernel density from which the configurations of fakes are drawn, in units of Scott's rule."""
    mirror: bool = False
    """Mirror half of the real images left to right, and their labels with them."""
    average_decay: float = 0.0
    """Decay of the moving average of the generator's weights, which is what is kept; 0 keeps the last weights."""
    warm_up_steps: int = 0
    """Steps in which the discriminator only learns to regress the configurations of real images, before the game."""


class HalganTrainer:
    """Plays the game between generator and discriminator, one generator step a call.

    Args:
        generator: learns to draw the goal.
        discriminator: learns to judge realism and to regress the configuration's features.
        near_goal: ``pixels`` [N, 64, 64, 3] uint8, ``pose`` [N, P] and ``goal_pose`` [N, P] of frames that show the goal.
        failed_pixels: uint8 ``[M, 64, 64, 3]``, frames into which goals are painted.
        settings: hyper-parameters.
        rng: draws everything that is random.

    Attributes:
        average: the generator whose weights are worth keeping.
    """

    def __init__(
        self,
        generator: HallucinationGenerator,
        discriminator: Discriminator,
        *,
        near_goal: dict[str, Tensor],
        failed_pixels: Tensor,
        settings: GanSettings,
        rng: torch.Generator,
        calibrate: bool = False,
        regressor: Discriminator | None = None,
    ) -> None:
        self.regressor = regressor
        self._expect = nn.Sequential(nn.Linear(4, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, 4)) if calibrate else None
        if calibrate: self._expect_opt = torch.optim.Adam(self._expect.parameters(), lr=1e-3)
        self.generator, self.discriminator, self.settings, self.rng = generator, discriminator, settings, rng
        self._real_pixels, self._failed_pixels = near_goal["pixels"], failed_pixels
        self._labels = goal_labels(settings.configuration, near_goal["pose"], near_goal["goal_pose"])
        features = label_features(settings.configuration, self._labels)
        self._mean, self._scale = features.mean(0), features.std(0).clamp_min(1e-3)
        self._kernel = _scott_kernel(self._labels) * settings.bandwidth
        self._generator_optimizer = torch.optim.Adam(
            generator.parameters(), lr=settings.generator_rate, betas=settings.betas
        )
        self._discriminator_optimizer = torch.optim.Adam(
            discriminator.parameters(), lr=settings.discriminator_rate, betas=settings.betas
        )
        if regressor is not None:
            self._regressor_optimizer = torch.optim.Adam(regressor.parameters(), lr=1e-3)
        self._average = AveragedModel(
            generator, multi_avg_fn=get_ema_multi_avg_fn(settings.average_decay), use_buffers=True
        )
        self._critic_step = 0

    @property
    def average(self) -> HallucinationGenerator:
        return self._average.module

    # --- batches
    def _draw_real(self) -> tuple[Tensor, Tensor]:
        rows = torch.randint(len(self._labels), (self.settings.batch_size,), generator=self.rng)
        images, labels = to_float(self._real_pixels[rows]), self._labels[rows]
        if self.settings.mirror:
            flip = torch.rand(len(rows), generator=self.rng) < 0.5
            images = torch.where(flip[:, None, None, None], images.flip(3), images)
            labels = torch.where(flip[:, None], mirrored(self.settings.configuration, labels), labels)
        lengths, angles = self.settings.label_noise
        sigma = torch.full((labels.shape[1],), 0.0)
        n = 1 if self.settings.configuration == "polar" else 2
        sigma[:n], sigma[n : n + 1] = lengths, angles
        labels = labels + sigma * torch.randn(labels.shape, generator=self.rng)
        return images, self._standard(labels)

    def _standard(self, labels: Tensor) -> Tensor:
        return (label_features(self.settings.configuration, labels) - self._mean) / self._scale

    def _draw_condition(self) -> Tensor:
        rows = torch.randint(len(self._labels), (self.settings.batch_size,), generator=self.rng)
        labels = self._labels[rows]
        if self.settings.mirror:
            flip = torch.rand(len(rows), 1, generator=self.rng) < 0.5
            labels = torch.where(flip, mirrored(self.settings.configuration, labels), labels)
        return labels + torch.randn(labels.shape, generator=self.rng) @ self._kernel.T

    def _draw_fake(self) -> tuple[Tensor, Tensor, Tensor]:
        rows = torch.randint(len(self._failed_pixels), (self.settings.batch_size,), generator=self.rng)
        images = to_float(self._failed_pixels[rows])
        features = self._standard(self._draw_condition())
        latent = self.generator.sample_latent(len(rows), self.rng)
        return images, features, self.generator.compose(images, self.generator(features, latent))

    # --- steps
    def warm_up(self) -> float:
        images, features = self._draw_real()
        net, opt = (self.regressor, self._regressor_optimizer) if self.regressor is not None else (self.discriminator, self._discriminator_optimizer)
        guess = net(images)[1]
        loss = nn.functional.mse_loss(guess, features)
        if self._expect is not None: self._descend(self._expect_opt, nn.functional.mse_loss(self._expect(features), guess.detach()))
        self._descend(opt, loss)
        return loss.item()

    def step(self) -> dict[str, Tensor]:
        metrics = {}
        for _ in range(self.settings.critic_steps):
            if self.regressor is not None: self.warm_up()
            metrics |= self._train_discriminator()
        metrics |= self._train_generator()
        self._average.update_parameters(self.generator)
        return metrics

    def _train_discriminator(self) -> dict[str, Tensor]:
        s = self.settings
        real, features = self._draw_real()
        with torch.no_grad():
            _, fake_features, fake = self._draw_fake()
        score, guess = self.discriminator(real, features)
        fake_score, _ = self.discriminator(fake, fake_features)
        distance = score.mean() - fake_score.mean()
        auxiliary = nn.functional.mse_loss(guess, features)
        loss = -distance + s.auxiliary_weight * auxiliary
        if self._critic_step % s.penalty_interval == 0:
            loss = loss + s.penalty_interval * s.penalty_weight * self._gradient_penalty(real, fake, features, fake_features)
        self._critic_step += 1
        self._descend(self._discriminator_optimizer, loss)
        return {"distance": distance.detach(), "auxiliary_real": auxiliary.detach()}

    def _gradient_penalty(self, real: Tensor, fake: Tensor, a: Tensor, b: Tensor) -> Tensor:
        mix = torch.rand(len(real), 1, 1, 1, generator=self.rng)
        between = torch.lerp(real, fake, mix).requires_grad_()
        score, _ = self.discriminator(between, torch.lerp(a, b, mix[:, :, 0, 0]))
        (gradient,) = torch.autograd.grad(score.sum(), between, create_graph=True)
        return (gradient.flatten(1).norm(dim=1) - 1).square().mean()

    def _train_generator(self) -> dict[str, Tensor]:
        s = self.settings
        images, features, fake = self._draw_fake()
        score, guess = self.discriminator(fake, features)
        if self.regressor is not None: guess = self.regressor(fake)[1]
        if self._expect is not None:
            with torch.no_grad(): features = self._expect(features)
        auxiliary = nn.functional.mse_loss(guess, features)
        change = (fake - images).square().mean()
        loss = -score.mean() + s.auxiliary_weight * auxiliary + s.change_weight * change
        self._descend(self._generator_optimizer, loss)
        return {"auxiliary_fake": auxiliary.detach(), "change": change.detach()}

    @staticmethod
    def _descend(optimizer: torch.optim.Optimizer, loss: Tensor) -> None:
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


def _scott_kernel(labels: Tensor) -> Tensor:
    """Return a factor L of the Gaussian kernel's covariance L L^T by Scott's rule, for labels ``[N, L]``."""
    n, size = labels.shape
    covariance = torch.cov(labels.T) + 1e-12 * torch.eye(size)
    return n ** (-1 / (size + 4)) * torch.linalg.cholesky(covariance)
