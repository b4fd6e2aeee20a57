"""A start for the generator before the game: paint what only near-goal frames show.

The game of a GAN finds out by trial where a goal belongs. Much of that can be read off the data: colours that
near-goal frames show many times as often as failed ones are the goal's, so each near-goal frame comes with a rough mask
of it, and a generator whose output is a matte can be fitted to mask and colours by plain regression. What the relative
pose does not tell, how the goal itself is turned and how far before it the robot stopped, is the same in all frames of
a rollout: one latent a rollout, found along with the weights (Bojanowski et al., "Optimizing the latent space of
generative networks", ICML 2018).

Not in the paper; goals without a colour of their own need the game alone.
"""

from collections.abc import Iterator

import torch
from torch import Tensor, nn

from halgan_rl.hallucination.generators.coordinates import SIZE, CoordinateGenerator
from halgan_rl.hallucination.training.data import Frames, matching_flags

LEVELS = 16
"""Levels of each colour channel that are told apart."""
LATENT_RATE = 15.0
"""Learning rate of the latents, in units of that of the weights: each sees few of the frames."""


def warm_start(
    generator: CoordinateGenerator,
    *,
    near_goal: Frames,
    failed: Frames,
    steps: int,
    rng: torch.Generator,
    batch_size: int = 128,
    pixels: int = 512,
    learning_rate: float = 4e-3,
    mirror: bool = True,
    latent_noise: float = 0.7,
) -> Iterator[float]:
    """Fit a generator's mattes to the goals of near-goal frames.

    Args:
        generator: is trained in place; its encoding must be standardised.
        near_goal: ``pixels`` uint8 [N, 64, 64, 3], ``pose`` and ``goal_pose`` [N, P]; rows of equal ``goal_pose``
            are of one rollout.
        failed: ``pixels`` uint8 [M, 64, 64, 3] and ``pose`` [M, P] of failed frames.
        steps: how many.
        rng: draws the batches and the first latents.
        batch_size: frames of a step.
        pixels: random pixels of each of them; the generator's cost is that of the pixels that it is asked for.
        learning_rate: at first; it falls linearly to a twentieth.
        mirror: mirror half of the frames left to right.
        latent_noise: share of noise in the latents, in [0, 1]. The more of it, the less they tell where the goal of a
            rollout is, as the poses should; what neither tells comes out blurred. A goal that is small beside the
            places where it counts as reached wants little noise.

    Yields:
        The loss after each step.

    Raises:
        ValueError: if the share of noise is out of range.
    """
    if not 0 <= latent_noise <= 1:
        raise ValueError(f"latent_noise={latent_noise} must be within [0, 1]: it is a share")
    frames, encoding = near_goal["pixels"], generator.encoding
    labels = encoding.labels(near_goal["pose"], near_goal["goal_pose"])
    flags, is_goal = _goal_colours_by_flags(near_goal, failed)
    rollouts = torch.unique(near_goal["goal_pose"], dim=0, return_inverse=True)[1]
    count = int(rollouts.max()) + 1
    latents = nn.Parameter(torch.randn(2 * count, generator.latent_size, generator=rng))  # the second half for mirrored
    optimizer = torch.optim.Adam(generator.parameters(), lr=learning_rate, betas=(0.9, 0.99))
    optimizer.add_param_group({"params": [latents], "lr": LATENT_RATE * learning_rate})
    flat, mirrored = frames.flatten(1, 2), torch.arange(SIZE * SIZE).unflatten(0, (SIZE, SIZE)).flip(1).flatten()
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.05, total_iters=steps)
    for _ in range(steps):
        rows = torch.randint(len(frames), (batch_size,), generator=rng)
        flip = (torch.rand(batch_size, generator=rng) < 0.5) & mirror
        where = torch.randperm(SIZE * SIZE, generator=rng)[:pixels]
        colours = torch.where(flip[:, None, None], flat[rows[:, None], mirrored[where]], flat[rows[:, None], where])
        features = encoding(torch.where(flip[:, None], encoding.mirror(labels[rows]), labels[rows]))
        standard = (latents - latents.mean(0)) / latents.std(0)  # as the latent's prior has it
        noise = torch.randn(batch_size, generator.latent_size, generator=rng)
        latent = (1 - latent_noise**2) ** 0.5 * standard[rollouts[rows] + count * flip] + latent_noise * noise
        matte = generator.matte_at(generator.coordinates[where], features, latent)
        mask = is_goal[flags[rows, None], colour_index(colours)]
        loss = _matte_loss(matte, colours, mask.float())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        yield float(loss.detach())


def _goal_colours_by_flags(near_goal: Frames, failed: Frames) -> tuple[Tensor, Tensor]:
    """Return the number of each near-goal frame's flags ``[N]``, and which colours are the goal's, for each number."""
    flags, failed_flags = matching_flags(near_goal, failed)
    pairs = (
        (near_goal["pixels"][flags == number], failed["pixels"][failed_flags == number])
        for number in range(int(flags.max()) + 1)
    )
    return flags, torch.stack([goal_colours(*pair) for pair in pairs])


def goal_colours(near_goal_pixels: Tensor, failed_pixels: Tensor, *, ratio: float = 4.0) -> Tensor:
    """Tell the colours that near-goal frames show at least ``ratio`` times as often as failed ones.

    Args:
        near_goal_pixels: uint8 ``[N, H, W, 3]``.
        failed_pixels: uint8 ``[M, H, W, 3]``; a goal in some of them does little harm.
        ratio: how many times as often.

    Returns:
        bool ``[LEVELS ** 3]``, to be looked up by :func:`colour_index`.
    """
    near, failed = (
        torch.bincount(colour_index(pixels).flatten(), minlength=LEVELS**3) / pixels[..., 0].numel() + 1e-6
        for pixels in (near_goal_pixels, failed_pixels)
    )
    return near > ratio * failed


def colour_index(pixels: Tensor) -> Tensor:
    """Number the colours of pixels uint8 ``[..., 3]``, int64 ``[...]`` below ``LEVELS ** 3``."""
    red, green, blue = (pixels.to(torch.int64) * LEVELS // 256).unbind(-1)
    return (red * LEVELS + green) * LEVELS + blue


def _matte_loss(matte: Tensor, colours: Tensor, mask: Tensor) -> Tensor:
    """Want opacity like the mask ``[N, M]``, and within it colour like the pixels uint8 ``[N, M, 3]``."""
    colour, opacity = matte[..., :3], matte[..., 3].clamp(1e-6, 1 - 1e-6)
    error = ((colour - (colours.float() / 127.5 - 1)).square().mean(-1) * mask).mean()
    return nn.functional.binary_cross_entropy(opacity, mask) + 4 * error
