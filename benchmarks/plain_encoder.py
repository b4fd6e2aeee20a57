"""The layers of our agents' encoder, as one would run them without this library: on images channels first."""

import torch
from torch import Tensor, nn

from halgan_rl.agents.encoder import Downsample, Encoder


class PlainEncoder(nn.Module):
    """The layers of :class:`halgan_rl.agents.encoder.Encoder`, in PyTorch's default order of channels.

    Args:
        downsample: How each convolution halves.
        memory_format: PyTorch's default, or ``channels_last``, for those who know of it.
    """

    def __init__(self, downsample: Downsample, memory_format: torch.memory_format = torch.contiguous_format) -> None:
        super().__init__()
        self.layers = Encoder(downsample=downsample).layers.to(memory_format=memory_format)
        self.memory_format = memory_format

    def forward(self, pixels: Tensor) -> Tensor:
        """Returns features ``[N, 512]`` of images uint8 ``[N, 3, 64, 64]``."""
        return self.layers((pixels.float() / 127.5 - 1).contiguous(memory_format=self.memory_format))
