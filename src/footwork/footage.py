"""Footage: what an episode looked like, every control step of it, for whoever shows the ant.

It is filmed in the environment that evaluation uses, with the same keys: an episode of
``play_episodes(trained, subs, n, seed)`` and the one filmed with the same arguments are the same.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from footwork.arena import extent_of
from footwork.env import Environment
from footwork.evaluate import actor, evaluation_environment, finish_step
from footwork.learn.networks import Policy
from footwork.options import Options, SubPolicies, task_state
from footwork.tasks.task import Task
from footwork.train import Trained
from footwork.types import Array, Key, Params, TimeStep

NOBODY = -1  # in ``choice``: no sub-policy acts, the policy is flat


@dataclass(frozen=True, eq=False)
class Footage:
    """One episode of one ant; T control steps, and with the start T + 1 poses.

    Args:
        row: address of the row whose policy acted.
        seed: of the policy.
        episode: its number among those filmed together.
        task: robot, arena, goal radius.
        goal: [2] in m.
        qpos: [T + 1, 15] float32, as in PhysicsState.
        choice: [T] int8, the direction of the sub-policy at work, or NOBODY.
        reward: [T] float32.
        distance: [T] float32, m to the goal.
        fallen: [T] bool, the torso at or below the robot's fall height.
        flipped: [T] bool, upside down.
        odds: [decisions, 4] float32, the master's probabilities; no rows where there is no master.
        value: [decisions] float32, the master's estimate; empty also where its critic was not packaged.
        option_steps: control steps per decision.
        outcome: reached, fallen, flipped, diverged, truncated (time was up), or cut: filmed no further.
    """

    row: str
    seed: int
    episode: int
    task: Task
    goal: np.ndarray
    qpos: np.ndarray
    choice: np.ndarray
    reward: np.ndarray
    distance: np.ndarray
    fallen: np.ndarray
    flipped: np.ndarray
    odds: np.ndarray
    value: np.ndarray
    option_steps: int
    outcome: str

    @property
    def num_steps(self) -> int:
        """T."""
        return len(self.reward)

    @property
    def control_dt(self) -> float:
        """Seconds per control step."""
        return self.task.robot.control_dt

    @property
    def has_goal(self) -> bool:
        """Whether the goal is a place to arrive at, and not a direction (targets 10 km away)."""
        return self.task.goal_radius is not None

    def extent(self, margin: float = 1.0) -> tuple[float, float, float, float]:
        """Centre x, y and half sizes (m) of what there is to see: path, start, goal, and a maze within its border."""
        points = [self.qpos[:, :2].astype(np.float64)]
        if self.has_goal:
            points.append(self.goal[None].astype(np.float64))
        return extent_of(self.task.arena, np.concatenate(points), margin)


class _Frame(NamedTuple):
    """What is kept of a control step, [N, ...]; of the poses those after it."""

    qpos: Any
    choice: Any
    reward: Any
    terminated: Any
    events: dict[str, Any]
    over: Any  # the episode had ended before this step


def film(
    trained: Trained,
    sub_policies: SubPolicies | None,
    num_episodes: int = 1,
    seed: int = 0,
    seed_index: int = 0,
    deterministic: bool = False,
    num_threads: int = 0,
    most_steps: int | None = None,
) -> list[Footage]:
    """Film ``num_episodes`` episodes of one seed's policy, all at once.

    Args:
        trained: the row; of a walker row the episodes are divided equally among its four directions.
        sub_policies: what a master chooses among.
        num_episodes: a multiple of four for walker rows.
        seed: of the episodes.
        seed_index: which of the row's seeds.
        deterministic: act by the mode of the distribution instead of a sample.
        num_threads: of the physics; changes no number.
        most_steps: stop after this many control steps (rounded up to a whole option); None: play to the end.
    """
    experiment = trained.experiment
    env = evaluation_environment(experiment, num_episodes, sub_policies, num_threads)
    act = actor(trained, seed_index, env, deterministic)
    stride = experiment.steps_per_decision
    wanted = experiment.task.episode_steps if most_steps is None else min(most_steps, experiment.task.episode_steps)
    key = jax.random.key(seed)
    state, obs = env.initial(jax.random.fold_in(key, 0))
    first, goal = np.asarray(task_state(state).physics.qpos).copy(), np.asarray(task_state(state).goal)
    frames: list[_Frame] = []
    opinions = []
    for i in range(math.ceil(wanted / stride)):
        if np.asarray(task_state(state).held).all():
            break
        if experiment.is_master:
            opinions.append(opinion(experiment.policy(), trained.single(seed_index), obs))
        state, action, simulate_key, finish_key = act(state, obs, key, np.int32(i + 1))
        choice = _choice(trained, env, action)
        over = np.asarray(task_state(state).held)
        for after, step in control_steps(env, state, simulate_key, finish_key):
            frames.append(_keep(after, step, choice, over))
            over = over | np.asarray(step.terminated | step.truncated)
        state, obs = after, step.obs
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *frames)
    return [_cut(trained, seed_index, n, first, goal, stacked, opinions) for n in range(num_episodes)]


def control_steps(env: Environment, state: Any, simulate_key: Key, finish_key: Key) -> Iterator[tuple[Any, TimeStep]]:
    """The control steps that ``simulate`` and ``finish`` take after ``begin``, one at a time."""
    if not isinstance(env, Options):
        yield finish_step(env, env.simulate(state, simulate_key), finish_key)
        return
    nothing = state.total
    for i in np.arange(env.option_steps):  # as simulate's own loop counts
        state, _ = env.control_step(simulate_key, state._replace(total=nothing), i)  # type: ignore[arg-type]
        yield state, state.total


@partial(jax.jit, static_argnums=0)
def opinion(policy: Policy, params: Params, obs: Array) -> tuple[Array, Array]:
    """A master's probabilities [N, 4], and its value [N], NaN without a critic."""
    odds = jax.nn.softmax(policy.outputs(params, obs))
    return odds, policy.value(params, obs) if "critic" in params else odds[:, 0] * np.nan


def _choice(trained: Trained, env: Environment, action: Array) -> np.ndarray:
    if trained.experiment.is_master:
        return np.asarray(action).astype(np.int8)
    if trained.experiment.is_walker:
        return np.array(env.goal_index, np.int8)  # type: ignore[attr-defined]
    return np.full(env.num_envs, NOBODY, np.int8)


def _keep(state: Any, step: TimeStep, choice: np.ndarray, over: np.ndarray) -> _Frame:
    kept = (step.reward, step.terminated, step.events)
    reward, terminated, events = jax.tree.map(np.asarray, kept)
    return _Frame(np.asarray(task_state(state).physics.qpos).copy(), choice, reward, terminated, events, over)


def _cut(
    trained: Trained, seed_index: int, n: int, first: np.ndarray, goal: np.ndarray, frames: _Frame, opinions: list[Any]
) -> Footage:
    """Row ``n`` of what was filmed, up to the end of its episode."""
    experiment = trained.experiment
    length = int((~frames.over[:, n]).sum())
    row = jax.tree.map(lambda leaf: leaf[:length, n], frames)
    stride = experiment.steps_per_decision
    decisions = math.ceil(length / stride)
    odds, value = np.zeros((0, 4), np.float32), np.zeros(0, np.float32)
    if opinions:
        odds, value = (np.stack([np.asarray(pair[k])[n] for pair in opinions[:decisions]]) for k in (0, 1))
        value = value if np.isfinite(value).all() else value[:0]
    return Footage(
        row=experiment.name,
        seed=trained.seeds[seed_index],
        episode=n,
        task=experiment.task,
        goal=goal[n].copy(),
        qpos=np.concatenate([first[n : n + 1], row.qpos]),
        choice=row.choice,
        reward=row.reward.astype(np.float32),
        distance=row.events["goal_distance"].astype(np.float32),
        fallen=row.events["fallen"],
        flipped=row.events["flipped"],
        odds=odds,
        value=value,
        option_steps=stride,
        outcome=_outcome(row, length >= experiment.task.episode_steps),
    )


def _outcome(row: _Frame, whole: bool) -> str:
    if not row.terminated[-1]:
        return "truncated" if whole else "cut"
    for name in ("reached", "diverged", "flipped", "fallen"):
        if row.events[name][-1]:
            return name
    return "truncated"


__all__ = ["NOBODY", "Footage", "control_steps", "film", "opinion"]
