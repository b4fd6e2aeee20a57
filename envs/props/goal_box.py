"""GoalBox: the red cube that the robot must find."""

import numpy as np
from dm_control import mjcf

from envs.contact import CONTACT
from envs.props.mocap_prop import MocapProp


class GoalBox(MocapProp):
    """A coloured cube that stands on the floor and cannot be pushed: a mocap body, moved through physics only.

    Args:
        size: Edge length [m].
        rgba: Colour.
        name: Name of the entity.

    Raises:
        ValueError: if the size is not positive.
    """

    def _build(
        self, size: float = 0.08, rgba: tuple[float, ...] = (0.85, 0.08, 0.06, 1.0), name: str = "goal_box"
    ) -> None:
        if size <= 0:
            raise ValueError(f"size must be positive; got {size} m.")
        self.size = size
        self._mjcf_root = mjcf.RootElement(model=name)
        self._mjcf_root.worldbody.add(
            "geom", name="cube", type="box", size=[size / 2] * 3, pos=[0, 0, size / 2], rgba=rgba,
            **CONTACT,
        )  # fmt: skip

    @property
    def radius(self) -> float:
        """Of the circle around its footprint [m]."""
        return float(self.size / np.sqrt(2))
