"""Importing the packages shows no warning of others' making, and leaves the user's warning filters as they are."""

import subprocess
import sys

IMPORT = "import {}, warnings; from torchrl.collectors import Collector; "
USER_MODULE = """
code = compile("warnings.warn('mine', DeprecationWarning)", "user_module.py", "exec")
exec(code, {"__name__": "user_module", "warnings": warnings})
"""


def python(code, *options):
    return subprocess.run([sys.executable, *options, "-c", code], capture_output=True, text=True, timeout=120)


def test_a_user_who_turns_deprecations_into_errors_can_import_and_gets_them_for_own_code():
    done = python(IMPORT.format("halgan_envs") + USER_MODULE, "-W", "error::DeprecationWarning")
    assert done.stderr.splitlines()[-1] == "DeprecationWarning: mine"
    assert "user_module.py" in done.stderr


def test_deprecations_that_python_hides_stay_hidden_after_the_import_and_it_is_silent():
    done = python(IMPORT.format("halgan_envs") + USER_MODULE)
    assert (done.returncode, done.stderr) == (0, "")


def test_torchrl_still_warns_of_a_subclass_of_the_user():
    derive = "from torchrl.collectors import WeightUpdaterBase\nclass Mine(WeightUpdaterBase): pass"
    done = python(IMPORT.format("halgan_rl") + derive, "-W", "default::DeprecationWarning")
    assert done.stderr.count("DeprecationWarning") == done.stderr.count("Creating Mine which inherits") == 1
