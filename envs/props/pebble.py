"""Pebble: the small stone that the robot must find."""

import numpy as np
from dm_control import mjcf

from .mocap_prop import MocapProp

_LUMPS = (
    # Position and half axes in units of the stone's size, and the angle about the vertical.
    ((0.0, 0.0, 0.36), (0.50, 0.42, 0.38), 0.0),
    ((0.14, 0.08, 0.30), (0.36, 0.34, 0.32), 0.7),
    ((-0.16, -0.04, 0.42), (0.32, 0.32, 0.32), -0.5),
)


class Pebble(MocapProp):
    """A rounded, sandy stone on the ground, through which robots drive: it neither blocks nor is pushed.

    Args:
        size: Its length [m].
        rgba: Colour.
        name: Name of the entity.

    Raises:
        ValueError: if the size is not positive.
    """

    def _build(
        self, size: float = 0.06, rgba: tuple[float, ...] = (0.96, 0.82, 0.58, 1.0), name: str = "pebble"
    ) -> None:
        if size <= 0:
            raise ValueError(f"size must be positive; got {size} m.")
        self.size = size
        self._mjcf_root = mjcf.RootElement(model=name)
        for position, axes, angle in _LUMPS:
            self._mjcf_root.worldbody.add(
                "geom", type="ellipsoid", pos=np.multiply(position, size), size=np.multiply(axes, size),
                euler=[0, 0, angle], rgba=rgba, contype=0, conaffinity=0,
            )  # fmt: skip

    @property
    def radius(self) -> float:
        """Radius of a circle around the footprint [m]."""
        return 0.55 * self.size
