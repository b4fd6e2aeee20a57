"""Pictures of a run: learning curves, the agent at work, hallucinations beside the truth."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

Curve = Mapping[str, Sequence[float]]


def draw_learning_curves(
    path: Path, methods: Mapping[str, Sequence[Curve]], *, title: str, column: str = "eval/success_rate"
) -> None:
    """Draws one column of the runs' metrics over frames; runs of one method share a colour, their mean is bold.

    Args:
        path: the PNG to write.
        methods: for each method its runs, each the columns of a ``metrics.csv``; ``frames`` and ``column`` are drawn.
        title: heading of the picture.
        column: a rate in [0, 1].
    """
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    for index, (method, runs) in enumerate(methods.items()):
        for run in runs:
            axes.plot(run["frames"], run[column], color=f"C{index}", alpha=0.35 if len(runs) > 1 else 1.0)
        length = min(len(run["frames"]) for run in runs)
        mean = np.mean([run[column][:length] for run in runs], axis=0)
        label = f"{method} ({len(runs)} seeds)" if len(runs) > 1 else method
        axes.plot(runs[0]["frames"][:length], mean, color=f"C{index}", linewidth=2.5, label=label)
    axes.set(title=title, xlabel="environment frames", ylabel=column, ylim=(-0.03, 1.03))
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=120)


def draw_frame_grid(path: Path, rows: Mapping[str, Tensor], *, title: str, frame_stack: int = 1) -> None:
    """Draws labelled rows of frames.

    Args:
        path: the PNG to write.
        rows: for each label, frames ``[N, H, W, C]`` uint8; all rows have the same N.
        title: heading of the picture.
        frame_stack: frames stacked along C, of which the last is shown.
    """
    columns = len(next(iter(rows.values())))
    figure = Figure(figsize=(1.1 * columns + 1.2, 1.2 * len(rows) + 0.4), layout="constrained")
    figure.suptitle(title, fontsize=10)
    grid = figure.subplots(len(rows), columns, squeeze=False)
    for axes_row, (label, frames) in zip(grid, rows.items(), strict=True):
        axes_row[0].set_ylabel(label, rotation=0, ha="right", va="center", fontsize=9)
        for axes, frame in zip(axes_row, frames, strict=True):
            axes.imshow(_shown(frame, frame_stack), interpolation="nearest", cmap="gray", vmin=0, vmax=255)
            axes.set(xticks=[], yticks=[])
    figure.savefig(path, dpi=120)


def _shown(frame: Tensor, frame_stack: int) -> np.ndarray:
    """The last of the frames stacked in ``[H, W, C]``: ``[H, W, 3]``, or ``[H, W]`` if it is grey."""
    channels = frame.shape[-1] // frame_stack
    return frame[..., -channels:].squeeze(-1).numpy()


def write_gif(path: Path, frames: Sequence[np.ndarray], *, frames_per_second: float = 20.0) -> None:
    """Writes frames ``[H, W, 3]`` uint8 as an endlessly looping GIF."""
    iio.imwrite(path, np.stack(list(frames)), extension=".gif", duration=1000.0 / frames_per_second, loop=0)
