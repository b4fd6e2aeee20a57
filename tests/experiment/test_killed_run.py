"""A run that is killed leaves no process, and a folder that can be read."""

import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from halgan_rl.experiment.policy import load_policy
from halgan_rl.experiment.run_folder import read_metrics
from tests.training.test_lifeline import PATIENCE, ROOT, running


def test_a_run_killed_amid_its_evaluations_leaves_no_process_and_no_partial_file(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    command = [sys.executable, "-m", "tests.experiment.mortal_run", str(folder)]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    with (
        (tmp_path / "stderr").open("w") as stderr,
        subprocess.Popen(command, stderr=stderr, env=environment, start_new_session=True) as parent,
    ):
        try:
            while not (folder / "metrics.csv").exists() or len(read_metrics(folder / "metrics.csv")) == 0:
                assert parent.poll() is None, (tmp_path / "stderr").read_text()
                time.sleep(0.05)
            parent.kill()
            deadline = time.monotonic() + PATIENCE
            while running(parent.pid) and time.monotonic() < deadline:
                time.sleep(0.1)
            assert not running(parent.pid)
        finally:
            for pid in running(parent.pid):
                os.kill(pid, signal.SIGKILL)
    metrics = read_metrics(folder / "metrics.csv")
    assert metrics["frames"][0] == 80
    assert all(math.isfinite(value) for value in metrics["eval/success_rate"])
    assert json.loads((folder / "config.json").read_text())["config"]["method"] == "her"
    policy, manifest = load_policy(folder / "policy.safetensors")
    assert manifest["environment"] == "room"
    assert policy.out_keys
