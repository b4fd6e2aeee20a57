"""Visual navigation with DDPG and hindsight: find the red box in the room, drive up to it, centre it.

Usage::

    python recipes/ddpg_navigate.py                                   # HALGAN, 2 m room, shipped weights
    python recipes/ddpg_navigate.py --hindsight oracle --seed 1       # the simulator itself paints the goal
    python recipes/ddpg_navigate.py --hindsight none                  # plain DDPG: never sees a reward
    python recipes/ddpg_navigate.py --preset paper                    # the paper's appendix, in its 4 m room

Every run writes into its own folder: ``config.json``, ``metrics.csv``, ``policy.safetensors`` (with its manifest),
``curve.png``, ``agent.gif`` and ``hallucinations.png``. ``recipes/play.py`` plays the saved policy.

Metrics, one row an evaluation:

==============================  ====================================================================
``frames``, ``seconds``         environment steps, and wall time since the start
``eval/success_rate``           deterministic policy, share of the fixed starts that reach the box
``eval/return``                 mean undiscounted return
``eval/episode_length``         mean steps
``train/success_rate``          share of the exploring episodes since the last evaluation that reach the box
``train/hallucinated_fraction`` share of the sampled rows that were relabelled since the last evaluation
``train/q_value``, ``.../loss`` mean over the updates since the last evaluation
``train/epsilon``               share of uniformly random actions
==============================  ====================================================================

Differences from the paper (Sahni et al., NeurIPS 2019, appendix), all undone by ``--preset paper``:

1. A 2 m room, starts at least 0.5 m from the box and 2 cm centring, instead of 4 m, 1 m and 1 cm.
2. Strided convolutions instead of max-pooling (same parameters; the paper gives no down-sampling): a third of the time.
3. Learning rates 1e-4 and 1e-3 instead of 1e-5 and 1e-4.
4. Discount 0.95 instead of 0.99: one step then changes a value by 5 % and not by 1 %, which is more than the critic's
   error, and values that it makes up decay. Target rate 2e-2 instead of 1e-3: values spread that much faster.
5. Targets clipped to [-1, 1], the range of any return.
6. A price on the square of the actor's pre-activations: without it the tanh saturates within 500 updates, everywhere.
7. Goals up to 96 steps ahead instead of 32, but near ones preferred (steps to the goal: uniform squared), so that goals
   are also seen from afar, and three times as many relabelled rows are rewarded.
8. Epsilon from 1 to 0.3 over 20,000 frames instead of to 0.5 over 100,000; 2,000 warm-up frames, not 10,000.
9. Relabelling decays over 60,000 frames instead of 100,000 (which the paper does not state; its epsilon's span).
10. The shipped generator is this library's (see ``recipes/train_halgan.py``); ``--weights`` takes any other. Its
    output is tabulated once and then looked up (`halgan_rl.hallucination_bank`); ``--no-bank`` asks the generator.
    Both images of a row show one latent's goal (the paper does not tell; its preset draws one for each image).

11. The actor's last layer starts near zero, as in DDPG's own paper: without it an untrained robot may drive in circles
    that meet the box by chance (8 % of the starts with seed 0).
12. A moving average of the actor's weights, over some 500 updates, is what is evaluated and saved. The policy that
    explores is the last one: in the 4 m room its success swings (56,000 and 58,000 frames: 88 and 20 %; the average's:
    94 and 86 %).

In both rooms the rover has no reverse gear, action -1 is rest and +1 full speed: a random walk that reverses takes half
of its hindsight goals from behind the robot, where no camera sees them (``envs.make(..., reverse_speed=0.5)`` gives it
one).
"""

import dataclasses
import time
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torchrl.collectors import Collector
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import Compose
from torchrl.modules import AdditiveGaussianModule, EGreedyModule
from torchrl.objectives import DDPGLoss, SoftUpdate, ValueEstimators
from torchrl.record.loggers import Logger
from torchrl.record.loggers.tensorboard import TensorboardLogger
from tqdm import tqdm

import envs
from envs import ComposerEnv, GoalRenderer
from halgan_rl import pictures, pipelines
from halgan_rl.evaluation import evaluate, record
from halgan_rl.frame_storage import FrameStorage
from halgan_rl.hallucination_bank import BankGrid, HallucinationBank
from halgan_rl.hallucinators import GanHallucinator, Hallucinator
from halgan_rl.models.agents import Actor, Critic, deterministic_policy
from halgan_rl.objectives import ClippedTD0Estimator, UnsaturatedDDPGLoss
from halgan_rl.poses import PoseTolerance
from halgan_rl.presets import parse_config
from halgan_rl.run_folder import RunFolder, read_metrics, versions
from halgan_rl.weights import load_generator, save_weights, shipped_weights

COLUMNS = (
    "frames",
    "seconds",
    "eval/success_rate",
    "eval/return",
    "eval/episode_length",
    "train/success_rate",
    "train/hallucinated_fraction",
    "train/q_value",
    "train/loss_value",
    "train/loss_actor",
    "train/epsilon",
)
EVALUATION_SEED = 10_000
"""Seed of the first fixed start; training seeds are far below."""


@dataclasses.dataclass(frozen=True)
class Config:
    """Visual navigation with DDPG and hindsight."""

    preset: Literal["default", "paper"] = "default"
    """Where the other values come from: what learns fastest on two cores, or the paper's appendix."""
    environment: Literal["navigate-2m", "navigate-4m"] = "navigate-2m"
    """The room."""
    hindsight: Literal["halgan", "oracle", "none"] = "halgan"
    """Who paints the goal into failed transitions: the GAN, the simulator itself, or nobody."""
    weights: Path | None = None
    """Generator to hallucinate with; by default the one shipped for the environment."""
    bank: bool = True
    """Look hallucinations up in a table of the generator's output, made at the start, instead of asking it."""
    share_latent: bool = True
    """Show one and the same goal in both images of a row, instead of drawing a latent for each."""
    allow_other_mujoco: bool = False
    """Accept weights trained with another release of MuJoCo, whose images may differ."""
    seed: int = 0
    """Seed of everything random in the run."""
    total_frames: int = 15_000
    """Environment steps."""
    out: Path = Path("runs/ddpg_navigate")
    """Folder of the run; must not hold one yet."""
    threads: int = 1
    """Threads of PyTorch; more do not help networks this small, and change the last bits of every sum."""
    tensorboard: bool = False
    """Also write TensorBoard logs (needs the `tensorboard` extra)."""

    replay_capacity: int = 100_000
    """Rows of the replay buffer."""
    warmup_frames: int = 2_000
    """Frames collected with random actions before the first update."""
    batch_size: int = 32
    """Rows an update."""
    frames_per_update: int = 1
    """Environment steps for each update."""
    frames_per_batch: int = 16
    """Environment steps collected at a time."""
    discount: float = 0.95
    """Discount factor."""
    actor_learning_rate: float = 1e-4
    """Adam's learning rate for the actor."""
    critic_learning_rate: float = 1e-3
    """Adam's learning rate for the critic."""
    target_rate: float = 2e-2
    """How far the target networks move towards the networks at each update."""
    clip_targets: bool = True
    """Clip the critic's targets to [-1, 1]."""
    preactivation_weight: float = 1e-3
    """Price of the square of what goes into the actor's tanh."""
    downsample: Literal["stride", "max_pool"] = "stride"
    """How the convolutions halve the image."""
    small_output: bool = True
    """Start the actor's last layer near zero."""
    policy_average: float = 0.998
    """Decay of the moving average of the actor's weights, which is evaluated and saved; 0 takes the last ones."""

    noise: float = 0.1
    """Standard deviation of the Gaussian noise on the actions."""
    epsilon_start: float = 1.0
    """Share of uniformly random actions at the start."""
    epsilon_end: float = 0.3
    """Share of uniformly random actions at the end."""
    epsilon_frames: int = 20_000
    """Frames over which the share falls."""

    hallucination_start: float = 0.3
    """Probability that a sampled row is relabelled, at the start."""
    hallucination_end: float = 0.0
    """Probability that a sampled row is relabelled, at the end."""
    hallucination_frames: int = 60_000
    """Frames over which the probability falls."""
    max_distance: int = 96
    """Longest failed snippet: the goal lies 1 to this many steps ahead."""
    nearness: float = 2.0
    """Preference for near goals: the steps to the goal are uniform to this power; 1 is uniform."""
    goal_distance: float = 0.01
    """A hindsight goal is reached within this distance [m] ..."""
    goal_angle: float = 0.1
    """... and this angle [rad]."""

    evaluate_every: int = 2_000
    """Frames between evaluations."""
    evaluation_starts: int = 50
    """Fixed starts of an evaluation."""
    film_starts: int = 5
    """How many of these starts `agent.gif` shows."""

    def __post_init__(self) -> None:
        """Refuse values that would fail only later."""
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if type(field.default) is int and field.name != "seed" and value < 1:
                raise ValueError(f"{field.name} must be at least 1, got {value}")
        for name in ("hallucination_start", "hallucination_end", "epsilon_start", "epsilon_end"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is a share: it must lie in [0, 1], got {getattr(self, name)}")
        if self.warmup_frames < self.max_distance:
            raise ValueError(
                f"warmup_frames={self.warmup_frames} is below max_distance={self.max_distance}: rows wait that long "
                "for their future before they can be sampled; warm up longer"
            )


PRESETS = {
    "default": Config(),
    "paper": Config(
        preset="paper",
        environment="navigate-4m",
        total_frames=250_000,
        warmup_frames=10_000,
        actor_learning_rate=1e-5,
        critic_learning_rate=1e-4,
        target_rate=1e-3,
        clip_targets=False,
        preactivation_weight=0.0,
        bank=False,
        share_latent=False,
        nearness=1.0,
        max_distance=32,
        discount=0.99,
        downsample="max_pool",
        small_output=False,
        policy_average=0.0,
        epsilon_end=0.5,
        epsilon_frames=100_000,
        hallucination_frames=100_000,
    ),
}


def make_hallucinator(config: Config) -> Hallucinator | None:
    """Return who paints the goal; weights that do not fit the environment are refused here."""
    if config.hindsight == "none":
        return None
    if config.hindsight == "oracle":
        return GoalRenderer(config.environment)
    path = config.weights or shipped_weights(config.environment)
    generator = load_generator(
        path, expected=envs.fingerprint(config.environment), allow_other_mujoco=config.allow_other_mujoco
    )
    rng = torch.Generator().manual_seed(config.seed)
    if config.bank:
        grid = BankGrid(goal_offset=envs.goal_offsets(config.environment))
        return HallucinationBank(generator, grid, rng=rng, share_latent=config.share_latent)
    return GanHallucinator(generator, rng=rng, share_latent=config.share_latent)


def make_hindsight(config: Config, hallucinator: Hallucinator | None) -> Compose | None:
    """Return the replay transform of the chosen method."""
    if hallucinator is None:
        return None
    pipeline = {"halgan": pipelines.halgan, "oracle": pipelines.oracle}[config.hindsight]
    return pipeline(
        hallucinator,
        max_distance=config.max_distance,
        nearness=config.nearness,
        probability=config.hallucination_start,
        final_probability=config.hallucination_end,
        annealing_steps=config.hallucination_frames,
        tolerance=PoseTolerance(config.goal_distance, config.goal_angle),
        generator=torch.Generator().manual_seed(config.seed),
    )


def make_collector(config: Config, env: ComposerEnv, explorer: TensorDictSequential) -> Collector:
    """Return what steps the environment: uniformly random actions first, then the exploring policy."""
    return Collector(
        env,
        explorer,
        frames_per_batch=config.frames_per_batch,
        total_frames=config.total_frames,
        init_random_frames=config.warmup_frames,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )


def make_buffer(config: Config, hindsight: Compose | None) -> TensorDictReplayBuffer:
    """Return the replay buffer; room for final frames suffices for episodes of four steps on average."""
    return TensorDictReplayBuffer(
        storage=FrameStorage(config.replay_capacity, extra_frames=config.replay_capacity // 4),
        batch_size=config.batch_size,
        transform=hindsight,
        generator=torch.Generator().manual_seed(config.seed),
    )


def make_agent(config: Config, *, action_size: int) -> tuple[TensorDictSequential, TensorDictModule]:
    """Return actor and critic; both read the camera image alone."""
    actor = Actor(action_size, downsample=config.downsample, small_output=config.small_output)
    critic = Critic(action_size, downsample=config.downsample)
    return (
        deterministic_policy(actor),
        TensorDictModule(critic, in_keys=["pixels", "action"], out_keys=["state_action_value"]),
    )


def make_loss(config: Config, actor: TensorDictModule, critic: TensorDictModule) -> tuple[DDPGLoss, SoftUpdate]:
    """Return TorchRL's DDPG loss, with the targets that the configuration asks for, and its target updater."""
    loss = UnsaturatedDDPGLoss(
        actor, critic, delay_actor=True, delay_value=True, preactivation_weight=config.preactivation_weight
    )
    if config.clip_targets:
        estimator = ClippedTD0Estimator(low=-1.0, high=1.0, gamma=config.discount, value_network=loss.actor_critic)
        estimator.set_keys(value=loss.tensor_keys.state_action_value)
        loss.make_value_estimator(estimator)
    else:
        loss.make_value_estimator(ValueEstimators.TD0, gamma=config.discount)
    return loss, SoftUpdate(loss, tau=config.target_rate)


def make_optimizer(config: Config, loss: DDPGLoss) -> torch.optim.Optimizer:
    """Return one Adam for both networks, with a learning rate for each."""
    actor_parameters = list(loss.actor_network_params.values(True, True))
    critic_parameters = list(loss.value_network_params.values(True, True))
    return torch.optim.Adam(
        [
            {"params": actor_parameters, "lr": config.actor_learning_rate},
            {"params": critic_parameters, "lr": config.critic_learning_rate},
        ],
        fused=True,
    )


def update(
    batch: TensorDictBase, loss: DDPGLoss, optimizer: torch.optim.Optimizer, target_updater: SoftUpdate
) -> TensorDictBase:
    """Make one DDPG update; return the losses."""
    losses = loss(batch)
    (losses["loss_actor"] + losses["loss_value"]).backward()  # TorchRL detaches the critic inside the actor's loss
    optimizer.step()
    optimizer.zero_grad()
    target_updater.step()
    return losses


class Means:
    """Running means of the figures between two evaluations, without a synchronisation an update."""

    def __init__(self, *names: str) -> None:
        self._values: dict[str, list[torch.Tensor]] = {name: [] for name in names}

    def add(self, **values: torch.Tensor) -> None:
        """Add one value to each mean."""
        for name, value in values.items():
            self._values[name].append(value.detach())

    def pop(self) -> dict[str, float]:
        """Return all means and start afresh; NaN where nothing was added."""
        means = {f"train/{name}": _mean(values) for name, values in self._values.items()}
        self._values = {name: [] for name in self._values}
        return means


def _mean(values: list[torch.Tensor]) -> float:
    return float(torch.stack(values).float().mean()) if values else float("nan")


def main(config: Config) -> None:
    """Train, evaluate, and write everything into `config.out`."""
    started = time.perf_counter()
    torch.set_num_threads(config.threads)
    hallucinator = make_hallucinator(config)
    torch.manual_seed(config.seed)  # After the hallucinator: with one seed all methods start from the same agent.
    folder = RunFolder(config.out, columns=COLUMNS)
    folder.write_config(dataclasses.asdict(config))
    logger = make_tensorboard(config)

    # The environment, and one more for evaluation.
    env = envs.make(config.environment, seed=config.seed)
    evaluation_env = envs.make(config.environment)
    starts = range(EVALUATION_SEED, EVALUATION_SEED + config.evaluation_starts)

    # The agent, and how it explores.
    action_spec = env.action_spec
    actor, critic = make_agent(config, action_size=action_spec.shape[-1])
    noise = AdditiveGaussianModule(action_spec, sigma_init=config.noise, sigma_end=config.noise)
    epsilon = EGreedyModule(action_spec, config.epsilon_start, config.epsilon_end, config.epsilon_frames)
    collector = make_collector(config, env, TensorDictSequential(actor, noise, epsilon))

    # Replay with hindsight: failed rows come out of the buffer as successes.
    hindsight = make_hindsight(config, hallucinator)
    buffer = make_buffer(config, hindsight)

    # Learning.
    loss, target_updater = make_loss(config, actor, critic)
    optimizer = make_optimizer(config, loss)
    average = AveragedModel(actor[0].module, multi_avg_fn=get_ema_multi_avg_fn(config.policy_average))
    policy = deterministic_policy(average.module)
    means = Means("success_rate", "hallucinated_fraction", "q_value", "loss_value", "loss_actor")
    frames, updates, next_evaluation, success = 0, 0, config.evaluate_every, float("nan")
    progress = tqdm(total=config.total_frames, unit="frame", desc=config.hindsight, dynamic_ncols=True)
    for rollout in collector:
        buffer.extend(rollout)
        frames += rollout.numel()
        epsilon.step(rollout.numel())
        if hindsight is not None:
            hindsight[1].step(rollout.numel())
        if (done := rollout["next", "done"]).any():
            means.add(success_rate=rollout["next", "terminated"][done].float().mean())

        while frames > config.warmup_frames and updates < (frames - config.warmup_frames) // config.frames_per_update:
            batch = buffer.sample()
            losses = update(batch, loss, optimizer, target_updater)
            average.update_parameters(actor[0].module)
            updates += 1
            means.add(
                hallucinated_fraction=batch["goal", "mask"].float().mean() if hindsight else torch.zeros(()),
                q_value=losses["pred_value"].mean(),
                loss_value=losses["loss_value"],
                loss_actor=losses["loss_actor"],
            )

        if frames >= next_evaluation or frames >= config.total_frames:
            next_evaluation += config.evaluate_every
            evaluation = evaluate(evaluation_env, policy, seeds=starts)
            success = evaluation.success_rate
            metrics = {"frames": frames, "seconds": time.perf_counter() - started, "train/epsilon": float(epsilon.eps)}
            metrics |= evaluation.metrics() | means.pop()
            folder.write_metrics(metrics)
            save_policy(folder, config, average.module)
            if logger is not None:
                for name, value in metrics.items():
                    logger.log_scalar(name, value, step=frames)
        progress.update(rollout.numel())
        progress.set_postfix(success=f"{success:.0%}", updates=updates, refresh=False)
    progress.close()
    collector.shutdown()

    draw_pictures(folder, config, evaluation_env, policy)
    if hallucinator is not None:
        draw_hallucinations(folder.file("hallucinations.png"), config, buffer, hallucinator)
    print(
        f"success rate {success:.0%} after {frames} frames; pictures and weights in {config.out}\n"
        f"next: python recipes/play.py --run {config.out}"
    )


def make_tensorboard(config: Config) -> Logger | None:
    """Return TorchRL's TensorBoard logger if it was asked for."""
    if not config.tensorboard:
        return None
    if find_spec("tensorboard") is None:
        raise ImportError("--tensorboard needs the extra: pip install 'halgan-rl[tensorboard]'")
    return TensorboardLogger(exp_name="tensorboard", log_dir=str(config.out))


def save_policy(folder: RunFolder, config: Config, actor: Actor) -> None:
    """Write `policy.safetensors` with all that is needed to rebuild and trust it."""
    manifest = {
        "kind": "actor",
        "arguments": {"action_size": actor.action_size, "downsample": config.downsample},
        **envs.fingerprint(config.environment),
        "config": dataclasses.asdict(config),
        "versions": versions(),
    }
    save_weights(folder.file("policy.safetensors"), actor, manifest)


def draw_pictures(folder: RunFolder, config: Config, env: ComposerEnv, policy: TensorDictSequential) -> None:
    """Draw the learning curve, and film the trained agent."""
    curve = {config.hindsight: [read_metrics(folder.file("metrics.csv"))]}
    pictures.draw_learning_curves(folder.file("curve.png"), curve, title=title_of(config))
    starts = range(EVALUATION_SEED, EVALUATION_SEED + config.film_starts)
    film = record(env, policy, partial(env.render_overview, 256, 320), seeds=starts)
    pictures.write_gif(folder.file("agent.gif"), film)


def draw_hallucinations(path: Path, config: Config, buffer: TensorDictReplayBuffer, hallucinator: Hallucinator) -> None:
    """Draw stored rows: the frame as it was, a goal some steps ahead truly rendered, and as the agent is shown it."""
    steps = min(12, config.max_distance)
    rows = buffer.storage[torch.linspace(0, len(buffer) - 1, 200).long()]  # past the transform, which would relabel
    rows = rows[rows["hindsight", "horizon"].squeeze(-1) >= steps][::16]
    goal = rows["hindsight", "pose"][:, [steps - 1]]
    frames, poses = rows["pixels"].unsqueeze(1), rows["pose"].unsqueeze(1)
    painters = {"true goal": GoalRenderer(config.environment), config.hindsight: hallucinator}
    painted = {label: painter(frames, poses, goal).squeeze(1) for label, painter in painters.items()}
    pictures.draw_frame_grid(path, {"failed": rows["pixels"], **painted}, title=title_of(config))


def title_of(config: Config) -> str:
    """Return what the pictures of a run are headed with."""
    return f"{config.environment}, {config.hindsight}, seed {config.seed}"


if __name__ == "__main__":
    main(parse_config(PRESETS, description=__doc__))
