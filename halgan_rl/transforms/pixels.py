"""The step between stored pixels and what the networks see."""

import torch
from torch import Tensor


def to_float(pixels: Tensor) -> Tensor:
    """Scale images to [-1, 1] and move the channels forward.

    A permuted ``HWC`` tensor already lies in memory as ``channels_last``: nothing is copied but by the conversion.

    Args:
        pixels: uint8 ``[..., H, W, C]``, any leading dimensions, also none.

    Returns:
        float32 ``[N, C, H, W]`` in [-1, 1], N the product of the leading dimensions.
    """
    return pixels.reshape(-1, *pixels.shape[-3:]).to(torch.float32).mul_(2 / 255).sub_(1).permute(0, 3, 1, 2)


def to_uint8(images: Tensor) -> Tensor:
    """Invert :func:`to_float`, rounding to the nearest of the 256 levels.

    Args:
        images: float ``[N, C, H, W]`` in [-1, 1]; values outside are clipped.

    Returns:
        uint8 ``[N, H, W, C]``. ``to_uint8(to_float(pixels))`` is ``pixels``, bit for bit.
    """
    levels = (images.permute(0, 2, 3, 1) + 1) * (255 / 2)
    return levels.round().clamp(0, 255).to(torch.uint8)
