"""An agent trained with hindsight, from its configuration to its pictures: what the recipes for agents share.

Knows no simulator: the recipes pass one, see :class:`Simulator`.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager, ExitStack, nullcontext
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol, TypeVar

import torch
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.collectors import BaseCollector, Collector
from torchrl.data import TensorDictReplayBuffer, TensorSpec
from torchrl.envs import Compose, EnvBase, ExcludeTransform
from torchrl.record.loggers import Logger
from torchrl.record.loggers.tensorboard import TensorboardLogger

from halgan_rl.experiment import pictures
from halgan_rl.experiment.config import HindsightConfig
from halgan_rl.experiment.metrics import Report
from halgan_rl.experiment.run_folder import RunFolder, check_unused, read_metrics, versions
from halgan_rl.hallucination.bank import BankGrid, HallucinationBank
from halgan_rl.hallucination.hallucinators import GanHallucinator, Hallucinator, RandomFlags
from halgan_rl.hallucination.weights import load_generator, save_weights, shipped_weights
from halgan_rl.poses import PoseTolerance
from halgan_rl.replay.frame_storage import FrameStorage
from halgan_rl.training.background_collector import BackgroundCollector
from halgan_rl.training.evaluation import Evaluation, record
from halgan_rl.training.evaluation_process import EvaluationProcess, evaluate_at_once
from halgan_rl.training.loop import COLUMNS, Agent, Schedule, train
from halgan_rl.transforms import pipelines


class Simulator(Protocol):
    """What is asked of a simulator, such as the package ``envs``. Environments go by names."""

    def make(self, name: str, *, seed: int | None = None) -> EnvBase:
        """Make an environment with ``pixels`` and ``pose``, and ``render_overview(height, width)`` for people."""

    def fingerprint(self, name: str) -> Mapping[str, str]:
        """Return what its images depend on, see :func:`halgan_rl.hallucination.weights.load_generator`."""

    def pose_flags(self, name: str) -> Sequence[str]:
        """Return the names of the entries of its poses after x, y and yaw."""

    def goal_offsets(self, name: str) -> tuple[float, ...]:
        """Return how far ahead of a goal pose the goal stands [m], for each setting of the flags."""

    def GoalRenderer(self, name: str) -> Hallucinator:
        """Return an oracle: what paints the goal as the simulator shows it."""


EVALUATION_SEED = 10_000
"""Seed of the first fixed start; training seeds are far below."""

Config = TypeVar("Config", bound=HindsightConfig)


def run(config: Config, make_agent: Callable[[Config, TensorSpec], Agent], simulator: Simulator) -> float:
    """Train an agent, evaluate it, and write everything into `config.out`.

    Args:
        config: what to do.
        make_agent: makes the agent for a configuration and the environment's actions.
        simulator: where the environments are from.

    Returns:
        The success rate at the end.

    Raises:
        FileExistsError: if `config.out` already holds anything.
        ValueError: if the environment is unknown, the weights do not fit it, or the device cannot be used.
    """
    check_unused(config.out)
    check_device(config.device)
    torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)

    # The environment and the agent.
    env = simulator.make(config.environment, seed=config.seed)
    agent = make_agent(config, env.action_spec)
    if config.compile != "no":
        agent.loss.compile(mode=config.compile)
    flags = simulator.pose_flags(config.environment)
    evaluator = make_evaluator(config, simulator, flags)

    # Replay with hindsight: failed rows come out of the buffer as successes.
    with torch.random.fork_rng(devices=[]):  # With one seed all methods explore alike, whatever a painter draws.
        hallucinator = make_hallucinator(config, simulator)
    hindsight = make_hindsight(config, hallucinator)
    buffer = make_buffer(config, hindsight)

    # Learning.
    with ExitStack() as stack:
        evaluate = stack.enter_context(evaluator)
        folder = make_folder(config, agent, flags)
        collector = make_collector(config, simulator, env, agent.explorer)
        stack.callback(collector.shutdown)
        policy = train(
            agent,
            collector,
            buffer,
            hindsight=hindsight,
            schedule=Schedule(
                config.total_frames, config.warmup_frames, config.frames_per_update, config.evaluate_every
            ),
            batch_size=config.batch_size,
            policy_average=config.policy_average,
            evaluate=evaluate,
            report=Report(folder, make_tensorboard(config)),
            save=partial(save_policy, folder, config, simulator),
            label=config.hindsight,
        )

    # Pictures.
    draw_pictures(folder, config, simulator.make(config.environment), policy)
    if hallucinator is not None:
        painters = {"true goal": simulator.GoalRenderer(config.environment), config.hindsight: hallucinator}
        draw_hallucinations(folder.file("hallucinations.png"), config, buffer, painters)
    return read_metrics(folder.file("metrics.csv"))["eval/success_rate"][-1]


def check_device(device: str) -> None:
    """Refuse a device that PyTorch cannot use here."""
    try:
        torch.zeros(1, device=device).cpu()
    except (AssertionError, ImportError, NotImplementedError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"device={device!r} cannot be used here ({reason}): choose 'cpu'") from error


def make_hallucinator(config: HindsightConfig, simulator: Simulator) -> Hallucinator | None:
    """Return who paints the goal; weights that do not fit the environment are refused here."""
    if config.hindsight == "none":
        return None
    rng = torch.Generator().manual_seed(config.seed)
    if config.hindsight == "oracle":
        painter = simulator.GoalRenderer(config.environment)
    else:
        painter = make_painter(config, simulator, rng)
    return RandomFlags(painter, rng=rng) if config.random_flags else painter


def make_painter(config: HindsightConfig, simulator: Simulator, rng: torch.Generator) -> Hallucinator:
    """Return what paints with a generator: its bank, or the generator itself."""
    path = config.weights or shipped_weights(config.environment)
    generator = load_generator(
        path,
        expected=simulator.fingerprint(config.environment),
        pose_size=3 + len(simulator.pose_flags(config.environment)),
        allow_other_mujoco=config.allow_other_mujoco,
    )
    if config.bank:
        grid = BankGrid(goal_offset=simulator.goal_offsets(config.environment))
        return HallucinationBank(generator, grid, rng=rng, share_latent=config.share_latent)
    return GanHallucinator(generator, rng=rng, share_latent=config.share_latent)


def make_hindsight(config: HindsightConfig, hallucinator: Hallucinator | None) -> Compose | None:
    """Return the replay transform of the chosen method."""
    if hallucinator is None:
        return None
    pipeline = pipelines.oracle if config.hindsight == "oracle" else pipelines.halgan
    return pipeline(
        hallucinator,
        max_distance=config.max_distance,
        nearness=config.nearness,
        probability=config.hallucination_start,
        final_probability=config.hallucination_end,
        annealing_steps=config.hallucination_frames,
        tolerance=PoseTolerance(config.goal_distance, config.goal_angle),
        pursue_unseen=config.pursue_unseen,
        generator=torch.Generator().manual_seed(config.seed),
    )


def make_collector(
    config: HindsightConfig, simulator: Simulator, env: EnvBase, explorer: TensorDictModuleBase
) -> BaseCollector:
    """Return what steps the environment: uniformly random actions first, then the exploring policy.

    In the background it steps one like it, and closes `env`.
    """
    settings: dict[str, Any] = {
        "frames_per_batch": config.frames_per_batch,
        "total_frames": config.total_frames,
        "init_random_frames": config.warmup_frames,
    }
    if not config.background_collection:
        return Collector(env, explorer, track_traj_ids=False, auto_register_policy_transforms=False, **settings)
    env.close()
    collector = BackgroundCollector(
        partial(simulator.make, config.environment),
        explorer,
        postproc=ExcludeTransform("collector"),
        num_threads=config.threads,
        **settings,
    )
    collector.set_seed(config.seed)
    return collector


def make_folder(config: HindsightConfig, agent: Agent, flags: Sequence[str]) -> RunFolder:
    """Return the run's folder, with its configuration."""
    columns = (*COLUMNS, *(f"train/{name}" for name in agent.figures.values()), *(f"eval/{flag}" for flag in flags))
    folder = RunFolder(config.out, columns=columns)
    folder.write_config(dataclasses.asdict(config))
    return folder


def make_buffer(config: HindsightConfig, hindsight: Compose | None) -> TensorDictReplayBuffer:
    """Return the replay buffer; room for final frames suffices for episodes of four steps on average."""
    return TensorDictReplayBuffer(
        storage=FrameStorage(config.replay_capacity, extra_frames=config.replay_capacity // 4),
        transform=hindsight,
        generator=torch.Generator().manual_seed(config.seed),
    )


def make_tensorboard(config: HindsightConfig) -> Logger | None:
    """Return TorchRL's TensorBoard logger if it was asked for."""
    if not config.tensorboard:
        return None
    if find_spec("tensorboard") is None:
        raise ImportError("--tensorboard needs the extra: pip install 'halgan-rl[tensorboard]'")
    return TensorboardLogger(exp_name="tensorboard", log_dir=str(config.out))


Evaluator = Callable[[TensorDictModuleBase], Future[Evaluation]]


def make_evaluator(
    config: HindsightConfig, simulator: Simulator, flags: Sequence[str]
) -> AbstractContextManager[Evaluator]:
    """Return what judges policies on the fixed starts: beside training, or at once."""
    make_env = partial(simulator.make, config.environment)
    starts = range(EVALUATION_SEED, EVALUATION_SEED + config.evaluation_starts)
    if config.background_evaluation:
        return EvaluationProcess(make_env, threads=config.threads, seeds=starts, flags=flags)
    return nullcontext(partial(evaluate_at_once, make_env(), seeds=starts, flags=flags))


def save_policy(folder: RunFolder, config: HindsightConfig, simulator: Simulator, network: nn.Module) -> None:
    """Write `policy.safetensors` with all that is needed to rebuild and trust it."""
    manifest = {
        "kind": network.kind,
        "arguments": network.arguments,
        **simulator.fingerprint(config.environment),
        "config": dataclasses.asdict(config),
        "versions": versions(),
    }
    save_weights(folder.file("policy.safetensors"), network, manifest)


def draw_pictures(folder: RunFolder, config: HindsightConfig, env: EnvBase, policy: TensorDictModuleBase) -> None:
    """Draw the learning curve, and film the trained agent."""
    curve = read_metrics(folder.file("metrics.csv"))
    pictures.draw_learning_curves(folder.file("curve.png"), {config.hindsight: [curve]}, title=title_of(config))
    starts = range(EVALUATION_SEED, EVALUATION_SEED + config.film_starts)
    film = record(env, policy, partial(env.render_overview, 256, 320), seeds=starts)
    pictures.write_gif(folder.file("agent.gif"), film)


def draw_hallucinations(
    path: Path, config: HindsightConfig, buffer: TensorDictReplayBuffer, painters: Mapping[str, Hallucinator]
) -> None:
    """Draw stored rows: the frame as it was, a goal some steps ahead truly rendered, and as the agent is shown it."""
    steps = min(12, config.max_distance)
    rows = buffer.storage[torch.linspace(0, len(buffer) - 1, 200).long()]  # past the transform, which would relabel
    rows = rows[rows["hindsight", "horizon"].squeeze(-1) >= steps][::16]
    goal = rows["hindsight", "pose"][:, [steps - 1]]
    frames, poses = rows["pixels"].unsqueeze(1), rows["pose"].unsqueeze(1)
    painted = {label: painter(frames, poses, goal).squeeze(1) for label, painter in painters.items()}
    pictures.draw_frame_grid(path, {"failed": rows["pixels"], **painted}, title=title_of(config))


def title_of(config: HindsightConfig) -> str:
    """Return what the pictures of a run are headed with."""
    return f"{config.environment}, {config.hindsight}, seed {config.seed}"
