"""Which generator: the part of a configuration that makes one."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from halgan_rl.hallucination.generators.base import HallucinationGenerator
from halgan_rl.hallucination.generators.coordinates import CoordinateGenerator
from halgan_rl.hallucination.generators.goal_encoding import Configuration
from halgan_rl.hallucination.generators.paper import Composition, PaperGenerator

GENERATORS: dict[str, Callable[..., HallucinationGenerator]] = {
    "coordinates": CoordinateGenerator,
    "paper": PaperGenerator,
}
"""All generators, by the name that manifests give as their ``kind``."""


@dataclass(frozen=True)
class GeneratorConfig:
    """Which generator."""

    kind: Literal["coordinates", "paper"] = "coordinates"
    """By coordinates with a matte, or the paper's convolutions."""
    composition: Composition = "difference"
    """How the paper's generator changes an image: tanh(s + H), or s + tanh(s + H) - tanh(s), the identity at H = 0."""
    configuration: Configuration = "planar"
    """The whole relative pose, or the paper's distance and bearing."""
    standardise: bool = True
    """Scale the configuration's features to mean 0 and variance 1."""

    def make(self, *, image_shape: Sequence[int], frame_stack: int, pose_size: int) -> HallucinationGenerator:
        """Returns the untrained generator; its first weights come from PyTorch's global generator."""
        shapes = {"pose_size": pose_size, "image_shape": image_shape, "frame_stack": frame_stack}
        options = {"composition": self.composition} if self.kind == "paper" else {}
        return GENERATORS[self.kind](configuration=self.configuration, **shapes, **options)
