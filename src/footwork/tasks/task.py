"""Tasks: AntWalker, AntBandit and AntMaze as one pure function over arrays, and their fields."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from footwork.arena import Arena, DistanceField, geodesic_field
from footwork.robot import Robot
from footwork.rotations import quaternion_to_matrix
from footwork.tasks import terms
from footwork.tasks.observe import WALKER_OBS_SIZE, observe_walker, scaled_joints
from footwork.tasks.terms import RewardWeights
from footwork.types import QVEL_SIZE, Array, Bool, Float, Int, Key, PhysicsState, TimeStep

FallRule = Literal["height", "flip", "either", "none"]
SUCCESS_RADII = (0.45, 0.5, 1.0, 5.0)  # m, reported side by side: the field disagrees


@dataclass(frozen=True)
class Task:
    """One task: an arena, what is observed, what is rewarded and when an episode ends.

    Args:
        name: for messages and metrics.
        robot: the ant, for its limits, heights and reset pose.
        arena: walls, start and goals.
        weights: of the reward terms.
        observe_xy: append the torso's x, y (AntBandit, AntMaze).
        observe_goal: append the goal's x, y (AntBandit).
        episode_steps: control steps to truncation. Not in the paper.
        fall_rule: which test ends an episode: torso at or below the robot's fall height,
            torso upside down, either, or none. Both are always counted. Not in the paper.
        goal_radius: m; the episode ends inside it. None: never. Not in the paper.
        potential: distance along the straight line (the paper) or around the walls.
        xy_scale: factor on every observed coordinate. Not in the paper.
    """

    name: str
    robot: Robot
    arena: Arena
    weights: RewardWeights
    observe_xy: bool = False
    observe_goal: bool = False
    episode_steps: int = 1000
    fall_rule: FallRule = "height"
    goal_radius: float | None = None
    potential: Literal["straight", "geodesic"] = "straight"
    xy_scale: float = 1.0

    def __post_init__(self) -> None:
        if not 1 <= self.episode_steps < 2**31:  # it is counted in 32 bits
            raise ValueError(f"episode_steps must be >= 1 and < 2**31, got {self.episode_steps}")
        if self.fall_rule not in ("height", "flip", "either", "none"):
            raise ValueError(f"fall_rule must be height, flip, either or none, got {self.fall_rule!r}")
        if self.potential not in ("straight", "geodesic"):
            raise ValueError(f"potential must be straight or geodesic, got {self.potential!r}")
        if self.goal_radius is not None and not self.goal_radius > 0:
            raise ValueError(f"goal_radius must be > 0, got {self.goal_radius}")
        if self.potential == "geodesic" and len(self.arena.goals) != 1:
            raise ValueError(f"a geodesic potential needs one goal, {self.arena.name} has {len(self.arena.goals)}")
        if self.potential == "geodesic":
            _ = self._distance_field  # refuse now what cannot be tabulated

    @property
    def obs_size(self) -> int:
        """Length of an observation: 32, plus 2 for coordinates, plus 2 for the goal."""
        return WALKER_OBS_SIZE + 2 * self.observe_xy + 2 * self.observe_goal

    @cached_property
    def goals(self) -> np.ndarray:
        """The arena's goals, [G, 2] in m."""
        return np.array(self.arena.goals, np.float32)

    @cached_property
    def _distance_field(self) -> DistanceField:
        return geodesic_field(self.arena, self.arena.goals[0])

    def reset_pose(self, key: Key, num_envs: int) -> tuple[Float[Array, "N 15"], Float[Array, "N 14"]]:
        """Positions and velocities at the start of an episode: at rest above the start, joints with noise."""
        joint_key, place_key = jax.random.split(key)
        noise, start_noise = self.robot.reset_joint_noise, self.arena.start_noise
        joints = jnp.array(self.robot.reset_joints()) + jax.random.uniform(
            joint_key, (num_envs, 8), minval=-noise, maxval=noise
        )
        xy = jnp.array(self.arena.start) + jax.random.uniform(
            place_key, (num_envs, 2), minval=-start_noise, maxval=start_noise
        )
        upright = jnp.broadcast_to(jnp.array([self.robot.reset_height, 1.0, 0.0, 0.0, 0.0]), (num_envs, 5))
        return jnp.concatenate([xy, upright, joints], axis=-1), jnp.zeros((num_envs, QVEL_SIZE))

    def observe(self, physics: PhysicsState, goal: Float[Array, "N 2"]) -> Float[Array, "N D"]:
        """The observation of a state."""
        parts = [observe_walker(physics, self.robot)]
        if self.observe_xy:
            parts.append(self.xy_scale * physics.qpos[:, :2])
        if self.observe_goal:
            parts.append(self.xy_scale * goal)
        return jnp.concatenate(parts, axis=-1)

    def progress(
        self, before: Float[Array, "N 2"], now: Float[Array, "N 2"], goal: Float[Array, "N 2"]
    ) -> Float[Array, " N"]:
        """Drop of the potential's distance over one control step, in m/s."""
        if self.potential == "straight":
            return terms.straight_progress(before, now, goal, self.robot.control_dt)
        field = self._distance_field
        return (field.at(before, jnp) - field.at(now, jnp)) / self.robot.control_dt

    def advance(
        self,
        previous: PhysicsState,
        action: Float[Array, "N 8"],
        now: PhysicsState,
        goal: Float[Array, "N 2"],
        t: Int[Array, " N"],
    ) -> TimeStep:
        """What one control step brought; ``t`` counts it. Actions are as the policy gave them, unclipped.

        A diverged row keeps the last state that was finite, so that nothing non-finite is
        learned from; it terminates and is counted in ``events``.
        """
        diverged = now.diverged
        now = last_finite(previous, now)
        fallen = now.qpos[:, 2] <= self.robot.fall_height
        flipped = quaternion_to_matrix(now.qpos[:, 3:7])[:, 2, 2] < 0.0
        distance = jnp.linalg.norm(goal - now.qpos[:, :2], axis=-1)
        reached = distance <= (self.goal_radius or -1.0)
        values = self._terms(previous, action, now, goal, fallen, flipped, reached)
        terminated = self._fall_ends(fallen, flipped) | diverged | reached
        obs = self.observe(now, goal)
        return TimeStep(
            obs=obs,
            next_obs=obs,
            reward=sum(values.values(), jnp.zeros_like(distance)),
            terms=values,
            terminated=terminated,
            truncated=(t >= self.episode_steps) & ~terminated,
            valid=~diverged,
            handover=jnp.zeros_like(diverged),
            events={
                "fallen": fallen,
                "flipped": flipped,
                "diverged": diverged,
                "reached": reached,
                "goal_distance": distance,
            },
        )

    def _terms(
        self,
        previous: PhysicsState,
        action: Array,
        now: PhysicsState,
        goal: Array,
        fallen: Bool[Array, " N"],
        flipped: Bool[Array, " N"],
        reached: Bool[Array, " N"],
    ) -> dict[str, Float[Array, " N"]]:
        position, speed = scaled_joints(now, self.robot)
        values = {
            "progress": self.progress(previous.qpos[:, :2], now.qpos[:, :2], goal),
            "alive": terms.alive(fallen),
            "electricity": terms.electricity(action, speed),
            "stall_torque": terms.stall_torque(action),
            "joints_at_limit": terms.joints_at_limit(position),
            "feet_collision": terms.feet_collision(now.foot_collision),
            "flip": flipped.astype(jnp.float32),
            "goal": reached.astype(jnp.float32),
        }
        return {name: getattr(self.weights, name) * value for name, value in values.items()}

    def _fall_ends(self, fallen: Bool[Array, " N"], flipped: Bool[Array, " N"]) -> Bool[Array, " N"]:
        ends = jnp.zeros_like(fallen)
        if self.fall_rule in ("height", "either"):
            ends |= fallen
        if self.fall_rule in ("flip", "either"):
            ends |= flipped
        return ends


def last_finite(previous: PhysicsState, now: PhysicsState) -> PhysicsState:
    """The state, with the arrays of the one before in rows that diverged; the engine's own stays."""
    rows = now.diverged
    pick = lambda a, b: jnp.where(rows.reshape(rows.shape + (1,) * (b.ndim - 1)), a, b)  # noqa: E731
    fields = ("qpos", "qvel", "foot_contact", "foot_collision")
    return now._replace(**{name: pick(getattr(previous, name), getattr(now, name)) for name in fields})
