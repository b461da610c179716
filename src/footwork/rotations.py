"""Rotations of arrays of ants: quaternions wxyz, angles in rad, matrices [..., 3, 3] (torso to world)."""

from __future__ import annotations

import jax.numpy as jnp

from footwork.types import Array, Float


def quaternion_to_matrix(quaternion: Float[Array, "*B 4"]) -> Float[Array, "*B 3 3"]:
    """Rotation matrix of a unit quaternion wxyz."""
    w, x, y, z = (quaternion[..., i] for i in range(4))
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def matrix_to_rpy(matrix: Float[Array, "*B 3 3"]) -> Float[Array, "*B 3"]:
    """Roll, pitch, yaw with R = Rz(yaw) Ry(pitch) Rx(roll); pitch within +-pi/2."""
    roll = jnp.arctan2(matrix[..., 2, 1], matrix[..., 2, 2])
    pitch = -jnp.arcsin(jnp.clip(matrix[..., 2, 0], -1.0, 1.0))
    yaw = jnp.arctan2(matrix[..., 1, 0], matrix[..., 0, 0])
    return jnp.stack([roll, pitch, yaw], axis=-1)


def rpy_to_matrix(sine: Float[Array, "*B 3"], cosine: Float[Array, "*B 3"]) -> Float[Array, "*B 3 3"]:
    """The inverse of :func:`matrix_to_rpy`, from the sines and cosines of roll, pitch and yaw."""
    (sr, sp, sy), (cr, cp, cy) = (tuple(a[..., i] for i in range(3)) for a in (sine, cosine))
    rows = (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def turn_xy(vector: Float[Array, "*B C"], angle: Float[Array, "*B"]) -> Float[Array, "*B C"]:
    """Turn the first two components by ``angle`` about the vertical; the others stay."""
    sine, cosine = jnp.sin(angle), jnp.cos(angle)
    x, y = vector[..., 0], vector[..., 1]
    turned = jnp.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)
    return jnp.concatenate([turned, vector[..., 2:]], axis=-1)
