"""The ant's bodies and geoms as plain data, for those who draw it without an engine."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from footwork.arena import open_field
from footwork.physics.mjcf import build_model
from footwork.robot import Robot


def skeleton(robot: Robot) -> dict[str, Any]:
    """What forward kinematics of a robot needs, as JSON would have it; lengths in m, quaternions wxyz.

    Returns:
        ``bodies``, parents first: ``parent`` (number of another), ``position`` and ``rotation`` in its parent's
        frame, and either ``free`` or the ``axis`` of its hinge with its ``index`` in qpos. ``geoms``, all spheres and
        capsules along their z axis: ``name``, ``body``, ``position``, ``rotation``, ``radius``, ``half`` length.
    """
    model = build_model(robot, open_field())
    return {
        "bodies": [_body(model, number) for number in range(1, model.nbody)],
        "geoms": [_geom(model, number) for number in range(model.ngeom) if model.geom_bodyid[number] > 0],
    }


def _body(model: mujoco.MjModel, number: int) -> dict[str, Any]:
    joint = int(model.body_jntadr[number])
    free = joint >= 0 and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE
    data = {
        "name": model.body(number).name,
        "parent": int(model.body_parentid[number]) - 1,
        "position": _numbers(model.body_pos[number]),
        "rotation": _numbers(model.body_quat[number]),
        "free": bool(free),
    }
    if joint >= 0 and not free:
        data |= {"axis": _numbers(model.jnt_axis[joint]), "index": int(model.jnt_qposadr[joint])}
    return data


def _geom(model: mujoco.MjModel, number: int) -> dict[str, Any]:
    sphere = model.geom_type[number] == mujoco.mjtGeom.mjGEOM_SPHERE
    return {
        "name": model.geom(number).name,
        "body": int(model.geom_bodyid[number]) - 1,
        "position": _numbers(model.geom_pos[number]),
        "rotation": _numbers(model.geom_quat[number]),
        "radius": float(model.geom_size[number, 0]),
        "half": 0.0 if sphere else float(model.geom_size[number, 1]),
    }


def _numbers(values: np.ndarray) -> list[float]:
    return [round(float(value), 9) for value in values]
