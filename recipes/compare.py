"""Draw the learning curves of several runs in one picture.

Usage::

    python recipes/compare.py --curves results/navigate-2m/*.csv --out results/navigate-2m.png --title "2 m room"

Each CSV is a run's ``metrics.csv``, renamed ``METHOD-seedN.csv``: runs of one method share a colour, and their mean is
drawn bold.
"""

import dataclasses
from pathlib import Path

import tyro

from halgan_rl.experiment import pictures
from halgan_rl.experiment.run_folder import read_metrics


@dataclasses.dataclass(frozen=True)
class Config:
    """Draw the learning curves of several runs in one picture."""

    curves: tuple[Path, ...]
    """Metrics of the runs, named METHOD-seedN.csv."""
    out: Path
    """The PNG to write."""
    title: str = ""
    """Heading of the picture."""
    column: str = "eval/success_rate"
    """What to draw over frames."""


def main(config: Config) -> None:
    """Group the runs by method and draw them."""
    methods: dict[str, list[pictures.Curve]] = {}
    for path in sorted(config.curves):
        methods.setdefault(path.stem.rsplit("-seed", 1)[0], []).append(read_metrics(path))
    pictures.draw_learning_curves(config.out, methods, title=config.title, column=config.column)


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
