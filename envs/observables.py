"""Composer observables of the persistent camera and of the pose."""

from collections.abc import Callable
from typing import Any

import numpy as np
from dm_control.composer.observation import observable
from dm_env import specs


class KnownSpec(observable.Observable):
    """An observable whose spec is known beforehand, so that composer takes no extra observation at each reset.

    Args:
        read: Maps a physics to a fresh array.
        spec: Shape, dtype and bounds of that array.
    """

    def __init__(self, read: Callable[[Any], np.ndarray], spec: specs.Array) -> None:
        super().__init__(update_interval=1, buffer_size=1, delay=0, aggregator=None, corruptor=None)
        self._read = read
        self._spec = spec

    @property
    def array_spec(self) -> specs.Array:
        """Shape, dtype and bounds of the array."""
        return self._spec

    def _callable(self, physics: Any) -> Callable[[], np.ndarray]:
        return lambda: self._read(physics)
