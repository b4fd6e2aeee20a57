"""A generator's training: a folder in which a generator is trained, compared with the truth, and shown."""

import dataclasses
import json
import shlex
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from halgan_rl.experiment import pictures
from halgan_rl.experiment.domain import Domain
from halgan_rl.experiment.run_folder import RunFolder, as_json, check_unused, versions
from halgan_rl.experiment.state_file import load_state, save_state
from halgan_rl.hallucination.generators.base import HallucinationGenerator
from halgan_rl.hallucination.generators.config import GeneratorConfig
from halgan_rl.hallucination.hallucinators import GeneratorHallucinator
from halgan_rl.hallucination.judging import fidelity
from halgan_rl.hallucination.judging.painting import paint_each
from halgan_rl.hallucination.training.data import Frames, check_images
from halgan_rl.hallucination.training.steps import LOSSES, GeneratorTraining, GeneratorTrainingConfig
from halgan_rl.hallucination.weights import save_weights

COLUMNS = ("steps", "seconds", "truth/mask_overlap", "truth/centroid_error", "truth/outside_change", *LOSSES)
STATE = "state.safetensors"
LATENT_SEED = 20_000
"""Seed of the latents with which held-out poses are painted."""
MAY_DIFFER = ("minutes", "resume", "out")
"""Fields of a configuration that may differ where a run is resumed."""


@dataclasses.dataclass(frozen=True)
class DataConfig:
    """How many frames a generator is trained on, and judged by.

    Raises:
        ValueError: if a count is out of range.
    """

    near_goal_frames: int = 2_000
    """Size of R, the near-goal frames."""
    steps_before_goal: int = 80
    """Frames of R from each rollout, besides its last; what is farther from the goal must be guessed."""
    failed_frames: int = 5_000
    """Frames of failed episodes to paint goals into."""
    held_out_frames: int = 128
    """Frames that are compared with the truth."""

    def __post_init__(self) -> None:
        """Refuses values that would fail only later."""
        counts = {"near_goal_frames": 1, "steps_before_goal": 0, "failed_frames": 1, "held_out_frames": 1}
        for name, least in counts.items():
            if getattr(self, name) < least:
                raise ValueError(f"{name}={getattr(self, name)} must be at least {least}")


@dataclasses.dataclass(frozen=True)
class GeneratorRunConfig:
    """Configuration of a generator's training; the defaults are what learns fastest on two cores.

    Raises:
        ValueError: if a value is out of range, or the generator has no mattes to fit.
    """

    preset: str = "default"
    """Where the other values come from: `default` is what learns fastest on two cores, `paper` its appendix."""
    environment: str = "navigate-2m"
    """Name of the environment."""
    seed: int = 0
    """Seed of everything random in the run."""
    minutes: float | None = None
    """Stop after this long, whatever is left to do; what is kept then depends on the machine's speed."""
    evaluate_every: int = 250
    """Steps between comparisons with the truth; weights and the state to resume from are written as often."""
    out: Path = Path("runs/train_generator")
    """Folder of the run; must not hold one yet."""
    resume: bool = False
    """Go on with the run in `out`, which must have the same configuration."""
    data: DataConfig = dataclasses.field(default_factory=DataConfig)
    """How many frames."""
    generator: GeneratorConfig = dataclasses.field(default_factory=GeneratorConfig)
    """Which generator."""
    training: GeneratorTrainingConfig = dataclasses.field(default_factory=GeneratorTrainingConfig)
    """How it is trained."""

    def __post_init__(self) -> None:
        """Refuses values that would fail only later."""
        if self.evaluate_every < 1:
            raise ValueError(f"evaluate_every={self.evaluate_every} must be at least 1")
        if self.minutes is not None and not self.minutes > 0:
            raise ValueError(f"minutes={self.minutes} must be positive")
        if self.training.mattes.steps and self.generator.kind == "paper":
            raise ValueError("generator.kind='paper' has no mattes to fit: pass --training.mattes.steps 0")


def run(
    config: GeneratorRunConfig, domain: Domain, *, near_goal: Frames, failed: Frames, held_out: Frames | None = None
) -> dict[str, float]:
    """Trains a generator, compares it with the truth, and writes everything into `config.out`.

    Args:
        config: what to do.
        domain: of what environment the frames are.

    Keyword Args:
        near_goal: ``pixels`` uint8 ``[N, H, W, C]``, ``pose`` and ``goal_pose`` ``[N, P]``.
        failed: ``pixels`` and ``pose`` of failed frames.
        held_out: ``pixels`` without a goal, ``pose``, ``goal_pose``, and ``truth``, the same images with the goal.
            Without them nothing is compared, and the metrics of the truth are NaN.

    Returns:
        The last metrics, by the names of ``COLUMNS``.

    Raises:
        FileExistsError: if the folder of the run already holds anything, unless it is resumed.
        FileNotFoundError: if there is nothing to resume.
        ValueError: if the frames do not fit the domain, or the run to resume has another configuration.
    """
    if held_out is not None:
        for name in ("pixels", "truth"):
            check_images(f"held_out[{name!r}]", held_out[name], domain.image_shape)
    folder, state = open_folder(config)
    torch.manual_seed(config.seed)  # initial weights
    generator = config.generator.make(
        image_shape=domain.image_shape, frame_stack=domain.frame_stack, pose_size=domain.poses.size
    )
    training = GeneratorTraining(
        generator,
        near_goal=near_goal,
        failed=failed,
        rng=torch.Generator().manual_seed(config.seed),
        config=config.training,
        poses=domain.poses,
        standardise=config.generator.standardise,
    )
    metrics = dict.fromkeys(COLUMNS, float("nan")) | {"seconds": 0.0}
    if state is not None:
        training.load_state_dict(state["training"])
        metrics = state["metrics"]
    for losses, seconds in steps(config, training, before=metrics["seconds"]):
        metrics |= losses
        if seconds is not None:
            metrics |= {"steps": training.steps, "seconds": seconds}
            kept = training.average
            if held_out is not None:
                metrics |= compare_with_truth(config, domain, kept, held_out, folder.file("hallucinations.png"))
            folder.write_metrics(metrics)
            save_weights(folder.file("generator.safetensors"), kept, make_manifest(config, domain, kept, metrics))
            save_state(folder.file(STATE), {"training": training.state_dict(), "metrics": metrics})
    return metrics


def prepare(config: GeneratorRunConfig) -> dict[str, Any] | None:
    """Refuses a folder that cannot be used, before any work is done; the first line of a recipe.

    Returns:
        The state of the run to resume, or None for a new run.

    Raises:
        FileExistsError: if the folder of the run already holds anything, unless it is resumed.
        FileNotFoundError: if there is nothing to resume.
        ValueError: if the run to resume has another configuration, or its state is damaged.
    """
    if not config.resume:
        check_unused(config.out)
        return None
    state = load_state(config.out / STATE)
    written = json.loads((config.out / "config.json").read_text())["config"]
    now = json.loads(as_json(dataclasses.asdict(config)))
    different = [name for name in now if name not in MAY_DIFFER and written.get(name) != now[name]]
    if different:
        raise ValueError(
            f"{config.out} cannot be resumed with other values of {', '.join(different)}: pass those of its config.json"
        )
    return state


def open_folder(config: GeneratorRunConfig) -> tuple[RunFolder, dict[str, Any] | None]:
    """Makes the folder of a run; or opens the one to resume, and reads its state.

    Metrics of steps after the state's are dropped: they are made again.
    """
    state = prepare(config)
    if state is None:
        folder = RunFolder(config.out, columns=COLUMNS)
        folder.write_config(dataclasses.asdict(config))
        return folder, None
    steps = state["training"]["steps"]
    return RunFolder.reopen(config.out, columns=COLUMNS, keep=lambda row: float(row["steps"]) <= steps), state


def steps(
    config: GeneratorRunConfig, training: GeneratorTraining, *, before: float
) -> Iterator[tuple[dict[str, float], float | None]]:
    """Makes the steps that are left, as long as there is time.

    Args:
        config: of the run.
        training: makes them.

    Keyword Args:
        before: seconds that the run took before it was resumed.

    Yields:
        The losses of each step, and, where it is to be evaluated, the seconds of the run so far.
    """
    started = time.perf_counter() - before
    total = config.training.steps
    with tqdm(total=total, initial=training.steps, unit="step", dynamic_ncols=True) as progress:
        over = training.steps == total
        while not over:
            losses = training.step()
            progress.update()
            seconds = time.perf_counter() - started
            over = training.steps == total or (config.minutes is not None and seconds > 60 * config.minutes)
            yield losses, seconds if over or training.steps % config.evaluate_every == 0 else None


def compare_with_truth(
    config: GeneratorRunConfig, domain: Domain, generator: HallucinationGenerator, held_out: Frames, picture: Path
) -> dict[str, float]:
    """Hallucinates at held-out poses; returns the comparison with the truth, and draws it."""
    painter = GeneratorHallucinator(generator, rng=torch.Generator().manual_seed(LATENT_SEED))
    rows: dict[str, Tensor] = {
        "failed": held_out["pixels"],
        "true goal": held_out["truth"],
        "hallucinated": paint_each(painter, held_out),
    }
    chosen = torch.linspace(0, len(held_out["pose"]) - 1, min(16, len(held_out["pose"]))).long()
    title = f"{domain.name}, seed {config.seed}: held-out poses"
    few = {label: frames[chosen] for label, frames in rows.items()}
    pictures.draw_frame_grid(picture, few, title=title, frame_stack=domain.frame_stack)
    found = fidelity.compare(*rows.values(), frame_stack=domain.frame_stack)
    return {f"truth/{name}": value for name, value in dataclasses.asdict(found).items()}


def make_manifest(
    config: GeneratorRunConfig, domain: Domain, generator: HallucinationGenerator, metrics: dict[str, float]
) -> dict[str, Any]:
    """Returns what has to be known to rebuild the generator, to trust it and to make it again."""
    return {
        "kind": config.generator.kind,
        "arguments": generator.arguments,
        **domain.fingerprint,
        "command": shlex.join(["python", *sys.argv]),
        "config": dataclasses.asdict(config),
        "metrics": metrics,
        "versions": versions(),
    }
