"""Our own contestants of ``footwork bench``, each a process: ``python -m footwork.study.workers SPEC``.

A contestant is a function that prepares something, its first update included, and returns how
to measure it. ``start_s`` of the report is therefore the time from nothing to the first update.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from footwork.arena import DIRECTIONS, Arena, Wall
from footwork.autoreset import AutoReset
from footwork.collect import start
from footwork.env import Env, Environment, loop_over
from footwork.learn.config import PAPER, PPOConfig
from footwork.learn.networks import Policy
from footwork.physics import physics_for
from footwork.physics.batch import BatchPhysics
from footwork.regularisers import directions_of_rows
from footwork.robot import HEAVY, ROBOTS
from footwork.study.experiments import ANT_MAZE, ANT_WALKER, find_row
from footwork.study.rivals import Measure, repeat, serve
from footwork.study.runs import find_trained
from footwork.train import (
    COMPILER_OPTIONS,
    Experiment,
    Learning,
    begin_learning,
    build_environment,
    compile_aside,
    fresh_learners,
    iterate,
    steps_per_iteration,
    update_all,
)
from footwork.types import Metrics, Transition

WALK_SPEED, WALK_UPDATES = 1.5, 10  # m/s, mean of the directions over so many updates
BANDIT_SUCCESS, BANDIT_EPISODES = 0.95, 200  # share of so many training episodes, the last ones
PRODUCT = 1536  # rows and columns of the plain product


def physics(rows: int, threads: int) -> Measure:
    """The engine alone, under actions drawn beforehand; ants are put back every 200 control steps."""
    engine = BatchPhysics(HEAVY, ANT_WALKER.arena, rows, threads)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (64, rows, 8))
    engine.initial()
    count = 0

    def control_step() -> float:
        nonlocal count
        if count % 200 == 0:
            engine.initial()
        engine.ctrl[...] = actions[count % len(actions)]
        engine.move()
        count += 1
        return rows

    repeat(control_step, 0.2)
    return lambda seconds: repeat(control_step, seconds)


def engine(engine: str, robot: str, rows: int) -> Measure:
    """An engine behind the Physics protocol, ten control steps at a time; ants are put back now and then."""
    physics = physics_for(engine, ROBOTS[robot], ANT_WALKER.arena, rows)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (10, rows, 8)).astype(np.float32)
    run = loop_over(physics, lambda state, action: (physics.step(state, action), None))
    state, count = physics.initial(), 0

    def ten_steps() -> float:
        nonlocal state, count
        state = physics.initial() if count % 20 == 0 else state
        state, _ = run(state, actions)
        jax.block_until_ready(state)
        count += 1
        return 10.0 * rows

    ten_steps()
    return lambda seconds: repeat(ten_steps, seconds)


def walkers(runs: int, threads: int, rows: int = PAPER.num_envs) -> Measure:
    """AntWalker (PAPER): ``runs`` learners in one batch, a direction each, ``rows`` ants per learner."""
    config = replace(PAPER, num_envs=rows, num_steps=max(1, PAPER.batch_size // rows))
    experiment = replace(find_row("walker/plain"), ppo=config)
    directions = directions_of_rows(runs * rows, [run % len(DIRECTIONS) for run in range(runs)])
    engine = BatchPhysics(HEAVY, ANT_WALKER.arena, runs * rows, threads)
    env = AutoReset(Env(ANT_WALKER, engine, directions, staggered=True))
    return _training(experiment, env, runs)


def maze_master(option_steps: int, threads: int) -> Measure:
    """A master on AntMaze, on packaged sub-policies."""
    row = find_row("maze/hrl/symmetric-interleaved")
    experiment = replace(row, option_steps=option_steps)
    return _training(experiment, _environment(experiment, threads), 1)


def walls(count: int, threads: int) -> Measure:
    """A flat policy among ``count`` posts, the nearest places of a lattice around the start first."""
    task = replace(ANT_MAZE, arena=posts(count))
    experiment = replace(find_row("maze/flat/free"), task=task)
    return _training(experiment, _environment(experiment, threads), 1)


def posts(count: int) -> Arena:
    """A floor with ``count`` posts, 3 m apart."""
    lattice = [(3.0 * x, 3.0 * y) for x in range(-8, 9) for y in range(-8, 9) if (x, y) != (0, 0)]
    nearest = sorted(lattice, key=lambda place: (place[0] ** 2 + place[1] ** 2, place))[:count]
    return Arena("posts", (0.0, 0.0), ((1.5, 1.5),), walls=tuple(Wall(x, y, 0.25, 0.25) for x, y in nearest))


def _environment(experiment: Experiment, threads: int) -> AutoReset:
    needed = None if experiment.needs is None else find_trained(experiment.needs, Path())
    return build_environment(experiment, 1, needed, threads)


def _training(experiment: Experiment, env: Environment, runs: int) -> Measure:
    """Whole iterations of a training run, and how much of their time the engine takes."""
    compiling = Compiling()
    in_engine = _time_engine(env.physics)
    aside = compile_aside(experiment, runs)
    keys = jax.random.split(jax.random.key(0), runs)
    learners = fresh_learners(experiment.policy(), experiment.ppo, keys)
    learning, metrics = iterate(experiment, env, Learning(0, learners, start(env, jax.random.key(1))), 0, aside)
    jax.block_until_ready((learning, metrics))
    compile_s = compiling.seconds

    def one_iteration() -> float:
        nonlocal learning
        learning, metrics = iterate(experiment, env, learning, 0)
        jax.block_until_ready((learning, metrics))
        return steps_per_iteration(experiment) * runs

    def measure(seconds: float) -> dict[str, float]:
        before = in_engine()
        answer = repeat(one_iteration, seconds)
        decisions = answer["steps"] / experiment.option_steps if experiment.is_master else 0.0
        return {**answer, "engine_s": in_engine() - before, "decisions": decisions, "compile_s": compile_s}

    return measure


def _time_engine(engine: Any) -> Callable[[], float]:
    """Let every step of the engine be timed from now on; returns how to read the clock."""
    move, total = engine.move, 0.0

    def timed(ids: Any = None) -> None:
        nonlocal total
        begun = time.perf_counter()
        try:
            move(ids)
        finally:
            total += time.perf_counter() - begun

    engine.move = timed
    return lambda: total


class Compiling:
    """Seconds that JAX has spent tracing, lowering and compiling since this was made."""

    def __init__(self) -> None:
        self.seconds = 0.0
        jax.monitoring.register_event_duration_secs_listener(self._heard)

    def _heard(self, event: str, duration_secs: float, **_: Any) -> None:
        if event.startswith("/jax/core/compile/"):
            self.seconds += duration_secs


def update(runs: int) -> Measure:
    """PPO's update alone and a plain large float32 product, in turn, on the same core."""
    row = find_row("walker/plain")
    policy, config = row.policy(), row.ppo
    compiling = Compiling()
    learners = fresh_learners(policy, config, jax.random.split(jax.random.key(0), runs))
    rollout = _some_rollout(policy, config, runs)
    multiply = jax.jit(jnp.matmul, compiler_options=COMPILER_OPTIONS)
    square = jax.random.normal(jax.random.key(1), (PRODUCT, PRODUCT))
    host_square = np.asarray(square)

    def learn() -> float:
        nonlocal learners
        learners, metrics = update_all(policy, config, learners, rollout, jax.random.key(2))
        jax.block_until_ready((learners, metrics))
        return runs * update_flops(policy, config)

    def product() -> float:
        jax.block_until_ready(multiply(square, square))
        return 2.0 * PRODUCT**3

    def host_product() -> float:
        np.matmul(host_square, host_square)
        return 2.0 * PRODUCT**3

    learn(), product(), host_product()
    compile_s = compiling.seconds

    def measure(seconds: float) -> dict[str, float]:
        mine = repeat(learn, seconds / 2)
        plain = max((repeat(p, seconds / 4) for p in (product, host_product)), key=lambda a: a["steps"] / a["seconds"])
        steps = mine["steps"] / update_flops(policy, config) * config.batch_size
        return {
            "steps": steps,
            "seconds": mine["seconds"],
            "flops": mine["steps"] / mine["seconds"],
            "product_flops": plain["steps"] / plain["seconds"],
            "compile_s": compile_s,
        }

    return measure


def _some_rollout(policy: Policy, config: PPOConfig, runs: int) -> Transition:
    rng = np.random.default_rng(0)
    shape = (runs, config.num_steps, config.num_envs)
    normal = lambda *more: jnp.asarray(rng.standard_normal((*shape, *more), np.float32))  # noqa: E731
    never, always = jnp.zeros(shape, bool), jnp.ones(shape, bool)
    obs = normal(policy.obs_size)
    return Transition(obs, normal(8), normal() - 10.0, normal(), never, never, obs, always)


def update_flops(policy: Policy, config: PPOConfig) -> float:
    """Multiplications and additions in the matrix products of one run's update: the work it cannot do without.

    Forward, and back to the weights and to the inputs of every layer but the first, for each
    sample in each epoch; and the critic twice for the advantages.
    """
    hidden = config.hidden_sizes
    nets = [(policy.obs_size, *hidden, policy.head.num_outputs), (policy.obs_size, *hidden, 1)]
    layers = [[2.0 * a * b for a, b in pairwise(net)] for net in nets]
    gradient = sum(3.0 * sum(net) - net[0] for net in layers)
    return config.batch_size * (config.update_epochs * gradient + 2.0 * sum(layers[1]))


def learn(row: str) -> Measure:
    """The row from nothing until it can do its task; ``seconds`` is the most that may take."""
    experiment = find_row(row)
    env = _environment(experiment, 0)
    goal = walks if experiment.is_walker else arrives

    def measure(seconds: float) -> dict[str, float]:
        begun, history = time.perf_counter(), list[Metrics]()
        aside = compile_aside(experiment, experiment.runs_per_seed)
        learning = begin_learning(experiment, env, (0,))
        while not goal(history):
            if time.perf_counter() - begun > seconds:
                return {"steps": 0.0, "seconds": time.perf_counter() - begun}
            learning, metrics = iterate(experiment, env, learning, 0, aside)
            history.append({name: np.asarray(value) for name, value in metrics.items()})
        steps = len(history) * steps_per_iteration(experiment) * experiment.runs_per_seed
        return {"steps": float(steps), "seconds": time.perf_counter() - begun}

    return measure


def walks(history: list[Metrics]) -> bool:
    """Four directions at WALK_SPEED in the mean, over the last updates."""
    last = history[-WALK_UPDATES:]
    return len(last) == WALK_UPDATES and bool(np.mean([m["rollout/progress"] for m in last]) >= WALK_SPEED)


def arrives(history: list[Metrics]) -> bool:
    """The wanted share of the last training episodes ended in the goal."""
    episodes = reached = 0.0
    for metrics in reversed(history):
        episodes += float(np.sum(metrics["episode/count"]))
        reached += float(np.sum(metrics["count/reached"]))
        if episodes >= BANDIT_EPISODES:
            return reached >= BANDIT_SUCCESS * episodes
    return False


KINDS: dict[str, Callable[..., Measure]] = {
    function.__name__: function for function in (physics, engine, walkers, maze_master, walls, update, learn)
}


def main() -> None:
    """A contestant, as its command line describes it."""
    spec = json.loads(sys.argv[1])
    serve(partial(KINDS[spec.pop("kind")], **spec))


if __name__ == "__main__":
    main()
