"""Arena: what all places have in common in which a robot must find its goal."""

import numpy as np
from dm_control import composer

from ..props.mocap_prop import MocapProp

WALL_GROUP = 1
"""Group of the geoms that may hide a goal, by which a camera can leave them out."""


class Arena(composer.Arena):
    """A flat rectangle, centred at the origin, that a robot cannot leave.

    Attributes:
        half_extent: Largest x and y inside [m], [2].
        description: What it is and how large, for people.
    """

    half_extent: np.ndarray
    description: str

    def attach_mocap(self, prop: MocapProp) -> None:
        """Attaches a prop that nothing pushes and physics can move."""
        self.attach(prop).mocap = True
