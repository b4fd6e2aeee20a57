"""The steps of a generator's training: matte regression, adversarial training, the paper's; those that have steps."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Protocol

import torch
from torch import Tensor

from halgan_rl.hallucination.generators.base import HallucinationGenerator
from halgan_rl.hallucination.training.adversarial import AdversarialConfig, AdversarialTrainer
from halgan_rl.hallucination.training.data import Frames, check_data
from halgan_rl.hallucination.training.matte_regression import MatteConfig, MatteRegression
from halgan_rl.hallucination.training.paper import PaperTrainer, PaperTrainingConfig
from halgan_rl.poses import PlanarPoses

LOSSES = (
    "mattes/loss",
    "adversarial/critic_gap",
    "adversarial/wrong_pose_gap",
    "adversarial/slope",
    "adversarial/extent",
    "paper/critic_distance",
    "paper/auxiliary_real",
    "paper/auxiliary_fake",
    "paper/change",
)
"""Names of all losses, see :meth:`GeneratorTraining.step`."""


class Stage(Protocol):
    """One kind of training."""

    @property
    def average(self) -> HallucinationGenerator:
        """The generator worth keeping."""

    def step(self) -> dict[str, Tensor]:
        """Makes one step; returns its losses, scalars."""

    def state_dict(self) -> dict[str, Any]:
        """Returns all that training goes on from."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on from a state."""


@dataclass(frozen=True)
class GeneratorTrainingConfig:
    """How a generator is trained: up to three stages, one after the other.

    Raises:
        ValueError: if no stage has steps.
    """

    mattes: MatteConfig = field(default_factory=MatteConfig)
    """Matte regression, for a generator by coordinates and a goal of its own colour."""
    adversarial: AdversarialConfig = field(default_factory=partial(AdversarialConfig, steps=0))
    """Adversarial training."""
    paper: PaperTrainingConfig = field(default_factory=partial(PaperTrainingConfig, steps=0))
    """The paper's adversarial training."""
    mirror: bool = True
    """Mirror half of the frames left to right."""

    def __post_init__(self) -> None:
        """Refuses to do nothing."""
        if not self.steps:
            raise ValueError("mattes.steps, adversarial.steps and paper.steps are all 0: there is nothing to train")

    @property
    def steps(self) -> int:
        """Steps of all stages."""
        return self.mattes.steps + self.adversarial.steps + self.paper.steps


class GeneratorTraining:
    """Trains a generator, one step a call.

    Args:
        generator: is trained in place.

    Keyword Args:
        near_goal: ``pixels`` uint8 ``[N, H, W, C]``, ``pose`` and ``goal_pose`` ``[N, P]`` of near-goal frames; rows of
            equal ``goal_pose`` are of one rollout.
        failed: ``pixels`` uint8 ``[M, H, W, C]`` and ``pose`` ``[M, P]`` of failed frames.
        rng: draws everything that is random, except the critics' first weights (PyTorch's global generator).
        config: which stages, and how.
        poses: which entries of a pose are flags.
        standardise: whether to scale the configuration's features to mean 0 and variance 1 first.

    Attributes:
        steps: made so far.

    Raises:
        KeyError: if an entry of the frames is missing.
        ValueError: if frames or poses are other than the generator's.
    """

    def __init__(
        self,
        generator: HallucinationGenerator,
        *,
        near_goal: Frames,
        failed: Frames,
        rng: torch.Generator,
        config: GeneratorTrainingConfig,
        poses: PlanarPoses = PlanarPoses(),
        standardise: bool = True,
    ) -> None:
        check_data(generator, near_goal, failed, poses)
        if standardise:
            generator.encoding.standardise(generator.encoding.labels(near_goal["pose"], near_goal["goal_pose"]))
        self.steps = 0
        common: dict[str, Any] = {
            "near_goal": near_goal, "failed": failed, "rng": rng, "poses": poses, "mirror": config.mirror
        }  # fmt: skip
        kinds: dict[str, tuple[Callable[..., Stage], Any]] = {
            "mattes": (MatteRegression, config.mattes),
            "adversarial": (AdversarialTrainer, config.adversarial),
            "paper": (PaperTrainer, config.paper),
        }
        self._stages = [
            (name, settings.steps, partial(make, generator, config=settings, **common))
            for name, (make, settings) in kinds.items()
            if settings.steps
        ]
        self._begin(0)

    @property
    def average(self) -> HallucinationGenerator:
        """The generator worth keeping."""
        return self._stage.average

    def step(self) -> dict[str, float]:
        """Makes a step; returns its losses, some of ``LOSSES``.

        Raises:
            StopIteration: if all steps are made.
        """
        if self._left == 0:
            if self._number + 1 == len(self._stages):
                raise StopIteration("all steps are made")
            self._begin(self._number + 1)
        name = self._stages[self._number][0]
        losses = {f"{name}/{loss}": float(value) for loss, value in self._stage.step().items()}
        self._left -= 1
        self.steps += 1
        return losses

    def state_dict(self) -> dict[str, Any]:
        """Returns all that training goes on from: the stage, its state, and how many steps are made."""
        return {"number": self._number, "left": self._left, "steps": self.steps, "stage": self._stage.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on from a state; generator, data and configuration must be the same."""
        self._begin(state["number"])
        self._stage.load_state_dict(state["stage"])
        self._left, self.steps = state["left"], state["steps"]

    def _begin(self, number: int) -> None:
        """Makes a stage, which starts from the generator as it is by then."""
        _, self._left, make = self._stages[number]
        self._number = number
        self._stage: Stage = make()
