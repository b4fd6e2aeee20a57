"""Algorithms by their names. A new one is a file of its own and a line here."""

from collections.abc import Mapping

import torch
from torchrl.data import TensorSpec

from halgan_rl.agents import ddpg, ddqn, sac
from halgan_rl.agents.agent import Agent, AgentConfig, Algorithm
from halgan_rl.agents.encoder import ImageShape
from halgan_rl.keys import Keys

AGENTS: Mapping[str, Algorithm] = {
    "ddpg": ddpg.ALGORITHM,
    "ddqn": ddqn.ALGORITHM,
    "sac": sac.ALGORITHM,
}
"""Names of algorithms, and what is known of each."""

POLICIES: Mapping[str, Algorithm] = {algorithm.network.kind: algorithm for algorithm in AGENTS.values()}
"""The same, by the kind that manifests of saved policies give."""


def make_agent(
    config: AgentConfig,
    *,
    action_spec: TensorSpec,
    image_shape: ImageShape,
    keys: Keys = Keys(),
    device: torch.device | str = "cpu",
) -> Agent:
    """Returns the agent of the algorithm to which a configuration belongs; arguments as for its own ``make_agent``.

    Raises:
        ValueError: If no algorithm has such a configuration, or if it does not fit the actions or the images.
    """
    for algorithm in AGENTS.values():
        if type(config) is algorithm.config:
            return algorithm.make_agent(
                config, action_spec=action_spec, image_shape=image_shape, keys=keys, device=device
            )
    known = ", ".join(algorithm.config.__name__ for algorithm in AGENTS.values())
    raise ValueError(f"{type(config).__name__} belongs to no algorithm: choose one of {known}.")


def policy_of(kind: str) -> Algorithm:
    """Returns the algorithm whose policies manifests call ``kind``: its ``network`` and ``make_policy`` rebuild one.

    Raises:
        ValueError: If there is none.
    """
    if kind not in POLICIES:
        raise ValueError(f"a policy of kind {kind!r} is unknown: choose one of {', '.join(POLICIES)}.")
    return POLICIES[kind]
