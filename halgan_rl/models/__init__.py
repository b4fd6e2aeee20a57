"""Neural networks: hallucination generators, their discriminator, and the agents."""

from halgan_rl.models.agents import Actor, Critic, QNetwork
from halgan_rl.models.coordinates import CoordinateGenerator
from halgan_rl.models.halgan import Discriminator, HallucinationGenerator, PaperGenerator

__all__ = [
    "Actor",
    "CoordinateGenerator",
    "Critic",
    "Discriminator",
    "HallucinationGenerator",
    "PaperGenerator",
    "QNetwork",
]
