"""The folder envs is installed as halgan_envs: in a wheel, in a process of any folder, for type checkers too."""

import json
import os
import shutil
import site
import subprocess
import sys
import venv
from pathlib import Path

import pytest

import halgan_envs

ROOT = Path(__file__).parents[2]

USE = """
import json
import multiprocessing

import gymnasium
import halgan_envs


def look(seed):
    env = halgan_envs.make("pick-and-place-2m", seed=seed)
    pose = env.rollout(3)["next", "pose"]
    env.close()
    return list(pose.shape)


if __name__ == "__main__":
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        (spawned,) = pool.map(look, [3])
    found = dict(halgan_envs.domain("navigate-2m").fingerprint)
    registered = halgan_envs.gymnasium_id("pebble") in gymnasium.registry
    print(json.dumps(found | {"file": halgan_envs.__file__, "spawned": spawned, "registered": registered}))
"""


def test_the_folder_is_no_package_of_its_own_name():
    done = subprocess.run([sys.executable, "-c", "import envs"], cwd=ROOT, capture_output=True, text=True)
    assert (
        done.stderr.splitlines()[-1] == "ImportError: The folder envs is installed as halgan_envs: import halgan_envs."
    )


@pytest.fixture(scope="module")
def python(tmp_path_factory):
    """The Python of a fresh environment that holds the wheel, and borrows all other packages from this one."""
    sources, home = tmp_path_factory.mktemp("sources"), tmp_path_factory.mktemp("fresh")
    for name in ("envs", "halgan_rl"):
        shutil.copytree(ROOT / name, sources / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, sources)
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", home, sources], check=True)
    venv.create(home / "venv", with_pip=False)
    (packages,) = (home / "venv" / "lib").glob("python*/site-packages")
    (wheel,) = home.glob("*.whl")
    subprocess.run([*pip, "install", "--no-deps", "--no-index", "--target", packages, wheel], check=True)
    # A folder that a .pth file names is searched, and its own .pth files are not read: not the editable install here.
    (packages / "borrowed.pth").write_text("\n".join(site.getsitepackages()))
    return home / "venv" / "bin" / "python"


@pytest.mark.slow
def test_a_wheel_renders_the_same_images_in_spawned_processes_of_another_folder_too(python, tmp_path):
    (tmp_path / "use.py").write_text(USE)
    done = subprocess.run([python, "use.py"], cwd=tmp_path, capture_output=True, text=True)
    assert done.stderr == ""
    found = json.loads(done.stdout)
    assert Path(found.pop("file")).is_relative_to(python.parents[1])
    assert (found.pop("spawned"), found.pop("registered")) == ([3, 4], True)
    assert found == dict(halgan_envs.domain("navigate-2m").fingerprint)


@pytest.mark.slow
def test_a_wheel_holds_every_module_and_its_types(python, tmp_path):
    installed = next(python.parents[1].glob("lib/python*/site-packages/halgan_envs"))
    ours = {str(file.relative_to(ROOT / "envs")) for file in (ROOT / "envs").rglob("*.py")}
    assert {str(file.relative_to(installed)) for file in installed.rglob("*.py")} == ours
    (tmp_path / "use.py").write_text("import halgan_envs\nreveal_type(halgan_envs.make('navigate-2m').environment)\n")
    mypy = [sys.executable, "-m", "mypy", "--python-executable", python, "--follow-imports", "silent", "use.py"]
    environment = {**os.environ, "MYPY_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(mypy, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert 'note: Revealed type is "halgan_envs.environment.Environment"' in done.stdout
