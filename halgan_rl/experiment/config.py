"""What every agent with hindsight is told: the values that all recipes share, and those of the paper."""

import dataclasses
from pathlib import Path
from typing import Any, Literal

from halgan_rl.agents.fast_cpu.block_convolutions import Downsample


@dataclasses.dataclass(frozen=True)
class HindsightConfig:
    """What every agent with hindsight is told."""

    preset: Literal["default", "paper"] = "default"
    """Where the other values come from: what learns fastest on two cores, or the paper's appendix."""
    environment: str = "navigate-2m"
    """One of the simulator's environments."""
    hindsight: Literal["halgan", "oracle", "none"] = "halgan"
    """Who paints the goal into failed transitions: the GAN, the simulator itself, or nobody."""
    weights: Path | None = None
    """Generator to hallucinate with; by default the one shipped for the environment."""
    bank: bool = True
    """Look hallucinations up in a table of the generator's output, made at the start, instead of asking it."""
    share_latent: bool = True
    """Show one and the same goal in both images of a row, instead of drawing a latent for each."""
    random_flags: bool = False
    """Paint a goal drawn at random, in tasks with several, instead of the one that is pursued."""
    allow_other_mujoco: bool = False
    """Accept weights trained with another release of MuJoCo, whose images may differ."""
    seed: int = 0
    """Seed of everything random in the run."""
    total_frames: int = 15_000
    """Environment steps."""
    out: Path = Path("runs/agent")
    """Folder of the run; must not hold one yet."""
    threads: int = 1
    """Threads of PyTorch; more do not help networks this small, and change the last bits of every sum."""
    device: str = "cpu"
    """Where the agent learns, such as `cuda`. Environments, replay and hindsight stay on the CPU."""
    compile: Literal["no", "default", "reduce-overhead", "max-autotune"] = "no"
    """How `torch.compile` treats the loss; with `reduce-overhead` it makes CUDA graphs. On a CPU it does not pay."""
    background_evaluation: bool = True
    """Evaluate in a process of its own, while training goes on; what is learned and measured is the same."""
    background_collection: bool = False
    """Collect in a process of its own while the agent is updated, by a policy that is a batch older."""
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
    target_rate: float = 2e-2
    """How far the target networks move towards the networks at each update."""
    clip_targets: bool = True
    """Clip the targets of values to [-1, 1]."""
    downsample: Downsample = "stride"
    """How the convolutions halve the image."""
    policy_average: float = 0.998
    """Decay of the moving average of the policy's weights, which is evaluated and saved; 0 takes the last ones."""

    epsilon_start: float = 1.0
    """Share of uniformly random actions at the start."""
    epsilon_end: float = 0.1
    """Share of uniformly random actions at the end."""
    epsilon_frames: int = 6_000
    """Frames over which the share falls."""

    hallucination_start: float = 0.3
    """Probability that a goal is drawn for a sampled row, at the start."""
    hallucination_end: float = 0.0
    """Probability that a goal is drawn for a sampled row, at the end."""
    hallucination_frames: int = 60_000
    """Frames over which the probability falls."""
    max_distance: int = 96
    """Longest failed snippet: the goal lies 1 to this many steps ahead."""
    nearness: float = 2.0
    """Preference for near goals: the steps to the goal are uniform to this power; 1 is uniform."""
    pursue_unseen: bool = True
    """Also pursue hindsight goals that the image does not show."""
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


PAPER: dict[str, Any] = {
    "warmup_frames": 10_000,
    "target_rate": 1e-3,
    "clip_targets": False,
    "bank": False,
    "share_latent": False,
    "nearness": 1.0,
    "pursue_unseen": True,
    "discount": 0.99,
    "downsample": "max_pool",
    "policy_average": 0.0,
    "epsilon_end": 0.5,
}
"""What the paper's tables say alike for all tasks (Sahni et al., NeurIPS 2019, appendix)."""
