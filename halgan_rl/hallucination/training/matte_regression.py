"""Matte regression: a generator is fitted to what only near-goal frames show.

Adversarial training finds out by trial where a goal belongs. Much of that can be read off the data: colours that
near-goal frames show many times as often as failed ones are the goal's, so each near-goal frame comes with a rough mask
of it, and a generator whose output is a matte can be fitted to mask and colours by plain regression. What the relative
pose does not say, how the goal itself is turned and how far before it the robot stopped, is the same in all frames of
a rollout: one latent a rollout, found along with the weights (Bojanowski et al., "Optimizing the latent space of
generative networks", ICML 2018).

Not in the paper; goals without a colour of their own need adversarial training.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from halgan_rl.hallucination.generators.base import HallucinationGenerator
from halgan_rl.hallucination.generators.coordinates import CoordinateGenerator
from halgan_rl.hallucination.training.data import Frames, check_data, matching_settings
from halgan_rl.poses import PlanarPoses

LEVELS = {1: 64, 3: 16}
"""Levels of each channel that are told apart, in grey and in RGB frames: a grey goal has nothing but its level."""
LATENT_RATE = 15.0
"""Learning rate of the latents, in units of that of the weights: each sees few of the frames."""


@dataclass(frozen=True)
class MatteConfig:
    """How generators are fitted to mattes.

    Raises:
        ValueError: if a count or the learning rate is out of range.
    """

    steps: int = 2_500
    """Steps of matte regression; 0 leaves it out."""
    batch_size: int = 128
    """Frames of a step."""
    pixels: int = 512
    """Random pixels of each frame of a step; the generator's cost is that of the pixels that it computes."""
    learning_rate: float = 4e-3
    """Learning rate at first; it falls linearly to a twentieth."""
    latent_noise: float = 0.7
    """Fraction of noise in the latents. The more of it, the less they say where the goal of a rollout is, as the poses
    should; what neither says comes out blurred. A goal that is small beside the places where it counts as reached wants
    little noise."""

    def __post_init__(self) -> None:
        """Refuses values that make no sense."""
        for name, least in (("steps", 0), ("batch_size", 1), ("pixels", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}={getattr(self, name)} must be at least {least}.")
        if not self.learning_rate > 0:
            raise ValueError(f"learning_rate={self.learning_rate} must be positive.")
        if not 0 <= self.latent_noise <= 1:
            raise ValueError(f"latent_noise={self.latent_noise} must be within [0, 1]: it is a fraction.")


class MatteRegression:
    """Fits a generator's mattes to the goals of near-goal frames, one step a call.

    Args:
        generator: a ``CoordinateGenerator``, trained in place; its encoding must be standardised.

    Keyword Args:
        near_goal: ``pixels`` uint8 ``[N, H, W, C]``, ``pose`` and ``goal_pose`` ``[N, P]``; rows of equal ``goal_pose``
            are of one rollout.
        failed: ``pixels`` uint8 ``[M, H, W, C]`` and ``pose`` ``[M, P]`` of failed frames.
        rng: draws the batches and the first latents.
        config: how long, and how fast.
        poses: which entries of a pose are flags; each setting of them has a goal of its own.
        mirror: whether half of the frames are mirrored left to right, where the task is symmetric.

    Attributes:
        average: the generator whose weights are worth keeping: the generator itself.

    Raises:
        KeyError: if an entry of the frames is missing.
        ValueError: if the generator has no mattes, frames or poses are other than the generator's, or no colour is
            the goal's.
    """

    def __init__(
        self,
        generator: HallucinationGenerator,
        *,
        near_goal: Frames,
        failed: Frames,
        rng: torch.Generator,
        config: MatteConfig = MatteConfig(),
        poses: PlanarPoses = PlanarPoses(),
        mirror: bool = True,
    ) -> None:
        if not isinstance(generator, CoordinateGenerator):
            raise ValueError(f"{type(generator).__name__} has no mattes to fit: use a CoordinateGenerator.")
        check_data(generator, near_goal, failed, poses)
        self.average = self._generator = generator
        self._rng = rng
        self._settings, self._is_goal = _goal_colours_by_setting(generator, near_goal, failed, poses)
        self._batches = _Batches(generator, near_goal, rng=rng, config=config, mirror=mirror)
        self._optimizer = torch.optim.Adam(generator.parameters(), lr=config.learning_rate, betas=(0.9, 0.99))
        latents = {"params": [self._batches.latents], "lr": LATENT_RATE * config.learning_rate}
        self._optimizer.add_param_group(latents)
        self._schedule = torch.optim.lr_scheduler.LinearLR(self._optimizer, 1.0, 0.05, total_iters=config.steps)

    def step(self) -> dict[str, Tensor]:
        """Makes a step; returns the ``loss``."""
        rows, where, colours, features, latent = self._batches.draw()
        matte = self._generator.matte_at(self._generator.coordinates[where], features, latent)
        mask = self._is_goal[self._settings[rows, None, None], colour_index(colours)]
        loss = _matte_loss(matte, colours, mask.float())
        self._optimizer.zero_grad()
        loss.backward()
        self._optimizer.step()
        self._schedule.step()
        return {"loss": loss.detach()}

    def state_dict(self) -> dict[str, Any]:
        """Returns all that training goes on from."""
        return {
            "generator": self._generator.state_dict(),
            "latents": self._batches.latents.detach(),
            "optimizer": self._optimizer.state_dict(),
            "schedule": self._schedule.state_dict(),
            "rng": self._rng.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on from a state; the data and the configuration must be the same."""
        self._generator.load_state_dict(state["generator"])
        self._batches.latents.data.copy_(state["latents"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._schedule.load_state_dict(state["schedule"])
        self._rng.set_state(state["rng"])


class _Batches:
    """Draws frames, mirrored or not, some of their pixels, and the latents of their rollouts.

    Attributes:
        latents: ``[2 * rollouts, Z]``, to be found along with the weights; the second half is of mirrored frames.
    """

    def __init__(
        self,
        generator: CoordinateGenerator,
        near_goal: Frames,
        *,
        rng: torch.Generator,
        config: MatteConfig,
        mirror: bool,
    ) -> None:
        self._generator, self._rng, self._config = generator, rng, config
        self._mirror = mirror
        self._labels = generator.encoding.labels(near_goal["pose"], near_goal["goal_pose"])
        self._rollouts = torch.unique(near_goal["goal_pose"], dim=0, return_inverse=True)[1]
        self._count = int(self._rollouts.max()) + 1
        self.latents = nn.Parameter(torch.randn(2 * self._count, generator.latent_size, generator=rng))
        height, width = generator.image_shape[:2]
        self._pixels = near_goal["pixels"].reshape(-1, height * width, generator.frame_stack, generator.colours)
        self._mirrored = torch.arange(height * width).unflatten(0, (height, width)).flip(1).flatten()

    def draw(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Returns a batch of B frames, of M pixels each.

        Returns:
            Rows ``[B]`` of the data, pixels ``[M]`` of the image, what the frames show there uint8 ``[B, M, S, c]``,
            features ``[B, K]`` and latents ``[B, Z]``.
        """
        size = self._config.batch_size
        rows = torch.randint(len(self._pixels), (size,), generator=self._rng)
        flip = (torch.rand(size, generator=self._rng) < 0.5) & self._mirror
        where = torch.randperm(len(self._mirrored), generator=self._rng)[: self._config.pixels]
        straight, mirrored = (self._pixels[rows[:, None], places] for places in (where, self._mirrored[where]))
        colours = torch.where(flip[:, None, None, None], mirrored, straight)
        encoding, labels = self._generator.encoding, self._labels[rows]
        features = encoding(torch.where(flip[:, None], encoding.mirror(labels), labels))
        return rows, where, colours, features, self._draw_latents(rows, flip)

    def _draw_latents(self, rows: Tensor, flip: Tensor) -> Tensor:
        """Returns the latents of the rows' rollouts, part of them noise, ``[B, Z]``: distributed as their prior."""
        standard = (self.latents - self.latents.mean(0)) / self.latents.std(0)
        noise = torch.randn(len(rows), self._generator.latent_size, generator=self._rng)
        fraction = self._config.latent_noise
        return (1 - fraction**2) ** 0.5 * standard[self._rollouts[rows] + self._count * flip] + fraction * noise


def _goal_colours_by_setting(
    generator: CoordinateGenerator, near_goal: Frames, failed: Frames, poses: PlanarPoses
) -> tuple[Tensor, Tensor]:
    """Returns the setting of each near-goal frame's flags ``[N]``, and which colours are the goal's, for each setting.

    Raises:
        ValueError: if a setting has near-goal frames, but no colour of its own.
    """
    near, other = matching_settings(near_goal, failed, poses)
    tables = []
    for setting in range(int(near.max()) + 1):
        frames = near_goal["pixels"][near == setting], failed["pixels"][other == setting]
        tables.append(goal_colours(*(split_stack(pixels, generator.frame_stack) for pixels in frames)))
        if len(frames[0]) and not tables[-1].any():
            raise ValueError(
                "No colour is shown several times as often near the goal as in failed frames (flags "
                f"{poses.flags_of(torch.tensor(setting)).tolist()}): matte regression cannot see this goal. Use "
                "adversarial training, or collect more frames."
            )
    return near, torch.stack(tables)


def goal_colours(near_goal_pixels: Tensor, failed_pixels: Tensor, *, ratio: float = 4.0) -> Tensor:
    """Finds the colours that near-goal frames show at least ``ratio`` times as often as failed ones.

    Args:
        near_goal_pixels: uint8 ``[N, ..., c]``, c being 1 or 3.
        failed_pixels: uint8 ``[M, ..., c]``; a goal in some of them does little harm.
        ratio: how many times as often.

    Returns:
        bool ``[LEVELS[c] ** c]``, to be looked up by :func:`colour_index`.
    """
    near, failed = (colour_fractions(pixels) + 1e-6 for pixels in (near_goal_pixels, failed_pixels))
    return near > ratio * failed


def colour_fractions(pixels: Tensor) -> Tensor:
    """Returns the fraction of pixels uint8 ``[N, ..., c]`` that have each colour, ``[LEVELS[c] ** c]``."""
    colours = pixels.shape[-1]
    counts = torch.zeros(LEVELS[colours] ** colours, dtype=torch.int64)
    for part in pixels.split(256):  # an index takes eight times the room of a level
        counts += torch.bincount(colour_index(part).flatten(), minlength=len(counts))
    return counts / (pixels.numel() // colours)


def colour_index(pixels: Tensor) -> Tensor:
    """Numbers the colours of pixels uint8 ``[..., c]``, c being 1 or 3, int64 ``[...]`` below ``LEVELS[c] ** c``."""
    levels = LEVELS[pixels.shape[-1]]
    index = torch.zeros(pixels.shape[:-1], dtype=torch.int64)
    for channel in pixels.unbind(-1):
        index = index * levels + channel.to(torch.int64) * levels // 256
    return index


def split_stack(pixels: Tensor, frame_stack: int) -> Tensor:
    """Returns images ``[..., S * c]`` of S stacked frames as ``[..., S, c]``."""
    return pixels.unflatten(-1, (frame_stack, -1))


def _matte_loss(matte: Tensor, colours: Tensor, mask: Tensor) -> Tensor:
    """Wants opacity like the mask, and within it colour like the pixels.

    Args:
        matte: ``[B, M, S * c + S]``: colours in [-1, 1], then opacities.
        colours: uint8 ``[B, M, S, c]``.
        mask: ``[B, M, S]``, 0 or 1.
    """
    painted, opacity = matte.split([colours[0, 0].numel(), mask.shape[-1]], -1)
    error = (painted.unflatten(-1, colours.shape[-2:]) - (colours.float() / 127.5 - 1)).square().mean(-1)
    return nn.functional.binary_cross_entropy(opacity.clamp(1e-6, 1 - 1e-6), mask) + 4 * (error * mask).mean()
