"""The hyper-parameters of hindsight: one object for all named pipelines."""

from dataclasses import dataclass

from halgan_rl.transforms.annealing import Annealing


@dataclass(frozen=True)
class HindsightConfig:
    """Which rows are relabelled, to which goals, and what they earn. The defaults learn fastest in our tasks.

    Raises:
        ValueError: if a value is out of range; what needs other values too is refused by the transforms.
    """

    probability: Annealing = Annealing(0.3, 0.0, 60_000)
    """Fraction of the sampled rows for which a goal is drawn."""
    max_distance: int = 96
    """Longest failed segment: the goal lies 1 to this many steps ahead. The paper's is 32 for Navigate."""
    nearness: float = 2.0
    """Preference for near goals: the steps to the goal are uniform to this power; 1 is uniform, as in the paper."""
    pursue_unseen: bool = True
    """Also pursue goals that the image does not show, as in the paper."""
    success_reward: float = 1.0
    """Added to the reward of a relabelled row that reaches its goal."""
    success_threshold: float = 0.0
    """A greater reward is a success, which is never relabelled. Give what any step may earn, such as an alive bonus."""
    max_step: float | None = None
    """Longest distance [m] of one step: rows with a longer one are refused. None if it is not known."""
    n_steps: int = 1
    """Steps that a row spans: n-step returns."""
    fixed_shape: bool = False
    """Hallucinate all rows, so that no shape depends on the data, for CUDA graphs."""

    def __post_init__(self) -> None:
        """Refuses values that would fail only later."""
        if not 1 <= self.n_steps <= self.max_distance:
            raise ValueError(
                f"max_distance must be at least 1 step and n_steps={self.n_steps}, got {self.max_distance}; n_steps "
                "must be at least 1."
            )
        if not self.nearness >= 1.0:
            raise ValueError(f"nearness must be at least 1, got {self.nearness}.")
