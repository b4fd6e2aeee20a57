"""How good hallucinations are, measured against the simulator's truth, which training never sees.

Usage::

    python recipes/evaluate_halgan.py                                        # the shipped weights of the 2 m room
    python recipes/evaluate_halgan.py --environment navigate-4m --bank       # looked up instead of generated
    python recipes/evaluate_halgan.py --weights runs/train_halgan/generator.safetensors

Three painters are compared: the simulator itself ("truth"), the hallucinator, and nobody ("failed": the frame without
a goal, the worst there is). The folder gets ``fidelity.json`` with everything below, and ``fidelity.png``.

- **Pose probe**: a network that has seen real near-goal frames only tells bearing and distance of the goal, on held-out
  real frames and on hallucinations for the same poses, the goal in view and within 1.5 m; their errors and ratio.
- **Goal mask**: intersection over union of the pixels that the goal truly changes and those that are painted, for bands
  of distance and of bearing.
- **No-op**: mean change outside the goal's true mask; and of the whole image where the goal is out of view.
- **Consistency**: along stretches of real trajectories with one hindsight goal, how far the positions scatter that the
  probe sees the goal at, once carried over into the room.

Poses come from random walks, goals from 1 to 96 steps ahead in the same walk.
"""

import dataclasses
from itertools import pairwise
from pathlib import Path
from typing import Any

import halgan_envs
import numpy as np
import torch
import tyro
from torch import Tensor

from halgan_rl.experiment import pictures
from halgan_rl.experiment.run_folder import check_unused, versions, write_json
from halgan_rl.hallucination.bank import BankGrid, HallucinationBank
from halgan_rl.hallucination.hallucinators import GanHallucinator, Hallucinator
from halgan_rl.hallucination.judging import fidelity
from halgan_rl.hallucination.judging.pose_probe import PoseProbe, polar_goal, train_probe
from halgan_rl.hallucination.weights import load_generator, read_manifest, shipped_weights
from halgan_rl.poses import flag_number

IN_VIEW = 0.36
"""Bearing within which the whole goal is in view [rad]: the camera sees 0.43 to either side."""
DISTANCES = (0.0, 0.3, 0.6, 1.0, 1.5, 6.0)
"""Bounds of the bands of distance [m]."""
BEARINGS = (0.0, 8.0, 16.0, 24.5)
"""Bounds of the bands of bearing, to either side [degrees]."""
STRETCH = 12
"""Frames of a stretch of trajectory."""


@dataclasses.dataclass(frozen=True)
class Config:
    """How good hallucinations are, measured against the simulator's truth."""

    environment: str = "navigate-2m"
    """The room."""
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
    """Collect, paint, compare, and write the report."""
    check_unused(config.out)
    path = config.weights or shipped_weights(config.environment)
    expected, pose_size = (
        halgan_envs.fingerprint(config.environment),
        3 + len(halgan_envs.pose_flags(config.environment)),
    )
    generator = load_generator(path, expected=expected, pose_size=pose_size)
    rng = torch.Generator().manual_seed(config.seed)
    torch.manual_seed(config.seed)
    hallucinator: Hallucinator = GanHallucinator(generator, rng=rng, share_latent=config.share_latent)
    if config.bank:
        grid = BankGrid(goal_offset=halgan_envs.goal_offsets(config.environment))
        hallucinator = HallucinationBank(generator, grid, rng=rng, share_latent=config.share_latent)
    renderer = halgan_envs.GoalRenderer(config.environment)

    probe = make_probe(config, rng)
    failed = draw_failures(config, renderer, rng)
    report: dict[str, Any] = {
        "probe": probe_errors(probe, config, renderer, hallucinator),
        **mask_overlaps(failed, renderer, hallucinator),
        "consistency": consistency(probe, config, renderer, hallucinator),
    }
    config.out.mkdir(parents=True, exist_ok=True)
    about = {"config": dataclasses.asdict(config), "weights": read_manifest(path), "versions": versions()}
    write_json(config.out / "fidelity.json", report | about)
    draw(config, failed, renderer, hallucinator)
    print_table(report)
    print(f"look at {config.out / 'fidelity.png'}")


def make_probe(config: Config, rng: torch.Generator) -> PoseProbe:
    """Train a probe on real near-goal frames with the goal in view."""
    data = in_view(near_goal(config, config.probe_frames, config.seed))
    return train_probe(data["pixels"], polar(data), rng=rng, steps=config.probe_steps)


def probe_errors(
    probe: PoseProbe, config: Config, renderer: halgan_envs.GoalRenderer, painter: Hallucinator
) -> dict[str, Any]:
    """Compare the probe's errors on held-out real frames and on the same poses painted."""
    data = in_view(near_goal(config, config.frames, config.seed + 1))
    where, empty = polar(data), without_goal(data, renderer)
    images = {"real": data["pixels"], "truth": paint(renderer, empty), "hallucinated": paint(painter, empty)}
    errors = {label: (probe_all(probe, frames) - where).abs().mean(0) for label, frames in images.items()}
    table = {
        label: {"bearing_degrees": float(error[0].rad2deg()), "distance_metres": float(error[1])}
        for label, error in errors.items()
    }
    ratio = errors["hallucinated"] / errors["real"]
    return table | {"ratio": {"bearing": float(ratio[0]), "distance": float(ratio[1])}, "frames": len(where)}


def mask_overlaps(
    failed: dict[str, Tensor], renderer: halgan_envs.GoalRenderer, painter: Hallucinator
) -> dict[str, dict[str, Any]]:
    """Compare what is painted into failed frames with what the simulator shows there, band by band."""
    frames, truth, painted = failed["pixels"], paint(renderer, failed), paint(painter, failed)
    bearing, distance = polar(failed).unbind(-1)
    seen = fidelity.changed(frames, truth).flatten(1).any(1)

    def judge(rows: Tensor) -> dict[str, float]:
        """Compare the masks in some of the frames; NaN if there are none."""
        figures = fidelity.compare(frames[rows], truth[rows], painted[rows]) if rows.any() else None
        return {"overlap": figures.mask_overlap if figures else float("nan"), "frames": int(rows.sum())}

    in_bands = {
        f"{low:g}-{high:g} m": judge(seen & (distance >= low) & (distance < high)) for low, high in pairwise(DISTANCES)
    }
    degrees = bearing.rad2deg().abs()
    in_sectors = {
        f"{low:g}-{high:g} degrees": judge(seen & (degrees >= low) & (degrees < high))
        for low, high in pairwise(BEARINGS)
    }
    change = (painted.float() - frames.float()).abs()
    return {
        "mask_by_distance": in_bands,
        "mask_by_bearing": in_sectors,
        "mask": {"within 1 m": judge(seen & (distance < 1)), "all": judge(seen)},
        "no_op": {
            "outside_the_mask": fidelity.compare(frames[seen], truth[seen], painted[seen]).outside_change,
            "out_of_view": float(change[~seen].mean()),
            "frames_out_of_view": int((~seen).sum()),
        },
    }


def consistency(
    probe: PoseProbe, config: Config, renderer: halgan_envs.GoalRenderer, painter: Hallucinator
) -> dict[str, float]:
    """Return how far the goal seems to wander in the room while the robot moves [m], the root mean square.

    NaN if no goal stays in view for long enough.
    """
    squares: dict[str, list[Tensor]] = {"real": [], "truth": [], "hallucinated": []}
    for stretch in stretches(near_goal(config, config.frames, config.seed + 2)):
        empty = without_goal(stretch, renderer)
        images = {
            "real": stretch["pixels"],
            "truth": paint_one(renderer, empty),
            "hallucinated": paint_one(painter, empty),
        }
        for label, frames in images.items():
            seen = in_room(stretch["pose"], probe_all(probe, frames))
            squares[label].append((seen - seen.mean(0)).square().sum(-1).mean())
    return {label: float(torch.tensor(values).mean().sqrt()) for label, values in squares.items()}


def stretches(data: dict[str, Tensor]) -> list[dict[str, Tensor]]:
    """Cut rollouts into stretches of consecutive frames with the whole goal in view."""
    bearing, distance = polar(data).unbind(-1)
    fits = (bearing.abs() < IN_VIEW) & (distance < 1.5)
    found = []
    for first in range(0, len(fits) - STRETCH + 1, STRETCH):
        rows = slice(first, first + STRETCH)
        if fits[rows].all() and (data["goal_pose"][rows] == data["goal_pose"][first]).all():
            found.append({name: entry[rows] for name, entry in data.items()})
    return found


def near_goal(config: Config, count: int, seed: int) -> dict[str, Tensor]:
    """Collect near-goal frames of successful rollouts."""
    environment = halgan_envs.named(config.environment)(random_state=seed)
    data = halgan_envs.collect_near_goal(environment, count, np.random.RandomState(seed))
    environment.close()
    return with_offsets(config, {name: torch.from_numpy(array) for name, array in data.items()})


def with_offsets(config: Config, data: dict[str, Tensor]) -> dict[str, Tensor]:
    """Add how far ahead of its goal pose each row's goal stands."""
    offsets = torch.tensor(halgan_envs.goal_offsets(config.environment))
    return data | {"goal_offset": offsets[flag_number(data["pose"])]}


def draw_failures(config: Config, renderer: halgan_envs.GoalRenderer, rng: torch.Generator) -> dict[str, Tensor]:
    """Walk at random; return poses, goals some steps ahead, and the frames from there without any box."""
    environment = halgan_envs.named(config.environment)(random_state=config.seed + 3)
    pose = torch.from_numpy(
        halgan_envs.collect_failed(environment, 10 * config.frames, np.random.RandomState(config.seed + 3))["pose"]
    )
    step = environment.task.robot.max_speed * environment.task.control_timestep
    environment.close()
    jumps = (pose[1:, :2] - pose[:-1, :2]).norm(dim=-1) > max(0.1, 1.1 * step)  # between the end of a walk and the next
    walk = torch.cat([torch.zeros(1), jumps.cumsum(0)])
    start = torch.randint(len(pose), (40 * config.frames,), generator=rng)
    ahead = (start + 1 + (torch.rand(len(start), generator=rng).square() * 96).long()).clamp(max=len(pose) - 1)
    good = (walk[start] == walk[ahead]) & (ahead > start)
    data = with_offsets(config, {"pose": pose[start[good]], "goal_pose": pose[ahead[good]]})
    return without_goal({name: entry[: config.frames] for name, entry in data.items()}, renderer)


def without_goal(data: dict[str, Tensor], renderer: halgan_envs.GoalRenderer) -> dict[str, Tensor]:
    """Return the data with the frames that are seen in a room without a box."""
    frames = np.stack([renderer.render_without_goal(pose) for pose in data["pose"].double().numpy()])
    return data | {"pixels": torch.from_numpy(frames)}


def in_view(data: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the rows in which the whole goal is in view, within 1.5 m."""
    bearing, distance = polar(data).unbind(-1)
    rows = (bearing.abs() < IN_VIEW) & (distance < 1.5)
    return {name: entry[rows] for name, entry in data.items()}


def polar(data: dict[str, Tensor]) -> Tensor:
    """Return bearing and distance of the goals, ``[N, 2]``."""
    return polar_goal(data["pose"], data["goal_pose"], goal_offset=data["goal_offset"])


def paint(painter: Hallucinator, data: dict[str, Tensor]) -> Tensor:
    """Paint each row's goal into its frame, each with a latent of its own."""
    return painter(*(data[name].unsqueeze(1) for name in ("pixels", "pose", "goal_pose"))).squeeze(1)


def paint_one(painter: Hallucinator, data: dict[str, Tensor]) -> Tensor:
    """Paint one goal, the first row's, into all frames, with one latent."""
    return painter(data["pixels"][None], data["pose"][None], data["goal_pose"][None, :1]).squeeze(0)


@torch.no_grad()
def probe_all(probe: PoseProbe, frames: Tensor) -> Tensor:
    """Ask the probe, a few frames at a time."""
    return torch.cat([probe(part) for part in frames.split(64)])


def in_room(pose: Tensor, seen: Tensor) -> Tensor:
    """Carry goals seen at bearing and distance ``[N, 2]`` from poses ``[N, 3]`` over into the room, ``[N, 2]``."""
    bearing, distance = seen.unbind(-1)
    heading = pose[:, 2] + bearing
    return pose[:, :2] + distance[:, None] * torch.stack([heading.cos(), heading.sin()], -1)


def draw(config: Config, failed: dict[str, Tensor], renderer: halgan_envs.GoalRenderer, painter: Hallucinator) -> None:
    """Draw a few failed frames with the goal in view: as they were, the truth, and hallucinated."""
    chosen = {name: entry[:16] for name, entry in in_view(failed).items()}
    rows = {"failed": chosen["pixels"], "truth": paint(renderer, chosen), "hallucinated": paint(painter, chosen)}
    pictures.draw_frame_grid(config.out / "fidelity.png", rows, title=f"{config.environment}: random walks, held out")


def print_table(report: dict[str, Any]) -> None:
    """Print what the report holds."""
    probe, no_op, scatter = report["probe"], report["no_op"], report["consistency"]
    print(f"{'pose probe':24s} {'bearing':>10s} {'distance':>10s}   ({probe['frames']} frames)")
    for label in ("real", "truth", "hallucinated"):
        print(f"  {label:22s} {probe[label]['bearing_degrees']:8.2f} ° {probe[label]['distance_metres']:8.3f} m")
    print(f"  {'hallucinated / real':22s} {probe['ratio']['bearing']:8.2f}   {probe['ratio']['distance']:8.2f}")
    print("mask overlap")
    for label, figures in {**report["mask"], **report["mask_by_distance"], **report["mask_by_bearing"]}.items():
        print(f"  {label:22s} {figures['overlap']:8.2f}   ({figures['frames']} frames)")
    print(f"change outside the mask  {no_op['outside_the_mask']:8.2f} / 255")
    print(f"change out of view       {no_op['out_of_view']:8.2f} / 255   ({no_op['frames_out_of_view']} frames)")
    print("goal scatters in the room by", ", ".join(f"{value:.3f} m ({label})" for label, value in scatter.items()))


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
