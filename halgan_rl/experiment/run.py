"""A run: a folder in which an agent is trained, judged and shown."""

import dataclasses
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from contextlib import AbstractContextManager, ExitStack, nullcontext
from functools import partial
from importlib.util import find_spec
from types import TracebackType
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.collectors import BaseCollector, Collector
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import EnvBase, ExcludeTransform
from torchrl.record.loggers import Logger
from torchrl.record.loggers.tensorboard import TensorboardLogger

from halgan_rl.agents.agent import Agent
from halgan_rl.agents.fast_cpu import accelerate
from halgan_rl.agents.registry import make_agent as make_plain_agent
from halgan_rl.experiment import pictures
from halgan_rl.experiment.config import RunConfig
from halgan_rl.experiment.domain import Domain
from halgan_rl.experiment.run_folder import RunFolder, check_unused, read_metrics, versions
from halgan_rl.hallucination.weights import save_weights
from halgan_rl.replay.frame_storage import FrameStorage
from halgan_rl.training.background_collector import BackgroundCollector
from halgan_rl.training.evaluation import Evaluation, record
from halgan_rl.training.evaluation_process import EvaluationProcess, evaluate_at_once
from halgan_rl.training.loop import COLUMNS, TrainingConfig, train
from halgan_rl.training.metrics import Report
from halgan_rl.transforms import Hallucinator
from halgan_rl.transforms.pipelines import Hindsight

EVALUATION_SEED = 10_000
"""Seed of the first fixed start; training seeds are far below."""
OVERVIEW = (256, 320)
"""Height and width of the view from outside in films [pixels]."""


def prepare(config: RunConfig) -> None:
    """Refuses what cannot work, and seeds PyTorch; the first line of a recipe.

    Raises:
        FileExistsError: if the folder of the run already holds anything.
        ValueError: if the device cannot be used.
        ImportError: if TensorBoard is to be used and is not installed.
    """
    check_unused(config.out)
    check_device(config.device)
    if config.tensorboard and find_spec("tensorboard") is None:
        raise ImportError("--tensorboard needs the extra: pip install 'halgan-rl[tensorboard]'")
    torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)


def check_device(device: str) -> None:
    """Refuses a device that PyTorch cannot use here."""
    try:
        torch.zeros(1, device=device).cpu()
    except (AssertionError, ImportError, NotImplementedError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"device={device!r} cannot be used here ({reason}): choose 'cpu'") from error


def make_agent(config: RunConfig, domain: Domain) -> Agent:
    """Returns the configured agent for the actions and images of a domain.

    Raises:
        ValueError: if the algorithm does not fit the actions.
    """
    agent = make_plain_agent(
        config.agent,
        action_spec=domain.action_spec,
        image_shape=domain.image_shape,
        keys=domain.keys,
        device=config.device,
    )
    if config.fast_cpu:
        accelerate(agent)
    if config.compile != "no":
        agent.loss.compile(mode=config.compile)
    return agent


def make_buffer(config: TrainingConfig, hindsight: Hindsight, *, seed: int) -> TensorDictReplayBuffer:
    """Returns the replay buffer; its room for final frames suffices for episodes of four steps on average."""
    return TensorDictReplayBuffer(
        storage=FrameStorage(config.replay_capacity, extra_frames=config.replay_capacity // 4, keys=hindsight.keys),
        transform=hindsight,
        generator=torch.Generator().manual_seed(seed),
    )


class Run:
    """Trains an agent in a folder of its own: configuration, metrics, weights, pictures.

    Entering it starts the evaluation and makes the folder; leaving it ends all processes.

    Args:
        config: what to do.
        domain: the environment.
        agent: learns, in place.
        buffer: replays.
        hindsight: the buffer's pipeline.
    """

    def __init__(
        self, config: RunConfig, domain: Domain, agent: Agent, buffer: TensorDictReplayBuffer, hindsight: Hindsight
    ) -> None:
        self.config, self.domain, self.agent, self.buffer, self.hindsight = config, domain, agent, buffer, hindsight
        self._stack = ExitStack()

    def __enter__(self) -> "Run":
        env = make_env(self.config, self.domain)
        with ExitStack() as stack, ExitStack() as own:  # undone if anything below fails
            if env is not None:
                own.callback(env.close)
            self._evaluate = stack.enter_context(make_evaluator(self.config, self.domain))
            self.folder = self._make_folder()
            self._collector = make_collector(self.config, self.domain, self.agent.explorer, env=env)
            own.pop_all()  # the collector closes its environment
            stack.callback(self._collector.shutdown)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def train(self) -> None:
        """Trains for as long as the configuration says; metrics and weights are written at each evaluation."""
        self.policy = train(
            self.agent,
            self._collector,
            self.buffer,
            self.hindsight,
            self.config.training,
            total_frames=self.config.total_frames,
            evaluate_every=self.config.evaluation.every,
            evaluate=self._evaluate,
            report=Report(self.folder.columns, self.folder.write_metrics, make_tensorboard(self.config)),
            save=self._save,
            keys=self.domain.keys,
            label=self.config.method,
        )

    def draw(self) -> None:
        """Draws the learning curve and the hallucinations, and films the trained agent."""
        curve = read_metrics(self.folder.file("metrics.csv"))
        path = self.folder.file("curve.png")
        pictures.draw_learning_curves(path, {self.config.method: [curve]}, title=self._title)
        self._film()
        self._draw_hallucinations()

    def summary(self) -> str:
        """Returns what a person wants to know at the end."""
        success = read_metrics(self.folder.file("metrics.csv"))["eval/success_rate"][-1]
        return (
            f"success rate {success:.0%} after {self.config.total_frames} frames; pictures and weights in "
            f"{self.config.out}\nnext: python recipes/play.py --run {self.config.out}"
        )

    @property
    def _title(self) -> str:
        return f"{self.domain.name}, {self.config.method}, seed {self.config.seed}"

    def _make_folder(self) -> RunFolder:
        shown = (f"train/{name}" for name in self.agent.metrics.values())
        flags = (f"eval/{flag}" for flag in self.domain.poses.flags)
        folder = RunFolder(self.config.out, columns=(*COLUMNS, *shown, *flags))
        folder.write_config(dataclasses.asdict(self.config))
        return folder

    def _save(self, network: nn.Module) -> None:
        """Writes ``policy.safetensors`` with all that is needed to rebuild and trust it."""
        manifest = {
            "kind": network.kind,
            "arguments": network.arguments,
            "environment": self.domain.name,
            **self.domain.fingerprint,
            "config": dataclasses.asdict(self.config),
            "versions": versions(),
        }
        save_weights(self.folder.file("policy.safetensors"), network, manifest)

    def _film(self) -> None:
        env = self.domain.make()
        overview = self.domain.overview and partial(self.domain.overview, env, *OVERVIEW)
        starts = range(EVALUATION_SEED, EVALUATION_SEED + self.config.evaluation.film_starts)
        film = record(
            env, self.policy, overview, seeds=starts, keys=self.domain.keys, frame_stack=self.domain.frame_stack
        )
        pictures.write_gif(self.folder.file("agent.gif"), film)
        env.close()

    def _draw_hallucinations(self) -> None:
        if (painter := self.hindsight.hallucinator) is None:
            return
        painters: dict[str, Hallucinator] = {self.config.method: painter}
        if self.domain.goal_renderer is not None:
            painters = {"true goal": self.domain.goal_renderer(), **painters}
        rows = paint_stored_rows(self.buffer, painters, domain=self.domain, steps=self.config.hindsight.max_distance)
        path = self.folder.file("hallucinations.png")
        pictures.draw_frame_grid(path, rows, title=self._title, frame_stack=self.domain.frame_stack)


def paint_stored_rows(
    buffer: TensorDictReplayBuffer, painters: Mapping[str, Hallucinator], *, domain: Domain, steps: int
) -> dict[str, torch.Tensor]:
    """Returns some stored frames ``[N, H, W, C]`` as they were, and with a goal some steps ahead by each painter."""
    keys, steps = domain.keys, min(12, steps)
    rows = buffer.storage[torch.linspace(0, len(buffer) - 1, 200).long()]  # past the transform, which would relabel
    rows = rows[rows[keys.hindsight_horizon].squeeze(-1) >= steps][::16]
    goal = rows[keys.hindsight_pose][:, [steps - 1]]
    frames, poses = rows[keys.pixels].unsqueeze(1), rows[keys.pose].unsqueeze(1)
    painted = {label: painter(frames, poses, goal).squeeze(1) for label, painter in painters.items()}
    return {"failed": rows[keys.pixels], **painted}


def make_env(config: RunConfig, domain: Domain) -> EnvBase | None:
    """Returns the environment to train in, which is what the domain says; None if a process of its own makes it.

    Raises:
        ValueError: if the environment is not what the domain says.
    """
    if config.training.background_collection:
        return None
    env = domain.make(seed=config.seed)
    try:
        domain.check(env)
    except ValueError:
        env.close()
        raise
    return env


def make_collector(
    config: RunConfig, domain: Domain, explorer: TensorDictModuleBase, *, env: EnvBase | None = None
) -> BaseCollector:
    """Returns what steps the environment: uniformly random actions first, then the exploring policy.

    It makes its environment, or steps ``env``; in the background it always makes one.
    """
    settings: dict[str, Any] = {
        "frames_per_batch": config.training.frames_per_batch,
        "total_frames": config.total_frames,
        "init_random_frames": config.training.warmup_frames,
    }
    if not config.training.background_collection:
        return Collector(
            env or make_env(config, domain),
            explorer,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
            **settings,
        )
    collector = BackgroundCollector(
        domain.make, explorer, postproc=ExcludeTransform("collector"), num_threads=config.threads, **settings
    )
    collector.set_seed(config.seed)
    return collector


Evaluator = Callable[[TensorDictModuleBase], Future[Evaluation]]


def make_evaluator(config: RunConfig, domain: Domain) -> AbstractContextManager[Evaluator]:
    """Returns what judges policies on the fixed starts: beside training, or at once."""
    starts = range(EVALUATION_SEED, EVALUATION_SEED + config.evaluation.starts)
    settings: dict[str, Any] = {"seeds": starts, "poses": domain.poses, "keys": domain.keys}
    if config.evaluation.background:
        return EvaluationProcess(domain.make, threads=config.threads, **settings)
    return nullcontext(partial(evaluate_at_once, domain.make(), **settings))


def make_tensorboard(config: RunConfig) -> Logger | None:
    """Returns TorchRL's TensorBoard logger if the configuration wants one."""
    return TensorboardLogger(exp_name="tensorboard", log_dir=str(config.out)) if config.tensorboard else None
