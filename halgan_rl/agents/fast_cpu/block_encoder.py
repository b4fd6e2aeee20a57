"""The encoder on blocks of pixels, and several encoders in one pass."""

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from halgan_rl.agents.encoder import CHANNELS, LEAK, Downsample, Encoder
from halgan_rl.agents.fast_cpu.block_convolutions import PLAIN, Layout, check_fit, halve, kind_of
from halgan_rl.transforms.pixels import to_float

_ACTIVATION = partial(F.leaky_relu, negative_slope=LEAK, inplace=True)
"""In place: no gradient needs what a convolution, or a pool, gave before it."""

_SQUARE = (Layout(writes=(2, 2)), Layout(reads=(2, 2), writes=(2, 1)))
"""The first two layers of one network."""
_TALL = (Layout(writes=(2, 1)), Layout(reads=(2, 1), writes=(2, 1)))
"""The first two layers of several networks."""


class BlockEncoder(Encoder):
    """An encoder that computes on blocks of pixels on a CPU; elsewhere, and where it is compiled, it is plain.

    The features and gradients are those of the plain layers, except for rounding. Forward hooks of the layers are not
    called.
    """

    def forward(self, pixels: Tensor) -> Tensor:
        """Returns features ``[N, F]`` of images uint8 ``[..., H, W, C]``, N the product of the leading dimensions.

        Raises:
            ValueError: If the images have another shape or type than the encoder was built for.
        """
        return encode_together(pixels, [self])[0]


def encode_together(pixels: Tensor, encoders: Sequence[Encoder]) -> tuple[Tensor, ...]:
    """Returns the features that several encoders give of the same images, in one pass.

    They are those that each gives alone, except for rounding. With strides, two encoders take three quarters of the
    time together; with max-pooling the gain is small.

    Args:
        pixels: uint8 ``[..., H, W, C]``.
        encoders: All with the same image shape and down-sampling, and each :func:`fits`.

    Returns:
        Features ``[N, F]`` of each encoder, N the product of the leading dimensions.

    Raises:
        ValueError: If the images have another shape or type, or if the encoders' down-samplings differ.
    """
    if len(kinds := {encoder.downsample for encoder in encoders}) != 1:
        raise ValueError(
            f"encoders that share a pass need one down-sampling, got {sorted(kinds)}: call each by itself."
        )
    if torch.compiler.is_compiling() or not pixels.is_cpu:
        return tuple(Encoder.forward(encoder, pixels) for encoder in encoders)
    encoders[0].check(pixels)

    images = to_float(pixels)  # uint8 [..., H, W, C] -> float [N, C, H, W]
    layouts = _layouts(encoders[0].downsample, len(encoders), learn=torch.is_grad_enabled())
    halved = halve(images, [encoder.convolutions for encoder in encoders], layouts, _ACTIVATION)
    return halved.flatten(1).chunk(len(encoders), -1)  # [N, G * 32, H / 16, W / 16] -> G times [N, F]


def fits(encoder: Encoder) -> bool:
    """Whether blocks compute what the layers of an encoder do, and divide its images.

    They do for the layers that :class:`~halgan_rl.agents.encoder.Encoder` builds, whatever the channels of the images,
    if both sides are multiples of 16 pixels.
    """
    if type(encoder) not in (Encoder, BlockEncoder) or not _has_usual_layers(encoder):
        return False
    kinds = tuple(kind_of(layer) for layer in encoder.convolutions)
    try:
        for networks in (1, 2):
            for learn in (True, False):
                check_fit(kinds, _layouts(encoder.downsample, networks, learn=learn), encoder.image_shape[:2])
    except ValueError:
        return False
    return True


def _has_usual_layers(encoder: Encoder) -> bool:
    """Whether the layers are those that :func:`halve` replaces: one that was exchanged must not be ignored."""
    pooled = encoder.downsample == "max_pool"
    stage = [nn.Conv2d, nn.MaxPool2d, nn.LeakyReLU] if pooled else [nn.Conv2d, nn.LeakyReLU]
    layers = list(encoder.layers)
    if [type(layer) for layer in layers] != [*len(CHANNELS) * stage, nn.Flatten]:
        return False
    usual = {
        nn.Conv2d: nn.Conv2d(1, 1, 5, stride=1 if pooled else 2, padding=2, device="meta"),
        nn.MaxPool2d: nn.MaxPool2d(2),
        nn.LeakyReLU: nn.LeakyReLU(LEAK),
        nn.Flatten: nn.Flatten(),
    }
    return all(_settings(layer) == _settings(usual[type(layer)]) for layer in layers)


def _settings(layer: nn.Module) -> dict[str, object]:
    """Returns all public attributes of a layer other than its numbers of channels, and whether it has a bias."""
    free = ("in_channels", "out_channels", "training", "inplace")
    settings = {name: value for name, value in vars(layer).items() if name not in free and not name.startswith("_")}
    return settings | {"bias": getattr(layer, "bias", None) is not None}


def _layouts(downsample: Downsample, networks: int, *, learn: bool) -> tuple[Layout, ...]:
    """Returns the layouts of the four layers that took least time of those tried, on a core with AVX-512.

    One network alone has half the channels of two, and larger blocks make up for it; three or more were not measured.
    Backward, a stride of 2 costs more than cutting the images into blocks, of which it is a stride of 1.
    """
    if downsample == "max_pool":
        return Layout(writes=(2, 2)), Layout(reads=(2, 2)), PLAIN, PLAIN
    third = Layout(reads=(2, 2) if learn and networks == 1 else (2, 1))
    fourth = Layout(reads=(2, 2) if learn else (1, 1))
    return *(_SQUARE if networks == 1 else _TALL), third, fourth
