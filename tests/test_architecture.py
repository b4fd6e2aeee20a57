"""The rooms of the house, and which may import which."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import halgan_rl

ROOT = Path(__file__).parent.parent
BASE = {"poses", "keys"}
MIDDLE = {"replay", "hallucination", "agents"}
ARROWS: dict[str, set[str]] = {
    "quiet_imports": set(),
    "poses": set(),
    "keys": set(),
    "transforms": BASE,
    "replay": {"keys"},
    "hallucination": {*BASE, "transforms"},
    "agents": {*BASE, "transforms"},
    "training": {*BASE, "transforms", *MIDDLE},
    "experiment": {*BASE, "transforms", *MIDDLE, "training"},
}
"""What each room may import besides itself."""
SIMULATORS = {"halgan_envs", "envs", "mujoco", "dm_control", "gymnasium"}


def files_of(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def imports_of(path: Path) -> Iterator[str]:
    """Yields the full name of each module, or of each name in a module, that a file imports; relative ones dotted."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{'.' * node.level}{node.module or ''}.{alias.name}" for alias in node.names)


def room_of(path: Path) -> str:
    return path.relative_to(ROOT / "halgan_rl").parts[0].removesuffix(".py")


LIBRARY = [path for path in files_of("halgan_rl") if path.name != "__init__.py" or path.parent.name != "halgan_rl"]


def test_the_house_has_these_rooms_and_no_others() -> None:
    assert {room_of(path) for path in LIBRARY} == set(ARROWS)


@pytest.mark.parametrize("room", ARROWS)
def test_import_arrows_point_down_only(room: str) -> None:
    allowed = ARROWS[room] | {room}
    for path in (each for each in LIBRARY if room_of(each) == room):
        for name in imports_of(path):
            if name.split(".")[0] == "halgan_rl":
                assert name.split(".")[1] in allowed, f"{path.relative_to(ROOT)} imports {name}"


def test_the_library_imports_absolutely() -> None:
    assert not [(path, name) for path in files_of("halgan_rl") for name in imports_of(path) if name.startswith(".")]


def test_the_library_knows_no_simulator() -> None:
    found = [(path, name) for path in files_of("halgan_rl") for name in imports_of(path)]
    assert not [(path, name) for path, name in found if name.split(".")[0] in SIMULATORS]


def test_environments_know_of_the_library_only_how_to_describe_themselves() -> None:
    allowed = ("halgan_rl.experiment.domain.", "halgan_rl.poses.", "halgan_rl.keys.")
    names = {name for path in files_of("envs") for name in imports_of(path) if name.split(".")[0] == "halgan_rl"}
    assert not [name for name in names if not name.startswith(allowed)]


def test_environments_import_one_another_relatively() -> None:
    names = {name for path in files_of("envs") for name in imports_of(path)}
    assert not [name for name in names if name.split(".")[0] in {"envs", "halgan_envs"}]


def test_importing_the_library_imports_no_environments() -> None:
    code = "import sys, halgan_rl; print([name for name in ('halgan_envs', 'dm_control') if name in sys.modules])"
    result = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines()[-1] == "[]"


def test_the_names_of_the_face_are_there_and_no_others() -> None:
    public = {name for name in vars(halgan_rl) if not name.startswith("_") and name not in {*ARROWS, "halgan_rl"}}
    assert public == set(halgan_rl.__all__)
    assert len(public) < 20
