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

import numpy as np
import torch
import tyro
from torch import Tensor

import halgan_envs
from halgan_rl.experiment import pictures
from halgan_rl.experiment.domain import Domain
from halgan_rl.experiment.run_folder import check_unused, versions, write_json
from halgan_rl.hallucination.bank import HallucinationBank
from halgan_rl.hallucination.hallucinators import GeneratorHallucinator
from halgan_rl.hallucination.judging.mask_overlaps import mask_overlaps
from halgan_rl.hallucination.judging.painting import paint_each, paint_one_goal
from halgan_rl.hallucination.judging.pose_probe import probe_errors, train_probe
from halgan_rl.hallucination.judging.scatter import cut_stretches, scatter
from halgan_rl.hallucination.judging.walks import draw_goals
from halgan_rl.hallucination.training.data import Frames
from halgan_rl.hallucination.weights import load_generator, read_manifest, shipped_weights
from halgan_rl.transforms import Hallucinator

IN_VIEW = 0.36
"""Bearing within which the whole goal is in view [rad]: the camera sees 0.43 to either side."""
WITHIN = 1.5
"""Distance within which goals are large enough for the probe [m]."""
DISTANCES = (0.0, 0.3, 0.6, 1.0, 1.5, 6.0)
"""Bounds of the bands of distance [m]."""
BEARINGS = (0.0, 8.0, 16.0, 24.5)
"""Bounds of the bands of bearing, to either side [degrees]."""


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
    torch.manual_seed(config.seed)
    rng = torch.Generator().manual_seed(config.seed)
    path = config.weights or shipped_weights(domain.name)
    painter = make_painter(config, domain, path, rng)
    renderer: Any = domain.goal_renderer()

    # The judge, which sees real frames only; then what is judged: failed frames with goals in hindsight.
    real = in_view(domain, near_goal(config, config.probe_frames, config.seed))
    probe = train_probe(real["pixels"], polar(domain, real), rng=rng, steps=config.probe_steps)
    failed = draw_failures(config, domain, renderer, rng)

    # The same poses: real, truly rendered, and hallucinated.
    real = in_view(domain, near_goal(config, config.frames, config.seed + 1))
    empty = without_goal(real, renderer)
    images = {"real": real["pixels"], "truth": paint_each(renderer, empty), "hallucinated": paint_each(painter, empty)}
    report: dict[str, Any] = {"probe": probe_errors(probe, polar(domain, real), images)}
    images = {"truth": paint_each(renderer, failed), "hallucinated": paint_each(painter, failed)}
    report |= mask_overlaps(
        failed["pixels"], *images.values(), polar(domain, failed), distances=DISTANCES, bearings=BEARINGS
    )

    # Stretches of trajectories with one goal.
    real = near_goal(config, config.frames, config.seed + 2)
    stretches = cut_stretches(real, whole_goal_in_view(polar(domain, real)))
    empty_ones = [without_goal(stretch, renderer) for stretch in stretches]
    report["consistency"] = {
        "real": scatter(probe, [(stretch["pose"], stretch["pixels"]) for stretch in stretches])
    } | {
        label: scatter(probe, [(stretch["pose"], paint_one_goal(by, stretch)) for stretch in empty_ones])
        for label, by in (("truth", renderer), ("hallucinated", painter))
    }

    # The report, and a picture of failed frames with the goal in view.
    config.out.mkdir(parents=True, exist_ok=True)
    about = {"config": dataclasses.asdict(config), "weights": read_manifest(path), "versions": versions()}
    write_json(config.out / "fidelity.json", report | about)
    chosen = {name: entry[:16] for name, entry in in_view(domain, failed).items()}
    rows = {
        "failed": chosen["pixels"],
        "truth": paint_each(renderer, chosen),
        "hallucinated": paint_each(painter, chosen),
    }
    title = f"{domain.name}: random walks, held out"
    pictures.draw_frame_grid(config.out / "fidelity.png", rows, title=title, frame_stack=domain.frame_stack)
    print_table(report)
    print(f"look at {config.out / 'fidelity.png'}")


def make_painter(config: Config, domain: Domain, path: Path, rng: torch.Generator) -> Hallucinator:
    """Returns who is judged: the generator, or the bank of its output."""
    generator = load_generator(
        path,
        fingerprint=domain.fingerprint,
        poses=domain.poses,
        image_shape=domain.image_shape,
        frame_stack=domain.frame_stack,
    )
    if config.bank:
        return HallucinationBank(generator, poses=domain.poses, rng=rng, share_latent=config.share_latent)
    return GeneratorHallucinator(generator, rng=rng, share_latent=config.share_latent)


def near_goal(config: Config, count: int, seed: int) -> Frames:
    """Collects near-goal frames of successful rollouts."""
    environment = halgan_envs.named(config.environment)(random_state=seed)
    data = halgan_envs.collect_near_goal(environment, count, np.random.RandomState(seed))
    environment.close()
    return {name: torch.from_numpy(array) for name, array in data.items()}


def draw_failures(config: Config, domain: Domain, renderer: Any, rng: torch.Generator) -> Frames:
    """Walks at random; returns poses, goals some steps ahead, and the frames from there without any goal."""
    environment = halgan_envs.named(config.environment)(random_state=config.seed + 3)
    source = np.random.RandomState(config.seed + 3)
    pose = torch.from_numpy(halgan_envs.collect_failed(environment, 10 * config.frames, source)["pose"])
    step = environment.task.robot.max_speed * environment.task.control_timestep
    environment.close()
    poses = draw_goals(pose, config.frames, max_step=max(0.1, 1.1 * step), rng=rng)
    return without_goal(dict(zip(("pose", "goal_pose"), poses, strict=True)), renderer)


def without_goal(data: Frames, renderer: Any) -> Frames:
    """Returns the data with the frames that are seen in a room without a goal."""
    frames = np.stack([renderer.render_without_goal(pose) for pose in data["pose"].double().numpy()])
    return data | {"pixels": torch.from_numpy(frames)}


def polar(domain: Domain, data: Frames) -> Tensor:
    """Returns bearing [rad] and distance [m] of the goals, ``[N, 2]``."""
    return domain.poses.goal_polar(data["pose"], data["goal_pose"])


def whole_goal_in_view(where: Tensor) -> Tensor:
    """Returns which goals at bearing and distance ``[N, 2]`` are wholly in view and near."""
    return (where[:, 0].abs() < IN_VIEW) & (where[:, 1] < WITHIN)


def in_view(domain: Domain, data: Frames) -> Frames:
    """Returns the rows in which the whole goal is in view and near."""
    rows = whole_goal_in_view(polar(domain, data))
    return {name: entry[rows] for name, entry in data.items()}


def print_table(report: dict[str, Any]) -> None:
    """Prints what the report holds."""
    probe, no_op, scatter = report["probe"], report["no_op"], report["consistency"]
    print(f"{'pose probe':24s} {'bearing':>10s} {'distance':>10s}   ({probe['frames']} frames)")
    for label in ("real", "truth", "hallucinated"):
        print(f"  {label:22s} {probe[label]['bearing_degrees']:8.2f} ° {probe[label]['distance_metres']:8.3f} m")
    print(f"  {'hallucinated / real':22s} {probe['ratio']['bearing']:8.2f}   {probe['ratio']['distance']:8.2f}")
    print("mask overlap")
    for label, band in {**report["mask"], **report["mask_by_distance"], **report["mask_by_bearing"]}.items():
        print(f"  {label:22s} {band['overlap']:8.2f}   ({band['frames']} frames)")
    print(f"change outside the mask  {no_op['outside_the_mask']:8.2f} / 255")
    print(f"change out of view       {no_op['out_of_view']:8.2f} / 255   ({no_op['frames_out_of_view']} frames)")
    print("goal scatters in the room by", ", ".join(f"{value:.3f} m ({label})" for label, value in scatter.items()))


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
