"""How hard things in a room touch."""

from typing import Any

CONTACT: dict[str, Any] = {
    "condim": 1,
    "solref": [-1000.0, -50.0],
    "solimp": [0.95, 0.99, 0.001, 0.5, 2.0],
}
"""MJCF attributes of every geom that collides; without friction, or a touch would spin the robot.

``solref`` in MuJoCo's direct form, stiffness [1/s^2] and damping [1/s]: at substeps of 0.02 s an impact stops within
one substep, and what it sank in (at most 1 cm at 0.5 m/s) shrinks by 40 % a substep. Larger numbers bounce.
"""
