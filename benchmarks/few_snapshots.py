"""How few near-goal snapshots a generator needs: its fidelity, and what an agent learns from its hallucinations.

Usage::

    python -m benchmarks.few_snapshots --out results/few-snapshots   # half an hour on one core

For each size of R a generator is trained (``recipes/train_generator.py``), compared with the
simulator's truth (``recipes/evaluate_generator.py``), and used by an agent in the 2 m room
(``recipes/ddpg_navigate.py``). Into the folder go pictures, the agents' curves and one table.
"""

import dataclasses
import json
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
import tyro

from benchmarks.tables import Table, report
from halgan_rl.experiment.presets import changed
from halgan_rl.experiment.run_folder import check_unused, read_metrics
from recipes import ddpg_navigate, evaluate_generator, train_generator

HEADER = (
    "snapshots",
    "bearing, hallucinated / real",
    "distance, hallucinated / real",
    "mask overlap within 1 m",
    "change out of view [of 255]",
    "success after frames",
)


@dataclasses.dataclass(frozen=True)
class Study:
    """How few near-goal snapshots a generator needs."""

    out: Path = Path("runs/few_snapshots")
    """Folder of the table; must not hold one yet."""
    sizes: tuple[int, ...] = (2_000, 1_000, 500, 250)
    """Sizes of R."""
    seed: int = 0
    """Seed of every training."""
    total_frames: int = 10_000
    """Frames of each agent."""


def main(study: Study) -> None:
    """Trains, judges and uses a generator of each size, and writes the table."""
    check_unused(study.out)
    torch.set_num_threads(1)
    study.out.mkdir(parents=True, exist_ok=True)
    lines = [judge(size, study) for size in study.sizes]
    title = f"Generators trained on few near-goal snapshots, 2 m room, seed {study.seed}."
    report("few_snapshots", [Table(title, HEADER, lines)], study.out)


def judge(size: int, study: Study) -> list[str]:
    """Returns the table's line for one size of R."""
    with TemporaryDirectory() as temporary:
        generator, judged, agent = (Path(temporary, name) for name in ("generator", "judged", "agent"))
        of_generator = {"data.near_goal_frames": size, "seed": study.seed, "out": generator}
        train_generator.main(changed(train_generator.PRESETS["default"], of_generator))
        weights = generator / "generator.safetensors"
        evaluate_generator.main(evaluate_generator.Config(weights=weights, out=judged))
        changes = {
            "painter.weights": weights,
            "total_frames": study.total_frames,
            "seed": study.seed,
            "out": agent,
            "evaluation.film_starts": 1,
        }
        ddpg_navigate.main(changed(ddpg_navigate.DEFAULT, changes))
        shutil.copy(agent / "metrics.csv", study.out / f"{size}-snapshots-seed{study.seed}.csv")
        shutil.copy(generator / "hallucinations.png", study.out / f"{size}-snapshots.png")
        found, curve = json.loads((judged / "fidelity.json").read_text()), read_metrics(agent / "metrics.csv")
    return [
        str(size),
        f"{found['probe']['ratio']['bearing']:.2f}",
        f"{found['probe']['ratio']['distance']:.2f}",
        f"{found['mask']['within 1 m']['overlap']:.2f}",
        f"{found['no_op']['out_of_view']:.2f}",
        ", ".join(
            f"{success:.0%} ({frames:.0f})"
            for frames, success in zip(curve["frames"], curve["eval/success_rate"], strict=True)
        ),
    ]


if __name__ == "__main__":
    main(tyro.cli(Study, description=__doc__))
