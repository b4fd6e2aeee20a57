"""The agents' networks of the paper (Sahni et al., NeurIPS 2019, appendix), all on the camera image alone."""

from collections.abc import Sequence
from functools import partial

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import QValueModule

from halgan_rl.agents.fast_cpu.block_convolutions import PLAIN, Downsample, Halving, Layout, halve
from halgan_rl.hallucination.generators.paper import LEAK
from halgan_rl.transforms.pixels import to_float

_VISION_SIZE = 512
_HIDDEN_SIZE = 32
_SMALL = 3e-3
"""Bound on what the actor's last layer starts from (Lillicrap et al., "Continuous control with deep reinforcement
learning", 2016, section 7)."""
_ACTIVATION = partial(nn.functional.leaky_relu, negative_slope=LEAK, inplace=True)
"""In place: no gradient needs what a convolution, or a pool, gave before it."""

_SQUARE = (Layout(writes=(2, 2)), Layout(reads=(2, 2), writes=(2, 1)))
"""The first two layers of one network."""
_TALL = (Layout(writes=(2, 1)), Layout(reads=(2, 1), writes=(2, 1)))
"""The first two layers of several networks."""


def _layouts(downsample: Downsample, networks: int, *, learn: bool) -> tuple[Layout, ...]:
    """Return the layouts of the four layers that took least time of those tried, on a core with AVX-512.

    One network alone has half the channels of two, and larger blocks make up for it; three or more were not measured.
    Backward, a stride of 2 costs more than cutting the images into blocks, of which it is a stride of 1.
    """
    if downsample == "max_pool":
        return Layout(writes=(2, 2)), Layout(reads=(2, 2)), PLAIN, PLAIN
    third = Layout(reads=(2, 2) if learn and networks == 1 else (2, 1))
    fourth = Layout(reads=(2, 2) if learn else (1, 1))
    return *(_SQUARE if networks == 1 else _TALL), third, fourth


class Vision(nn.Module):
    """Four 5x5 convolutions of 4, 8, 16 and 32 channels, each of which halves the image. 17,160 parameters.

    Args:
        downsample: how each convolution halves: ``"stride"`` 2, or ``"max_pool"`` behind it. The paper's table does not
            tell; the parameters are the same, the strides cost less than half of the time.

    Raises:
        ValueError: if ``downsample`` is neither.
    """

    def __init__(self, downsample: Downsample = "stride") -> None:
        super().__init__()
        self.downsample = downsample
        self.layers = nn.Sequential(
            Halving(3, 4, 5, downsample=downsample),
            nn.LeakyReLU(LEAK),
            Halving(4, 8, 5, downsample=downsample),
            nn.LeakyReLU(LEAK),
            Halving(8, 16, 5, downsample=downsample),
            nn.LeakyReLU(LEAK),
            Halving(16, 32, 5, downsample=downsample),
            nn.LeakyReLU(LEAK),
            nn.Flatten(),
        )

    @property
    def halvings(self) -> list[Halving]:
        """The convolutions."""
        return [layer for layer in self.layers if isinstance(layer, Halving)]

    def forward(self, pixels: Tensor) -> Tensor:
        """Return features ``[N, 512]`` of images uint8 ``[..., 64, 64, 3]``, N the product of the leading dimensions.

        Raises:
            ValueError: if the images have another shape or type.
        """
        return see(pixels, [self])[0]


def see(pixels: Tensor, visions: Sequence[Vision]) -> tuple[Tensor, ...]:
    """Return what several networks see in the same images, in one pass: the same as each alone, but for rounding.

    With strides, two networks take three quarters of the time together; with max-pooling the gain is small. The layers'
    forward hooks are not called.

    Args:
        pixels: uint8 ``[..., 64, 64, 3]``.
        visions: all with the same down-sampling.

    Returns:
        Features ``[N, 512]`` for each network, N the product of the leading dimensions.

    Raises:
        ValueError: if the images have another shape or type, or if the networks' down-samplings differ.
    """
    if len(kinds := {vision.downsample for vision in visions}) != 1:
        raise ValueError(f"networks that share a pass need one down-sampling, got {sorted(kinds)}: ask each by itself")
    if pixels.shape[-3:] != (64, 64, 3) or pixels.dtype != torch.uint8:
        raise ValueError(f"pixels must be uint8 [..., 64, 64, 3], got {pixels.dtype} {list(pixels.shape)}")
    images = to_float(pixels)
    downsample, networks = visions[0].downsample, [vision.halvings for vision in visions]
    plain = torch.compiler.is_compiling() or not images.is_cpu
    layouts = 4 * (PLAIN,) if plain else _layouts(downsample, len(visions), learn=torch.is_grad_enabled())
    return halve(images, networks, layouts, _ACTIVATION).flatten(1).chunk(len(visions), -1)


class Actor(nn.Module):
    """The actor of DDPG, up to the tanh that bounds its actions: 33,642 parameters for 2 actions.

    :func:`deterministic_policy` adds the tanh. It is kept apart because the loss needs what goes into it: see
    :class:`halgan_rl.agents.objectives.UnsaturatedDDPGLoss`.

    Args:
        action_size: A.
        downsample: see :class:`Vision`.
        small_output: start the last layer's weights and biases within 3e-3 of zero, as DDPG does: an untrained policy
            then asks for the middle of all actions, whatever it sees.

    Attributes:
        kind: what manifests call such networks.
        arguments: what rebuilds the network, ready for JSON.

    Examples:
        >>> from tensordict import TensorDict
        >>> images = torch.zeros(5, 64, 64, 3, dtype=torch.uint8)
        >>> deterministic_policy(Actor())(TensorDict({"pixels": images}, batch_size=[5]))["action"].shape
        torch.Size([5, 2])
    """

    kind = "actor"

    def __init__(self, action_size: int = 2, *, downsample: Downsample = "stride", small_output: bool = True) -> None:
        super().__init__()
        self.arguments = {"action_size": action_size, "downsample": downsample}
        self.vision = Vision(downsample)
        self.head = _head(_VISION_SIZE, action_size)
        if small_output:
            for parameter in self.head[-1].parameters():
                nn.init.uniform_(parameter, -_SMALL, _SMALL)

    def forward(self, pixels: Tensor) -> Tensor:
        """Return unbounded pre-activations ``[..., A]`` for images uint8 ``[..., 64, 64, 3]``."""
        return self.head(self.vision(pixels)).reshape(*pixels.shape[:-3], -1)


def deterministic_policy(
    actor: Actor,
    *,
    pixels_key: NestedKey = "pixels",
    preactivation_key: NestedKey = "preactivation",
    action_key: NestedKey = "action",
) -> TensorDictSequential:
    """Return the policy of an actor: reads images, writes actions in [-1, 1] and what went into their tanh.

    Args:
        actor: the network.
        pixels_key: images uint8 ``[..., 64, 64, 3]``.
        preactivation_key: unbounded, ``[..., A]``.
        action_key: in [-1, 1], ``[..., A]``.
    """
    return TensorDictSequential(
        TensorDictModule(actor, in_keys=[pixels_key], out_keys=[preactivation_key]),
        TensorDictModule(nn.Tanh(), in_keys=[preactivation_key], out_keys=[action_key]),
    )


class Critic(nn.Module):
    """The value of an action in DDPG; the action joins the flattened features. 33,673 parameters for 2 actions.

    Args:
        action_size: A.
        downsample: see :class:`Vision`.
    """

    def __init__(self, action_size: int = 2, *, downsample: Downsample = "stride") -> None:
        super().__init__()
        self.vision = Vision(downsample)
        self.head = _head(_VISION_SIZE + action_size, 1)

    def forward(self, pixels: Tensor, action: Tensor) -> Tensor:
        """Return values ``[..., 1]`` for images uint8 ``[..., 64, 64, 3]`` and actions ``[..., A]``."""
        return self.judge(self.vision(pixels), action.reshape(-1, action.shape[-1])).reshape(*pixels.shape[:-3], 1)

    def judge(self, features: Tensor, action: Tensor) -> Tensor:
        """Return values ``[N, 1]`` for features ``[N, 512]`` and actions ``[N, A]``."""
        return self.head(torch.cat([features, action], -1))


class QNetwork(nn.Module):
    """The action values of DDQN: 33,708 parameters for 4 actions.

    Args:
        actions: number of discrete actions A.
        downsample: see :class:`Vision`.

    Attributes:
        kind: what manifests call such networks.
        arguments: what rebuilds the network, ready for JSON.
    """

    kind = "q_network"

    def __init__(self, actions: int = 4, *, downsample: Downsample = "stride") -> None:
        super().__init__()
        self.arguments = {"actions": actions, "downsample": downsample}
        self.vision = Vision(downsample)
        self.head = _head(_VISION_SIZE, actions)

    def forward(self, pixels: Tensor) -> Tensor:
        """Return values ``[..., A]`` for images uint8 ``[..., 64, 64, 3]``."""
        return self.head(self.vision(pixels)).reshape(*pixels.shape[:-3], -1)


class FirstBest(QValueModule):
    """TorchRL's choice of the best action, one-hot; of several whose values are the same to the last bit, the first.

    TorchRL's own marks all of them (0.14.1), which is no action: it ended a training after 20,000 frames.
    """

    @staticmethod
    def _one_hot(value: Tensor) -> Tensor:
        return nn.functional.one_hot(value.argmax(-1), value.shape[-1])


def greedy_policy(network: QNetwork, *, pixels_key: NestedKey = "pixels") -> TensorDictSequential:
    """Return the policy of an action-value network: reads images, writes the best action, one-hot, and all values.

    Args:
        network: the network.
        pixels_key: images uint8 ``[..., 64, 64, 3]``.

    Examples:
        >>> from tensordict import TensorDict
        >>> images = torch.zeros(5, 64, 64, 3, dtype=torch.uint8)
        >>> greedy_policy(QNetwork())(TensorDict({"pixels": images}, batch_size=[5]))["action"].shape
        torch.Size([5, 4])
    """
    return TensorDictSequential(
        TensorDictModule(network, in_keys=[pixels_key], out_keys=["action_value"]), FirstBest(action_space="one_hot")
    )


def _head(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, _HIDDEN_SIZE), nn.LeakyReLU(LEAK), nn.Linear(_HIDDEN_SIZE, outputs))
