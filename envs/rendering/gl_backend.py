"""Chooses the OpenGL backend that MuJoCo renders with.

Importing this module settles ``MUJOCO_GL``, then imports mujoco and dm_control's renderer, which read it once. Whoever
imports those two themselves should import this first.
"""

import importlib
import os
import subprocess
import sys
from collections.abc import Callable, Sequence

VARIABLE = "MUJOCO_GL"
"""The environment variable that mujoco and dm_control read."""

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


def makes_context(backend: str, timeout: float = 60.0) -> bool:
    """Whether a fresh process makes a MuJoCo rendering context with a backend.

    A process of its own, since a failed attempt leaves OpenGL bindings behind that spoil the next one.

    Args:
        backend: A value for ``MUJOCO_GL``.
        timeout: Seconds after which the attempt counts as failed.
    """
    environment = {**os.environ, VARIABLE: backend}
    try:
        probe = subprocess.run([sys.executable, "-c", _PROBE], env=environment, capture_output=True, timeout=timeout)
    except subprocess.TimeoutExpired:
        return False
    return probe.returncode == 0


def candidates() -> list[str]:
    """Backends worth trying on this machine: a window system only where there is a display."""
    return [backend for backend in BACKENDS if backend != "glfw" or os.environ.get("DISPLAY")]


def choose(backends: Sequence[str] | None = None, works: Callable[[str], bool] = makes_context) -> str:
    """Settles ``MUJOCO_GL`` for this process and its children.

    A value that is already set is kept. Otherwise every candidate is tried by really making a context. Mesa's helper
    threads are switched off unless asked for: handing them an image of 64x64 takes longer than drawing it.

    Args:
        backends: Backends to try in order; :func:`candidates` by default.
        works: Tells whether a backend makes a context.

    Returns:
        The chosen backend.

    Raises:
        ValueError: if ``MUJOCO_GL`` is set to something that cannot render.
        RuntimeError: if no backend works.
    """
    os.environ.setdefault(MESA_THREADS, "0")
    preset = os.environ.get(VARIABLE, "").strip().lower()
    if preset:
        return _checked(preset)
    tried = candidates() if backends is None else list(backends)
    for backend in tried:
        if works(backend):
            os.environ[VARIABLE] = backend
            return backend
    raise RuntimeError(f"No OpenGL backend renders on this machine (tried {', '.join(tried)}): {INSTALL_HINT}.")


def broken(error: Exception) -> str:
    """What to tell a person whose backend does not work."""
    return f"{VARIABLE}={os.environ.get(VARIABLE)} does not render on this machine ({error}): {INSTALL_HINT}."


def _checked(preset: str) -> str:
    if preset not in BACKENDS:
        raise ValueError(
            f"{VARIABLE}={preset!r} cannot render images: unset it (a backend is then chosen) "
            f"or set it to one of {', '.join(BACKENDS)}."
        )
    return preset


def _load() -> None:
    # A backend whose library is missing fails here, with errors that name neither it nor the remedy.
    try:
        importlib.import_module("mujoco")
        importlib.import_module("dm_control._render")
    except Exception as error:
        raise RuntimeError(broken(error)) from error


choose()
_load()
