"""The configuration of a run, made of small ones that each belong to a part."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from halgan_rl.agents.agent import AgentConfig
from halgan_rl.agents.ddpg import DDPGConfig
from halgan_rl.training.loop import TrainingConfig
from halgan_rl.transforms import HindsightConfig


@dataclass(frozen=True)
class PainterConfig:
    """How goals are painted into images."""

    weights: Path | None = None
    """Generator to hallucinate with; by default the one shipped for the environment."""
    bank: bool = True
    """Look hallucinations up in a table of the generator's output, made at the start, instead of computing them."""
    share_latent: bool = True
    """Show one and the same goal in both images of a row, instead of drawing a latent for each."""
    random_flags: bool = False
    """Paint a goal drawn at random, in tasks with several, instead of the one that is pursued."""
    allow_other_mujoco: bool = False
    """Accept weights trained with another release of MuJoCo, whose images may differ."""


@dataclass(frozen=True)
class EvaluationConfig:
    """How policies are judged while they learn."""

    every: int = 2_000
    """Frames between evaluations."""
    starts: int = 50
    """Fixed starts of an evaluation."""
    background: bool = True
    """Evaluate in a process of its own, while training goes on; what is learned and measured is the same."""
    film_starts: int = 5
    """How many of the starts `agent.gif` shows."""

    def __post_init__(self) -> None:
        """Refuses values that would fail only later."""
        for name in ("every", "starts", "film_starts"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")


@dataclass(frozen=True)
class RunConfig:
    """Configuration of a run."""

    preset: str = "default"
    """Where the other values come from: what learns fastest on two cores, or the paper's appendix."""
    environment: str = "navigate-2m"
    """Name of the environment."""
    method: str = "halgan"
    """What is done about missing rewards, one of `halgan_rl.experiment.methods.METHODS`: `halgan`, `her`, `oracle`,
    `none`."""
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
    fast_cpu: bool = True
    """Compute agents on the CPU by the faster equivalent of their plain networks, where it fits."""
    compile: Literal["no", "default", "reduce-overhead", "max-autotune"] = "no"
    """How `torch.compile` treats the loss; with `reduce-overhead` it makes CUDA graphs. On a CPU it does not pay."""
    tensorboard: bool = False
    """Also write TensorBoard logs (needs the `tensorboard` extra)."""

    agent: AgentConfig = field(default_factory=DDPGConfig)
    """The algorithm."""
    hindsight: HindsightConfig = field(default_factory=HindsightConfig)
    """Which rows are relabelled, and to which goals."""
    painter: PainterConfig = field(default_factory=PainterConfig)
    """How goals are painted into images."""
    training: TrainingConfig = field(default_factory=TrainingConfig)
    """Collection, replay and updates."""
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    """How policies are judged."""

    def __post_init__(self) -> None:
        """Refuses values that do not go together."""
        for name in ("total_frames", "threads"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.training.warmup_frames < self.hindsight.max_distance:
            raise ValueError(
                f"warmup_frames={self.training.warmup_frames} is below max_distance={self.hindsight.max_distance}: "
                "rows wait that long for their future before they can be sampled; warm up longer"
            )


PAPER_PAINTER = PainterConfig(bank=False, share_latent=False)
"""The paper's (Sahni et al., NeurIPS 2019, appendix and authors' code): a latent an image, and no table."""
PAPER_TRAINING = TrainingConfig(warmup_frames=10_000, policy_average=0.0)
"""What the paper's tables say alike for all tasks; the last weights are evaluated."""
