"""MuJoCo in JAX (MJX), behind the Physics protocol: many ants on a GPU (extra ``[mjx]``).

The same model as :mod:`footwork.physics.batch` steps, and every step is a traceable function of arrays: a whole
rollout is one compiled program, with no way back to the host in between. It runs on a CPU too, many times
slower than MuJoCo in C; it is how the tests know that it works.
"""

from __future__ import annotations

import contextlib
import io
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from footwork.arena import Arena
from footwork.physics.mjcf import PAIR_HAS_FOOT, build_model
from footwork.robot import Robot
from footwork.types import NUM_FEET, QPOS_SIZE, QVEL_SIZE, Array, Bool, Float, PhysicsState

with contextlib.redirect_stdout(io.StringIO()):  # it prints that Warp, which it could also run on, is missing
    from mujoco import mjx

# MJX runs every step of a line search, needed or not; MuJoCo in C stops at the minimum, well before these.
LINE_SEARCH_STEPS = 8


class Moved(NamedTuple):
    """What the engine's own part of a control step brings, in the engine's own precision."""

    qpos: Float[Array, "N 15"]
    qvel: Float[Array, "N 14"]
    qacc: Float[Array, "N 14"]  # of the last substep: where the solver begins at the next
    touching: Bool[Array, "N 10"]  # the model's contact sensors, at the beginning of the last substep


class MjxPhysics:
    """``mujoco.mjx`` as a Physics.

    A state's arrays are the simulation: qpos and qvel, and in ``engine`` the solver's warm start, [N, 14]. Everything
    is float32, as JAX has it; an engine made and stepped within ``jax.enable_x64()`` computes in float64.

    A foot's contact bits are, as in C, those of the beginning of the last substep, and a row that was just reset
    touches nothing yet. A row that holds a number which is not finite, or that MuJoCo in C would not go on with, is
    reported in ``diverged`` until it is reset. Rows outside ``active`` are held, but cost as much as the others.

    Args:
        robot: the ant.
        arena: whose walls stand around every ant.
        num_envs: N.
        num_threads: of no effect: XLA has threads of its own.
    """

    traceable = True
    resumable = True
    restore_alters = False

    def __init__(self, robot: Robot, arena: Arena, num_envs: int, num_threads: int = 0):
        if num_envs < 1:
            raise ValueError(f"num_envs must be >= 1, got {num_envs}")
        if num_threads < 0:
            raise ValueError(f"num_threads must be >= 0, got {num_threads}")
        self.control_dt = robot.control_dt
        self.num_envs = num_envs
        self._substeps = robot.substeps
        self._reset_height = robot.reset_height
        model = build_model(robot, arena)
        model.opt.ls_iterations = LINE_SEARCH_STEPS
        self._sensors = _Sensors.of(model)
        self._integrate = {"Euler": mjx.euler, "implicitfast": mjx.implicit}[robot.integrator]
        self._model = mjx.put_model(model)
        self._blank = mjx.make_data(self._model)
        self.move = jax.jit(jax.vmap(self._move_one))
        self._step = jax.jit(self._step_rows)

    def initial(self) -> PhysicsState:
        """All rows at the reset height with straight joints, at rest."""
        upright = jnp.zeros((self.num_envs, QPOS_SIZE)).at[:, 2:4].set(jnp.array([self._reset_height, 1.0]))
        still, off = jnp.zeros((self.num_envs, QVEL_SIZE)), jnp.zeros(self.num_envs, bool)
        nothing = jnp.zeros((self.num_envs, NUM_FEET))
        return PhysicsState(upright, still, nothing, nothing, off, still)

    def reset(self, state: PhysicsState, mask: Any, qpos: Any, qvel: Any) -> PhysicsState:
        """Put the masked rows at ``qpos``, ``qvel`` with the solver's warm start cleared."""
        mask = jnp.asarray(mask)
        qpos, qvel = jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32)
        nothing = jnp.zeros((self.num_envs, NUM_FEET))
        fresh = PhysicsState(qpos, qvel, nothing, nothing, ~_sound(qpos, qvel), jnp.zeros_like(qvel))
        return _pick(mask, fresh, state)

    def step(self, state: PhysicsState, action: Any, active: Any | None = None) -> PhysicsState:
        """One control step; actions are clipped to [-1, 1] and a non-finite one counts as divergence."""
        active = jnp.ones(self.num_envs, bool) if active is None else jnp.asarray(active)
        return self._step(state, jnp.asarray(action), active)

    def _step_rows(self, state: PhysicsState, action: Array, active: Array) -> PhysicsState:
        usable = jnp.isfinite(action).all(axis=1)
        ctrl = jnp.where(usable[:, None], jnp.clip(action, -1.0, 1.0), 0.0)
        moved = self.move(state.qpos, state.qvel, state.engine, ctrl)
        diverged = state.diverged | ~usable | ~_sound(*moved[:3])
        touching = moved.touching.astype(jnp.float32)
        after = PhysicsState(
            qpos=moved.qpos.astype(jnp.float32),
            qvel=moved.qvel.astype(jnp.float32),
            foot_contact=touching[:, :NUM_FEET],
            foot_collision=jnp.minimum(touching[:, NUM_FEET:] @ PAIR_HAS_FOOT, 1.0),
            diverged=diverged,
            engine=jnp.where(diverged[:, None], 0.0, moved.qacc.astype(jnp.float32)),
        )
        return _pick(active, after, state)

    def _move_one(self, qpos: Array, qvel: Array, warmstart: Array, ctrl: Array) -> Moved:
        """One ant's control step. Vmapped and compiled, and so with an axis N everywhere, this is ``move``."""
        dtype = self._blank.qpos.dtype
        begin = self._blank.replace(ctrl=ctrl.astype(dtype))

        def substep(moving: Any, _: None) -> Any:
            qpos, qvel, warmstart = moving
            data = _forward(self._model, begin.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart))
            data = self._integrate(self._model, data)
            return (data.qpos, data.qvel, data.qacc_warmstart), self._sensors.read(data)

        start = (qpos.astype(dtype), qvel.astype(dtype), warmstart.astype(dtype))
        moved, touching = jax.lax.scan(substep, start, None, length=self._substeps)
        return Moved(*moved, touching[-1])

    def snapshot(self) -> dict[str, Any]:
        """Nothing: all there is is in the state."""
        return {}

    def restore(self, arrays: dict[str, Any]) -> None:
        """Nothing to do, for the same reason."""

    def close(self) -> None:
        """Nothing to do: all of it is memory."""


def _forward(model: Any, data: Any) -> Any:
    """``mjx.forward``, less what the ant has not, and with the frames of its contacts turned as C turns them."""
    for stage in (mjx.kinematics, mjx.com_pos, mjx.crb, mjx.factor_m, mjx.collision):
        data = stage(model, data)
    data = data.tree_replace({"_impl.contact.frame": _aligned_frames(model, data)})
    for stage in (mjx.make_constraint, mjx.transmission, mjx.fwd_velocity, mjx.fwd_actuation, mjx.fwd_acceleration):
        data = stage(model, data)
    return mjx.solve(model, data)


def _aligned_frames(model: Any, data: Any) -> Float[Array, "C 3 3"]:
    """The frames of all contacts, those of a capsule on the floor along the capsule.

    Friction acts within a pyramid, so it matters how the frame is turned about the normal. MuJoCo in C turns its
    first tangent along the capsule; MJX 3.17 does so too, but for capsules steeper than 60 degrees takes the y axis.
    """
    contact = data._impl.contact
    plane, capsule = int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_CAPSULE)
    kind = jnp.asarray(model.geom_type)[contact.geom]
    normal, axis = contact.frame[:, 0], data.geom_xmat[contact.geom[:, 1]][:, :, 2]
    along = axis - normal * jnp.sum(normal * axis, axis=1, keepdims=True)
    length = jnp.linalg.norm(along, axis=1, keepdims=True)
    along = along / jnp.maximum(length, mujoco.mjMINVAL)
    aligned = jnp.stack([normal, along, jnp.cross(normal, along)], axis=1)
    usable = (kind[:, 0] == plane) & (kind[:, 1] == capsule) & (length[:, 0] > mujoco.mjMINVAL)
    return jnp.where(usable[:, None, None], aligned, contact.frame)


class _Sensors(NamedTuple):
    """The model's contact sensors between two geoms.

    MJX has them too, but its own do not know of a geom's ``gap``, within which feet count as touching.
    """

    geoms: np.ndarray  # [S, 2]
    gap: np.ndarray  # [S] m

    @classmethod
    def of(cls, model: mujoco.MjModel) -> _Sensors:
        contacts = model.sensor_type == mujoco.mjtSensor.mjSENS_CONTACT
        geoms = np.stack([model.sensor_objid[contacts], model.sensor_refid[contacts]], axis=1)
        return cls(geoms, model.geom_gap[geoms].sum(axis=1))

    def read(self, data: Any) -> Bool[Array, " S"]:
        """Whether the geoms of each touch, from the distances of all pairs of geoms that can."""
        contact = data._impl.contact
        one, other = self.geoms.T
        pair, flipped = (
            (contact.geom[:, 0] == first[:, None]) & (contact.geom[:, 1] == second[:, None])
            for first, second in ((one, other), (other, one))
        )
        near = contact.dist - contact.includemargin < self.gap[:, None]
        return ((pair | flipped) & near).any(axis=1)


def _sound(*arrays: Array) -> Bool[Array, " N"]:
    """Rows whose numbers are finite, and of a size at which MuJoCo in C does not give up."""
    return jnp.stack([(jnp.abs(array) < mujoco.mjMAXVAL).all(axis=1) for array in arrays]).all(axis=0)


def _pick(mask: Array, one: PhysicsState, other: PhysicsState) -> PhysicsState:
    """Per row: ``one`` where the mask holds."""
    rows = lambda a, b: jnp.where(mask.reshape(mask.shape + (1,) * (jnp.ndim(b) - 1)), a, b)  # noqa: E731
    return jax.tree.map(rows, one, other)
