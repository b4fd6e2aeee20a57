"""GoalBox: a coloured cube that the robot must find."""

from typing import Any

import numpy as np
from dm_control import mjcf

from ..contact import CONTACT
from .mocap_prop import MocapProp

RED = (0.85, 0.08, 0.06, 1.0)
GREEN = (0.05, 0.62, 0.10, 1.0)


class GoalBox(MocapProp):
    """A cube on the floor that cannot be pushed: a mocap body, moved through physics only.

    Args:
        size: Edge length [m].
        rgba: Colour.
        checker: Two colours (red, green, blue) of a checkered cube instead, each side two fields wide.
        name: Name of the entity.

    Raises:
        ValueError: if the size is not positive.
    """

    def _build(
        self,
        size: float = 0.08,
        rgba: tuple[float, ...] = RED,
        checker: tuple[tuple[float, ...], tuple[float, ...]] | None = None,
        name: str = "goal_box",
    ) -> None:
        if size <= 0:
            raise ValueError(f"size must be positive; got {size} m.")
        self.size = size
        self._mjcf_root = mjcf.RootElement(model=name)
        look = {"rgba": rgba} if checker is None else {"material": self._checkered(*checker)}
        self._mjcf_root.worldbody.add(
            "geom", name="cube", type="box", size=[size / 2] * 3, pos=[0, 0, size / 2], **look,
            **CONTACT,
        )  # fmt: skip

    def _checkered(self, one: tuple[float, ...], other: tuple[float, ...]) -> Any:
        texture = self._mjcf_root.asset.add(
            "texture", name="checker", type="cube", builtin="checker", rgb1=one, rgb2=other, width=64, height=64
        )
        return self._mjcf_root.asset.add("material", name="checker", texture=texture, specular=0.0)

    @property
    def radius(self) -> float:
        """Radius of the circle around the footprint [m]."""
        return float(self.size / np.sqrt(2))

    def after_compile(self, physics: Any, random_state: np.random.RandomState) -> None:
        """Finds the box's addresses in the compiled model."""
        super().after_compile(physics, random_state)
        self._geom = int(physics.model.ptr.body(self._mjcf_root.full_identifier).geomadr[0])

    def set_solid(self, physics: Any, solid: bool) -> None:
        """Lets things collide with the box, or pass through it."""
        physics.model.ptr.geom_contype[self._geom] = solid
        physics.model.ptr.geom_conaffinity[self._geom] = solid
