"""Whatever ends a training, its child processes end within seconds."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PATIENCE = 10.0
"""How long all processes may take to end [s]."""
OTHER_MOMENTS = ("starting", "collecting", "shutting down", "without cleaning up")
"""Moments that the quick suite leaves out."""


def press_control_c_twice(parent: int) -> None:
    """Does what a terminal does: all processes of the group get the signal."""
    os.killpg(parent, signal.SIGINT)
    time.sleep(0.1)
    if running(parent):
        os.killpg(parent, signal.SIGINT)


def terminate(parent: int) -> None:
    os.kill(parent, signal.SIGTERM)


def kill(parent: int) -> None:
    os.kill(parent, signal.SIGKILL)


@pytest.mark.parametrize(
    ("moment", "end"),
    [
        ("updating", press_control_c_twice),
        ("updating", terminate),
        ("collecting", kill),
        *(pytest.param(moment, press_control_c_twice, marks=pytest.mark.slow) for moment in OTHER_MOMENTS),
    ],
    ids=lambda value: value if isinstance(value, str) else value.__name__,
)
def test_no_process_outlives_a_training_by_more_than_seconds(moment: str, end: object) -> None:
    command = [sys.executable, "-m", "tests.training.mortal_training", moment]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, start_new_session=True
    ) as parent:
        try:
            said = parent.stdout.readline()
            assert said.strip() == moment, parent.stderr.read()
            assert len(running(parent.pid)) > 1
            end(parent.pid)
            deadline = time.monotonic() + PATIENCE
            while running(parent.pid) and time.monotonic() < deadline:
                time.sleep(0.1)
            assert not running(parent.pid)
        finally:
            for pid in running(parent.pid):
                os.kill(pid, signal.SIGKILL)


def running(session: int) -> list[int]:
    """Returns the processes of a session that have not ended."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, its_session = stat.read_text().rsplit(")", 1)[1].split()[:4]
        except OSError:  # it has just gone
            continue
        if int(its_session) == session and state != "Z":
            found.append(int(stat.parent.name))
    return found
