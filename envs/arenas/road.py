"""Road: a piece of road between two kerbs, closed at both ends, with the clutter of a street around it."""

from typing import Any

import numpy as np

from ..contact import CONTACT
from . import textures
from .arena import WALL_GROUP, Arena

_KERB_WIDTH = 0.12
_KERB_HEIGHT = 0.1
_SIDEWALK = 0.8
"""Width of the pavement on either side [m]."""
_BEYOND = 1.0
"""How far the road goes on behind the barriers [m]."""
_BARRIER_HEIGHT = 0.3
_BARRIER_DEPTH = 0.1
_FENCE_HEIGHT = 0.9
_ORANGE, _WHITE = [0.92, 0.42, 0.10, 1], [0.90, 0.90, 0.88, 1]


class Road(Arena):
    """A road along x with kerbs that no robot climbs, pavements, barriers at both ends, cones, crates and bins.

    The clutter is drawn from a seed when the model is built and never moves. Everything solid keeps the
    drivable rectangle free: its ends are at ``x = -length / 2`` and ``length / 2``, its kerbs at ``y = -width / 2`` and
    ``width / 2``. Two street lamps of different strength light it unevenly; nothing casts shadows.

    Args:
        length: Of the drivable part [m].
        width: Between the kerbs [m].
        seed: Of the asphalt and the clutter.
        name: Name of the arena.

    Raises:
        ValueError: if a size is not positive.
    """

    def _build(self, length: float = 6.0, width: float = 3.0, seed: int = 0, name: str = "road") -> None:
        super()._build(name=name)
        if length <= 0 or width <= 0:
            raise ValueError(f"length and width must be positive; got {length} m and {width} m.")
        self.length = length
        self.width = width
        self.half_extent = np.array([length, width]) / 2
        self.description = f"road of {length} m x {width} m"
        self._random_state = np.random.RandomState(seed)
        self._build_light()
        self._build_ground()
        self._build_sides()
        self._build_ends()
        self._build_clutter()
        self._build_overview()

    def _build_light(self) -> None:
        root = self._mjcf_root
        root.visual.headlight.set_attributes(ambient=[0.38] * 3, diffuse=[0.10] * 3, specular=[0.0] * 3)
        root.visual.map.set_attributes(znear=0.01, zfar=30)
        # Lights are computed at vertices: large planes need some, small round things few.
        root.visual.quality.set_attributes(numquads=8, numslices=16, numstacks=8)
        root.statistic.set_attributes(extent=1.0, center=[0, 0, 0])
        root.worldbody.add(
            "light", name="sun", pos=[0, 0, 5], dir=[0.3, 0.5, -1], directional=True, castshadow=False,
            diffuse=[0.32, 0.31, 0.29], specular=[0.0] * 3,
        )  # fmt: skip
        side = self.width / 2 + 0.5
        for name_, x, y, strength in (
            ("bright", -0.25 * self.length, side, 0.75),
            ("dim", 0.35 * self.length, -side, 0.35),
        ):
            self._build_lamp(name_, x, y, strength)
        root.asset.add(
            "texture", name="sky", type="skybox", builtin="gradient", rgb1=[0.78, 0.84, 0.90], rgb2=[0.55, 0.65, 0.76],
            width=32, height=192,
        )  # fmt: skip

    def _build_lamp(self, name: str, x: float, y: float, strength: float) -> None:
        self._mjcf_root.worldbody.add(
            "light", name=name, pos=[x, y, 2.0], dir=[0, -0.4 * np.sign(y), -1], castshadow=False, cutoff=90,
            exponent=1, attenuation=[1.0, 0.0, 0.08], specular=[0.0] * 3,
            diffuse=[strength, 0.93 * strength, 0.8 * strength],
        )  # fmt: skip
        self._decorate("cylinder", [0.03, 1.0], [x, y, 1.0], rgba=[0.25, 0.27, 0.28, 1])
        self._decorate("sphere", [0.08], [x, y, 2.05], rgba=[0.95, 0.93, 0.80, 1])

    def _build_ground(self) -> None:
        size = (self.length + 2 * _BEYOND, self.width + 2 * (_KERB_WIDTH + _SIDEWALK))
        picture = textures.asphalt(size, (self.length, self.width), self._random_state)
        self._mjcf_root.worldbody.add(
            "geom", name="asphalt", type="plane", size=[size[0] / 2, size[1] / 2, 0.1],
            material=self._material("asphalt", picture), condim=1,
        )  # fmt: skip

    def _build_sides(self) -> None:
        stone = self._material("kerb", textures.bricks((0.56, 0.56, 0.55), 0.40, self._random_state), (0.8, 2.5))
        slabs = self._material("slabs", textures.bricks((0.60, 0.57, 0.52), 0.45, self._random_state), (1.0, 1.0))
        wall = self._material("wall", textures.bricks((0.58, 0.34, 0.26), 0.62, self._random_state), (1.5, 1.5))
        hedge = self._material("hedge", textures.leaves((0.20, 0.36, 0.16), self._random_state), (1.0, 1.0))
        half, edge = self.length / 2 + _BEYOND, self.width / 2
        for name, side, fence in (("north", 1, wall), ("south", -1, hedge)):
            facing = [0, -side, 0]
            kerb = [0, side * (edge + _KERB_WIDTH / 2), _KERB_HEIGHT / 2]
            self._solid(f"{name}_kerb", [half, _KERB_HEIGHT / 2, _KERB_WIDTH / 2], kerb, facing, stone)
            pavement = [0, side * (edge + _KERB_WIDTH + _SIDEWALK / 2), _KERB_HEIGHT]
            self._face([half, _SIDEWALK / 2], pavement, [0, 0, 1], slabs)
            behind = [0, side * (edge + _KERB_WIDTH + _SIDEWALK), _FENCE_HEIGHT / 2]
            self._face([half, _FENCE_HEIGHT / 2], behind, facing, fence)

    def _build_ends(self) -> None:
        half, across = self.length / 2, self.width / 2 + _KERB_WIDTH
        for name, side, colours, facade in (
            ("east", 1, ((0.80, 0.16, 0.12), (0.88, 0.88, 0.86)), (0.44, 0.50, 0.58)),
            ("west", -1, ((0.85, 0.68, 0.10), (0.12, 0.12, 0.12)), (0.70, 0.64, 0.50)),
        ):
            barrier = self._material(f"{name}_barrier", textures.stripes(*colours), (2.0, 2.0))
            house = self._material(f"{name}_house", textures.bricks(facade, 0.75, self._random_state), (1.0, 1.0))
            facing = [-side, 0, 0]
            size = [across, _BARRIER_HEIGHT / 2, _BARRIER_DEPTH / 2]
            self._solid(f"{name}_barrier", size, [side * (half + size[2]), 0, size[1]], facing, barrier)
            self._face([across + _SIDEWALK, 0.75], [side * (half + _BEYOND), 0, 0.75], facing, house)

    def _build_clutter(self) -> None:
        wood = self._material("wood", textures.planks((0.62, 0.46, 0.28), self._random_state), (1.0, 1.0), kind="cube")
        self._build_cone_mesh()
        kinds = [lambda x, y: self._build_crate(x, y, wood), self._build_cone, self._build_bin]
        for i, (x, y) in enumerate(self._clutter_positions()):
            kinds[i % len(kinds)](x, y)

    def _clutter_positions(self) -> list[tuple[float, float]]:
        draw = self._random_state.uniform
        pavement = self.width / 2 + _KERB_WIDTH + 0.3
        along = [(x + draw(-0.3, 0.3), side * (pavement + draw(0.0, 0.25)))
                 for side in (-1, 1) for x in np.linspace(-0.42, 0.42, 5) * self.length]  # fmt: skip
        ends = [(side * (self.length / 2 + draw(0.35, 0.75)), y + draw(-0.25, 0.25))
                for side in (-1, 1) for y in np.linspace(-0.35, 0.35, 3) * self.width]  # fmt: skip
        return along + ends

    def _build_crate(self, x: float, y: float, wood: Any) -> None:
        edge = self._random_state.uniform(0.12, 0.18)
        self._decorate("box", [edge] * 3, [x, y, _KERB_HEIGHT + edge], material=wood,
                       euler=[0, 0, self._random_state.uniform(0, np.pi)])  # fmt: skip

    def _build_bin(self, x: float, y: float) -> None:
        colour = [[0.16, 0.30, 0.42, 1], [0.30, 0.32, 0.34, 1]][self._random_state.randint(2)]
        self._decorate("cylinder", [0.14, 0.2], [x, y, _KERB_HEIGHT + 0.2], rgba=colour)
        self._decorate("cylinder", [0.15, 0.02], [x, y, _KERB_HEIGHT + 0.42], rgba=[0.12, 0.13, 0.14, 1])

    def _build_cone(self, x: float, y: float) -> None:
        self._decorate("mesh", None, [x, y, _KERB_HEIGHT], mesh="cone", rgba=_ORANGE)
        self._decorate("mesh", None, [x, y, _KERB_HEIGHT], mesh="cone_band", rgba=_WHITE)
        self._decorate("box", [0.12, 0.12, 0.01], [x, y, _KERB_HEIGHT + 0.01], rgba=_ORANGE)

    def _build_cone_mesh(self) -> None:
        for name, low, high, wider in (("cone", 0.0, 0.36, 0.0), ("cone_band", 0.15, 0.24, 0.003)):
            rings = [_ring(0.1 * (1 - height / 0.4) + wider, height) for height in (low, high)]
            self._mjcf_root.asset.add("mesh", name=name, vertex=np.concatenate(rings).ravel())

    def _material(
        self, name: str, picture: np.ndarray, repeat: tuple[float, float] | None = None, kind: str = "2d"
    ) -> Any:
        # With repeat: so many times a metre. Without: once over the whole geom.
        texture = self._mjcf_root.asset.add("texture", name=name, type=kind, file=textures.png_asset(picture))
        return self._mjcf_root.asset.add(
            "material", name=name, texture=texture, texuniform=repeat is not None, texrepeat=repeat or (1.0, 1.0),
            specular=0.0,
        )  # fmt: skip

    def _solid(self, name: str, size: list[float], pos: list[float], facing: list[int], material: Any) -> None:
        # A box whose picture is on the side towards the road: width, height and depth in that view.
        self._mjcf_root.worldbody.add(
            "geom", name=name, type="box", size=size, pos=pos, xyaxes=_upright(facing), material=material,
            group=WALL_GROUP, **CONTACT,
        )  # fmt: skip

    def _face(self, size: list[float], pos: list[float], facing: list[int], material: Any) -> None:
        # Seen from one side only.
        self._decorate("plane", [*size, 0.1], pos, xyaxes=_upright(facing), material=material)

    def _decorate(self, kind: str, size: list[float] | None, pos: list[float], **kw: Any) -> None:
        self._mjcf_root.worldbody.add(
            "geom", type=kind, size=size, pos=pos, contype=0, conaffinity=0, group=WALL_GROUP, **kw
        )

    def _build_overview(self) -> None:
        elevation = np.deg2rad(48.0)
        distance = 1.05 * self.length
        self._mjcf_root.worldbody.add(
            "camera", name="overview", pos=[0, -distance * np.cos(elevation), distance * np.sin(elevation)], fovy=45,
            xyaxes=[1, 0, 0, 0, np.sin(elevation), np.cos(elevation)],
        )  # fmt: skip


def _upright(facing: list[int]) -> list[int]:
    # The x and y axes of a picture that faces that way with its upper side up (or north).
    if facing[2]:
        return [1, 0, 0, 0, 1, 0]
    return [-facing[1], facing[0], 0, 0, 0, 1]


def _ring(radius: float, height: float) -> np.ndarray:
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    return np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(12, height)], axis=1)
