"""Chooses the OpenGL backend that MuJoCo renders with.

Importing this module settles ``MUJOCO_GL``, then imports mujoco and dm_control, which read it once. Whoever imports
those two themselves should import this first.
"""

import contextlib
import importlib
import importlib.util
import os
import subprocess
import sys
import warnings
from collections.abc import Callable, Sequence

VARIABLE = "MUJOCO_GL"
"""The environment variable that mujoco and dm_control read."""

PLATFORM = "PYOPENGL_PLATFORM"
"""The environment variable by which PyOpenGL is held to one backend."""

DEVICE = "MUJOCO_EGL_DEVICE_ID"
"""The environment variable that chooses among EGL's devices."""

MESA_THREADS = "LP_NUM_THREADS"
"""The environment variable that says how many helper threads Mesa's software renderer starts."""

BACKENDS = ("egl", "osmesa", "glfw")
"""Backends that can be chosen, in the order in which they are tried."""

INSTALL_HINT = (
    "install a software renderer, for example `apt-get install libegl1 libgl1-mesa-dri` for MUJOCO_GL=egl "
    "or `apt-get install libosmesa6` for MUJOCO_GL=osmesa"
)

_PROBE = """
import mujoco
from dm_control import _render
gl = _render.Renderer(max_width=8, max_height=8)
with gl.make_current() as thread:
    context = thread.call(mujoco.MjrContext, mujoco.MjModel.from_xml_string("<mujoco/>"), 150)
    thread.call(context.free)
gl.free()
"""

_RENDERER = "dm_control._render"
"""The module that reads ``MUJOCO_GL``."""


def failure_of(backend: str, timeout: float = 60.0) -> str | None:
    """Makes a MuJoCo rendering context with a backend, in a fresh process.

    A process of its own, since a failed attempt leaves OpenGL bindings behind that spoil the next one. ``-P`` keeps
    the current folder off its path: a file ``mujoco.py`` there is not MuJoCo.

    Args:
        backend: A value for ``MUJOCO_GL``.
        timeout: Seconds after which the attempt counts as failed.

    Returns:
        None if the context is made, else the reason why it is not.
    """
    command = [sys.executable, "-P", "-c", _PROBE]
    environment = {**os.environ, VARIABLE: backend}
    try:
        probe = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=timeout)
    except subprocess.TimeoutExpired:
        return f"no context within {timeout:g} s"
    if probe.returncode == 0:
        return None
    lines = probe.stderr.strip().splitlines() or [f"the process ended with code {probe.returncode}"]
    return _readable(lines[-1])


def candidates() -> list[str]:
    """Returns the backends worth trying on this machine: a window system only where there is a display."""
    return [backend for backend in BACKENDS if backend != "glfw" or has_display()]


def has_display() -> bool:
    """Returns whether a window system is named in the environment."""
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def choose(backends: Sequence[str] | None = None, failure: Callable[[str], str | None] = failure_of) -> str:
    """Settles ``MUJOCO_GL`` for this process and its children.

    A value that is already set is kept, in lower case, for dm_control reads no other. Otherwise every candidate is
    tried by really making a context. Mesa's helper threads are switched off unless their number is set: handing them
    an image of 64x64 takes longer than drawing it.

    Args:
        backends: Backends to try in order; :func:`candidates` by default.
        failure: Returns why a backend makes no context, or None.

    Returns:
        The chosen backend.

    Raises:
        ValueError: if ``MUJOCO_GL`` is set to something that cannot render.
        RuntimeError: if no backend works.
    """
    os.environ.setdefault(MESA_THREADS, "0")
    preset = os.environ.get(VARIABLE, "").strip().lower()
    if preset:
        os.environ[VARIABLE] = _checked(preset)
        return preset
    reasons: dict[str, str] = {}
    for backend in candidates() if backends is None else backends:
        reason = failure(backend)
        if reason is None:
            os.environ[VARIABLE] = backend
            return backend
        reasons[backend] = reason
    tried = "; ".join(f"{backend}: {reason}" for backend, reason in reasons.items())
    raise RuntimeError(f"No OpenGL backend renders on this machine ({tried}): {_remedy(reasons)}.")


def broken(error: Exception) -> str:
    """Returns the message for a person whose backend does not work."""
    backend = os.environ.get(VARIABLE, "")
    reason = _readable(str(error) or type(error).__name__)
    return f"{VARIABLE}={backend} does not render on this machine ({reason}): {_remedy({backend: reason})}."


def check_loaded(failure: Callable[[str], str | None] = failure_of) -> None:
    """Refuses a backend that dm_control chose before this module was imported, unless it renders.

    dm_control chooses once, at its first import, and without ``MUJOCO_GL`` prefers windows even where no display is.

    Args:
        failure: Returns why a backend makes no context, or None.

    Raises:
        RuntimeError: if the backend of a loaded dm_control does not render here.
    """
    loaded = sys.modules.get(_RENDERER)
    if loaded is None or os.environ.get(VARIABLE, "").strip().lower() == loaded.BACKEND:
        return
    reason = failure(loaded.BACKEND) if loaded.BACKEND else "dm_control found none"
    if reason is not None:
        raise RuntimeError(
            f"dm_control was imported before halgan_envs and chose the OpenGL backend {loaded.BACKEND}, which does not "
            f"render on this machine ({reason}): import halgan_envs first, or set {VARIABLE} before Python starts."
        )
    os.environ[VARIABLE] = loaded.BACKEND


def _readable(reason: str) -> str:
    # In PyOpenGL a library that is not found is None.
    hint = " (PyOpenGL finds no such library)" if "'NoneType' object has no attribute" in reason else ""
    return reason.strip().rstrip(".") + hint


def _remedy(reasons: dict[str, str]) -> str:
    """Returns what mends backends that fail for these reasons: the variable that excludes them, else a package."""
    platform, device = os.environ.get(PLATFORM, ""), os.environ.get(DEVICE)
    if platform and any(PLATFORM in reason for reason in reasons.values()):
        return f"unset {PLATFORM}, now {platform!r}"
    if device is not None and _is_about_device(reasons.get("egl", "")):
        return f"unset {DEVICE}, now {device!r}: every device is then tried"
    return INSTALL_HINT


def _is_about_device(reason: str) -> bool:
    # Out of range; no number; or a device that refuses to start.
    return any(part in reason for part in (DEVICE, "invalid literal for int()", "headless EGL display"))


def _checked(preset: str) -> str:
    if preset not in BACKENDS:
        raise ValueError(
            f"{VARIABLE}={preset!r} cannot render images: unset it (a backend is then chosen) "
            f"or set it to one of {', '.join(BACKENDS)}."
        )
    if preset == "glfw" and sys.platform == "linux" and not has_display():
        raise ValueError(f"{VARIABLE}=glfw opens windows, and DISPLAY is not set: unset {VARIABLE}, and it is chosen.")
    return preset


def _load() -> None:
    # A backend whose library is missing fails here, with errors that name neither it nor the remedy.
    try:
        importlib.import_module("mujoco")
        importlib.import_module(_RENDERER)
    except Exception as error:
        raise RuntimeError(broken(error)) from error
    # At its first import composer shows every DeprecationWarning from then on, whatever filters the user set.
    with warnings.catch_warnings():
        importlib.import_module("dm_control.composer")


def _load_triton() -> None:
    # Triton and Mesa each bring an LLVM. A process in which Mesa makes a context before libtriton is loaded dies of a
    # segmentation fault, so a Triton that is installed (PyPI's torch for CUDA brings it) is loaded first.
    if importlib.util.find_spec("triton") is not None:
        with contextlib.suppress(ImportError):  # A Triton that cannot be loaded cannot clash either.
            importlib.import_module("triton")


check_loaded()
choose()
_load_triton()
_load()
