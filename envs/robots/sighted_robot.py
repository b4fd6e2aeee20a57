"""SightedRobot: what all robots have in common that see through one egocentric camera."""

from typing import Any

import numpy as np
from dm_control import composer, mjcf

from ..rendering.persistent_camera import PersistentCamera

HIDDEN = 4
"""A geom group that cameras leave out."""


class SightedRobot(composer.Entity):
    """A robot with one forward camera that keeps its OpenGL context; subclasses build ``_mjcf_root``.

    Attributes:
        image_size: Height and width of an image [pixels].
        camera: Open from compilation to :meth:`close`.
    """

    image_size: tuple[int, int]
    camera: PersistentCamera | None = None
    _mjcf_root: mjcf.RootElement

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        """The robot's MJCF."""
        return self._mjcf_root

    def attach_to(self, arena: composer.Arena) -> None:
        """Puts the robot into an arena, in which its own joints move it."""
        arena.attach(self)

    def _add_camera(self, body: Any, position: list[float], pitch: float, field_of_view: float) -> None:
        # Looks ahead and down by pitch [rad]; the field of view is vertical [rad].
        body.add(
            "camera", name="egocentric", pos=position, fovy=np.rad2deg(field_of_view),
            xyaxes=[0, -1, 0, np.sin(pitch), 0, np.cos(pitch)],
        )  # fmt: skip

    def _open_camera(self, physics: Any) -> PersistentCamera:
        self.close()
        height, width = self.image_size
        name = f"{self._mjcf_root.full_identifier}egocentric"
        self.camera = PersistentCamera(physics, name, height=height, width=width)
        return self.camera

    def close(self) -> None:
        """Closes the camera, which then refuses to render."""
        if self.camera is not None:
            self.camera.close()
