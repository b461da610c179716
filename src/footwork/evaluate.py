"""Evaluate: success, falls and progress of a row; hand-overs and random switching of sub-policies."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from footwork.arena import DIRECTIONS, open_field
from footwork.env import Env, Environment, loop_over, simulate, split_phases
from footwork.learn.networks import Policy
from footwork.options import Options, OptionsState, SubPolicies, task_state
from footwork.physics import DEFAULT_ENGINE, ENGINES, physics_for
from footwork.regularisers import directions_of_rows
from footwork.statistics import mean_over_seeds, rate_over_seeds
from footwork.tasks.task import SUCCESS_RADII, Task
from footwork.train import Experiment, Trained, choices_of
from footwork.types import Array, Key, Params

IDLE_SPEED = 0.2  # m/s; an option that gains less than this along its direction is idle
SWITCHING_STEPS = 2000  # control steps of random switching
SWITCHING_PERIODS = (25, 50, 100, 200)  # control steps per option
HANDOVER_AFTER = (100, 200)  # control steps of the first policy, uniform in this range in multiples of the segment
HANDOVER_STEPS = 300  # control steps of the second
HANDOVER_SPEED = 0.5  # m/s along the second, over all its steps, from which a hand-over counts as a success
_STRETCH = 100  # decisions at most between two looks whether all rows have ended, on a device
_PATH_STEPS = 10  # control steps between two looks at a path that no master leads
_SEGMENT = 25  # control steps between two looks
_NUM_DIRECTIONS = len(DIRECTIONS)
_UNIT = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)], np.float32)  # of the directions, world frame

Report = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Episodes:
    """One episode per row, and what its path was.

    All arrays have a leading row axis; ``paths`` is [looks, N, 2] in m, at the start and after each
    decision of a master, every tenth of others, and ``choices`` [decisions, N], of master rows only.
    """

    closest: np.ndarray  # m, to the goal
    fallen: np.ndarray
    flipped: np.ndarray
    progress: np.ndarray  # m, of the potential
    distance: np.ndarray  # return in the distance part of the reward
    time_to_goal: np.ndarray  # s; NaN where the goal was not reached
    paths: np.ndarray
    choices: np.ndarray
    ended: np.ndarray  # [decisions, N], the row's episode was over before this decision


def evaluation_environment(
    experiment: Experiment, num_envs: int, needed: SubPolicies | None, num_threads: int = 0
) -> Environment:
    """The row's task without resets; an episode goes on until the smallest success radius."""
    task = experiment.task
    if task.goal_radius is not None:
        task = replace(task, goal_radius=min(*SUCCESS_RADII, task.goal_radius))
    physics = physics_for(experiment.engine, task.robot, task.arena, num_envs, num_threads)
    if experiment.is_walker:
        return Env(task, physics, directions_of_rows(num_envs, range(_NUM_DIRECTIONS)))
    env = Env(task, physics)
    return env if needed is None else Options(env, needed, experiment.option_steps)


def play_episodes(
    trained: Trained,
    sub_policies: SubPolicies | None,
    num_episodes: int,
    seed: int,
    seed_index: int = 0,
    deterministic: bool = False,
    num_threads: int = 0,
) -> Episodes:
    """Play ``num_episodes`` episodes of one seed's policy, all at once."""
    env = evaluation_environment(trained.experiment, num_episodes, sub_policies, num_threads)
    act = actor(trained, seed_index, env, deterministic)
    with closing(env.physics):
        course = _play_out(trained.experiment, env, act, jax.random.key(seed))
    return _summary(trained.experiment, course)


class _Course(NamedTuple):
    """Episodes as they went: what is kept of each decision of the policy, [decisions, N]."""

    events: dict[str, np.ndarray]
    progress: np.ndarray
    choices: np.ndarray  # of master rows; else no decisions
    ended: np.ndarray  # before the decision
    paths: np.ndarray  # [looks, N, 2] in m


def _play_out(experiment: Experiment, env: Environment, act: Any, key: Key) -> _Course:
    """Play until every row's episode has ended."""
    num_decisions = math.ceil(experiment.task.episode_steps / experiment.steps_per_decision)
    play = loop_over(env.physics, partial(_decide, env, act, key))
    stretch = math.gcd(num_decisions, _STRETCH) if env.physics.traceable else 1  # of one length: it is compiled once
    playing, kept = env.initial(jax.random.fold_in(key, 0)), []
    start = _positions(playing[0])
    for first in range(1, 1 + num_decisions, stretch):
        if np.asarray(task_state(playing[0]).held).all():
            break
        playing, stretch_kept = play(playing, np.arange(first, first + stretch, dtype=np.int32))
        kept.append(jax.tree.map(np.asarray, stretch_kept))
    ended, positions, events, progress, choices = jax.tree.map(lambda *leaves: np.concatenate(leaves), *kept)
    choices = choices if experiment.is_master else np.zeros((0, env.num_envs), np.int32)
    steps_per_look = 1 if experiment.is_master else _PATH_STEPS
    return _Course(events, progress, choices, ended, np.concatenate([start[None], positions[::steps_per_look]]))


def _decide(env: Environment, act: Any, key: Key, playing: tuple[Any, Array], number: Array) -> tuple[Any, Any]:
    """One decision of the policy under test, as the body of a loop, and what is kept of it."""
    state, obs = playing
    ended = task_state(state).held
    state, action, simulate_key, finish_key = act(state, obs, key, number)
    state, step = finish_step(env, env.simulate(state, simulate_key), finish_key)
    choice = action if isinstance(env, Options) else ()
    kept = (ended, task_state(state).physics.qpos[:, :2], step.events, step.terms["progress"], choice)
    return (state, step.obs), kept


def _summary(experiment: Experiment, course: _Course) -> Episodes:
    """What the episodes came to; a decision after a row's end counts for nothing."""
    dt = experiment.task.robot.control_dt
    distance = np.where(course.ended, np.inf, course.events["goal_distance"])
    arrived = distance <= (experiment.task.goal_radius or 0.0)
    decisions = np.where(arrived.any(axis=0), arrived.argmax(axis=0) + 1.0, np.nan)
    progress = course.progress.sum(axis=0)
    return Episodes(
        closest=distance.min(axis=0),
        fallen=(course.events["fallen"] & ~course.ended).any(axis=0),
        flipped=(course.events["flipped"] & ~course.ended).any(axis=0),
        progress=progress * dt,
        distance=progress,
        time_to_goal=decisions * (experiment.steps_per_decision * dt),
        paths=course.paths,
        choices=course.choices,
        ended=course.ended,
    )


def actor(trained: Trained, seed_index: int, env: Environment, deterministic: bool) -> Any:
    """The jitted first call of a step: the policy under test, and the environment's begin."""
    experiment = trained.experiment
    if experiment.is_walker:
        walkers = trained.sub_policies(seed_index, deterministic)
        direction = jnp.array(env.goal_index)  # type: ignore[attr-defined]
        choose: Any = lambda obs, key: walkers.act(obs, direction, key)  # noqa: E731
    else:
        choose = partial(_choose, experiment.policy(), trained.single(seed_index), deterministic)

    @jax.jit
    def act(state: Any, obs: Array, key: Key, i: Array) -> Any:
        act_key, env_key = jax.random.split(jax.random.fold_in(key, i))
        begin_key, simulate_key, finish_key = split_phases(env_key)
        action = choose(obs, act_key)
        return env.begin(state, action, begin_key), action, simulate_key, finish_key

    return act


def _choose(policy: Policy, params: Params, deterministic: bool, obs: Array, key: Key) -> Array:
    return policy.mode(params, obs) if deterministic else policy.act(params, obs, key)[0]


@partial(jax.jit, static_argnums=0)
def finish_step(env: Environment, state: Any, key: Key) -> Any:
    """The jitted second call of a step."""
    return env.finish(state, key)


def _positions(state: Any) -> np.ndarray:
    return np.asarray(task_state(state).physics.qpos)[:, :2].copy()


def evaluate(
    trained: Trained,
    needed: Trained | None,
    num_episodes: int = 1000,
    seed: int = 1_000_003,
    deterministic: bool = False,
    num_threads: int = 0,
) -> dict[str, Any]:
    """Figures of a row over ``num_episodes`` episodes of each of its seeds, with 95 % intervals.

    Success is judged at several radii from the closest approach; a walker's is None, its targets being
    10 km away. Time to goal is known to one decision of the policy: a master's is rounded up to a whole option.
    The intervals are over seeds and episodes (:mod:`footwork.statistics`); one seed says nothing about others.
    """
    experiment = trained.experiment
    subs = choices_of(experiment, needed)
    episodes = [
        play_episodes(trained, subs, num_episodes, seed + index, index, deterministic, num_threads)
        for index in range(len(trained.seeds))
    ]
    closest, fallen, flipped, progress = (
        np.stack([getattr(e, name) for e in episodes]) for name in ("closest", "fallen", "flipped", "progress")
    )
    arrival = [e.time_to_goal[np.isfinite(e.time_to_goal)] for e in episodes]
    arrived = np.concatenate(arrival)
    generator = np.random.default_rng(seed)
    success = None if experiment.is_walker else {str(radius): closest <= radius for radius in SUCCESS_RADII}
    report: dict[str, Any] = {
        "row": experiment.name,
        "engine": experiment.engine,
        "seeds": list(trained.seeds),
        "episodes": int(closest.size),
        "episode_steps": experiment.task.episode_steps,
        "success": None if success is None else {radius: float(hit.mean()) for radius, hit in success.items()},
        "fall_rate": float(fallen.mean()),
        "flip_rate": float(flipped.mean()),
        "progress_m": float(progress.mean()),
        "time_to_goal_s": float(arrived.mean()) if arrived.size else None,
        "interval": {
            "success": None if success is None else {r: list(rate_over_seeds(hit)) for r, hit in success.items()},
            "fall_rate": list(rate_over_seeds(fallen)),
            "flip_rate": list(rate_over_seeds(flipped)),
            "progress_m": list(mean_over_seeds(list(progress), generator)),
            "time_to_goal_s": list(mean_over_seeds(arrival, generator)) if arrived.size else None,
        },
        "source": trained.source,
    }
    if experiment.is_walker:
        report["speed_mps"] = _speed_by_direction(experiment, episodes)
    return report


def _speed_by_direction(experiment: Experiment, episodes: list[Episodes]) -> dict[str, list[float]]:
    """Mean speed over the whole episode time, per direction: one entry per seed. Time after a fall counts."""
    seconds = experiment.task.episode_steps * experiment.task.robot.control_dt
    blocks = [np.split(e.progress, _NUM_DIRECTIONS) for e in episodes]
    return {
        name: [float(block[direction].mean() / seconds) for block in blocks]
        for direction, name in enumerate(DIRECTIONS)
    }


def switching_task(task: Task) -> Task:
    """An open field where nothing ends an episode, for tests of hand-overs."""
    return replace(task, arena=open_field(), fall_rule="none", goal_radius=None, episode_steps=1_000_000)


@dataclass(frozen=True, eq=False)
class _Walk:
    """Ants driven by chosen sub-policies in segments of a few control steps."""

    env: Options
    key: Key

    def __enter__(self) -> _Walk:
        return self

    def __exit__(self, *_: object) -> None:
        self.env.physics.close()

    def start(self) -> OptionsState:
        state, _ = self.env.initial(jax.random.fold_in(self.key, 0))
        return state

    def run(self, state: OptionsState, choice: np.ndarray, segment: int) -> tuple[OptionsState, Any]:
        """One segment: the state after it and what was counted."""
        begin, simulating, finish = split_phases(jax.random.fold_in(self.key, 1 + segment))
        state = simulate(self.env, self.env.begin(state, jnp.asarray(choice), begin), simulating)
        state, step = finish_step(self.env, state, finish)
        return state, step.events


def _walk(sub_policies: SubPolicies, task: Task, num_envs: int, key: Key, num_threads: int, engine: str) -> _Walk:
    task = switching_task(task)
    env = Env(task, physics_for(engine, task.robot, task.arena, num_envs, num_threads), (0,) * num_envs)
    return _Walk(Options(env, sub_policies, _SEGMENT), key)


def handover_matrix(
    sub_policies: SubPolicies,
    task: Task,
    ants: int = 64,
    seed: int = 0,
    num_threads: int = 0,
    engine: str = DEFAULT_ENGINE,
) -> list[list[dict[str, float]]]:
    """Run i for 100 to 200 control steps, then j for 300: entry [i][j] has fall and flip rate and the speed after.

    ``ants`` per pair. A fall or flip counts from the hand-over on; the speed is along j over all 300 steps.
    A hand-over succeeds without either at :data:`HANDOVER_SPEED` or more. An engine whose ants are large gets one i
    after the other, each with a key of its own: no more ants at once than :func:`random_switching` with 4 ``ants``.
    """
    pairs = np.repeat(np.arange(_NUM_DIRECTIONS**2, dtype=np.int32), ants)
    low, high = (steps // _SEGMENT for steps in HANDOVER_AFTER)
    switch = np.random.default_rng(seed).integers(low, high + 1, pairs.size)
    key, count = jax.random.key(seed), _NUM_DIRECTIONS if ENGINES[engine].large else 1
    keys = [key] if count == 1 else [jax.random.fold_in(key, i) for i in range(count)]
    walks = [
        _hand_over(_walk(sub_policies, task, some.size, one, num_threads, engine), some, when)
        for some, when, one in zip(np.split(pairs, count), np.split(switch, count), keys, strict=True)
    ]
    fell, flipped, at_switch, at_end = (np.concatenate(parts) for parts in zip(*walks, strict=True))
    second = pairs % _NUM_DIRECTIONS
    seconds = HANDOVER_STEPS * task.robot.control_dt
    speed = np.sum((at_end - at_switch) * _UNIT[second], axis=1) / seconds
    success = ~fell & ~flipped & (speed >= HANDOVER_SPEED)
    counted_as = {"fall": fell, "flip": flipped, "speed_mps": speed, "success": success}
    by_pair = {
        name: array.reshape(_NUM_DIRECTIONS, _NUM_DIRECTIONS, ants).mean(2) for name, array in counted_as.items()
    }
    return [
        [{name: float(rates[i, j]) for name, rates in by_pair.items()} for j in range(_NUM_DIRECTIONS)]
        for i in range(_NUM_DIRECTIONS)
    ]


def _hand_over(walk: _Walk, pairs: np.ndarray, switch: np.ndarray) -> tuple[np.ndarray, ...]:
    """Hand over from ``pairs // 4`` to ``pairs % 4`` after ``switch`` segments.

    Returns:
        Who fell and who flipped after it, [N] each, and where it was and where its steps ended, [N, 2] in m each.
    """
    first, second = pairs // _NUM_DIRECTIONS, pairs % _NUM_DIRECTIONS
    fell, flipped = np.zeros_like(first, bool), np.zeros_like(first, bool)
    at_switch, at_end = np.zeros((first.size, 2)), np.zeros((first.size, 2))
    after = HANDOVER_STEPS // _SEGMENT
    with walk:
        state = walk.start()
        for segment in range(HANDOVER_AFTER[1] // _SEGMENT + after):
            position = _positions(state)
            at_switch = np.where(np.equal(segment, switch)[:, None], position, at_switch)
            state, events = walk.run(state, np.where(segment < switch, first, second), segment)
            counted = (segment >= switch) & (segment < switch + after)
            fell = fell | (np.asarray(events["fallen"]) & counted)
            flipped = flipped | (np.asarray(events["flipped"]) & counted)
            at_end = np.where(np.equal(segment, switch + after - 1)[:, None], _positions(state), at_end)
    return fell, flipped, at_switch, at_end


def random_switching(
    sub_policies: SubPolicies,
    task: Task,
    option_steps: int,
    ants: int = 256,
    seed: int = 0,
    orthogonal: bool = False,
    num_threads: int = 0,
    engine: str = DEFAULT_ENGINE,
) -> dict[str, float]:
    """2000 control steps in which every ant draws a new direction every ``option_steps``.

    The draw is uniform over all four directions, or over the two orthogonal to the last.
    Speed is along the direction of each option, over all options after the first; an option under
    0.2 m/s is idle. ``upside_down`` and ``fallen`` (by height) are shares at the end.
    """
    if option_steps % _SEGMENT:
        raise ValueError(f"option_steps must be a multiple of {_SEGMENT}, got {option_steps}")
    generator = np.random.default_rng(seed)
    choice = generator.integers(0, _NUM_DIRECTIONS, ants)
    per_option, speeds = option_steps // _SEGMENT, []
    with _walk(sub_policies, task, ants, jax.random.key(seed), num_threads, engine) as walk:
        state = walk.start()
        for option in range(SWITCHING_STEPS // option_steps):
            if option:
                turn = generator.choice((1, 3), ants) if orthogonal else generator.integers(0, _NUM_DIRECTIONS, ants)
                choice = (choice + turn) % _NUM_DIRECTIONS
            before = _positions(state)
            for segment in range(per_option):
                state, _ = walk.run(state, choice.astype(np.int32), option * per_option + segment)
            moved = np.sum((_positions(state) - before) * _UNIT[choice], axis=1)
            speeds.append(moved / (option_steps * task.robot.control_dt))
    after_first = np.stack(speeds[1:])
    qpos = np.asarray(state.inner.physics.qpos)
    return {
        "speed_mps": float(after_first.mean()),
        "idle": float((after_first < IDLE_SPEED).mean()),
        "upside_down": float(_upside_down(qpos).mean()),
        "fallen": float((qpos[:, 2] <= task.robot.fall_height).mean()),
    }


def _upside_down(qpos: np.ndarray) -> np.ndarray:
    return 1.0 - 2.0 * (qpos[:, 4] ** 2 + qpos[:, 5] ** 2) < 0.0


def transitions(
    trained: Trained,
    ants: int = 256,
    seed: int = 1_000_003,
    deterministic: bool = False,
    num_threads: int = 0,
    periods: tuple[int, ...] = SWITCHING_PERIODS,
    orthogonal: bool = False,
    report: Report = lambda line: None,
) -> dict[str, Any]:
    """The hand-over matrix and random switching of a row's sub-policies, as means over its seeds.

    With ``orthogonal``, every new direction of the switching is at right angles to the last.

    Raises:
        ValueError: the row trains no sub-policies.
    """
    task, engine = trained.experiment.task, trained.experiment.engine
    if not trained.experiment.is_walker:
        raise ValueError(f"transitions are measured on sub-policies (walker/...), not on {trained.experiment.name}")
    matrices: list[list[list[dict[str, float]]]] = []
    switching: dict[str, list[dict[str, float]]] = {str(k): [] for k in periods}
    for index in range(len(trained.seeds)):
        subs = trained.sub_policies(index, deterministic)
        report(f"seed {trained.seeds[index]}: hand-over matrix")
        matrices.append(handover_matrix(subs, task, max(1, ants // 4), seed + index, num_threads, engine))
        for k in periods:
            report(f"seed {trained.seeds[index]}: random switching, k = {k}")
            figures = random_switching(subs, task, k, ants, seed + index, orthogonal, num_threads, engine)
            switching[str(k)].append(figures)
    mean = lambda *values: float(np.mean(values))  # noqa: E731
    return {
        "row": trained.experiment.name,
        "engine": engine,
        "seeds": list(trained.seeds),
        "orthogonal": orthogonal,
        "handover": jax.tree.map(mean, *matrices),
        "switching": {k: jax.tree.map(mean, *results) for k, results in switching.items()},
        "switching_by_seed": switching,
        "source": trained.source,
    }


__all__ = [
    "Episodes",
    "actor",
    "evaluate",
    "evaluation_environment",
    "finish_step",
    "handover_matrix",
    "play_episodes",
    "random_switching",
    "switching_task",
    "transitions",
]
