"""Hallucinators: whatever paints a goal into images."""

import math

import torch
from torch import Tensor

from halgan_rl.hallucination.generators.base import HallucinationGenerator, ImageShape
from halgan_rl.poses import PlanarPoses
from halgan_rl.transforms.hallucinate_goal import Hallucinator
from halgan_rl.transforms.pixels import to_float, to_uint8

__all__ = ["GeneratorHallucinator", "Hallucinator", "RandomFlags", "check_pixels", "check_poses"]


class GeneratorHallucinator:
    """Paints goals with a trained generator.

    A plain object, no module: the network's weights stay out of whoever holds it.

    Args:
        generator: the trained network; its train or eval mode is left as it was found.

    Keyword Args:
        rng: draws the latents.
        share_latent: the images of a row share one latent, so that they show one and the same goal.
        chunk: images of one pass; few keep the activations of a pass in a CPU's cache.

    Attributes:
        image_shape: height H, width W and channels C of the images that the network paints.

    Raises:
        ValueError: when called, if images have another shape or dtype, or poses another size than those that the
            network was trained with, or if poses are not finite.
    """

    def __init__(
        self, generator: HallucinationGenerator, *, rng: torch.Generator, share_latent: bool = True, chunk: int = 2
    ) -> None:
        self._generator, self._rng, self._share_latent, self._chunk = generator, rng, share_latent, chunk
        self.image_shape: ImageShape = generator.image_shape

    @torch.no_grad()
    def __call__(self, pixels: Tensor, pose: Tensor, goal_pose: Tensor) -> Tensor:
        """Paints the goals, see :class:`Hallucinator`."""
        check_pixels(self.image_shape, pixels)
        check_poses(int(self._generator.arguments["pose_size"]), pose=pose, goal_pose=goal_pose)
        rows, frames = pixels.shape[:2]
        features = self._generator.encoding(self._generator.encoding.labels(pose, goal_pose)).flatten(0, 1)
        repeats = frames if self._share_latent else 1
        latent = self._generator.sample_latent(rows * frames // repeats, self._rng).repeat_interleave(repeats, 0)
        was_training = self._generator.training
        self._generator.eval()
        parts = zip(*(part.split(self._chunk) for part in (pixels.flatten(0, 1), features, latent)), strict=True)
        painted = [self._paint(*part) for part in parts]
        self._generator.train(was_training)
        return torch.cat(painted).reshape(pixels.shape) if painted else pixels.clone()

    def _paint(self, pixels: Tensor, features: Tensor, latent: Tensor) -> Tensor:
        return to_uint8(self._generator.compose(to_float(pixels), self._generator(features, latent)))


class RandomFlags:
    """Has a hallucinator paint goals that flags drawn at random select, instead of those of the poses.

    So do the paper's authors in tasks with several goals, where the flags of a pose select the one that is pursued.

    Args:
        hallucinator: paints.

    Keyword Args:
        poses: which entries of a pose are flags.
        rng: draws one setting of the flags for all images of a row.

    Attributes:
        image_shape: that of the hallucinator, or None if it has none.
    """

    def __init__(self, hallucinator: Hallucinator, *, poses: PlanarPoses, rng: torch.Generator) -> None:
        self._hallucinator, self._poses, self._rng = hallucinator, poses, rng
        self.image_shape: ImageShape | None = getattr(hallucinator, "image_shape", None)

    def __call__(self, pixels: Tensor, pose: Tensor, goal_pose: Tensor) -> Tensor:
        """Paints the goals, see :class:`Hallucinator`."""
        check_poses(self._poses.size, pose=pose)
        flags = torch.randint(2, (len(pose), 1, len(self._poses.flags)), generator=self._rng)
        pose = pose.clone()
        self._poses.flag_part(pose)[...] = flags
        return self._hallucinator(pixels, pose, goal_pose)


def check_pixels(image_shape: ImageShape, pixels: Tensor) -> None:
    """Refuses images that a generator does not paint.

    Raises:
        ValueError: unless the images are uint8 ``[N, F, *image_shape]``; names both shapes.
    """
    if pixels.ndim != 5 or tuple(pixels.shape[2:]) != image_shape or pixels.dtype != torch.uint8:
        height, width, channels = image_shape
        raise ValueError(
            f"pixels are {pixels.dtype} {list(pixels.shape)}, but the generator paints torch.uint8 "
            f"[N, F, {height}, {width}, {channels}] (rows, frames, height, width, channels): use weights of an "
            "environment with such images."
        )


def check_poses(size: int, **poses: Tensor) -> None:
    """Refuses poses that a generator trained on poses of ``size`` entries cannot know.

    Raises:
        ValueError: if poses have another size or are not finite; names them.
    """
    for name, value in poses.items():
        if value.shape[-1] != size:
            raise ValueError(
                f"{name} has {value.shape[-1]} entries, but the generator was trained with {size}: "
                "use weights of an environment with such poses."
            )
        if not math.isfinite(value.sum(dtype=torch.float64)):  # several times as fast as looking at each entry
            raise ValueError(f"{name} holds NaN or infinity: look for it in the rows of the replay buffer.")
