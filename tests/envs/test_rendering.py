import os
import subprocess
import sys

import numpy as np
import pytest
from halgan_envs.rendering import gl_backend
from halgan_envs.rendering.persistent_camera import PersistentCamera


def run_python(code, **variables):
    return subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, **variables}, capture_output=True, text=True, timeout=120
    )


@pytest.mark.parametrize("closing", ["", "env.close(); camera.close()"])
def test_a_process_ends_quietly(closing):
    done = run_python(
        "import halgan_envs; env = halgan_envs.make('navigate-2m', seed=0); env.rollout(3); env.render_overview();"
        f"camera = env.robot.camera; other = halgan_envs.GoalRenderer('navigate-2m'); {closing}"
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_an_unknown_backend_is_refused_before_any_work():
    done = run_python("import halgan_envs", MUJOCO_GL="vulkan")
    assert done.returncode != 0
    assert "MUJOCO_GL='vulkan' cannot render images: unset it" in done.stderr.splitlines()[-1]


def test_a_backend_that_is_not_installed_says_what_to_install():
    done = run_python(
        "import halgan_envs; halgan_envs.make('navigate-2m')", MUJOCO_GL="osmesa", PYOPENGL_PLATFORM="osmesa"
    )
    if done.returncode == 0:
        pytest.skip("OSMesa is installed here.")
    assert "apt-get install" in done.stderr.splitlines()[-1]


def test_without_any_backend_the_error_names_what_to_install(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    with pytest.raises(RuntimeError, match=r"tried egl, osmesa.*apt-get install libegl1 libgl1-mesa-dri"):
        gl_backend.choose(["egl", "osmesa"], works=lambda backend: False)


def test_the_first_backend_that_works_is_chosen_for_children_too(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "")
    assert gl_backend.choose(["egl", "osmesa", "glfw"], works=lambda backend: backend == "osmesa") == "osmesa"
    assert os.environ["MUJOCO_GL"] == "osmesa"


def test_a_backend_that_is_set_is_kept(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "OSMesa")
    assert gl_backend.choose(["egl"], works=lambda backend: True) == "osmesa"


def test_glfw_is_tried_only_with_a_display(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    assert "glfw" not in gl_backend.candidates()
    monkeypatch.setenv("DISPLAY", ":0")
    assert gl_backend.candidates()[-1] == "glfw"


def test_the_probe_really_makes_a_context():
    assert gl_backend.makes_context(os.environ["MUJOCO_GL"])
    assert not gl_backend.makes_context("vulkan")


def test_images_are_upright(stage):
    stage.place((-0.5, 0.0, 0.0))
    image = stage.robot.camera.render(stage.physics).astype(int)
    wall, floor = image[2].mean(axis=0), image[-2].mean(axis=0)
    assert wall[2] > wall[0]  # The bluish wall is above,
    assert abs(floor[2] - floor[0]) < 25  # the grey floor below.


def test_left_is_left(stage):
    stage.place((0.0, 0.0, 0.0), box=(0.4, 0.1))
    image = stage.robot.camera.render(stage.physics).astype(int)
    columns = ((image[..., 0] > 100) & (image[..., 1] < 60)).any(axis=0).nonzero()[0]
    assert 0 < columns.max() < 32


def test_it_agrees_with_dm_control_s_own_renderer(stage):
    """Within the difference that a slower renderer with shadows off and anti-aliasing makes at edges."""
    stage.place((-0.3, 0.2, -0.5), box=(0.1, 0.0))
    ours = stage.robot.camera.render(stage.physics).astype(int)
    stock = stage.physics.render(64, 64, camera_id="rover/egocentric").astype(int)
    assert np.abs(ours - stock).mean() < 3


def test_an_unknown_camera_lists_the_known_ones(stage):
    with pytest.raises(ValueError, match=r"'nose'.*rover/egocentric"):
        PersistentCamera(stage.physics, "nose")
