"""The records that cross every boundary of Footwork, as pytrees of arrays.

Axis letters, used in every signature:

====== =======================================================================
letter axis
====== =======================================================================
``T``  control step within a rollout
``N``  environment row (one ant)
``R``  run: a learner with its own parameters (a direction, a seed)
``J``  joint, in the order hip_1, ankle_1, ..., hip_4, ankle_4
``F``  foot, in the order of the legs: counter-clockwise from (+x, +y) at heading zero
``D``  observation
====== =======================================================================

Units are SI, angles are radians, quaternions are wxyz. Above the physics door
everything is float32, counters are int32 and masks are bool.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

from jaxtyping import Array, Bool, Float, Int

Key = Any  # a jax.random key, new style
Params = Any  # a pytree of arrays
Metrics = dict[str, Any]

NUM_JOINTS = 8
NUM_FEET = 4
QPOS_SIZE = 15  # position 3, quaternion 4, joints 8
QVEL_SIZE = 14  # linear velocity (world frame) 3, angular velocity (torso frame) 3, joints 8


class PhysicsState(NamedTuple):
    """What every engine tells of N ants.

    ``engine`` is the engine's own and opaque; every leaf of it has the row axis
    first, so that rows can be permuted by whoever holds the state.
    """

    qpos: Float[Array, "N 15"]
    qvel: Float[Array, "N 14"]
    foot_contact: Float[Array, "N 4"]  # 1 where the foot's shin touches the floor
    foot_collision: Float[Array, "N 4"]  # 1 where the foot's shin touches another foot's
    diverged: Bool[Array, " N"]  # the engine could not step this row, or it is not finite
    engine: Any = ()


class Physics(Protocol):
    """A physics engine stepping N ants at once."""

    traceable: bool  # may be called inside jit (MJX), or only from the host (C engines)
    resumable: bool  # snapshot() holds all there is: a run can go on bit for bit
    restore_alters: bool  # the ants feel a restore(): whoever saves restores too, and goes on as one who resumes
    control_dt: float  # seconds per control step
    num_envs: int

    def initial(self) -> PhysicsState:
        """All rows at the model's own reference pose, at rest."""

    def reset(
        self,
        state: PhysicsState,
        mask: Any,  # Bool[Array, "N"], of JAX or numpy
        qpos: Any,  # Float[Array, "N 15"]
        qvel: Any,  # Float[Array, "N 14"]
    ) -> PhysicsState:
        """Put the rows in ``mask`` at ``qpos``, ``qvel``; the others stay as they are.

        The ``qpos`` that comes back is the engine's own view of that pose, from which progress counts.
        """

    def step(self, state: PhysicsState, action: Any, active: Any | None = None) -> PhysicsState:
        """Advance one control step; rows outside ``active`` are held and cost nothing."""

    def snapshot(self) -> dict[str, Any]:
        """The engine's whole hidden state as named arrays (empty where all of it is in PhysicsState)."""

    def restore(self, arrays: dict[str, Any]) -> None:
        """Continue from what :meth:`snapshot` returned, bit for bit as every engine that is restored from it.

        Where ``restore_alters`` is false, that is also how the one went on that it was taken from.

        Raises:
            ValueError: the engine is not ``resumable``; one line that says why.
        """

    def close(self) -> None:
        """Give back at once what Python's garbage collector would not (processes)."""


class TimeStep(NamedTuple):
    """What an environment answers after one step of N rows.

    ``obs`` is what to act on next: after an automatic reset it belongs to the new
    episode. ``next_obs`` is the true successor of the step, before any reset or
    hand-over, and is what a truncated return bootstraps from.
    """

    obs: Float[Array, "N D"]
    next_obs: Float[Array, "N D"]
    reward: Float[Array, " N"]
    terms: dict[str, Float[Array, " N"]]  # named parts of the reward, weighted; they sum to it
    terminated: Bool[Array, " N"]
    truncated: Bool[Array, " N"]
    valid: Bool[Array, " N"]  # the step was taken by the learner, not by a partner or noise
    handover: Bool[Array, " N"]  # somebody else acts next: returns stop here and bootstrap
    events: dict[str, Any]  # counted, never learned from: fallen, flipped, diverged, distances


class Handovers(NamedTuple):
    """What a learner expects of others who may take its rows over: every leaf has axes [T, N]."""

    chance: Float[Array, "T N"]  # that somebody else acts from the step's successor on
    value: Float[Array, "T N"]  # of that successor to them, in the learner's (scaled) reward


class Transition(NamedTuple):
    """A rollout as a learner sees it: every leaf has axes [T, N, ...]."""

    obs: Float[Array, "T N D"]
    action: Any  # Float[Array, "T N A"] or Int[Array, "T N"]
    log_prob: Float[Array, "T N"]
    reward: Float[Array, "T N"]
    terminated: Bool[Array, "T N"]
    truncated: Bool[Array, "T N"]  # truncation or hand-over: the sum stops, the value goes on
    next_obs: Float[Array, "T N D"]
    valid: Bool[Array, "T N"]
    handovers: Handovers | None = None  # None: what others make of a successor is none of the learner's concern


__all__ = [
    "NUM_FEET",
    "NUM_JOINTS",
    "QPOS_SIZE",
    "QVEL_SIZE",
    "Array",
    "Bool",
    "Float",
    "Handovers",
    "Int",
    "Key",
    "Metrics",
    "Params",
    "Physics",
    "PhysicsState",
    "TimeStep",
    "Transition",
]
