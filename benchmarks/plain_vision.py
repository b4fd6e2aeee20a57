"""What our agents see with, as one would write it without this library."""

import torch
from torch import Tensor, nn

from halgan_rl.agents.fast_cpu.block_convolutions import Downsample
from halgan_rl.hallucination.generators.paper import LEAK


class PlainVision(nn.Module):
    """The function of :class:`halgan_rl.agents.networks.Vision` in plain layers.

    Like there, max-pooling comes before the LeakyReLU: the other way round costs more and gives the same.

    Args:
        downsample: how each convolution halves.
        memory_format: PyTorch's default, or ``channels_last``, for those who know of it.
    """

    def __init__(self, downsample: Downsample, memory_format: torch.memory_format = torch.contiguous_format) -> None:
        super().__init__()
        pooled = downsample == "max_pool"
        layers: list[nn.Module] = []
        for inputs, outputs in ((3, 4), (4, 8), (8, 16), (16, 32)):
            layers += [nn.Conv2d(inputs, outputs, 5, stride=1 if pooled else 2, padding=2)]
            layers += [nn.MaxPool2d(2)] if pooled else []
            layers += [nn.LeakyReLU(LEAK)]
        self.layers = nn.Sequential(*layers, nn.Flatten()).to(memory_format=memory_format)
        self.memory_format = memory_format

    def forward(self, pixels: Tensor) -> Tensor:
        """Return features ``[N, 512]`` of images uint8 ``[N, 3, 64, 64]``."""
        return self.layers((pixels.float() / 127.5 - 1).contiguous(memory_format=self.memory_format))
