"""WalledRoom: a square room with a wall of another colour in each direction."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..contact import CONTACT
from .arena import WALL_GROUP, Arena


@dataclass(frozen=True)
class Wall:
    """How a wall looks, and where.

    Attributes:
        angle: Direction of the outward normal [rad].
        dark: One colour of its checkers.
        light: The other.
    """

    angle: float
    dark: tuple[float, ...]
    light: tuple[float, ...]


WALLS = {  # None is bright, as the goals are.
    "east": Wall(0.0, (0.36, 0.48, 0.60), (0.44, 0.56, 0.68)),
    "north": Wall(0.5 * np.pi, (0.42, 0.55, 0.42), (0.50, 0.64, 0.50)),
    "west": Wall(np.pi, (0.66, 0.60, 0.42), (0.74, 0.68, 0.50)),
    "south": Wall(1.5 * np.pi, (0.52, 0.47, 0.60), (0.60, 0.55, 0.68)),
}
_THICKNESS = 0.05


class WalledRoom(Arena):
    """A square floor inside four walls of different colour, under soft light without shadows.

    Args:
        size: Inner edge length [m]; the room spans ``-size / 2 ... size / 2`` in x and y.
        wall_height: [m].
        name: Name of the arena.

    Raises:
        ValueError: if a size is not positive.
    """

    def _build(self, size: float = 4.0, wall_height: float = 0.5, name: str = "room") -> None:
        super()._build(name=name)
        if size <= 0 or wall_height <= 0:
            raise ValueError(f"size and wall_height must be positive; got {size} m and {wall_height} m.")
        self.size = size
        self.half_extent = np.full(2, size / 2)
        self.description = f"room of {size} m"
        self._build_light()
        self._build_floor()
        for wall_name, wall in WALLS.items():
            self._build_wall(wall_name, wall, wall_height)
        self._build_overview()

    def _build_light(self) -> None:
        visual = self._mjcf_root.visual
        visual.headlight.set_attributes(ambient=[0.45] * 3, diffuse=[0.25] * 3, specular=[0.0] * 3)
        visual.map.set_attributes(znear=0.01, zfar=20)
        self._mjcf_root.statistic.set_attributes(extent=1.0, center=[0, 0, 0])
        self._mjcf_root.worldbody.add(
            "light", name="ceiling", pos=[0, 0, 3], dir=[0.3, 0.2, -1], directional=True, castshadow=False,
            ambient=[0.1] * 3, diffuse=[0.4] * 3, specular=[0.0] * 3,
        )  # fmt: skip
        self._mjcf_root.asset.add(
            "texture", name="sky", type="skybox", builtin="gradient", rgb1=[0.80, 0.86, 0.92], rgb2=[0.62, 0.70, 0.78],
            width=32, height=192,
        )  # fmt: skip

    def _build_floor(self) -> None:
        material = self._material("floor", (0.58, 0.56, 0.53), (0.66, 0.64, 0.61), repeat=2.0)
        half = self.size / 2
        self._mjcf_root.worldbody.add(
            "geom", name="floor", type="plane", size=[half, half, 0.1], material=material, contype=0, conaffinity=0
        )

    def _build_wall(self, name: str, wall: Wall, height: float) -> None:
        material = self._material(name, wall.dark, wall.light, repeat=2.0)
        outwards = np.array([np.cos(wall.angle), np.sin(wall.angle)])
        centre = outwards * (self.size + _THICKNESS) / 2
        self._mjcf_root.worldbody.add(
            "geom", name=name, type="box", size=[_THICKNESS / 2, self.size / 2 + _THICKNESS, height / 2],
            pos=[*centre, height / 2], euler=[0, 0, wall.angle], material=material,
            group=WALL_GROUP, **CONTACT,
        )  # fmt: skip

    def _material(self, name: str, dark: tuple[float, ...], light: tuple[float, ...], repeat: float) -> Any:
        texture = self._mjcf_root.asset.add(
            "texture", name=name, type="2d", builtin="checker", rgb1=dark, rgb2=light, width=64, height=64
        )
        return self._mjcf_root.asset.add(
            "material", name=name, texture=texture, texuniform=True, texrepeat=[repeat, repeat], specular=0.0
        )

    def _build_overview(self) -> None:
        # From above one corner, looking at the centre: the whole floor is in the picture.
        distance, elevation = 1.25 * self.size, np.deg2rad(50.0)
        back = distance * np.cos(elevation)
        self._mjcf_root.worldbody.add(
            "camera", name="overview", pos=[0, -back, distance * np.sin(elevation)], fovy=45,
            xyaxes=[1, 0, 0, 0, np.sin(elevation), np.cos(elevation)],
        )  # fmt: skip
