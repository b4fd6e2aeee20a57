"""Tables: printed, and saved without a trace of who ran them."""

import dataclasses
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from halgan_rl.experiment.run_folder import versions

RESULTS = Path(__file__).parent / "results"


@dataclasses.dataclass(frozen=True)
class Table:
    """A table of numbers.

    Attributes:
        title: What was measured, and how.
        header: Names of the columns, with units.
        rows: Cells, as they are to be read.
    """

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]

    def __str__(self) -> str:
        """Return the table in Markdown."""
        cells = [self.header, ["---"] * len(self.header), *self.rows]
        return "\n".join([self.title, "", *("| " + " | ".join(row) + " |" for row in cells)])


def report(name: str, tables: Sequence[Table], folder: Path = RESULTS) -> None:
    """Print tables, and save them as ``folder/name.json`` with the machine and the versions they were measured on."""
    print("\n\n".join(str(table) for table in tables), end="\n\n")
    content = {"machine": machine(), "tables": [dataclasses.asdict(table) for table in tables]}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.json").write_text(json.dumps(content, indent=1) + "\n")


def machine() -> dict[str, Any]:
    """Return how many processors there are, and the versions of Python and of what was measured."""
    shown = {name: version for name, version in versions().items() if name in ("python", "torch", "torchrl")}
    return {"cpus": os.cpu_count()} | shown
