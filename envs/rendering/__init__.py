"""The persistent camera, its OpenGL backend, and the fingerprint of its images."""

from . import gl_backend  # settles the backend before anything imports mujoco

__all__ = ["gl_backend"]
