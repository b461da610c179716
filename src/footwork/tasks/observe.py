"""What the ant observes: arithmetic on a PhysicsState, and the turn of an observation by quarter turns.

The 32 numbers, in the paper's order (section 3.1; scalings and the clip to +-5 as in
PyBullet's walker):

======= ==== ===================================================================
index   size meaning
======= ==== ===================================================================
0..15   16   per joint: position scaled to [-1, 1] within its limits, 0.1 x speed (rad/s)
16..19  4    1 where the foot touches the floor
20      1    torso height minus the reset height (m)
21..23  3    0.3 x torso velocity (m/s) in the frame turned by yaw only
24, 25  2    roll, pitch (rad)
26..28  3    sine of roll, pitch, yaw
29..31  3    cosine of roll, pitch, yaw
======= ==== ===================================================================

Tasks with coordinates append x, y (m) and, where the goal varies, the goal's x, y.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from footwork.robot import ANKLE_SIGN, Robot
from footwork.rotations import matrix_to_rpy, quaternion_to_matrix, rpy_to_matrix, turn_xy
from footwork.types import NUM_FEET, Array, Float, Int, PhysicsState

WALKER_OBS_SIZE = 32
OBS_CLIP = 5.0
JOINT_SPEED_SCALE = 0.1
VELOCITY_SCALE = 0.3

_FEET, _HEIGHT, _VELOCITY, _TILT, _SINE, _COSINE = 16, 20, slice(21, 24), slice(24, 26), slice(26, 29), slice(29, 32)


def scaled_joints(physics: PhysicsState, robot: Robot) -> tuple[Float[Array, "N 8"], Float[Array, "N 8"]]:
    """Joint positions scaled so that the limits are at +-1, and joint speeds times 0.1."""
    low, high = np.array(robot.joint_limits(), np.float32).T
    position = 2.0 * (physics.qpos[:, 7:] - (low + high) / 2.0) / (high - low)
    return position, JOINT_SPEED_SCALE * physics.qvel[:, 6:]


def observe_walker(physics: PhysicsState, robot: Robot) -> Float[Array, "N 32"]:
    """The 32 numbers of AntWalker (paper, section 3.1)."""
    position, speed = scaled_joints(physics, robot)
    joints = jnp.stack([position, speed], axis=-1).reshape(-1, 16)
    rpy = matrix_to_rpy(quaternion_to_matrix(physics.qpos[:, 3:7]))
    velocity_yaw = turn_xy(physics.qvel[:, :3], -rpy[:, 2])
    parts = (
        joints,
        physics.foot_contact,
        physics.qpos[:, 2:3] - robot.reset_height,
        VELOCITY_SCALE * velocity_yaw,
        rpy[:, :2],
        jnp.sin(rpy),
        jnp.cos(rpy),
    )
    return jnp.clip(jnp.concatenate(parts, axis=-1), -OBS_CLIP, OBS_CLIP)


def turn_legs(values: Float[Array, "N 4 C"], quarter_turns: Int[Array, " N"]) -> Float[Array, "N 4 C"]:
    """Relabel legs so that an ant seen after turning the world by ``-quarter_turns`` looks the same.

    Leg i takes the place of leg i - quarter_turns: legs are numbered counter-clockwise.
    """
    source = (jnp.arange(NUM_FEET)[None, :] + quarter_turns[:, None]) % NUM_FEET
    return jnp.take_along_axis(values, source[:, :, None], axis=1)


def _turn_joints(joints: Float[Array, "N 8 C"], quarter_turns: Int[Array, " N"]) -> Float[Array, "N 8 C"]:
    """Shift the legs, and mirror ankles as their hinge axes are: opposite legs share an axis."""
    sign = jnp.array([[1.0, s] for s in ANKLE_SIGN])[None, :, :, None]  # [1, leg, hip/ankle, 1]
    legs = (joints.reshape(-1, 4, 2, joints.shape[-1]) * sign).reshape(-1, 4, 2 * joints.shape[-1])
    turned = turn_legs(legs, quarter_turns).reshape(-1, 4, 2, joints.shape[-1]) * sign
    return turned.reshape(joints.shape)


def turn_action(action: Float[Array, "N 8"], quarter_turns: Int[Array, " N"]) -> Float[Array, "N 8"]:
    """The torques of the same ant in a frame turned by ``quarter_turns`` x 90 degrees.

    ``turn_action(a, -q)`` undoes ``turn_action(a, q)``.
    """
    return _turn_joints(action[:, :, None], quarter_turns)[:, :, 0]


def turn_observation(obs: Float[Array, "N D"], quarter_turns: Int[Array, " N"]) -> Float[Array, "N D"]:
    """What the ant would observe in a frame turned by ``quarter_turns`` x 90 degrees.

    World and torso frame are both relabelled (R becomes Rz(-a) R Rz(a)), so an ant
    walking along +y at heading zero looks, with one quarter turn, like one walking
    along +x at heading zero. Numbers beyond the first 32 pass unchanged.
    """
    angle = quarter_turns.astype(jnp.float32) * (jnp.pi / 2)
    joints = _turn_joints(obs[:, :16].reshape(-1, 8, 2), quarter_turns).reshape(-1, 16)
    feet = turn_legs(obs[:, _FEET:_HEIGHT, None], quarter_turns)[:, :, 0]
    zero, one = jnp.zeros_like(angle), jnp.ones_like(angle)
    about_z = rpy_to_matrix(
        jnp.stack([zero, zero, jnp.sin(angle)], axis=-1), jnp.stack([one, one, jnp.cos(angle)], axis=-1)
    )
    torso = rpy_to_matrix(obs[:, _SINE], obs[:, _COSINE])
    rpy = matrix_to_rpy(jnp.swapaxes(about_z, 1, 2) @ torso @ about_z)
    # velocity is given in the frame of the old yaw: back to the world, turned, into the new yaw
    yaw = jnp.arctan2(obs[:, 28], obs[:, 31])
    velocity = turn_xy(obs[:, _VELOCITY], yaw - angle - rpy[:, 2])
    parts = (joints, feet, obs[:, _HEIGHT : _HEIGHT + 1], velocity, rpy[:, :2], jnp.sin(rpy), jnp.cos(rpy), obs[:, 32:])
    return jnp.concatenate(parts, axis=-1)
