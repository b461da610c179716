"""Train: one row of the table, for one or several seeds, into a run directory."""

from __future__ import annotations

import math
import signal
import time
import warnings
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from footwork import checkpoint
from footwork.arena import DIRECTIONS
from footwork.autoreset import AutoReset
from footwork.collect import Carry, collect, start
from footwork.env import Env, Environment, host_jit
from footwork.learn import ppo
from footwork.learn.config import PPOConfig
from footwork.learn.networks import Policy, categorical_policy, gaussian_policy
from footwork.options import Options, SubPolicies
from footwork.physics import DEFAULT_ENGINE, check_engine, physics_for
from footwork.record import Progress, RunDir, config_to_json, versions
from footwork.regularisers import (
    AppropriateBias,
    Interleaved,
    Regulariser,
    directions_of_rows,
    expect_handovers,
    regularise,
)
from footwork.tasks.task import Task
from footwork.types import Key, Metrics, Params, Transition

SAVE_EVERY_STEPS = 131_072  # control steps of all learners between checkpoints, where a checkpoint changes numbers
COMPILER_OPTIONS = {"xla_cpu_multi_thread_eigen": False}  # a product's result must not depend on the thread count


@dataclass(frozen=True)
class Experiment:
    """A row of the table: everything that defines a run but its seeds.

    Args:
        name: the row's address, e.g. ``maze/hrl/interleaved``.
        task: what is to be done.
        ppo: how it is learned; ``num_envs`` is per run (per direction, per seed).
        total_steps: control steps per run. Not in the paper.
        regulariser: of sub-policy rows.
        symmetric: one policy in four frames instead of four policies.
        sub_policies: of master rows: the walker row that the master chooses among.
        option_steps: the paper's k, of master rows. Not stated in the paper.
        deterministic_sub_policies: they act by their mode under a master. Not in the paper.
        engine: the physics it is trained on, one of ``footwork.physics.ENGINES``.
    """

    name: str
    task: Task
    ppo: PPOConfig
    total_steps: int
    regulariser: Regulariser | None = None
    symmetric: bool = False
    sub_policies: str | None = None
    option_steps: int = 50
    deterministic_sub_policies: bool = False
    engine: str = DEFAULT_ENGINE

    def __post_init__(self) -> None:
        check_engine(self.engine)
        if self.total_steps < 1:
            raise ValueError(f"total_steps must be >= 1, got {self.total_steps}")
        if self.option_steps < 1:
            raise ValueError(f"option_steps must be >= 1, got {self.option_steps}")
        if self.regulariser is not None and not self.is_walker:
            raise ValueError(f"{self.name}: only sub-policies are regularised")
        if self.is_master and self.is_walker:
            raise ValueError(f"{self.name}: a master needs a task with coordinates (observe_xy)")

    @property
    def is_walker(self) -> bool:
        """Whether the row trains sub-policies: on a task with the four directions as goals."""
        return not self.task.observe_xy

    @property
    def is_master(self) -> bool:
        """Whether the row trains a master."""
        return self.sub_policies is not None

    @property
    def steps_per_decision(self) -> int:
        """Control steps per action of its policy: a master's k, else one."""
        return self.option_steps if self.is_master else 1

    @property
    def runs_per_seed(self) -> int:
        """Learners side by side for one seed."""
        return len(DIRECTIONS) if self.is_walker and not self.symmetric else 1

    @property
    def needs(self) -> str | None:
        """The row that must be trained first."""
        if isinstance(self.regulariser, AppropriateBias):
            return self.regulariser.partners
        return self.sub_policies

    def policy(self) -> Policy:
        """The network that this row trains."""
        if self.is_master:
            return categorical_policy(self.ppo, self.task.obs_size, len(DIRECTIONS))
        return gaussian_policy(self.ppo, self.task.obs_size, 8)


class Trained(NamedTuple):
    """Policies as they come out of a run: parameters have leading axes [seed, run of that seed]."""

    experiment: Experiment
    seeds: tuple[int, ...]
    params: Params
    source: str  # where they were found, for messages

    def sub_policies(self, seed_index: int = 0, deterministic: bool = False) -> SubPolicies:
        """One seed's sub-policies, for a master or a hand-over test."""
        params = jax.tree.map(lambda leaf: leaf[seed_index], self.params)
        if self.experiment.symmetric:
            params = jax.tree.map(lambda leaf: leaf[0], params)
        return SubPolicies(self.experiment.policy(), params, self.experiment.symmetric, deterministic)

    def single(self, seed_index: int = 0) -> Params:
        """One seed's parameters without leading axes, of rows that train one policy per seed: a master, a flat one."""
        return jax.tree.map(lambda leaf: leaf[seed_index, 0], self.params)


class Learning(NamedTuple):
    """All that changes while a run learns."""

    iteration: int
    learners: ppo.TrainState  # leading axis: seeds x runs of a seed
    carry: Carry


class TrainingDiverged(RuntimeError):
    """A loss or a gradient is no longer finite."""


class Interrupted(RuntimeError):
    """The run was asked to stop, and has saved itself as far as its engine allows."""


def choices_of(experiment: Experiment, needed: Trained | None) -> SubPolicies | None:
    """The sub-policies that a master chooses among, acting as its row says; None for other rows.

    Args:
        experiment: the row.
        needed: the policies of ``experiment.needs``.
    """
    if needed is None or not experiment.is_master:
        return None
    return needed.sub_policies(deterministic=experiment.deterministic_sub_policies)


def build_environment(
    experiment: Experiment, num_seeds: int, needed: Trained | None, num_threads: int = 0
) -> AutoReset:
    """The training environment of a row: task, regulariser or options, automatic reset."""
    num_envs = experiment.ppo.num_envs * num_seeds * experiment.runs_per_seed
    task = experiment.task
    physics = physics_for(experiment.engine, task.robot, task.arena, num_envs, num_threads)
    if experiment.needs is not None and needed is None:
        raise ValueError(f"{experiment.name} needs the policies of {experiment.needs}")
    if not experiment.is_walker:
        env = Env(task, physics, staggered=True)
        subs = choices_of(experiment, needed)
        return AutoReset(env if subs is None else Options(env, subs, experiment.option_steps))
    directions = directions_of_rows(num_envs // num_seeds, range(len(DIRECTIONS))) * num_seeds
    walker = Env(task, physics, directions, staggered=True)
    partners = None if needed is None else needed.sub_policies()
    return AutoReset(regularise(walker, experiment.regulariser, experiment.symmetric, num_seeds, partners))


def steps_per_iteration(experiment: Experiment) -> int:
    """Control steps that one run takes between updates."""
    return experiment.ppo.batch_size * experiment.steps_per_decision


def planned_steps(experiment: Experiment) -> int:
    """Control steps that a run takes: as many whole iterations as ``total_steps`` holds, and at least one."""
    per_iteration = steps_per_iteration(experiment)
    return max(1, experiment.total_steps // per_iteration) * per_iteration


def begin_learning(experiment: Experiment, env: Environment, seeds: tuple[int, ...]) -> Learning:
    """Fresh learners and first episodes. One root key per seed; the environment's comes from the first."""
    keys = [jax.random.split(jax.random.fold_in(jax.random.key(seed), 0), experiment.runs_per_seed) for seed in seeds]
    learners = fresh_learners(experiment.policy(), experiment.ppo, jnp.concatenate(keys))
    return Learning(0, learners, start(env, jax.random.fold_in(jax.random.key(seeds[0]), 1)))


@partial(host_jit, num_static=2)
def fresh_learners(policy: Policy, config: PPOConfig, keys: Key) -> ppo.TrainState:
    """One learner per key."""
    return jax.vmap(partial(ppo.init, policy, config))(keys)


@partial(jax.jit, static_argnums=(0, 1), compiler_options=COMPILER_OPTIONS)
def update_all(
    policy: Policy, config: PPOConfig, learners: ppo.TrainState, transition: Transition, key: Key
) -> tuple[ppo.TrainState, Metrics]:
    """One PPO update of every run."""
    keys = jax.random.split(key, transition.reward.shape[0])
    return jax.vmap(partial(ppo.update, policy, config))(learners, transition, keys)


def compile_aside(experiment: Experiment, num_learners: int) -> Future[None]:
    """Begin to compile :func:`update_all`, the longest compilation of a run, before there is a rollout to call it with.

    Whatever else a start needs is compiled meanwhile, on another core.
    """
    aside = ThreadPoolExecutor(1, "compile")
    compiling = aside.submit(_compile_update, experiment, num_learners)
    aside.shutdown(wait=False)
    return compiling


def _compile_update(experiment: Experiment, num_learners: int) -> None:
    policy, config = experiment.policy(), experiment.ppo
    key = jax.eval_shape(jax.random.key, 0)

    def arguments(key: Key) -> tuple[ppo.TrainState, Transition]:
        learners = fresh_learners(policy, config, jax.random.split(key, num_learners))
        shape = (num_learners, config.num_steps, config.num_envs)
        number, flag, obs = jnp.zeros(shape), jnp.zeros(shape, bool), jnp.zeros((*shape, policy.obs_size))
        action = policy.head.mode(jnp.zeros((*shape, policy.head.num_outputs)))
        transition = Transition(obs, action, number, number, flag, flag, obs, flag)
        return learners, _with_handovers(experiment, learners, transition)

    update_all.lower(policy, config, *jax.eval_shape(arguments, key), key).compile()


def iterate(
    experiment: Experiment, env: Environment, learning: Learning, seed: int, compiling: Future[None] | None = None
) -> tuple[Learning, Metrics]:
    """One rollout and one update, which waits for ``compiling``; metrics have the leading axis of the learners."""
    return iterate_in_sight(experiment, env, learning, seed, compiling)[:2]


def iterate_in_sight(
    experiment: Experiment, env: Environment, learning: Learning, seed: int, compiling: Future[None] | None = None
) -> tuple[Learning, Metrics, Transition]:
    """:func:`iterate`, and the rollout that was learned from, axes [R, T, N, ...], for those who show it."""
    policy, config = experiment.policy(), experiment.ppo
    root = jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), 2), learning.iteration)
    collect_key, update_key = jax.random.split(root)
    carry, transition, metrics = collect(
        env, policy, learning.learners.params, learning.carry, collect_key, config.num_steps
    )
    transition = _with_handovers(experiment, learning.learners, transition)
    if compiling is not None:
        compiling.result()
    learners, update_metrics = update_all(policy, config, learning.learners, transition, update_key)
    return Learning(learning.iteration + 1, learners, carry), {**metrics, **update_metrics}, transition


def _with_handovers(experiment: Experiment, learners: ppo.TrainState, transition: Transition) -> Transition:
    """The rollout, with what the learners expect of each other where the row's regulariser says that they do."""
    regulariser = experiment.regulariser
    if not (isinstance(regulariser, Interleaved) and regulariser.cooperative):
        return transition
    return expect_handovers(regulariser, experiment.symmetric, experiment.policy(), learners.params, transition)


def train(
    experiment: Experiment,
    seeds: tuple[int, ...],
    run: RunDir,
    needed: Trained | None = None,
    num_threads: int = 0,
    checkpoint_seconds: float = 60.0,
    tensorboard: bool = False,
) -> Trained:
    """Train a row to its end in ``run``, going on from its newest sound checkpoint if it has one.

    Args:
        experiment: the row.
        seeds: trained side by side in one batch.
        run: an existing run directory, locked by the caller.
        needed: the policies of ``experiment.needs``.
        num_threads: of the physics; changes no number.
        checkpoint_seconds: time between checkpoints; changes no number. Not heeded on an engine whose ants feel it
            (``Physics.restore_alters``): there a checkpoint comes every :data:`SAVE_EVERY_STEPS`, and only then.
        tensorboard: also write event files (extra ``[tb]``).

    Raises:
        TrainingDiverged: a metric of the learner is not finite; names it, the step and the last checkpoint.
        Interrupted: SIGINT or SIGTERM came; says what is saved.
        ValueError: the run is beyond ``experiment.total_steps`` already, or has a checkpoint that its engine
            cannot go on from.
    """
    env = build_environment(experiment, len(seeds), needed, num_threads)
    compiling = compile_aside(experiment, len(seeds) * experiment.runs_per_seed)
    with closing(env.physics):
        learning = _resume(run, env, begin_learning(experiment, env, seeds))
        _check_not_beyond(experiment, run, learning)
        learning = _learn(experiment, env, learning, seeds, run, needed, compiling, checkpoint_seconds, tensorboard)
        total = planned_steps(experiment)
        if not env.physics.restore_alters:
            _save(run, env, learning, total)
    return _finish(experiment, seeds, run, learning, total)


def _check_not_beyond(experiment: Experiment, run: RunDir, learning: Learning) -> None:
    """Refuse to go on with a run that has taken more steps than it is asked for."""
    at, total = learning.iteration * steps_per_iteration(experiment), planned_steps(experiment)
    if at > total:
        raise ValueError(f"{run.path} is at step {at} already: total_steps must be at least that, got {total}")


def _learn(
    experiment: Experiment,
    env: Environment,
    learning: Learning,
    seeds: tuple[int, ...],
    run: RunDir,
    needed: Trained | None,
    compiling: Future[None],
    checkpoint_seconds: float,
    tensorboard: bool,
) -> Learning:
    """Iterate to the last planned step: what was learned. Logs every iteration, saves now and then."""
    per_iteration, total = steps_per_iteration(experiment), planned_steps(experiment)
    all_per_iteration = len(seeds) * experiment.runs_per_seed * per_iteration
    step, last_save = learning.iteration * per_iteration, time.monotonic()
    with (
        run.open_metrics(tensorboard) as log,
        Progress(total, experiment.name, initial_step=step) as progress,
        _stop_signals() as stop_asked,
    ):
        if needed is not None:
            progress.say(f"stands on {needed.experiment.name}, {needed.source}")
        if step > 0:
            progress.say(f"goes on from step {step:,} of {total:,}")
        while step < total:
            begun = time.monotonic()
            learning, metrics = iterate(experiment, env, learning, seeds[0], compiling)
            step = learning.iteration * per_iteration
            metrics = jax.tree.map(np.asarray, metrics)
            _check_finite({**metrics, "parameters": _largest(learning.learners.params)}, step, run)
            rate = all_per_iteration / (time.monotonic() - begun)
            log.write(step, {**metrics, "time/steps_per_second": rate})
            progress.update(step, _headline(experiment, metrics))
            if env.physics.restore_alters:
                due = learning.iteration % max(1, SAVE_EVERY_STEPS // all_per_iteration) == 0
            else:
                due = stop_asked() or time.monotonic() - last_save > checkpoint_seconds
            if due:
                _save(run, env, learning, step)
                last_save = time.monotonic()
            if stop_asked():
                raise Interrupted(f"stopped at step {step} of {total}; {_way_on(experiment, env, run)}")
    return learning


def _way_on(experiment: Experiment, env: Environment, run: RunDir) -> str:
    """What a run that was stopped has saved, and how it goes on."""
    saved = [step for step, _ in run.checkpoints()]
    where = f"saved at step {saved[-1]} in {run.path}" if saved else f"nothing is saved in {run.path} yet"
    return f"{where}, " + (
        "the same command with --resume goes on"
        if env.physics.resumable
        else f"but engine {experiment.engine} cannot resume"
    )


def _finish(experiment: Experiment, seeds: tuple[int, ...], run: RunDir, learning: Learning, step: int) -> Trained:
    shape = (len(seeds), experiment.runs_per_seed)
    params = jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[1:]), learning.learners.params)
    run.save_policy(params, policy_meta(experiment, seeds, step))
    run.finish({"row": experiment.name, "seeds": list(seeds), "steps": step})
    return Trained(experiment, seeds, params, str(run.policy_path))


def policy_meta(experiment: Experiment, seeds: tuple[int, ...], step: int) -> dict[str, Any]:
    """What a file of policies says of itself."""
    return {
        "experiment": config_to_json(experiment),
        "seeds": list(seeds),
        "steps": step,
        "versions": versions(),
    }


def _tree(env: Environment, learning: Learning) -> dict[str, Any]:
    return {"learners": learning.learners, "carry": learning.carry, "engine": env.physics.snapshot()}


def _save(run: RunDir, env: Environment, learning: Learning, step: int) -> None:
    tree = _tree(env, learning)
    run.save_checkpoint(step, tree, {"iteration": learning.iteration, **_pace(env)})
    if env.physics.restore_alters:
        env.physics.restore(tree["engine"])


def _pace(env: Environment) -> dict[str, int]:
    """What a checkpoint says of when the others come, where that is part of what makes the numbers."""
    return {"save_every_steps": SAVE_EVERY_STEPS} if env.physics.restore_alters else {}


def _resume(run: RunDir, env: Environment, fresh: Learning) -> Learning:
    """The newest sound checkpoint of the run, or the fresh start."""
    latest = run.latest_checkpoint()
    if latest.path is None:
        if latest.skipped:
            raise checkpoint.CheckpointError(f"no checkpoint of {run.path} can be read: {latest.skipped[0]}")
        run.rewind(latest.step)
        return fresh
    tree, meta = checkpoint.load(latest.path, _tree(env, fresh))
    if meta.get("save_every_steps") != _pace(env).get("save_every_steps"):
        raise ValueError(f"{run.path} has its checkpoints at other steps than this version: choose another --name")
    for damage in latest.skipped:
        warnings.warn(f"going on from step {latest.step}: {damage}", stacklevel=2)
    env.physics.restore(tree["engine"])
    run.rewind(latest.step)
    return Learning(int(meta["iteration"]), tree["learners"], tree["carry"])


def _largest(params: Params) -> Any:
    """The largest magnitude among all parameters; not finite if one of them is not."""
    return np.max([np.abs(np.asarray(leaf)).max() for leaf in jax.tree.leaves(params)])


def _check_finite(metrics: Metrics, step: int, run: RunDir) -> None:
    for name in ("policy_loss", "value_loss", "grad_norm", "approx_kl", "entropy", "parameters"):
        if not np.isfinite(metrics[name]).all():
            last = run.latest_checkpoint().path
            kept = f"the last good checkpoint is {last}" if last else "there is no earlier checkpoint"
            raise TrainingDiverged(f"{name} is not finite at step {step}; {kept}")


def _headline(experiment: Experiment, metrics: Metrics) -> dict[str, float]:
    """The figures that matter while one watches."""
    if experiment.is_walker:
        return {"m/s": float(np.mean(metrics["rollout/progress"]))}
    ended = max(float(np.sum(metrics["episode/count"])), 1.0)
    return {
        "success": float(np.sum(metrics["count/reached"])) / ended,
        "episode progress m": float(np.nanmean(metrics["episode/progress"])) * experiment.task.robot.control_dt
        if np.isfinite(metrics["episode/progress"]).any()
        else math.nan,
    }


@contextmanager
def _stop_signals() -> Iterator[Any]:
    """Turn the first SIGINT or SIGTERM into a request; a second one acts at once."""
    asked = False

    def ask(number: int, frame: Any) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True

    try:
        old = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    except ValueError:  # not in the main thread: signals are somebody else's
        old = {}
    try:
        yield lambda: asked
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
