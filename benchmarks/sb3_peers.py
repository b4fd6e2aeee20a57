"""Stable-Baselines3's buffers, DDPG and DQN, on the same rows and networks."""

from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from stable_baselines3 import DDPG, DQN
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.common.vec_env import DummyVecEnv
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer
from tensordict import TensorDict
from torch import Tensor, nn

from benchmarks.plain_encoder import PlainEncoder
from benchmarks.rows import EPISODE, channels_first
from halgan_rl.agents.agent import AgentConfig
from halgan_rl.agents.encoder import LEAK

ACTIONS = spaces.Box(-1, 1, (2,), np.float32)
POSES = spaces.Box(-np.inf, np.inf, (3,), np.float32)
TOLERANCE = 0.01
"""A goal is reached within this distance [m]."""


class Still(gymnasium.Env):
    """An environment that is never stepped: it has spaces, and rewards poses that are their goal."""

    def __init__(self, observation_space: spaces.Space, action_space: spaces.Space = ACTIONS) -> None:
        self.observation_space, self.action_space = observation_space, action_space

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, _info: Any) -> np.ndarray:
        """Return 1 where the goal is reached."""
        return (np.linalg.norm(achieved_goal - desired_goal, axis=-1) < TOLERANCE).astype(np.float32)


def images(side: int) -> spaces.Box:
    """Return the space of images, channels first as Stable-Baselines3 wants them."""
    return spaces.Box(0, 255, (3, side, side), np.uint8)


def make_buffer(rows: int, side: int, **options: Any) -> ReplayBuffer:
    """Return a ``ReplayBuffer`` for one environment."""
    return ReplayBuffer(rows, images(side), ACTIONS, device="cpu", **options)


def make_her_buffer(rows: int, side: int) -> HerReplayBuffer:
    """Return a ``HerReplayBuffer`` with its defaults: 80 % of a sample get a later pose as their goal."""
    space = spaces.Dict({"observation": images(side), "achieved_goal": POSES, "desired_goal": POSES})
    env = DummyVecEnv([partial(Still, space)])
    return HerReplayBuffer(rows, space, ACTIONS, env=env, device="cpu")


Transition = tuple[Any, Any, np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]


def transitions(rows: TensorDict, *, goals: bool) -> list[Transition]:
    """Return the arguments of ``add``, row by row."""
    before, after = (_observations(part, goals=goals) for part in (rows, rows["next"]))
    actions, rewards = rows["action"].numpy(), rows["next", "reward"].numpy()
    dones = rows["next", "done"].numpy()
    infos = [{"TimeLimit.truncated": bool(done)} for done in dones]
    return [
        (_pick(before, i), _pick(after, i), actions[i : i + 1], rewards[i], dones[i], infos[i : i + 1])
        for i in range(len(rows))
    ]


def _observations(rows: TensorDict, *, goals: bool) -> dict[str, np.ndarray]:
    observations = {"observation": channels_first(rows["pixels"]).numpy()}
    if goals:
        observations |= {"achieved_goal": rows["pose"].numpy(), "desired_goal": np.full_like(rows["pose"], 9.0)}
    return observations


def _pick(observations: dict[str, np.ndarray], place: int) -> Any:
    picked = {name: values[place : place + 1] for name, values in observations.items()}
    return picked if len(picked) > 1 else picked["observation"]


def add(buffer: ReplayBuffer, rows: list[Transition]) -> None:
    """Add transitions one by one: there is one environment."""
    for row in rows:
        buffer.add(*row)


def fill(buffer: ReplayBuffer, rows: TensorDict) -> None:
    """Write rows that are whole episodes into the arrays, as ``add`` would: a million calls would take minutes."""
    goals = isinstance(buffer, HerReplayBuffer)
    start, stop = buffer.pos, buffer.pos + len(rows)
    for target, part in ((buffer.observations, rows), (getattr(buffer, "next_observations", None), rows["next"])):
        observations = _observations(part, goals=goals)
        if goals:
            for name, values in observations.items():
                target[name][start:stop, 0] = values
        elif target is not None:
            target[start:stop, 0] = observations["observation"]
    buffer.actions[start:stop, 0] = rows["action"].numpy()
    buffer.dones[start:stop] = buffer.timeouts[start:stop] = rows["next", "done"].numpy()
    if goals:
        buffer.ep_start[start:stop, 0] = np.arange(start, stop) // EPISODE * EPISODE
        buffer.ep_length[start:stop] = EPISODE
    buffer.full, buffer.pos = stop == buffer.buffer_size, stop % buffer.buffer_size


def nbytes(buffer: ReplayBuffer) -> int:
    """Return the size of all its arrays [bytes], without the empty infos of hindsight."""
    total = 0
    for name, value in vars(buffer).items():
        arrays = value.values() if isinstance(value, dict) else [value]
        total += sum(array.nbytes for array in arrays if isinstance(array, np.ndarray) and name != "infos")
    return total


class Features(BaseFeaturesExtractor):
    """The encoder of our agents, of plain convolutions."""

    def __init__(self, observation_space: spaces.Box, downsample: str) -> None:
        super().__init__(observation_space, features_dim=512)
        self.layers = PlainEncoder(downsample).layers

    def forward(self, observations: Tensor) -> Tensor:
        """Return features ``[N, 512]``."""
        return self.layers(observations)


def make_model(
    algorithm: type[OffPolicyAlgorithm], actions: spaces.Space, rows: TensorDict, config: AgentConfig, rate: float
) -> OffPolicyAlgorithm:
    """Return an algorithm with our networks, on a buffer filled with rows of images 64x64."""
    model = algorithm(
        "CnnPolicy",
        DummyVecEnv([partial(Still, images(64), actions)]),
        learning_rate=rate,
        buffer_size=len(rows),
        tau=config.tau,
        gamma=config.discount,
        device="cpu",
        policy_kwargs={
            "features_extractor_class": Features,
            "features_extractor_kwargs": {"downsample": config.downsample},
            "net_arch": [32],
            "activation_fn": partial(nn.LeakyReLU, LEAK),
        },
    )
    model.set_logger(Logger(folder=None, output_formats=[]))
    fill(model.replay_buffer, rows)
    return model


Updates = Callable[[int], object]
"""Makes so many updates."""


def make_ddpg_updates(
    rows: TensorDict, config: AgentConfig, rate: float, batch_size: int
) -> tuple[Updates, tuple[int, ...]]:
    """Return updates of DDPG, and the numbers of parameters of actor and critic, each with its own convolutions."""
    model = make_model(DDPG, ACTIONS, rows, config, rate)
    return partial(model.train, batch_size=batch_size), _counts(model.actor, model.critic)


class DoubleTarget(nn.Module):
    """What a target network says of the actions that the network itself prefers.

    Takes the place of the target network: the largest of its values, of which there is one a frame, is then the target
    of double DQN.
    """

    def __init__(self, network: nn.Module, target: nn.Module) -> None:
        super().__init__()
        self.network, self.target = network, target

    def forward(self, observations: Tensor) -> Tensor:
        """Return values ``[N, 1]``."""
        return self.target(observations).gather(1, self.network(observations).argmax(1, keepdim=True))


def make_dqn_updates(
    rows: TensorDict, config: AgentConfig, rate: float, batch_size: int, *, double: bool
) -> tuple[Updates, tuple[int, ...]]:
    """Return updates of DQN and of its target, and the number of parameters; the rows' actions are one-hot."""
    choices = spaces.Discrete(rows["action"].shape[-1])
    rows = rows.clone(False).set("action", rows["action"].argmax(-1, keepdim=True))
    model = make_model(DQN, choices, rows, config, rate)
    target = model.q_net_target
    if double:
        model.q_net_target = DoubleTarget(model.q_net, target)

    def run(count: int) -> None:
        for _ in range(count):
            model.train(gradient_steps=1, batch_size=batch_size)
            polyak_update(model.q_net.parameters(), target.parameters(), model.tau)

    return run, _counts(model.q_net)


def _counts(*networks: nn.Module) -> tuple[int, ...]:
    return tuple(sum(parameter.numel() for parameter in network.parameters()) for network in networks)
