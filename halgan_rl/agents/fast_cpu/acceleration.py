"""One call that makes an agent fast on a CPU."""

import logging
from typing import Any

from torch import nn
from torchrl.objectives import LossModule, SoftUpdate

from halgan_rl.agents.agent import Agent
from halgan_rl.agents.encoder import Encoder
from halgan_rl.agents.fast_cpu.block_encoder import BlockEncoder, fits
from halgan_rl.agents.fast_cpu.fused_soft_update import FusedSoftUpdate
from halgan_rl.agents.fast_cpu.one_pass_losses import share_passes

logger = logging.getLogger(__name__)


def accelerate(agent: Agent) -> tuple[str, ...]:
    """Makes an agent fast in place, wherever it fits, and logs what it did.

    What learns stays what it is: the same parameters, optimizer and state. Each part becomes its faster subclass:

    - ``"encoder"``: encoders compute on blocks of pixels, also in policies that are copied from the agent later. It
      needs images with sides that are multiples of 16 pixels, and the layers that ``Encoder`` builds. Where an agent
      learns on a GPU, its acting network and copies of it on the CPU become fast.
    - ``"loss"``: networks that see the same images share a pass. It needs a loss of DDPG or DDQN on the CPU, with the
      networks of :mod:`~halgan_rl.agents.ddpg` or :mod:`~halgan_rl.agents.ddqn`.
    - ``"target update"``: all parameters move in one call. It needs a ``SoftUpdate``.

    Everything else stays as it is. Values and gradients are the same except for rounding. Call it before
    ``agent.loss.compile()``; networks that are changed must be changed before.

    Args:
        agent: Becomes fast.

    Returns:
        Which parts are fast now, of ``"encoder"``, ``"loss"`` and ``"target update"``.
    """
    parts = {
        "loss": share_passes(agent.loss),
        "encoder": _use_blocks(agent),
        "target update": _fuse(agent.target_updater),
    }
    fast = tuple(name for name, done in parts.items() if done)
    plain = tuple(name for name, done in parts.items() if not done)
    logger.info("fast on a CPU: %s; plain: %s", ", ".join(fast) or "nothing", ", ".join(plain) or "nothing")
    return fast


def _use_blocks(agent: Agent) -> bool:
    """Makes the encoders of the agent's networks compute on blocks; returns whether all do."""
    networks = [agent.network, agent.acting, agent.explorer, *_networks_of(agent.loss)]
    encoders = [part for network in networks for part in network.modules() if isinstance(part, Encoder)]
    for encoder in encoders:
        if fits(encoder):
            encoder.__class__ = BlockEncoder
    return all(type(encoder) is BlockEncoder for encoder in encoders)


def _networks_of(loss: LossModule) -> list[nn.Module]:
    """Returns the networks that TorchRL fills with a loss's parameters; they are no children of it."""
    return [part for part in vars(loss).values() if isinstance(part, nn.Module)]


def _fuse(updater: Any) -> bool:
    """Makes a target update move all parameters in one call; returns whether it does."""
    if type(updater) is SoftUpdate:
        updater.__class__ = FusedSoftUpdate
    return type(updater) is FusedSoftUpdate
