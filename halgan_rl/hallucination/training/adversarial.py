"""Adversarial training of a generator: a relativistic game in which critic and generator both know the pose.

Four things make it work, see ``results/generators.md``:

- The critic judges an image *under a configuration* (:class:`~.critic.PoseCritic`): a goal in the wrong place is as
  wrong as no goal.
- Real images under wrong configurations are fakes, too: they show the critic what a configuration means.
- Fakes are painted into failed frames that are seen from where the real ones are (:mod:`~.matching`), under the same
  configuration: only the goal tells the two apart.
- The loss compares each fake with a real image, softplus(D(fake, c) - D(real, c)), and the critic's slope at real
  images is kept small (R1). Source: Jolicoeur-Martineau, "The relativistic discriminator", ICLR 2019; Huang et al.,
  "The GAN is dead; long live the GAN!" (R3GAN), NeurIPS 2024; R1: Mescheder et al., ICML 2018.

Training starts with coarse images, half as high and as wide. No colours are looked at, and no goal is masked.
"""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from halgan_rl.hallucination.generators.base import HallucinationGenerator
from halgan_rl.hallucination.training.critic import PoseCritic
from halgan_rl.hallucination.training.data import Frames, check_data
from halgan_rl.hallucination.training.matching import nearest_backgrounds
from halgan_rl.poses import PlanarPoses
from halgan_rl.transforms.pixels import to_float


@dataclass(frozen=True)
class AdversarialConfig:
    """How generators are trained adversarially.

    Raises:
        ValueError: if a value is out of range.
    """

    steps: int = 4_000
    """Steps of adversarial training; 0 leaves it out."""
    coarse: float = 0.65
    """Fraction of the steps, the first ones, with images of half the height and width."""
    batch_size: int = 32
    """Real images of a step, and fake ones."""
    learning_rate: float = 2e-3
    """Learning rate of both networks (Adam) with coarse images; it falls linearly in the second half."""
    fine_learning_rate: float = 1e-3
    """Learning rate with whole images; it falls likewise."""
    betas: tuple[float, float] = (0.0, 0.99)
    """Adam's decay rates."""
    penalty_weight: float = 0.3
    """Weight of the critic's squared slope at real images (R1) with coarse images."""
    fine_penalty_weight: float = 1.0
    """Weight of it with whole images, by which the critic overfits sooner."""
    penalty_interval: int = 8
    """Steps from one penalty to the next; its weight grows as much (StyleGAN2's trick)."""
    wrong_pose_weight: float = 1.0
    """Weight of telling real images under their configuration from the same under another's."""
    painted_maps: bool = True
    """Show the critic where in the image the goal must be seen, instead of comparing summaries alone."""
    extent_weight: float = 3.0
    """Weight of how much of the image the generator changes: a goal that resembles the room would be painted where
    nothing needs to change."""
    elsewhere: int = 8
    """Configurations of a step between any two failed poses; only the weight on the extent applies to them. Near-goal
    frames show no goal that lies behind, and what is painted there is otherwise up to chance."""
    label_noise: tuple[float, float] = (0.01, 0.02)
    """Standard deviation of the noise on configurations: lengths [m], angles [rad]."""
    backgrounds: int = 4
    """Failed frames to choose from for each real one, the nearest; 0: any with the same flags."""
    average_decay: float = 0.998
    """Decay of the moving average of the generator's weights, which is what is kept; it is less at first."""

    def __post_init__(self) -> None:
        """Refuses values that make no sense."""
        for name, least in (
            ("steps", 0),
            ("batch_size", 2),
            ("penalty_interval", 1),
            ("backgrounds", 0),
            ("elsewhere", 0),
        ):
            if getattr(self, name) < least:
                raise ValueError(f"{name}={getattr(self, name)} must be at least {least}.")
        for name in ("coarse", "average_decay"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name}={getattr(self, name)} must be within [0, 1]: it is a fraction.")
        for name in ("learning_rate", "fine_learning_rate"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}={getattr(self, name)} must be positive.")
        for name in ("penalty_weight", "fine_penalty_weight", "wrong_pose_weight", "extent_weight"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name}={getattr(self, name)} must not be negative.")

    @property
    def coarse_steps(self) -> int:
        """Steps with coarse images."""
        return round(self.coarse * self.steps)

    def rate_at(self, step: int) -> float:
        """Returns the learning rate of a step, counted from 0."""
        coarse = step < self.coarse_steps
        first, last = (0, self.coarse_steps) if coarse else (self.coarse_steps, self.steps)
        left = 1 - (step - first) / (last - first)
        return (self.learning_rate if coarse else self.fine_learning_rate) * min(1.0, 2 * left)


class AdversarialTrainer:
    """Trains a generator against a critic that knows the pose, one step of both a call.

    Args:
        generator: learns to paint the goal; its encoding is used as it is.

    Keyword Args:
        near_goal: ``pixels`` uint8 ``[N, H, W, C]``, ``pose`` and ``goal_pose`` ``[N, P]`` of near-goal frames.
        failed: ``pixels`` uint8 ``[M, H, W, C]`` and ``pose`` ``[M, P]`` of failed frames.
        config: hyper-parameters.
        rng: draws everything that is random, except the critic's first weights (PyTorch's global generator).
        poses: which entries of a pose are flags; each setting of them has a goal of its own.
        mirror: whether half of the images are mirrored left to right, where the task is symmetric.

    Attributes:
        average: the generator whose weights are worth keeping, the moving average.
        steps: made so far.

    Raises:
        KeyError: if an entry of the frames is missing.
        ValueError: if frames or poses are other than the generator's, or images too small for the critic.
    """

    def __init__(
        self,
        generator: HallucinationGenerator,
        *,
        near_goal: Frames,
        failed: Frames,
        config: AdversarialConfig,
        rng: torch.Generator,
        poses: PlanarPoses = PlanarPoses(),
        mirror: bool = True,
    ) -> None:
        check_data(generator, near_goal, failed, poses)
        self.generator, self.config, self.rng = generator, config, rng
        self.critic = PoseCritic(
            generator.encoding.size, image_shape=generator.image_shape, painted_maps=config.painted_maps
        )
        self.average = deepcopy(generator)
        self.steps = 0
        self._encoding, self._mirror = generator.encoding, mirror
        self._real_pixels, self._failed_pixels = near_goal["pixels"], failed["pixels"]
        self._failed_pose = failed["pose"]
        self._labels = generator.encoding.labels(near_goal["pose"], near_goal["goal_pose"])
        self._noise = generator.encoding.noise(*config.label_noise)
        count = config.backgrounds or len(failed["pose"])
        self._backgrounds = nearest_backgrounds(near_goal, failed, poses, count=count)
        self._optimizers = {
            name: torch.optim.Adam(network.parameters(), lr=config.learning_rate, betas=config.betas)
            for name, network in (("generator", generator), ("critic", self.critic))
        }

    def step(self) -> dict[str, Tensor]:
        """Trains the critic, then the generator.

        Returns:
            Scalars: ``critic_gap``, by how much real images score better than fakes; ``wrong_pose_gap``, by how much
            better than themselves under another configuration; ``slope``, the critic's mean squared slope at real
            images, in steps that penalise it; ``extent``, how much of the images the generator changes.
        """
        coarse = self.steps < self.config.coarse_steps
        for optimizer in self._optimizers.values():
            optimizer.param_groups[0]["lr"] = self.config.rate_at(self.steps)
        real, background, features, wrong = self._draw(coarse=coarse)
        change = self._draw_change(features, size=real.shape[2:])
        fake = self.generator.compose(background, change)
        metrics = self._train_critic(real, fake.detach(), features, wrong, coarse=coarse)
        extent = self.generator.extent(change).mean() + self._extent_elsewhere(size=real.shape[2:])
        metrics |= self._train_generator(real, fake, features, extent, coarse=coarse)
        self.steps += 1
        self._update_average()
        return metrics

    def networks(self) -> dict[str, nn.Module]:
        """Returns generator, its average, and critic, by name."""
        return {"generator": self.generator, "average": self.average, "critic": self.critic}

    def state_dict(self) -> dict[str, Any]:
        """Returns all that training goes on from: networks, optimizers, steps, and the state of the random draws."""
        return {
            **{name: network.state_dict() for name, network in self.networks().items()},
            "optimizers": {name: optimizer.state_dict() for name, optimizer in self._optimizers.items()},
            "rng": self.rng.get_state(),
            "steps": self.steps,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on from a state; the data, the configuration and the networks' shapes must be the same."""
        for name, network in self.networks().items():
            network.load_state_dict(state[name])
        for name, optimizer in self._optimizers.items():
            optimizer.load_state_dict(state["optimizers"][name])
        self.rng.set_state(state["rng"])
        self.steps = state["steps"]

    def _train_critic(
        self, real: Tensor, fake: Tensor, features: Tensor, wrong: Tensor, *, coarse: bool
    ) -> dict[str, Tensor]:
        """Prefers real images to fakes, and to themselves under other configurations."""
        config, critic = self.config, self.critic
        seen = critic.look(torch.cat([real, fake]), coarse=coarse)
        real_seen, fake_seen = ({name: part.chunk(2)[half] for name, part in seen.items()} for half in (0, 1))
        score = critic.score(real_seen, features)
        gap = score - critic.score(fake_seen, features)
        wrong_gap = score - critic.score(real_seen, wrong)
        loss = functional.softplus(-gap).mean() + config.wrong_pose_weight * functional.softplus(-wrong_gap).mean()
        metrics = {"critic_gap": gap.mean().detach(), "wrong_pose_gap": wrong_gap.mean().detach()}
        if self.steps % config.penalty_interval == 0:
            slope = self._slope(real, features, coarse=coarse)
            weight = config.penalty_weight if coarse else config.fine_penalty_weight
            loss = loss + config.penalty_interval * weight / 2 * slope
            metrics["slope"] = slope.detach()
        self._descend("critic", loss)
        return metrics

    def _slope(self, real: Tensor, features: Tensor, *, coarse: bool) -> Tensor:
        """Returns the mean squared norm of the score's gradient in the images."""
        images = real.clone().requires_grad_()
        score = self.critic.score(self.critic.look(images, coarse=coarse), features)
        (slope,) = torch.autograd.grad(score.sum(), images, create_graph=True)
        return slope.square().sum((1, 2, 3)).mean()

    def _train_generator(
        self, real: Tensor, fake: Tensor, features: Tensor, extent: Tensor, *, coarse: bool
    ) -> dict[str, Tensor]:
        """Makes fakes that the critic prefers to real images, and that change little."""
        critic = self.critic
        with torch.no_grad():
            score = critic.score(critic.look(real, coarse=coarse), features)
        critic.requires_grad_(False)
        gap = score - critic.score(critic.look(fake, coarse=coarse), features)
        critic.requires_grad_(True)
        self._descend("generator", functional.softplus(gap).mean() + self.config.extent_weight * extent)
        return {"extent": extent.detach()}

    def _descend(self, name: str, loss: Tensor) -> None:
        self._optimizers[name].zero_grad()
        loss.backward()
        self._optimizers[name].step()

    @torch.no_grad()
    def _update_average(self) -> None:
        """Follows the generator: closely at first, or the average would hold on to its first weights."""
        decay = min(self.config.average_decay, (1 + self.steps) / (10 + self.steps))
        for kept, new in zip(self.average.parameters(), self.generator.parameters(), strict=True):
            kept.lerp_(new, 1 - decay)
        for copy, now in zip(self.average.buffers(), self.generator.buffers(), strict=True):
            copy.copy_(now)

    def _draw(self, *, coarse: bool) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Draws real images and matching backgrounds, mirrored alike, their configurations, and wrong ones."""
        count = self.config.batch_size
        rows = torch.randint(len(self._labels), (count,), generator=self.rng)
        choice = torch.randint(self._backgrounds.shape[1], (count,), generator=self.rng)
        flip = (torch.rand(count, generator=self.rng) < 0.5) & self._mirror
        labels = torch.where(flip[:, None], self._encoding.mirror(self._labels[rows]), self._labels[rows])
        labels = labels + self._noise * torch.randn(labels.shape, generator=self.rng)
        wrong = self._encoding.with_flags_of(labels.roll(1, 0), labels)
        images = self._real_pixels[rows], self._failed_pixels[self._backgrounds[rows, choice]]
        real, background = (_prepare(pixels, flip, coarse=coarse) for pixels in images)
        return real, background, self._encoding(labels), self._encoding(wrong)

    def _extent_elsewhere(self, *, size: Sequence[int]) -> Tensor:
        """Returns how much is changed where goals lie anywhere, also where no near-goal frame has them."""
        count = self.config.elsewhere
        if not count:
            return torch.zeros(())
        here, there = torch.randint(len(self._failed_pose), (2, count), generator=self.rng)
        labels = self._encoding.labels(self._failed_pose[here], self._failed_pose[there])
        return self.generator.extent(self._draw_change(self._encoding(labels), size=size)).mean()

    def _draw_change(self, features: Tensor, *, size: Sequence[int]) -> Tensor:
        """Returns the generator's changes of images of a size, each with a latent of its own."""
        return self.generator(features, self.generator.sample_latent(len(features), self.rng), size=size)


def _prepare(pixels: Tensor, flip: Tensor, *, coarse: bool) -> Tensor:
    """Returns images ``[N, C, H, W]`` for uint8 ``[N, H, W, C]``, some of them mirrored, in half the size if coarse."""
    images = to_float(pixels)
    images = torch.where(flip[:, None, None, None], images.flip(3), images)
    return functional.avg_pool2d(images, 2) if coarse else images
