"""What each part of adversarial training is worth, beside matte regression and the paper's loop.

Usage::

    python -m benchmarks.halgan_ablation --out results/ablation   # four hours on one core

Trains a generator with ``recipes/train_generator.py`` for each variant: by adversarial training, by the
same with one part left out, by matte regression, and by the paper's loop for some minutes. At intervals each is
compared with the simulator's truth on the same held-out poses. Into the folder go the runs' curves, one picture and one
table: fidelity in the end, steps and minutes, and when the variant reached the best that the paper's loop got to. A
variant whose curve is there already is not trained again.
"""

import dataclasses
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
import tyro
from matplotlib.figure import Figure

from benchmarks.tables import Table, report
from halgan_rl.experiment.generator_run import GeneratorRunConfig
from halgan_rl.experiment.presets import changed
from halgan_rl.experiment.run_folder import read_metrics
from recipes import train_generator

Changes = dict[str, Any]


def adversarial(**changes: Any) -> tuple[str, Changes]:
    """Return adversarial training with some values changed."""
    return "adversarial", {f"training.adversarial.{name}": value for name, value in changes.items()}


PAPER, REGRESSION = "the paper's loop", "matte regression"
VARIANTS: dict[str, tuple[str, Changes]] = {
    "adversarial": ("adversarial", {}),
    "... backgrounds not matched": adversarial(backgrounds=0),
    "... no wrong poses": adversarial(wrong_pose_weight=0.0),
    "... no painted maps": adversarial(painted_maps=False),
    "... no penalty": adversarial(penalty_weight=0.0, fine_penalty_weight=0.0),
    "... no weight on the extent": adversarial(extent_weight=0.0),
    "... no configurations elsewhere": adversarial(elsewhere=0),
    "... whole images from the start": adversarial(coarse=0.0),
    "... no moving average": adversarial(average_decay=0.0),
    "... not mirrored": ("adversarial", {"training.mirror": False}),
    "... distance and bearing": ("adversarial", {"generator.configuration": "polar"}),
    "... the paper's generator": ("adversarial", {"generator.kind": "paper"}),
    REGRESSION: ("default", {}),
    "matte regression, then adversarial": ("adversarial", {"training.mattes.steps": 2_500}),
    PAPER: ("paper", {"evaluate_every": 5}),
}
"""Name: preset of ``train_generator``, and what is changed of it, by the names of its flags."""


@dataclasses.dataclass(frozen=True)
class Ablation:
    """What each part of adversarial training is worth."""

    out: Path = Path("runs/ablation")
    """Folder of the table; variants whose curves it already holds are not trained again."""
    minutes: float | None = None
    """Longest training of a variant; by default all make their steps."""
    paper_minutes: float = 30.0
    """Of training, the paper's loop."""
    only: tuple[str, ...] = tuple(VARIANTS)
    """Variants to run."""
    seed: int = 0
    """Seed of every run."""


def main(ablation: Ablation) -> None:
    """Trains all variants, and writes the table."""
    unknown = set(ablation.only) - set(VARIANTS)
    if unknown:
        raise ValueError(f"unknown variants {sorted(unknown)}: choose from {list(VARIANTS)}")
    torch.set_num_threads(1)
    ablation.out.mkdir(parents=True, exist_ok=True)
    curves = {}
    for name in ablation.only:
        kept = ablation.out / f"{''.join(letter if letter.isalnum() else '-' for letter in name)}.csv"
        if not kept.exists():
            train(name, ablation, kept)
        curves[name] = read_metrics(kept)
        write_report(ablation, curves)


def train(name: str, ablation: Ablation, kept: Path) -> None:
    """Trains one variant; keeps its curve and its picture."""
    with TemporaryDirectory() as folder:
        config = make_config(name, ablation, Path(folder, "run"))
        train_generator.main(config)
        shutil.copy(config.out / "hallucinations.png", kept.with_suffix(".png"))
        shutil.copy(config.out / "metrics.csv", kept)


def make_config(name: str, ablation: Ablation, out: Path) -> GeneratorRunConfig:
    """Returns the configuration of a variant."""
    preset, changes = VARIANTS[name]
    minutes = ablation.paper_minutes if name == PAPER else ablation.minutes
    common = {"minutes": minutes, "seed": ablation.seed, "out": out}
    return changed(train_generator.PRESETS[preset], changes | common)


def write_report(ablation: Ablation, curves: dict[str, dict[str, list[float]]]) -> None:
    """Writes table and picture of the variants that have been trained."""
    best = max(curves[PAPER]["truth/mask_overlap"]) if PAPER in curves else float("nan")
    lines = [
        [
            name,
            f"{curve['seconds'][-1] / 60:.1f}",
            f"{curve['steps'][-1]:.0f}",
            f"{curve['truth/mask_overlap'][-1]:.2f}",
            f"{curve['truth/centroid_error'][-1]:.1f}",
            f"{curve['truth/outside_change'][-1]:.1f}",
            reached(curve, best),
        ]
        for name, curve in curves.items()
    ]
    header = ("variant", "minutes", "steps", "mask overlap", "centre off [pixels]", "change outside [of 255]")
    paper = f"minutes to the paper's best, {best:.2f}"
    title = f"Held-out poses, 2 m room, seed {ablation.seed}, one thread."
    report("ablation", [Table(title, (*header, paper), lines)], ablation.out)
    figure = Figure(figsize=(10, 6))
    axes = figure.subplots()
    for number, (name, curve) in enumerate(curves.items()):
        minutes = [seconds / 60 for seconds in curve["seconds"]]
        style = "-" if number < 10 else "--"  # there are ten colours
        axes.plot(minutes, curve["truth/mask_overlap"], style, color=f"C{number}", label=name)
    axes.set(xlabel="minutes of training", ylabel="overlap with the goal's true mask", ylim=(0, 1))
    axes.legend(fontsize="small")
    figure.savefig(ablation.out / "ablation.png", dpi=100, bbox_inches="tight")


def reached(curve: dict[str, list[float]], overlap: float) -> str:
    """Returns the minutes after which a curve first reaches an overlap."""
    minutes = [
        seconds / 60
        for seconds, value in zip(curve["seconds"], curve["truth/mask_overlap"], strict=True)
        if value >= overlap
    ]
    return f"{minutes[0]:.2f}" if minutes else "never"


if __name__ == "__main__":
    main(tyro.cli(Ablation, description=__doc__))
