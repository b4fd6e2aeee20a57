"""The OpenGL backend: chosen by trying, and where none renders, the error holds the true reason and the true remedy."""

import os
import subprocess
import sys

import pytest

from halgan_envs.rendering import gl_backend

RENDER = "import halgan_envs; env = halgan_envs.make('navigate-2m', seed=0); env.reset(); env.close()"


def run_python(code, cwd=None, **variables):
    """Runs code in a fresh process, in which of the variables about OpenGL only those given are set."""
    ours = (gl_backend.VARIABLE, gl_backend.PLATFORM, gl_backend.DEVICE, "DISPLAY", "WAYLAND_DISPLAY")
    environment = {name: value for name, value in os.environ.items() if name not in ours}
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=cwd, env={**environment, **variables}, capture_output=True, text=True, timeout=120,
    )  # fmt: skip


def error_of(code, **variables):
    """Returns the last line of what a process writes that must fail."""
    done = run_python(code, **variables)
    assert done.returncode != 0
    return done.stderr.splitlines()[-1]


def test_a_process_that_closes_nothing_ends_quietly():
    done = run_python(
        "import halgan_envs; env = halgan_envs.make('navigate-2m', seed=0); env.rollout(3); env.render_overview();"
        "camera = env.robot.camera; other = halgan_envs.domain('navigate-2m').goal_renderer()"
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_an_unknown_backend_is_refused_before_any_work():
    error = error_of("import halgan_envs", MUJOCO_GL="vulkan")
    assert "MUJOCO_GL='vulkan' cannot render images: unset it" in error


def test_a_backend_that_is_not_installed_says_what_to_install():
    done = run_python(RENDER, MUJOCO_GL="osmesa", PYOPENGL_PLATFORM="osmesa")
    if done.returncode == 0:
        pytest.skip("OSMesa is installed here.")
    assert "finds no such library" in done.stderr.splitlines()[-1]
    assert "apt-get install" in done.stderr.splitlines()[-1]


def test_a_backend_in_capitals_is_that_backend_and_a_process_that_closes_all_ends_quietly():
    done = run_python(f"{RENDER}; import os; print(os.environ['MUJOCO_GL'])", MUJOCO_GL="EGL")
    assert (done.returncode, done.stdout, done.stderr) == (0, "egl\n", "")


@pytest.mark.parametrize("platform", ["glx", "nonsense"])
@pytest.mark.parametrize("preset", [{}, {"MUJOCO_GL": "egl"}], ids=["to be chosen", "egl"])
def test_a_platform_of_pyopengl_that_excludes_egl_is_quoted_and_is_to_be_unset(platform, preset):
    error = error_of(RENDER, PYOPENGL_PLATFORM=platform, **preset)
    assert f"PYOPENGL_PLATFORM environment variable is set to '{platform}'" in error
    assert error.endswith(f"unset PYOPENGL_PLATFORM, now '{platform}'.")


def test_osmesa_as_platform_of_pyopengl_renders_or_is_to_be_unset():
    done = run_python(RENDER, PYOPENGL_PLATFORM="osmesa")
    if done.returncode == 0:
        pytest.skip("OSMesa is installed here.")
    error = done.stderr.splitlines()[-1]
    assert "PYOPENGL_PLATFORM environment variable is set to 'osmesa'" in error
    assert error.endswith("unset PYOPENGL_PLATFORM, now 'osmesa'.")


@pytest.mark.parametrize(
    ("device", "reason"), [("77", "MUJOCO_EGL_DEVICE_ID must be an integer between 0 and"), ("gpu", "base 10: 'gpu'")]
)
def test_a_wrong_egl_device_is_quoted_and_is_to_be_unset(device, reason):
    for preset in ({}, {"MUJOCO_GL": "egl"}):
        error = error_of(RENDER, MUJOCO_EGL_DEVICE_ID=device, **preset)
        assert reason in error
        assert error.endswith(f"unset MUJOCO_EGL_DEVICE_ID, now '{device}': every device is then tried.")


def test_windows_without_a_display_are_the_reason_and_not_a_missing_package():
    error = error_of("import halgan_envs", MUJOCO_GL="glfw")
    assert error.endswith("opens windows, and DISPLAY is not set: unset MUJOCO_GL, and it is chosen.")


def test_dm_control_imported_first_without_a_display_says_to_import_it_later():
    error = error_of(f"from dm_control import composer; {RENDER}")
    assert "dm_control was imported before halgan_envs and chose the OpenGL backend glfw" in error
    assert error.endswith("import halgan_envs first, or set MUJOCO_GL before Python starts.")


def test_dm_control_and_mujoco_imported_first_do_no_harm_where_the_backend_renders():
    done = run_python(f"import dm_control.composer, mujoco; {RENDER}", MUJOCO_GL=os.environ["MUJOCO_GL"])
    assert done.returncode == 0


def test_a_loaded_backend_that_renders_is_kept_for_children_too(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL")
    gl_backend.check_loaded(failure=lambda backend: None)
    assert os.environ["MUJOCO_GL"] == sys.modules["dm_control._render"].BACKEND


def test_without_any_backend_the_error_names_each_reason_and_what_to_install(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    pattern = r"\(egl: no egl here; osmesa: no osmesa here\): .*apt-get install libegl1 libgl1-mesa-dri"
    with pytest.raises(RuntimeError, match=pattern):
        gl_backend.choose(["egl", "osmesa"], failure=lambda backend: f"no {backend} here")


def test_the_first_backend_that_works_is_chosen_for_children_too(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "")
    chosen = gl_backend.choose(["egl", "osmesa", "glfw"], failure={"egl": "no", "osmesa": None}.get)
    assert chosen == os.environ["MUJOCO_GL"] == "osmesa"


def test_a_backend_that_is_set_is_kept_in_lower_case(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "OSMesa")
    assert gl_backend.choose(["egl"], failure=lambda backend: None) == os.environ["MUJOCO_GL"] == "osmesa"


def test_glfw_is_tried_only_with_a_display(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert "glfw" not in gl_backend.candidates()
    monkeypatch.setenv("DISPLAY", ":0")
    assert gl_backend.candidates()[-1] == "glfw"


def test_the_probe_really_makes_a_context():
    assert gl_backend.failure_of(os.environ["MUJOCO_GL"]) is None
    assert "MUJOCO_GL" in gl_backend.failure_of("vulkan")


def test_a_probe_that_hangs_is_ended():
    assert gl_backend.failure_of(os.environ["MUJOCO_GL"], timeout=0.01) == "no context within 0.01 s"


def test_the_probe_runs_no_file_of_the_current_folder(tmp_path, monkeypatch):
    ran = tmp_path / "ran"
    for module in ("mujoco", "dm_control"):
        (tmp_path / f"{module}.py").write_text(f"open({str(ran)!r}, 'w')")
    monkeypatch.chdir(tmp_path)
    assert gl_backend.failure_of(os.environ["MUJOCO_GL"]) is None
    assert not ran.exists()


def test_the_probe_finds_packages_of_the_python_path(tmp_path, monkeypatch):
    (tmp_path / "mujoco.py").write_text("raise RuntimeError('found on the path')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert gl_backend.failure_of(os.environ["MUJOCO_GL"]) == "RuntimeError: found on the path"


def test_triton_is_loaded_before_mujoco_where_it_is_installed(tmp_path):
    (tmp_path / "triton.py").write_text("import sys; sys.exit('mujoco' in sys.modules)")
    done = run_python("import halgan_envs; sys.exit('not loaded')", PYTHONPATH=str(tmp_path), MUJOCO_GL="egl")
    assert (done.returncode, done.stderr) == (0, "")
