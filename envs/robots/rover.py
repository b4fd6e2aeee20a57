"""Rover: a small wheeled robot that sees through one forward camera."""

from typing import Any

import numpy as np
from dm_control import mjcf
from dm_env import specs

from ..contact import CONTACT
from .sighted_robot import HIDDEN, SightedRobot

_LAG = 0.025
"""Time constant of the velocity servos [s]; above half a physics substep, or they would oscillate."""


class Rover(SightedRobot):
    """A planar base (slide x, slide y, hinge yaw) with velocity servos in its own frame and an egocentric camera.

    Two servos drive (forward speed, turn rate); a third holds the sideways speed at zero as wheels would. The camera
    sits above the centre and looks over the body, so the robot never sees itself.

    Args:
        radius: Body radius [m].
        body_height: Height of the body [m]; the mast on it rises to the camera.
        mass: [kg].
        max_speed: Forward speed at action +1 [m/s].
        reverse_speed: Backward speed at action -1 [m/s]. By default 0, no reverse gear: a robot that sees only what is
            ahead would back through goals that hindsight puts behind it. Action 0 is then half speed.
        max_turn_rate: Turn rate at action +1, to the left [rad/s].
        camera_height: [m].
        camera_pitch: How far the camera looks down [rad].
        field_of_view: Vertical [rad].
        image_size: Height and width of an image [pixels].
        name: Name of the entity.

    Raises:
        ValueError: if speeds are out of order, or the body would be in its own view.
    """

    def _build(
        self,
        radius: float = 0.05,
        body_height: float = 0.045,
        mass: float = 1.0,
        max_speed: float = 0.5,
        reverse_speed: float = 0.0,
        max_turn_rate: float = np.deg2rad(100.0),
        camera_height: float = 0.1,
        camera_pitch: float = np.deg2rad(15.0),
        field_of_view: float = np.deg2rad(49.0),
        image_size: tuple[int, int] = (64, 64),
        name: str = "rover",
    ) -> None:
        self.radius = radius
        self.max_speed = max_speed
        self.reverse_speed = reverse_speed
        self.max_turn_rate = max_turn_rate
        self.image_size = image_size
        self._mjcf_root = mjcf.RootElement(model=name)
        _check_speeds(reverse_speed, max_speed, max_turn_rate)
        _check_view(radius, camera_height - body_height, camera_pitch + field_of_view / 2)
        self._build_body(radius, body_height, mass)
        self._build_camera(camera_height, camera_pitch, field_of_view)
        self._build_servos(mass, inertia=mass * radius**2 / 2)

    def _build_body(self, radius: float, height: float, mass: float) -> None:
        base = self._mjcf_root.worldbody.add("body", name="base")
        base.add("joint", name="x", type="slide", axis=[1, 0, 0])
        base.add("joint", name="y", type="slide", axis=[0, 1, 0])
        base.add("joint", name="yaw", type="hinge", axis=[0, 0, 1])
        clearance = 0.005  # Above the floor, which it never touches.
        half = (height - clearance) / 2
        base.add("inertial", pos=[0, 0, clearance + half], mass=mass, diaginertia=[mass * radius**2 / 2] * 3)
        self._decorate(base, "cylinder", [radius, half], [0, 0, clearance + half], [0.20, 0.23, 0.28, 1])
        # In the plane a sphere touches like the cylinder, and MuJoCo has exact contacts for it.
        base.add("geom", name="hull", type="sphere", size=[radius], pos=[0, 0, 0.04], group=HIDDEN, **CONTACT)
        base.add("site", name="centre", pos=[0, 0, 0])
        for side in (-1, 1):
            self._decorate(base, "cylinder", [0.4 * radius, 0.006], [0, side * 0.95 * radius, 0.4 * radius],
                           [0.08, 0.08, 0.08, 1], euler=[np.pi / 2, 0, 0])  # fmt: skip
        self._decorate(base, "box", [0.25 * radius, 0.1 * radius, 0.001], [0.6 * radius, 0, height - 0.001],
                       [0.95, 0.80, 0.25, 1])  # fmt: skip
        self._base = base

    def _build_camera(self, height: float, pitch: float, field_of_view: float) -> None:
        self._add_camera(self._base, [0, 0, height], pitch, field_of_view)
        # All of it behind the lens: visible to others only.
        self._decorate(self._base, "box", [0.012, 0.016, 0.012], [-0.018, 0, height], [0.85, 0.87, 0.90, 1])
        self._decorate(self._base, "cylinder", [0.005, height / 2 - 0.02], [-0.02, 0, height / 2 + 0.01],
                       [0.5, 0.5, 0.55, 1])  # fmt: skip

    def _decorate(
        self, body: Any, kind: str, size: list[float], pos: list[float], rgba: list[float], **kw: Any
    ) -> None:
        body.add("geom", type=kind, size=size, pos=pos, rgba=rgba, mass=0.0, contype=0, conaffinity=0, **kw)

    def _build_servos(self, mass: float, inertia: float) -> None:
        for name, gear, load in (
            ("forward", [1, 0, 0, 0, 0, 0], mass),
            ("sideways", [0, 1, 0, 0, 0, 0], mass),
            ("turn", [0, 0, 0, 0, 0, 1], inertia),
        ):
            self._mjcf_root.actuator.add("velocity", name=name, site="centre", gear=gear, kv=load / _LAG)

    @property
    def action_spec(self) -> specs.BoundedArray:
        """Forward speed and turn rate (positive is left), both in [-1, 1]."""
        return specs.BoundedArray((2,), np.float32, -1.0, 1.0, name="forward\tturn")

    def after_compile(self, physics: Any, random_state: np.random.RandomState) -> None:
        """Finds the robot's addresses in the compiled model and opens its camera."""
        del random_state
        joints = [physics.model.ptr.joint(f"{self._mjcf_root.full_identifier}{n}") for n in ("x", "y", "yaw")]
        self._qpos = slice(joints[0].qposadr[0], joints[2].qposadr[0] + 1)
        self._qvel = slice(joints[0].dofadr[0], joints[2].dofadr[0] + 1)
        self._ctrl = slice(*_first_and_end(physics, self._mjcf_root.full_identifier))
        self._open_camera(physics)

    def apply_action(self, physics: Any, action: np.ndarray, random_state: np.random.RandomState) -> None:
        """Sets the servos to the :meth:`velocities` of an action."""
        del random_state
        speed, turn_rate = self.velocities(action)
        physics.data.ptr.ctrl[self._ctrl] = speed, 0.0, turn_rate

    def velocities(self, action: np.ndarray) -> tuple[float, float]:
        """Returns forward speed [m/s] and turn rate [rad/s] of an action [2] in [-1, 1], both linear in it."""
        throttle = (float(action[0]) + 1) / 2
        speed = throttle * self.max_speed - (1 - throttle) * self.reverse_speed
        return speed, float(action[1]) * self.max_turn_rate

    def action_for(self, speed: float, turn_rate: float) -> np.ndarray:
        """Returns the action [2] nearest to a forward speed [m/s] and a turn rate [rad/s]."""
        forward = 2 * (speed + self.reverse_speed) / (self.max_speed + self.reverse_speed) - 1
        return np.clip([forward, turn_rate / self.max_turn_rate], -1.0, 1.0)

    def pose(self, physics: Any) -> np.ndarray:
        """Returns where the robot is: x [m], y [m], yaw [rad] in (-pi, pi], float64 [3], in the world frame."""
        pose = physics.data.ptr.qpos[self._qpos].copy()
        pose[2] = wrap_angle(pose[2])
        return pose

    def set_pose(self, physics: Any, pose: np.ndarray) -> None:
        """Places the robot at rest at x [m], y [m], yaw [rad]; positions derived from it are stale until a forward."""
        physics.data.ptr.qpos[self._qpos] = pose
        physics.data.ptr.qvel[self._qvel] = 0.0


def wrap_angle(angle: float) -> float:
    """Returns an angle [rad] in (-pi, pi].

    >>> round(wrap_angle(1.5 * np.pi) / np.pi, 6)
    -0.5
    >>> wrap_angle(-np.pi) == np.pi
    True
    """
    return float(np.pi - (np.pi - angle) % (2 * np.pi))


def _first_and_end(physics: Any, prefix: str) -> tuple[int, int]:
    first = physics.model.ptr.actuator(f"{prefix}forward").id
    return first, first + 3


def _check_speeds(reverse_speed: float, max_speed: float, max_turn_rate: float) -> None:
    if reverse_speed < 0 or max_speed <= 0:
        raise ValueError(f"Need max_speed > 0 and reverse_speed >= 0; got {max_speed} and {reverse_speed} m/s.")
    if max_turn_rate <= 0:
        raise ValueError(f"max_turn_rate must be positive; got {max_turn_rate} rad/s.")


def _check_view(radius: float, camera_above_body: float, lowest_ray: float) -> None:
    if camera_above_body < radius * np.tan(lowest_ray):
        raise ValueError(
            f"The robot would see its own body: the camera is {camera_above_body} m above a body of radius {radius} m; "
            "raise camera_height, or lower camera_pitch or field_of_view."
        )
