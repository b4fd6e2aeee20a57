"""The folder that a run writes: configuration, metrics, pictures, weights."""

import csv
import json
import os
import re
import shlex
import sys
from collections.abc import Callable
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

    @classmethod
    def reopen(cls, path: Path, *, columns: tuple[str, ...], keep: Callable[[dict[str, str]], bool]) -> "RunFolder":
        """Returns the folder of an earlier run, to go on in.

        Args:
            path: of the folder.
            columns: of its ``metrics.csv``.
            keep: which rows of it to keep.

        Raises:
            ValueError: if ``metrics.csv`` has other columns.
        """
        folder = cls.__new__(cls)
        folder.path, folder.columns = path, columns
        with folder.file("metrics.csv").open(newline="") as file:
            reader = csv.DictReader(file)
            rows = [row for row in reader if keep(row)]
        if tuple(reader.fieldnames or ()) != columns:
            raise ValueError(f"{folder.file('metrics.csv')} has other columns: it was written by another version")
        temporary = folder.file("metrics.csv.partial")
        with temporary.open("w", newline="") as file:
            writer = csv.DictWriter(file, columns)
            writer.writeheader()
            writer.writerows(rows)
        os.replace(temporary, folder.file("metrics.csv"))
        return folder

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
    temporary.write_text(as_json(content))
    os.replace(temporary, path)


def as_json(content: dict[str, Any]) -> str:
    """Returns the text of a JSON file; what JSON does not know, such as paths, becomes strings."""
    return json.dumps(content, indent=2, default=str) + "\n"


def read_metrics(path: Path) -> dict[str, list[float]]:
    """Reads a ``metrics.csv`` as one list of floats a column."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {column: [float(row[column]) for row in rows] for column in rows[0]} if rows else {}
