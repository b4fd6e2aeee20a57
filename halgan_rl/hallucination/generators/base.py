"""What all generators have in common."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from halgan_rl.hallucination.generators.goal_encoding import Configuration, GoalEncoding
from halgan_rl.poses import PlanarPoses

LEAK = 0.3
"""Slope of Keras' LeakyReLU, which the authors use."""
LARGEST = 4096
"""Bound on height and width [pixels], on channels, and on the entries of latents."""

ImageShape = tuple[int, int, int]
"""Height, width and channels."""


class HallucinationGenerator(nn.Module, ABC):
    """Draws what has to change in an image so that it shows the goal.

    Its output depends on the relative pose and a latent alone, never on the image.

    Args:
        configuration: how the relative pose is described to the network.
        pose_size: P, entries of a pose.
        latent_size: Z.

    Keyword Args:
        image_shape: height H, width W and channels C of the images.
        frame_stack: how many frames are stacked along the channels, each with 1 (grey) or 3 (RGB) of them. The pose is
            that of the last frame; how the robot moved between the frames is not known to the network.

    Attributes:
        arguments: what rebuilds the network, ready for JSON; subclasses add their own.
        encoding: turns poses into the network's features.
        image_shape: H, W, C.
        frame_stack: frames of an image.
        colours: channels of one frame, 1 or 3.

    Raises:
        ValueError: if a value has another type, is out of range, or frames have other than 1 or 3 channels.
    """

    def __init__(
        self,
        configuration: Configuration,
        pose_size: int,
        latent_size: int,
        *,
        image_shape: Sequence[int] = (64, 64, 3),
        frame_stack: int = 1,
    ) -> None:
        check_count("latent_size", latent_size)
        super().__init__()
        self.image_shape = check_image_shape(image_shape, frame_stack)
        self.frame_stack, self.colours = frame_stack, self.image_shape[2] // frame_stack
        self.latent_size = latent_size
        self.encoding = GoalEncoding(configuration, pose_size)
        self.arguments: dict[str, Any] = {
            "configuration": configuration,
            "pose_size": pose_size,
            "latent_size": latent_size,
            "image_shape": list(self.image_shape),
            "frame_stack": frame_stack,
        }

    @abstractmethod
    def forward(self, features: Tensor, latent: Tensor, *, size: Sequence[int] | None = None) -> Tensor:
        """Returns the change of images.

        Args:
            features: ``[N, K]``.
            latent: ``[N, Z]``.

        Keyword Args:
            size: height h and width w to paint at, by default those of ``image_shape``.

        Returns:
            float ``[N, D, h, w]``.
        """

    @abstractmethod
    def sample_latent(self, count: int, rng: torch.Generator) -> Tensor:
        """Draws latents ``[count, Z]`` from their prior."""

    @abstractmethod
    def extent(self, change: Tensor) -> Tensor:
        """Returns how much a change alters images, float ``[N]``: 0 if it leaves them as they are."""

    @abstractmethod
    def compose(self, images: Tensor, change: Tensor) -> Tensor:
        """Returns images float ``[N, C, H, W]`` in [-1, 1] with a change applied; same shape and range."""


def check_image_shape(image_shape: Sequence[int], frame_stack: int) -> ImageShape:
    """Returns height, width and channels, once it is sure that they are.

    Raises:
        ValueError: if they are not three counts in range, or the channels no ``frame_stack`` frames of 1 or 3.
    """
    check_count("frame_stack", frame_stack)
    if not isinstance(image_shape, Sequence) or isinstance(image_shape, str) or len(image_shape) != 3:
        raise ValueError(f"image_shape={image_shape!r} must be height, width and channels.")
    for name, value in zip(("height", "width", "channels"), image_shape, strict=True):
        check_count(name, value)
    height, width, channels = image_shape
    if channels not in (frame_stack, 3 * frame_stack):
        raise ValueError(
            f"image_shape={tuple(image_shape)} has {channels} channels, but frame_stack={frame_stack} frames have "
            f"{frame_stack} (grey) or {3 * frame_stack} (RGB): give height, width, channels, and the frames stacked."
        )
    return height, width, channels


def check_pose_size(generator: HallucinationGenerator, poses: PlanarPoses) -> None:
    """Refuses poses of another size than those that a generator is made for.

    Raises:
        ValueError: if the sizes differ; names them and the flags.
    """
    size = generator.arguments["pose_size"]
    if size != poses.size:
        raise ValueError(
            f"The generator takes poses of {size} entries, but x, y, yaw and the flags {poses.flags} are {poses.size}: "
            "name the flags in poses=PlanarPoses(flags=(...))."
        )


def check_count(name: str, value: object, least: int = 1, most: int = LARGEST) -> None:
    """Raises a ``ValueError`` that names ``name`` unless ``value`` is a whole number from ``least`` to ``most``."""
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
        raise ValueError(f"{name}={value!r} must be a whole number from {least} to {most}.")


def check_number(name: str, value: object, low: float, high: float) -> None:
    """Raises a ``ValueError`` that names ``name`` unless ``value`` is a number strictly between two."""
    if not isinstance(value, int | float) or isinstance(value, bool) or not low < value < high:
        raise ValueError(f"{name}={value!r} must be a number between {low:g} and {high:g}.")
