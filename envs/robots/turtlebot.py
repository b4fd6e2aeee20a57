"""TurtleBot: a TurtleBot2-like robot that rolls on two driven wheels, driven by a few discrete actions."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from dm_control import composer, mjcf
from dm_env import specs

from ..contact import CONTACT
from .rover import wrap_angle
from .sighted_robot import HIDDEN, SightedRobot

BODY_GROUP = 2
"""Group of all of the robot that can be seen; its own camera leaves it out, since nothing of it is in view."""

RADIUS = 0.177
"""Radius of the round base [m]; this and the following are those of a Kobuki base, which a TurtleBot2 is built on."""
WHEEL_RADIUS = 0.038
"""[m]."""
WHEEL_BASE = 0.23
"""Between the wheels [m]."""
MAX_SPEED = 0.7
"""[m/s]."""
MAX_TURN_RATE = np.pi
"""[rad/s]."""
_MASS = 6.3
_WHEEL_MASS = 0.2
_CASTER_RADIUS = 0.015
_CASTER_OFFSET = 0.115
_BASE_BOTTOM, _BASE_TOP = 0.02, 0.115
_PLATES = (0.145, 0.20, 0.41)
_PLATE_RADIUS = 0.15
_CENTRE_OF_MASS = 0.1

_MAX_TORQUE = 0.5
"""Largest torque of a wheel's servo [N m]: too little for a slip, so wheels stall where the robot cannot go on."""
_SERVO_GAIN = 0.12
"""Torque for each rad/s that a wheel is too slow [N m s]: gets up to speed within about 0.1 s."""

_ARMATURE = 0.001
"""Inertia of a motor, behind its gear [kg m^2]; keeps the light wheels from spinning when they start."""
_SINK = 3e-5
"""How deep the wheels are in the ground at rest [m]."""

_BUMPER = {"condim": 3, "friction": [0.2, 0.005, 0.0001]}
"""The base touches with a little friction: stalled wheels would let it pivot freely at what it runs into."""

FORWARD, LEFT, RIGHT, FAST = range(4)
"""The actions that ``MOTIONS`` defines."""
BACKWARD = FAST
"""The action that replaces driving fast in a robot with a reverse gear, see :func:`motions_for`."""

MOTIONS = ((0.4, 0.0), (0.0, np.deg2rad(96.0)), (0.0, -np.deg2rad(48.0)), (0.64, 0.0))
"""Forward speed [m/s] and turn rate [rad/s] of each action: in 0.25 s, 0.1 m, 24 degrees, -12 degrees, or 0.16 m.

The paper's network for the TurtleBot has four outputs (Sahni et al., NeurIPS 2019, appendix); what they do is chosen
here for an agent without memory. Left turns are quick and right ones fine: where no goal is in view, equal turns are
equally good, and a greedy agent dithers between them for ever; of unequal ones the quick one finds the goal sooner, so
it searches. Nothing drives backward: a robot that sees only what is ahead would back through goals that hindsight puts
behind it.
"""


class TurtleBot(SightedRobot):
    """A Kobuki base with plates on poles, two driven wheels, two casters, and an egocentric camera; a free body.

    Nothing but friction at the wheels moves it: an action is a pair of wheel speeds that servos hold for a step. To get
    up to speed or to stop takes about 0.1 s, so the first step of a motion is shorter, and the motion before fades out
    in it. The camera sits in front of the poles and looks over the base: the robot never sees itself.

    Args:
        motions: Forward speed [m/s] and turn rate (positive is left) [rad/s] of each action, by default ``MOTIONS``;
            see :func:`motions_for` for a reverse gear.
        camera_height: [m].
        camera_pitch: How far the camera looks down [rad].
        field_of_view: Vertical [rad].
        image_size: Height and width of an image [pixels].
        name: Name of the entity.

    Raises:
        ValueError: if no motion drives, none turns, or one is faster than a TurtleBot2.
    """

    def _build(
        self,
        motions: Sequence[tuple[float, float]] = MOTIONS,
        camera_height: float = 0.3,
        camera_pitch: float = np.deg2rad(25.0),
        field_of_view: float = np.deg2rad(56.0),
        image_size: tuple[int, int] = (64, 64),
        name: str = "turtlebot",
    ) -> None:
        self.motions = np.array(motions, float)
        _check_motions(self.motions)
        self.max_speed, self.max_turn_rate = np.abs(self.motions).max(axis=0)
        self.reverse_speed = max(-self.motions[:, 0].min(), 0.0)
        self.radius = RADIUS
        self.image_size = image_size
        self._mjcf_root = mjcf.RootElement(model=name)
        # Friction as a cone, and stiff: the wheels must not creep sideways.
        self._mjcf_root.option.set_attributes(cone="elliptic", impratio=10)
        self._base = self._mjcf_root.worldbody.add("body", name="base")
        self._build_base()
        self._build_decks()
        for side, name_ in ((1, "left"), (-1, "right")):
            self._build_wheel(name_, side * WHEEL_BASE / 2)
        self._build_camera(camera_height, camera_pitch, field_of_view)

    def _build_base(self) -> None:
        mass, half = _MASS - 2 * _WHEEL_MASS, (_BASE_TOP - _BASE_BOTTOM) / 2
        across = mass * (3 * RADIUS**2 + _PLATES[-1] ** 2) / 12
        self._base.add(
            "inertial", pos=[0, 0, _CENTRE_OF_MASS], mass=mass, diaginertia=[across, across, mass * RADIUS**2 / 2]
        )
        self._base.add(
            "geom", name="hull", type="cylinder", size=[RADIUS, half], pos=[0, 0, _BASE_BOTTOM + half],
            rgba=[0.13, 0.13, 0.14, 1], group=BODY_GROUP, priority=1, **(CONTACT | _BUMPER),
        )  # fmt: skip
        for name, x in (("front", _CASTER_OFFSET), ("rear", -_CASTER_OFFSET)):
            self._base.add(
                "geom", name=f"{name}_caster", type="sphere", size=[_CASTER_RADIUS], pos=[x, 0, _CASTER_RADIUS],
                rgba=[0.6, 0.6, 0.6, 1], group=BODY_GROUP, condim=1, priority=1, solref=[0.04, 1],
            )  # fmt: skip

    def _build_decks(self) -> None:
        dark, metal = [0.09, 0.09, 0.10, 1], [0.55, 0.56, 0.58, 1]
        # A bumper and the lid that make a Kobuki a Kobuki.
        self._decorate("cylinder", [RADIUS - 0.012, 0.004], [0, 0, _BASE_TOP + 0.003], [0.92, 0.92, 0.90, 1])
        for height in _PLATES:
            self._decorate("cylinder", [_PLATE_RADIUS, 0.004], [0, 0, height], dark)
        low, high = _BASE_TOP, _PLATES[-1]
        for x, y in ((0.07, 0.11), (0.07, -0.11), (-0.11, 0.07), (-0.11, -0.07)):
            self._decorate("cylinder", [0.006, (high - low) / 2], [x, y, (high + low) / 2], metal)
        # A laptop on the upper deck, which only others see.
        self._decorate("box", [0.09, 0.13, 0.01], [-0.02, 0, high + 0.014], [0.30, 0.31, 0.34, 1])

    def _build_wheel(self, name: str, y: float) -> None:
        wheel = self._base.add("body", name=f"{name}_wheel", pos=[0, y, WHEEL_RADIUS])
        wheel.add("joint", name=name, type="hinge", axis=[0, 1, 0], armature=_ARMATURE)
        rolling = _WHEEL_MASS * WHEEL_RADIUS**2 / 2
        wheel.add("inertial", pos=[0, 0, 0], mass=_WHEEL_MASS, diaginertia=[rolling / 2, rolling, rolling / 2])
        # A sphere touches the ground in one point, half a wheel base from the centre.
        wheel.add(
            "geom", name=f"{name}_tyre", type="sphere", size=[WHEEL_RADIUS], group=HIDDEN, condim=3,
            friction=[1.0, 0.005, 0.0001], priority=1, solref=[0.01, 1], solimp=[0.99, 0.999, 0.001, 0.5, 2],
        )  # fmt: skip
        self._decorate(
            "cylinder", [WHEEL_RADIUS, 0.012], [0, 0, 0], [0.06, 0.06, 0.06, 1], wheel, euler=[np.pi / 2, 0, 0]
        )
        self._mjcf_root.actuator.add(
            "velocity", name=name, joint=wheel.joint[0], kv=_SERVO_GAIN, forcerange=[-_MAX_TORQUE, _MAX_TORQUE]
        )

    def _decorate(
        self, kind: str, size: list[float], pos: list[float], rgba: list[float], body: Any = None, **kw: Any
    ) -> None:
        (body or self._base).add(
            "geom", type=kind, size=size, pos=pos, rgba=rgba, mass=0.0, contype=0, conaffinity=0, group=BODY_GROUP, **kw
        )

    def _build_camera(self, height: float, pitch: float, field_of_view: float) -> None:
        x = 0.09
        self._add_camera(self._base, [x, 0, height], pitch, field_of_view)
        # All of it behind the lens: visible to others only.
        self._decorate("box", [0.018, 0.13, 0.018], [x - 0.03, 0, height], [0.10, 0.10, 0.11, 1])
        self._decorate("box", [0.02, 0.02, (height - _PLATES[1]) / 2], [x - 0.04, 0, (height + _PLATES[1]) / 2],
                       [0.10, 0.10, 0.11, 1])  # fmt: skip

    def attach_to(self, arena: composer.Arena) -> None:
        """Puts the robot into an arena, in which it can go anywhere: only contacts hold it."""
        arena.add_free_entity(self)

    @property
    def action_spec(self) -> specs.DiscreteArray:
        """The number of an action, as in ``motions``."""
        return specs.DiscreteArray(len(self.motions), np.int64, name="motion")

    def after_compile(self, physics: Any, random_state: np.random.RandomState) -> None:
        """Finds the robot's addresses in the compiled model and opens its camera."""
        del random_state
        model, prefix = physics.model.ptr, self._mjcf_root.full_identifier
        joint = model.joint(prefix)
        self._qpos = slice(int(joint.qposadr[0]), int(joint.qposadr[0]) + 7)
        self._wheels = [int(model.joint(f"{prefix}{side}").qposadr[0]) for side in ("left", "right")]
        self._dofs = [*range(joint.dofadr[0], joint.dofadr[0] + 6)]
        self._dofs += [int(model.joint(f"{prefix}{side}").dofadr[0]) for side in ("left", "right")]
        self._ctrl = [model.actuator(f"{prefix}{side}").id for side in ("left", "right")]
        self._open_camera(physics).options.geomgroup[BODY_GROUP] = False

    def apply_action(self, physics: Any, action: int, random_state: np.random.RandomState) -> None:
        """Sets the servos to the wheel speeds of an action."""
        del random_state
        physics.data.ptr.ctrl[self._ctrl] = wheel_speeds(*self.velocities(action))

    def velocities(self, action: int) -> tuple[float, float]:
        """Returns the forward speed [m/s] and the turn rate [rad/s] that an action commands."""
        speed, turn_rate = self.motions[action]
        return float(speed), float(turn_rate)

    def action_for(self, speed: float, turn_rate: float) -> int:
        """Returns the action nearest to a forward speed [m/s] and a turn rate [rad/s], in units of the fastest ones."""
        fastest = self.max_speed, self.max_turn_rate
        wanted = np.clip(np.divide([speed, turn_rate], fastest), -1.0, 1.0)
        return int(np.square(self.motions / fastest - wanted).sum(axis=1).argmin())

    def pose(self, physics: Any) -> np.ndarray:
        """Returns where the robot is: x [m], y [m], yaw [rad] in (-pi, pi], float64 [3], in the world frame."""
        x, y, _, w, i, j, k = physics.data.ptr.qpos[self._qpos]
        return np.array([x, y, wrap_angle(np.arctan2(2 * (w * k + i * j), 1 - 2 * (j * j + k * k)))])

    def set_pose(self, physics: Any, pose: np.ndarray) -> None:
        """Places the robot on its wheels, at rest, at x [m], y [m], yaw [rad]; what derives from it is then stale."""
        x, y, yaw = pose
        physics.data.ptr.qpos[self._qpos] = x, y, -_SINK, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)
        physics.data.ptr.qpos[self._wheels] = 0.0
        physics.data.ptr.qvel[self._dofs] = 0.0


def motions_for(reverse_speed: float = 0.0) -> tuple[tuple[float, float], ...]:
    """Returns ``MOTIONS``, or for a robot with a reverse gear the same with backward in place of driving fast.

    Args:
        reverse_speed: Of the reverse gear [m/s]; 0: none.

    Raises:
        ValueError: if it is negative.

    >>> motions_for(0.3)[BACKWARD]
    (-0.3, 0.0)
    """
    if not reverse_speed >= 0:
        raise ValueError(f"reverse_speed must not be negative; got {reverse_speed} m/s.")
    return (*MOTIONS[:BACKWARD], (-reverse_speed, 0.0)) if reverse_speed else MOTIONS


def wheel_speeds(speed: float, turn_rate: float) -> np.ndarray:
    """Returns the speeds of left and right wheel [rad/s], [2], at a forward speed [m/s] and a turn rate [rad/s].

    >>> wheel_speeds(0.38, 0.0).round(6).tolist()
    [10.0, 10.0]
    """
    sideways = turn_rate * WHEEL_BASE / 2
    return np.array([speed - sideways, speed + sideways]) / WHEEL_RADIUS


def _check_motions(motions: np.ndarray) -> None:
    if motions.ndim != 2 or motions.shape[1] != 2:
        raise ValueError(f"Each motion is a pair of speed [m/s] and turn rate [rad/s]; got {motions.tolist()}.")
    if not (np.abs(motions).max(axis=0) > 0).all():
        raise ValueError(f"Some motion must drive, and some must turn; got {motions.tolist()}.")
    if not (np.abs(motions) <= (MAX_SPEED, MAX_TURN_RATE)).all():
        raise ValueError(f"A TurtleBot2 reaches {MAX_SPEED} m/s and {MAX_TURN_RATE:.3f} rad/s; got {motions.tolist()}.")
