"""The ant as data: what differs between one ant and another, and its quarter-turn symmetry.

A robot is a row of :data:`ROBOTS`. The geometry all of them share stands in
``assets/ant.xml``; the fields here are what calibration decides (docs/ant.md) and
what the simulators of the field disagree about.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

JOINT_NAMES = tuple(f"{part}_{leg}" for leg in (1, 2, 3, 4) for part in ("hip", "ankle"))

# The ankle of these legs bends by negative angles (the hinge axes of opposite legs agree).
ANKLE_SIGN = (1.0, -1.0, -1.0, 1.0)


@dataclass(frozen=True)
class Robot:
    """One ant. Lengths in m, angles in degrees as model files write them, torques in N m."""

    name: str
    density: float  # kg/m^3 of every geom
    hip_torque: float  # N m at action 1
    ankle_torque: float  # N m at action 1
    hip_range_deg: tuple[float, float]
    ankle_range_deg: tuple[float, float]  # of the legs with positive ankles; mirrored for the others
    hip_armature: float  # kg m^2 added to the joint's inertia
    ankle_armature: float  # kg m^2
    joint_damping: float  # N m s/rad
    limit_solref: tuple[float, float]  # MuJoCo solreflimit; both negative: (-stiffness, -damping)
    limit_solimp: tuple[float, float, float, float, float]  # MuJoCo solimplimit
    contact_solref: tuple[float, float]  # MuJoCo solref of every geom
    foot_gap: float  # m within which a foot counts as touching, without force
    friction: float  # sliding friction of the ant's geoms against the floor, after combination
    control_dt: float  # s
    substeps: int
    integrator: Literal["Euler", "implicitfast"]
    reset_height: float  # m
    reset_ankle_deg: float  # angle around which ankles start, mirrored as their ranges are
    reset_joint_noise: float  # rad; every joint starts within +- this of its reset angle
    fall_height: float  # m; a torso at or below it has fallen (PyBullet: 0.26)

    def __post_init__(self) -> None:
        positive = ("density", "hip_torque", "ankle_torque", "control_dt", "substeps", "reset_height")
        for field in positive:
            if not getattr(self, field) > 0:
                raise ValueError(f"{field} must be > 0, got {getattr(self, field)}")
        for field in ("hip_armature", "ankle_armature", "joint_damping", "foot_gap", "friction", "reset_joint_noise"):
            if not getattr(self, field) >= 0:
                raise ValueError(f"{field} must be >= 0, got {getattr(self, field)}")
        for field in ("hip_range_deg", "ankle_range_deg"):
            low, high = getattr(self, field)
            if not low < high:
                raise ValueError(f"{field} must rise, got {low}..{high}")
        if self.integrator not in ("Euler", "implicitfast"):
            raise ValueError(f"integrator must be Euler or implicitfast, got {self.integrator!r}")

    def joint_limits(self) -> tuple[tuple[float, float], ...]:
        """Lower and upper limit of each joint in rad, [J] pairs in the order of JOINT_NAMES."""
        limits = []
        for sign in ANKLE_SIGN:
            low, high = (math.radians(angle) for angle in self.ankle_range_deg)
            limits.append((math.radians(self.hip_range_deg[0]), math.radians(self.hip_range_deg[1])))
            limits.append((low, high) if sign > 0 else (-high, -low))
        return tuple(limits)

    def reset_joints(self) -> tuple[float, ...]:
        """Joint angles in rad around which an episode starts, [J]."""
        ankle = math.radians(self.reset_ankle_deg)
        return tuple(angle for sign in ANKLE_SIGN for angle in (0.0, sign * ankle))


# PyBullet's masses, torques and limits; how far it agrees with PyBullet's ant is measured in docs/ant.md.
# Bullet's joint limits stop a joint and do not push it back: no stiffness to speak of, and damping 1 / substep.
HEAVY = Robot(
    name="heavy",
    density=1000.0,
    hip_torque=250.0,
    ankle_torque=250.0,
    hip_range_deg=(-40.0, 40.0),
    ankle_range_deg=(30.0, 100.0),
    hip_armature=0.01,
    ankle_armature=0.01,
    joint_damping=0.0,
    limit_solref=(-10.0, -121.0),
    limit_solimp=(0.99, 0.995, 0.001, 0.5, 2.0),
    contact_solref=(0.02, 2.0),
    foot_gap=0.02,
    friction=1.2,
    control_dt=0.0165,
    substeps=2,
    integrator="implicitfast",
    reset_height=0.75,
    reset_ankle_deg=0.0,
    reset_joint_noise=0.1,
    fall_height=0.26,
)

_MUJOCO_SOLREF = (0.02, 1.0)
_MUJOCO_SOLIMP = (0.9, 0.95, 0.001, 0.5, 2.0)

ROBOTS: dict[str, Robot] = {
    robot.name: robot
    for robot in (
        HEAVY,
        # Two quirks of Bullet copied: links have the inertia of their bounding boxes, and an ankle's axis (1, 1, 0)
        # counts at its length sqrt 2, so that it turns with 1 / sqrt 2 of the torque and against twice the inertia.
        replace(HEAVY, name="bullet", ankle_torque=176.8, hip_armature=0.6, ankle_armature=0.66),
        # MuJoCo's default joint limits push back hard: an easier animal, on stilts.
        replace(HEAVY, name="stiff", limit_solref=_MUJOCO_SOLREF, limit_solimp=_MUJOCO_SOLIMP),
        # Gymnasium's Ant: 200 times lighter, short-ranged, damped joints.
        replace(
            HEAVY,
            name="light",
            density=5.0,
            hip_torque=150.0,
            ankle_torque=150.0,
            hip_range_deg=(-30.0, 30.0),
            ankle_range_deg=(30.0, 70.0),
            hip_armature=1.0,
            ankle_armature=1.0,
            joint_damping=1.0,
            limit_solref=_MUJOCO_SOLREF,
            limit_solimp=_MUJOCO_SOLIMP,
            contact_solref=_MUJOCO_SOLREF,
            foot_gap=0.0,
            friction=1.0,
            reset_ankle_deg=57.3,
        ),
    )
}
