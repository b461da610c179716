"""What one visitor of ``footwork play`` has: ants that walk as evaluation's do, who leads them, and a lesson.

An ant is stepped in the environment of its row (``Options``), one control step at a time. What a
visitor may do to it goes through the same door as a restart: the state is changed and marked
stale, and the engine learns of it at its next step.
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from footwork.arena import Arena, DistanceField, Point, geodesic_field
from footwork.env import Env
from footwork.footage import opinion
from footwork.learn.networks import Policy
from footwork.options import Options, OptionsState
from footwork.physics import DEFAULT_ENGINE, physics_for
from footwork.tasks.task import Task
from footwork.train import (
    Experiment,
    Trained,
    begin_learning,
    build_environment,
    iterate_in_sight,
    planned_steps,
    steps_per_iteration,
)
from footwork.types import Array, Key, Params

REACH = 0.5  # m from the goal that count as there
LEAVE = 1.5  # m from the goal that count as gone again
STAY_SECONDS = 1.2  # at the goal, before a led ant begins anew
LIE_SECONDS = 4.0  # upside down, before any ant does
PUSH = 3.0  # m/s that a push adds
_LOOK_AHEAD = 1.2  # m
_FOR_EVER = 1_000_000_000
_UNIT = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)], np.float64)
_WINDOW = 30  # updates over which a lesson's success is counted
_SHOWN_ROWS = 32  # ants of a lesson whose ways are shown


@dataclass(frozen=True, eq=False)
class Master:
    """A trained master: it sees what its task observes."""

    policy: Policy
    params: Params  # of one policy

    @classmethod
    def of(cls, trained: Trained) -> Master:
        """The first seed's."""
        return cls(trained.experiment.policy(), trained.single())


@dataclass(frozen=True, eq=False)
class Planner:
    """No learning: the direction in which the shortest way around the walls shrinks most."""

    field: DistanceField

    @classmethod
    def to(cls, arena: Arena, goal: Point) -> Planner:
        """Tabulate the way to a goal.

        Raises:
            ValueError: no way leads there.
        """
        return cls(geodesic_field(arena, goal, resolution=0.5))

    def choose(self, position: np.ndarray) -> int:
        """A direction, from [2] in m."""
        return int(np.argmin(self.field.at(position + _LOOK_AHEAD * _UNIT)))


class Ant:
    """One ant, its environment, and what has happened to it.

    Args:
        sub_policies: a trained walker row.
        task: of the row that leads; its arena is where the ant walks. Nothing ends the episode.
        option_steps: control steps per decision.
        seed: of everything random.
        engine: the physics under it.
    """

    def __init__(self, sub_policies: Trained, task: Task, option_steps: int, seed: int, engine: str = DEFAULT_ENGINE):
        task = replace(task, episode_steps=_FOR_EVER, fall_rule="none", goal_radius=None, potential="straight")
        physics = physics_for(engine, task.robot, task.arena, 1, 1)
        self.row = sub_policies.experiment.name
        self.task = task
        self.env = Options(Env(task, physics), sub_policies.sub_policies(), option_steps)
        self.key = jax.random.key(seed)
        self.rng = np.random.default_rng(seed)
        self.steps = self.decisions = self.within = 0
        self.falls = self.flips = self.goals = 0
        self.choice = 0
        self.odds: np.ndarray | None = None  # of the last decision, [4], where a master made it
        self.value: float | None = None
        self.fallen = self.flipped = self.arrived = False
        self.lying = self.staying = 0  # control steps, upside down and at the goal
        self.distance = np.inf
        self.state: OptionsState
        self.state, self.obs = self.env.initial(jax.random.fold_in(self.key, 0))

    @property
    def qpos(self) -> np.ndarray:
        """[15]."""
        return np.asarray(self.state.inner.physics.qpos)[0]

    @property
    def goal(self) -> np.ndarray:
        """[2] in m."""
        return np.asarray(self.state.inner.goal)[0]

    def step(self, leader: Master | Planner | int) -> None:
        """One control step; at the beginning of an option the leader decides. An int is a direction held by hand."""
        if self.within == 0 or (isinstance(leader, int) and leader != self.choice):
            self._decide(leader)
        step_key = jax.random.fold_in(self.key, 2 * self.decisions + 1)
        before = self.state._replace(total=self._nothing)  # so that what comes back is of this control step alone
        self.state, _ = self.env.control_step(step_key, before, jnp.int32(self.within))
        self.obs = self.state.obs
        self.within = (self.within + 1) % self.env.option_steps
        self.steps += 1
        self._count()

    def _decide(self, leader: Master | Planner | int) -> None:
        self.odds = self.value = None
        if isinstance(leader, int):
            self.choice = leader
        elif isinstance(leader, Planner):
            self.choice = leader.choose(self.qpos[:2].astype(np.float64))
        else:
            odds, value = (np.asarray(part)[0] for part in opinion(leader.policy, leader.params, self.obs))
            self.odds, self.value = odds, float(value) if np.isfinite(value) else None
            self.choice = int(self.rng.choice(len(odds), p=odds.astype(np.float64) / odds.sum(dtype=np.float64)))
        self.decisions, self.within = self.decisions + 1, 0
        action = jnp.array([self.choice], jnp.int32)
        self.state = _begin(self.env, self.state, action, self.key)
        self._nothing = self.state.total

    def _count(self) -> None:
        """Falls, flips and arrivals are counted as they begin."""
        events = {name: np.asarray(value)[0] for name, value in self.state.total.events.items()}
        self.distance = float(events["goal_distance"])
        fallen, flipped = bool(events["fallen"]), bool(events["flipped"])
        arrived = self.distance <= (LEAVE if self.arrived else REACH)
        self.falls += fallen and not self.fallen
        self.flips += flipped and not self.flipped
        self.goals += arrived and not self.arrived
        self.lying = self.lying + 1 if flipped else 0
        self.staying = self.staying + 1 if arrived else 0
        self.fallen, self.flipped, self.arrived = fallen, flipped, arrived
        if bool(np.asarray(self.state.inner.held)[0]):  # the simulation failed
            self.restart()

    def begin_again(self, led: bool) -> bool:
        """Restart what has arrived (where it is ``led``) or lies on its back, after a while; tells whether it did."""
        dt = self.task.robot.control_dt
        if self.lying * dt < LIE_SECONDS and (not led or self.staying * dt < STAY_SECONDS):
            return False
        self.restart()
        return True

    def restart(self) -> None:
        """Begin anew above the start; a goal that was moved stays."""
        goal = self.state.inner.goal
        self.state, self.obs = _restart(self.env, self.state, jax.random.fold_in(self.key, 2 * self.steps + 2))
        self.move_goal(np.asarray(goal)[0])
        self.within = self.lying = self.staying = 0
        self.fallen = self.flipped = False

    def move_goal(self, goal: np.ndarray) -> None:
        """Put the goal at [2] in m."""
        inner = self.state.inner
        self.state = self.state._replace(inner=inner._replace(goal=jnp.asarray(goal, jnp.float32)[None]))
        self.arrived, self.staying = False, 0

    def push(self, angle: float) -> None:
        """A sudden push: :data:`PUSH` m/s more in a direction (rad), and a third of that upwards."""
        inner = self.state.inner
        qvel = np.array(inner.physics.qvel)
        qvel[0, :3] += PUSH * np.array([np.cos(angle), np.sin(angle), 1 / 3])
        physics = inner.physics._replace(qvel=jnp.asarray(qvel, jnp.float32))
        self.state = self.state._replace(inner=inner._replace(physics=physics, stale=jnp.ones(1, bool)))

    def close(self) -> None:
        """Give back what the engine holds."""
        self.env.physics.close()

    def report(self) -> dict[str, Any]:
        """What the page shows, as JSON would have it."""
        return {
            "qpos": [round(float(number), 4) for number in self.qpos],
            "goal": [round(float(number), 3) for number in self.goal],
            "choice": self.choice,
            "odds": None if self.odds is None else [round(float(p), 3) for p in self.odds],
            "value": None if self.value is None else round(self.value, 2),
            "distance": round(self.distance, 2) if np.isfinite(self.distance) else None,
            "fallen": self.fallen,
            "flipped": self.flipped,
            "arrived": self.arrived,
            "falls": self.falls,
            "flips": self.flips,
            "goals": self.goals,
            "steps": self.steps,
        }


@partial(jax.jit, static_argnums=0)
def _begin(env: Options, state: OptionsState, action: Array, key: Key) -> OptionsState:
    return env.begin(state, action, key)


@partial(jax.jit, static_argnums=0)
def _restart(env: Options, state: OptionsState, key: Key) -> tuple[OptionsState, Array]:
    return env.restart(state, jnp.ones(env.num_envs, bool), key)


class Lesson:
    """A master that learns in a thread of its own, with what training itself uses.

    Args:
        experiment: a master row, with the visitor's arena.
        needed: the sub-policies it chooses among.
        seed: of the run.
    """

    def __init__(self, experiment: Experiment, needed: Trained, seed: int = 0):
        self.experiment = experiment
        self.total = planned_steps(experiment)
        self.step, self.rate, self.success, self.progress = 0, 0.0, None, None
        self.params: Params | None = None  # of the newest master
        self.error = ""
        self._needed, self._seed = needed, seed
        self._stop = threading.Event()
        self._ways: deque[list[int]] = deque(maxlen=4000)
        self._curve: list[tuple[float, float]] = []
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="lesson", daemon=True)
        self._thread.start()

    @property
    def running(self) -> bool:
        """Whether it is still learning."""
        return self._thread.is_alive()

    def stop(self) -> None:
        """Ask it to end; what was learned stays."""
        self._stop.set()

    def join(self, seconds: float) -> None:
        """Wait for its end."""
        self._thread.join(seconds)

    def master(self) -> Master | None:
        """The newest master, once there is one."""
        return None if self.params is None else Master(self.experiment.policy(), self.params)

    def curve(self) -> list[tuple[float, float]]:
        """Success so far: (share of the lesson, share of episodes), one point per update that has one."""
        with self._lock:
            return list(self._curve)

    def report(self) -> dict[str, Any]:
        """What the page shows; ``ways`` are pieces [x, y, x, y, choice] in cm walked since the last report."""
        with self._lock:
            ways, news = list(self._ways), (self.step, self.rate, self.success, self.progress)
            self._ways.clear()
        step, rate, success, progress = news
        return {
            "step": step,
            "total": self.total,
            "rate": round(rate),
            "success": success,
            "progress": progress,
            "running": self.running,
            "error": self.error,
            "ways": ways,
        }

    def _run(self) -> None:
        try:
            _be_nice()
            self._learn()
        except Exception as error:  # the page says so, and goes on
            self.error = f"{type(error).__name__}: {error}"

    def _learn(self) -> None:
        experiment = self.experiment
        env = build_environment(experiment, 1, self._needed, 1)
        learning = begin_learning(experiment, env, (self._seed,))
        per_iteration = steps_per_iteration(experiment)
        ended: deque[tuple[float, float, float]] = deque(maxlen=_WINDOW)
        while self.step < self.total and not self._stop.is_set():
            begun = time.monotonic()
            learning, metrics, transition = iterate_in_sight(experiment, env, learning, self._seed)
            metrics = jax.tree.map(np.asarray, metrics)
            count = float(metrics["episode/count"].sum())
            progress = float(np.nan_to_num(metrics["episode/progress"].sum())) * experiment.task.robot.control_dt
            ended.append((count, float(metrics["count/reached"].sum()), progress * count))
            episodes, reached, way = (sum(column) for column in zip(*ended, strict=True))
            ways = _ways(transition, experiment.task)
            with self._lock:
                self.step = learning.iteration * per_iteration
                self.rate = per_iteration / (time.monotonic() - begun)
                self.success = round(reached / episodes, 3) if episodes else None
                self.progress = round(way / episodes, 2) if episodes else None
                self._ways.extend(ways)
                if self.success is not None:
                    self._curve.append((round(self.step / self.total, 4), self.success))
            self.params = jax.tree.map(lambda leaf: leaf[0], learning.learners.params)


def _ways(transition: Any, task: Task) -> list[list[int]]:
    """Where some ants of a rollout walked, one piece per decision, [x, y, x, y, choice] in cm."""
    place = slice(32, 34)
    before = np.asarray(transition.obs)[0, :, :_SHOWN_ROWS, place] / task.xy_scale
    after = np.asarray(transition.next_obs)[0, :, :_SHOWN_ROWS, place] / task.xy_scale
    choice = np.asarray(transition.action)[0, :, :_SHOWN_ROWS]
    pieces = np.concatenate([100 * before, 100 * after], axis=-1).astype(int)
    return np.concatenate([pieces, choice[..., None]], axis=-1).reshape(-1, 5).tolist()


def _be_nice() -> None:
    """This thread yields to those that show ants (Linux gives threads a niceness each; elsewhere nothing happens)."""
    if hasattr(os, "setpriority") and os.uname().sysname == "Linux":
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 10)


__all__ = ["PUSH", "REACH", "Ant", "Lesson", "Master", "Planner"]
