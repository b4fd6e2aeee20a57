"""Reads what a user fixes of an episode's start."""

from collections.abc import Mapping
from typing import Any

import numpy as np


def read_start(start: Mapping[str, Any], entries: Mapping[str, tuple[str, ...]]) -> dict[str, np.ndarray]:
    """Reads named vectors.

    Args:
        start: What is fixed: any of the names in ``entries``, each with its numbers; one may be a bare number.
        entries: The task's names, each with what its entries mean.

    Returns:
        The vectors of ``start``, float64.

    Raises:
        ValueError: if a name is unknown, or a vector has the wrong length or an entry that is no finite number.

    >>> read_start({"box": (0.5, 1)}, {"pose": ("x [m]", "y [m]", "yaw [rad]"), "box": ("x [m]", "y [m]")})
    {'box': array([0.5, 1. ])}
    """
    unknown = [name for name in start if name not in entries]
    if unknown:
        raise ValueError(f"Unknown start option {unknown[0]!r}: choose among {', '.join(entries)}.")
    return {name: _vector(name, value, entries[name]) for name, value in start.items()}


def _vector(name: str, value: Any, entries: tuple[str, ...]) -> np.ndarray:
    try:
        vector = np.atleast_1d(np.array(value, np.float64))
    except (TypeError, ValueError):
        vector = np.array(np.nan)
    if vector.shape != (len(entries),) or not np.isfinite(vector).all():
        raise ValueError(f"{name}={value!r} must be {_count(entries)}, {', '.join(entries)}; leave it out to draw it.")
    return vector


def _count(entries: tuple[str, ...]) -> str:
    return "one finite number" if len(entries) == 1 else f"{len(entries)} finite numbers"
