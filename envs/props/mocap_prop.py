"""MocapProp: a thing that nothing pushes and that physics can put anywhere."""

from typing import Any

import numpy as np
from dm_control import composer, mjcf


class MocapProp(composer.Entity):
    """A mocap body: subclasses build its ``_mjcf_root``, arenas attach it with ``attach_mocap``.

    Attributes:
        size: Its length [m].
    """

    size: float
    _mjcf_root: mjcf.RootElement

    @property
    def radius(self) -> float:
        """Radius of a circle around the footprint [m]."""
        raise NotImplementedError

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        """The prop's MJCF."""
        return self._mjcf_root

    def after_compile(self, physics: Any, random_state: np.random.RandomState) -> None:
        """Finds the prop's address in the compiled model."""
        del random_state
        self._mocap = int(physics.model.ptr.body(self._mjcf_root.full_identifier).mocapid[0])

    def position(self, physics: Any) -> np.ndarray:
        """Returns where its centre is: x, y [m], float64 [2], in the world frame."""
        return physics.data.ptr.mocap_pos[self._mocap, :2].copy()

    def set_position(self, physics: Any, position: np.ndarray, *, yaw: float = 0.0, height: float = 0.0) -> None:
        """Moves the prop to x, y [m], turned by yaw [rad], its bottom at height [m].

        Positions derived from it are stale until a forward.
        """
        physics.data.ptr.mocap_pos[self._mocap] = *position, height
        physics.data.ptr.mocap_quat[self._mocap] = np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)
