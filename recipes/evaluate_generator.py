"""How good hallucinations are, measured against the simulator's truth, which training never sees.

Usage::

    python recipes/evaluate_generator.py                                     # the shipped weights of the 2 m room
    python recipes/evaluate_generator.py --environment navigate-4m --bank    # looked up instead of computed
    python recipes/evaluate_generator.py --weights runs/generator/generator.safetensors

Three kinds of images are compared: the simulator's ("truth"), the hallucinator's, and the failed frames without any
goal, the worst there is. The folder gets ``fidelity.json`` with everything below, and ``fidelity.png``.

- **Pose probe**: a network that has seen real near-goal frames only reads bearing and distance of the goal off held-out
  real frames and off hallucinations for the same poses, the goal in view and within 1.5 m; their errors and ratio.
- **Goal mask**: intersection over union of the pixels that the goal truly changes and those that are painted, for bands
  of distance and of bearing.
- **No-op**: mean change outside the goal's true mask; and of the whole image where the goal is out of view.
- **Consistency**: along stretches of real trajectories with one hindsight goal, how far the positions scatter where the
  probe sees the goal, once carried over into the room.

Poses come from random walks, goals from 1 to 96 steps ahead in the same walk.
"""

import dataclasses
from pathlib import Path
from typing import Any

import torch
import tyro

import halgan_envs
from halgan_rl.experiment import pictures
from halgan_rl.experiment.domain import Domain
from halgan_rl.experiment.run_folder import check_unused, versions, write_json
from halgan_rl.hallucination.bank import HallucinationBank
from halgan_rl.hallucination.hallucinators import GeneratorHallucinator
from halgan_rl.hallucination.judging.painting import paint_each
from halgan_rl.hallucination.judging.pose_probe import train_probe
from halgan_rl.hallucination.judging.report import View, as_text, judge
from halgan_rl.hallucination.judging.walks import draw_goals
from halgan_rl.hallucination.weights import load_generator, read_manifest, shipped_weights
from halgan_rl.transforms import Hallucinator


@dataclasses.dataclass(frozen=True)
class Config:
    """How good hallucinations are, measured against the simulator's truth."""

    environment: str = "navigate-2m"
    """One of `halgan_envs.NAMES`."""
    weights: Path | None = None
    """Generator to judge; by default the one shipped for the environment."""
    bank: bool = False
    """Judge the lookup table made from the generator instead of the generator."""
    share_latent: bool = True
    """Draw one latent for all images of a row, or of a trajectory, instead of one for each image."""
    seed: int = 100
    """Seed of everything random; the shipped weights were trained on other seeds."""
    frames: int = 2_000
    """Held-out frames of each kind."""
    probe_frames: int = 6_000
    """Real near-goal frames that the probe is trained on."""
    probe_steps: int = 4_000
    """Training steps of the probe."""
    out: Path = Path("runs/fidelity")
    """Folder of the report; must not hold one yet."""


def main(config: Config) -> None:
    """Collects, paints, compares, and writes the report."""
    check_unused(config.out)
    domain = halgan_envs.domain(config.environment)
    path = config.weights or shipped_weights(domain.name)
    torch.manual_seed(config.seed)
    rng = torch.Generator().manual_seed(config.seed)
    painter = make_painter(config, domain, path, rng)
    renderer: Any = domain.goal_renderer()
    view = View(domain.poses)

    # The judge, which sees real frames only.
    real = view.select(halgan_envs.near_goal_frames(domain.name, config.probe_frames, seed=config.seed))
    probe = train_probe(real["pixels"], view.polar(real), rng=rng, steps=config.probe_steps)

    # What is judged: goals in failed frames some steps ahead, at the poses of real frames, and along real rollouts.
    failed = halgan_envs.failed_frames(domain.name, 10 * config.frames, seed=config.seed + 3)
    pose, goal_pose = draw_goals(failed["pose"], failed["episode"], config.frames, rng=rng)
    walks = halgan_envs.without_goal({"pose": pose, "goal_pose": goal_pose}, renderer)
    near_goal, rollouts = (
        halgan_envs.near_goal_frames(domain.name, config.frames, seed=config.seed + number) for number in (1, 2)
    )
    for frames in (near_goal, rollouts):
        frames["empty"] = halgan_envs.without_goal(frames, renderer)["pixels"]
    data = {"near_goal": view.select(near_goal), "rollouts": rollouts, "walks": walks}
    report = judge(painter, renderer, probe=probe, view=view, **data)

    # The report, and a picture of failed frames with the goal in view.
    config.out.mkdir(parents=True, exist_ok=True)
    about = {"config": dataclasses.asdict(config), "weights": read_manifest(path), "versions": versions()}
    write_json(config.out / "fidelity.json", report | about)
    few = {name: entry[:16] for name, entry in view.select(walks).items()}
    rows = {"failed": few["pixels"], "truth": paint_each(renderer, few), "hallucinated": paint_each(painter, few)}
    title = f"{domain.name}: random walks, held out"
    pictures.draw_frame_grid(config.out / "fidelity.png", rows, title=title, frame_stack=domain.frame_stack)
    print(f"{as_text(report)}\nlook at {config.out / 'fidelity.png'}")


def make_painter(config: Config, domain: Domain, path: Path, rng: torch.Generator) -> Hallucinator:
    """Returns who is judged: the generator, or the bank of its output."""
    shapes: dict[str, Any] = {"image_shape": domain.image_shape, "frame_stack": domain.frame_stack}
    generator = load_generator(path, fingerprint=domain.fingerprint, poses=domain.poses, **shapes)
    if config.bank:
        return HallucinationBank(generator, poses=domain.poses, rng=rng, share_latent=config.share_latent)
    return GeneratorHallucinator(generator, rng=rng, share_latent=config.share_latent)


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
