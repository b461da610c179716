"""Builds a MuJoCo model from a robot row and an arena."""

from __future__ import annotations

from importlib import resources
from typing import Any

import mujoco
import numpy as np

from footwork.arena import Arena, open_field
from footwork.robot import ANKLE_SIGN, Robot
from footwork.types import NUM_FEET

# The contact sensors: floor_1 to floor_4, then feet_i_j in the order of these pairs.
_PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
PAIR_HAS_FOOT = np.array([[foot in pair for foot in range(NUM_FEET)] for pair in _PAIRS], np.float32)

_PARTS = {"torso": "torso", "thigh": "thigh_1", "shin": "shin_1"}
WALL_COLOUR = (0.55, 0.57, 0.62, 1.0)


def build_spec(robot: Robot, arena: Arena) -> mujoco.MjSpec:
    """The editable model: the shared geometry with the robot's numbers and the arena's walls written in."""
    xml = resources.files("footwork").joinpath("assets/ant.xml").read_text(encoding="utf-8")
    spec = mujoco.MjSpec.from_string(xml)
    spec.option.timestep = robot.control_dt / robot.substeps
    spec.option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{robot.integrator.upper()}")
    for number, wall in enumerate(arena.walls):
        spec.worldbody.add_geom(
            name=f"wall_{number}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[wall.x, wall.y, arena.wall_height / 2],
            size=[wall.half_x, wall.half_y, arena.wall_height / 2],
            rgba=WALL_COLOUR,
        )
    _write_robot(spec, robot)
    return spec


def _write_robot(spec: mujoco.MjSpec, robot: Robot) -> None:
    for geom in spec.geoms:
        geom.friction[0] = robot.friction  # the larger of the two counts, so both carry the combined value
        geom.solref = list(robot.contact_solref)
        geom.density = robot.density  # of what moves; floor and walls have no mass
        if geom.name.startswith("shin"):
            geom.gap = robot.foot_gap  # seen by the contact sensors, felt by nothing
    for actuator in spec.actuators:
        actuator.gear[0] = robot.hip_torque if actuator.name.startswith("hip") else robot.ankle_torque
    for joint in spec.joints:
        if joint.type != mujoco.mjtJoint.mjJNT_FREE:
            _write_joint(joint, robot)


def _write_joint(joint: mujoco.MjsJoint, robot: Robot) -> None:
    part, leg = joint.name.split("_")
    low, high = robot.hip_range_deg if part == "hip" else robot.ankle_range_deg
    if part == "ankle" and ANKLE_SIGN[int(leg) - 1] < 0:
        low, high = -high, -low
    joint.range = [low, high]
    joint.armature = robot.hip_armature if part == "hip" else robot.ankle_armature
    # damping is a polynomial in MuJoCo 4: the first coefficient is the linear one
    joint.damping = np.array([robot.joint_damping] + [0.0] * (np.size(joint.damping) - 1))
    joint.solref_limit = list(robot.limit_solref)
    joint.solimp_limit = list(robot.limit_solimp)


def build_model(robot: Robot, arena: Arena) -> mujoco.MjModel:
    """The compiled model."""
    return build_spec(robot, arena).compile()


def describe(robot: Robot) -> dict[str, dict[str, Any]]:
    """Of the compiled ant: masses in kg (all of it, the torso with its stubs, one thigh, one shin), limits in deg."""
    model = build_model(robot, open_field())
    mass = {part: float(model.body(name).mass[0]) for part, name in _PARTS.items()}
    limits = {part: np.degrees(model.joint(f"{part}_1").range).round(3).tolist() for part in ("hip", "ankle")}
    return {"mass_kg": {"ant": float(model.body_mass.sum()), **mass}, "limits_deg": limits}
