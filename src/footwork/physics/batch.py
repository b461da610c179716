"""MuJoCo in C: many ants on a thread pool, behind the Physics protocol."""

from __future__ import annotations

from typing import Any

import mujoco
import mujoco.batch
import numpy as np

from footwork.arena import Arena
from footwork.physics.mjcf import PAIR_HAS_FOOT, build_model
from footwork.robot import Robot
from footwork.types import NUM_FEET, PhysicsState

_FATAL_WARNINGS = [
    int(kind)
    for kind in (
        mujoco.mjtWarning.mjWARN_BADQPOS,
        mujoco.mjtWarning.mjWARN_BADQVEL,
        mujoco.mjtWarning.mjWARN_BADQACC,
    )
]


class BatchPhysics:
    """``mujoco.batch.Batch`` as a Physics.

    The simulations live in the engine; a state's arrays are float32 copies, and its
    ``engine`` is the simulation that each row drives, [N] int32. Permuting a state's
    rows therefore moves ants between rows without touching a single simulation.

    Foot contacts are those of the beginning of the last substep (a few milliseconds
    old), which is what MuJoCo computes anyway. Results are bit-identical on any
    number of threads. A simulation that MuJoCo failed to step, whose bad-state
    warnings rose, or that holds a non-finite number is reported in ``diverged``
    until it is reset.

    Args:
        robot: the ant.
        arena: whose walls stand in every simulation.
        num_envs: N.
        num_threads: threads across simulations; 0 means all cores.
    """

    traceable = False
    resumable = True
    restore_alters = False

    def __init__(self, robot: Robot, arena: Arena, num_envs: int, num_threads: int = 0):
        if num_envs < 1:
            raise ValueError(f"num_envs must be >= 1, got {num_envs}")
        if num_threads < 0:
            raise ValueError(f"num_threads must be >= 0, got {num_threads}")
        _keep_quiet()
        self.control_dt = robot.control_dt
        self.num_envs = num_envs
        self._substeps = robot.substeps
        self._reset_height = robot.reset_height
        self._batch = mujoco.batch.Batch(build_model(robot, arena), num_envs, num_threads)
        self._qpos = self._batch.bind("qpos")
        self._qvel = self._batch.bind("qvel")
        self._ctrl = self._batch.bind("ctrl")
        self._warmstart = self._batch.bind("qacc_warmstart")
        self._sensors = self._batch.bind("sensordata")
        self._touching = np.zeros(self._sensors.shape, np.float32)
        self._failed = np.zeros(num_envs, bool)

    def initial(self) -> PhysicsState:
        """All rows at the reset height with straight joints, at rest."""
        self._batch.reset()
        self._qpos[:, 2] = self._reset_height
        everyone = np.arange(self.num_envs, dtype=np.int32)
        self._forward(everyone)
        return self._read(everyone)

    def reset(self, state: PhysicsState, mask: Any, qpos: Any, qvel: Any) -> PhysicsState:
        """Put the masked rows at ``qpos``, ``qvel`` with the solver's warm start cleared."""
        rows = np.flatnonzero(mask)
        if rows.size == 0:
            return state
        simulation = np.asarray(state.engine)
        ids = simulation[rows]
        self._qpos[ids] = np.asarray(qpos)[rows]
        self._qvel[ids] = np.asarray(qvel)[rows]
        self._warmstart[ids] = 0.0
        self._ctrl[ids] = 0.0
        self._forward(np.sort(ids))  # rows may be permuted, and Batch wants rising ids
        return self._read(simulation)

    def step(self, state: PhysicsState, action: Any, active: Any | None = None) -> PhysicsState:
        """One control step; actions are clipped to [-1, 1] and a non-finite one counts as divergence."""
        simulation = np.asarray(state.engine)
        action = np.asarray(action)
        bad = ~np.isfinite(action).all(axis=1)
        self._ctrl[simulation] = np.where(bad[:, None], 0.0, np.clip(action, -1.0, 1.0))
        self._failed[simulation[bad if active is None else bad & active]] = True
        ids = None if active is None else np.sort(simulation[np.flatnonzero(active)])
        if ids is None or ids.size:
            try:
                self.move(ids)
            except mujoco.batch.SimulationError as error:
                self._failed[error.ids] = True
            rows = slice(None) if ids is None else ids
            self._touching[rows] = self._sensors[rows] > 0
        return self._read(simulation)

    def move(self, ids: np.ndarray | None = None) -> None:
        """The engine's own part of a control step: moves the simulations ``ids`` (rising; None: all) by ``ctrl``."""
        self._batch.step(ids, nstep=self._substeps)

    @property
    def ctrl(self) -> np.ndarray:
        """The engine's live actions, [N, 8]; for who measures the engine alone."""
        return self._ctrl

    def snapshot(self) -> dict[str, Any]:
        """The engine's rows (positions, velocities, warm starts, time), contacts and failure flags."""
        return {
            "state": self._batch.state.copy(),
            "touching": self._touching.copy(),
            "warning": self._batch.warning.copy(),
            "failed": self._failed.copy(),
        }

    def restore(self, arrays: dict[str, Any]) -> None:
        """Continue, bit for bit, from a snapshot."""
        self._batch.state[...] = arrays["state"]
        self._touching[...] = arrays["touching"]
        self._batch.warning[...] = arrays["warning"]
        self._failed[...] = arrays["failed"]

    def close(self) -> None:
        """Nothing to do: all of it is memory."""

    def _forward(self, ids: np.ndarray) -> None:
        """Forget earlier failures and bring contacts up to date after a change of state; a bad state is seen here."""
        self._failed[ids] = False
        self._batch.warning[ids] = 0
        self._batch.forward(ids)
        self._touching[ids] = self._sensors[ids] > 0

    def _read(self, simulation: np.ndarray) -> PhysicsState:
        qpos = self._qpos.astype(np.float32)[simulation]
        qvel = self._qvel.astype(np.float32)[simulation]
        touching = self._touching[simulation]
        finite = np.isfinite(qpos).all(axis=1) & np.isfinite(qvel).all(axis=1)
        warned = (self._batch.warning[:, _FATAL_WARNINGS, 1] > 0).any(axis=1)
        return PhysicsState(
            qpos=qpos,
            qvel=qvel,
            foot_contact=touching[:, :NUM_FEET],
            foot_collision=np.minimum(touching[:, NUM_FEET:] @ PAIR_HAS_FOOT, 1.0),
            diverged=~finite | (self._failed | warned)[simulation],
            engine=simulation,
        )


def _keep_quiet() -> None:
    """Divergence is reported per row: MuJoCo need not print it, nor write MUJOCO_LOG.TXT into the working directory."""
    config = mujoco.MjLogConfig.get()
    config.logto_console = config.logto_file = False
    mujoco.MjLogConfig.set(config)
