"""What is done about missing rewards: one function a method, looked up by name."""

from collections.abc import Callable
from typing import Any

import torch

from halgan_rl.experiment.config import PainterConfig, RunConfig
from halgan_rl.experiment.domain import Domain
from halgan_rl.hallucination.bank import HallucinationBank
from halgan_rl.hallucination.hallucinators import GeneratorHallucinator, RandomFlags
from halgan_rl.hallucination.weights import load_generator, shipped_weights
from halgan_rl.transforms import Hallucinator, pipelines

Method = Callable[[RunConfig, Domain], pipelines.Hindsight]
"""Returns the transform of the replay buffer. A method without hindsight returns ``pipelines.none()``."""


def none(config: RunConfig, domain: Domain) -> pipelines.Hindsight:
    """Plain replay."""
    del config
    return pipelines.none(keys=domain.keys)


def her(config: RunConfig, domain: Domain) -> pipelines.Hindsight:
    """Naive hindsight experience replay: reward and termination of a goal that the image does not show."""
    return pipelines.her(**relabelling(config, domain))


def halgan(config: RunConfig, domain: Domain) -> pipelines.Hindsight:
    """HALGAN: a trained generator, or the table of its output, paints the goal."""
    hallucinator = make_hallucinator(config.painter, domain, seed=config.seed)
    return pipelines.halgan(hallucinator, **relabelling(config, domain))


def oracle(config: RunConfig, domain: Domain) -> pipelines.Hindsight:
    """The simulator itself paints the goal."""
    if domain.goal_renderer is None:
        raise ValueError(f"method='oracle' needs a goal_renderer, which the domain {domain.name!r} lacks")
    rng = torch.Generator().manual_seed(config.seed)
    renderer = _with_flags(domain.goal_renderer(), config.painter, domain, rng)
    return pipelines.halgan(renderer, **relabelling(config, domain))


METHODS: dict[str, Method] = {"halgan": halgan, "her": her, "oracle": oracle, "none": none}
"""All methods, by the name that ``RunConfig.method`` gives."""


def make_hindsight(config: RunConfig, domain: Domain) -> pipelines.Hindsight:
    """Returns the replay transform of the configured method.

    Raises:
        ValueError: if there is no such method, or what it needs does not fit the domain.
        FileNotFoundError: if it needs weights, and there are none.
    """
    if config.method not in METHODS:
        raise ValueError(f"method={config.method!r} is unknown: choose one of {', '.join(METHODS)}")
    with torch.random.fork_rng(devices=[]):  # with one seed all methods explore alike, whatever a painter draws
        return METHODS[config.method](config, domain)


def make_hallucinator(config: PainterConfig, domain: Domain, *, seed: int) -> Hallucinator:
    """Returns what paints with a generator: its bank, or the generator itself.

    Raises:
        ValueError: if the weights do not fit the domain.
        FileNotFoundError: if there are no weights.
    """
    rng = torch.Generator().manual_seed(seed)
    generator = load_generator(
        config.weights or shipped_weights(domain.name),
        fingerprint=domain.fingerprint,
        poses=domain.poses,
        image_shape=domain.image_shape,
        frame_stack=domain.frame_stack,
        allow_other_mujoco=config.allow_other_mujoco,
    )
    painter: Hallucinator
    if config.bank:
        painter = HallucinationBank(generator, poses=domain.poses, rng=rng, share_latent=config.share_latent)
    else:
        painter = GeneratorHallucinator(generator, rng=rng, share_latent=config.share_latent)
    return _with_flags(painter, config, domain, rng)


def _with_flags(painter: Hallucinator, config: PainterConfig, domain: Domain, rng: torch.Generator) -> Hallucinator:
    return RandomFlags(painter, poses=domain.poses, rng=rng) if config.random_flags else painter


def relabelling(config: RunConfig, domain: Domain) -> dict[str, Any]:
    """Returns the arguments that all pipelines with relabelled rows share."""
    rng = torch.Generator().manual_seed(config.seed)
    return {
        "config": config.hindsight,
        "rng": rng,
        "discount": config.agent.discount,
        "poses": domain.poses,
        "keys": domain.keys,
    }
