"""The folder that a run writes: configuration, metrics, pictures, weights."""

import csv
import json
import os
import re
import shlex
import sys
from importlib.metadata import requires, version
from pathlib import Path
from typing import Any


class RunFolder:
    """A fresh folder for one run.

    Args:
        path: where to; created with its parents.
        columns: columns of ``metrics.csv``, in order.

    Raises:
        FileExistsError: if the folder already holds anything, before any work is done.
    """

    def __init__(self, path: Path, *, columns: tuple[str, ...]) -> None:
        check_unused(path)
        path.mkdir(parents=True, exist_ok=True)
        self.path = path
        self.columns = columns
        with self.file("metrics.csv").open("w", newline="") as file:
            csv.writer(file).writerow(columns)

    def file(self, name: str) -> Path:
        """Returns the path of a file in the folder."""
        return self.path / name

    def write_config(self, config: dict[str, Any]) -> None:
        """Writes ``config.json``: the configuration, the command line and the versions it ran with."""
        write_json(
            self.file("config.json"),
            {"config": config, "command": shlex.join(sys.argv), "versions": versions()},
        )

    def write_metrics(self, row: dict[str, float]) -> None:
        """Appends one row to ``metrics.csv``; it is on disk when this returns.

        Raises:
            KeyError: if a column is missing from the row.
        """
        with self.file("metrics.csv").open("a", newline="") as file:
            csv.writer(file).writerow([_written(row[column]) for column in self.columns])


def _written(value: float) -> str:
    """Whole numbers keep all their digits, others six of them."""
    return str(value) if isinstance(value, int) else f"{value:.6g}"


def check_unused(path: Path) -> None:
    """Raises FileExistsError if the folder already holds anything."""
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise FileExistsError(f"{path} already holds a run; choose another --out, or remove it first")


def versions() -> dict[str, str]:
    """Returns the versions of Python, of this library and of everything it declares to need."""
    needed = [re.split(r"[^\w.-]", line)[0] for line in requires("halgan-rl") or [] if "extra ==" not in line]
    return {"python": sys.version.split()[0]} | {name: version(name) for name in ("halgan-rl", *needed)}


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Writes a JSON file atomically: a reader never meets a partial one."""
    temporary = path.with_name(path.name + ".partial")
    temporary.write_text(json.dumps(content, indent=2, default=str) + "\n")
    os.replace(temporary, path)


def read_metrics(path: Path) -> dict[str, list[float]]:
    """Reads a ``metrics.csv`` as one list of floats a column."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {column: [float(row[column]) for row in rows] for column in rows[0]} if rows else {}
