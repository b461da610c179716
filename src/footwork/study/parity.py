"""``footwork parity``: how far the engines agree, measured engine by engine.

Every ant is an engine with a row of :data:`footwork.robot.ROBOTS`, and is driven through the Physics protocol alone:
one body of code measures them all. What is not installed is skipped, and named.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from footwork.arena import DEFAULT_MAZE, Arena, inside_walls
from footwork.env import loop_over
from footwork.evaluate import handover_matrix
from footwork.physics import ENGINES, mjcf, physics_for, require_engine
from footwork.record import RunDir, RunError, read_metrics, versions
from footwork.robot import ROBOTS, Robot
from footwork.study.bench import machine, ratio, spread
from footwork.study.contest import Contestant, ContestantFailed, Record, Team
from footwork.study.experiments import ANT_WALKER
from footwork.study.runs import find_trained, finished_runs, load_run
from footwork.train import Trained
from footwork.types import NUM_JOINTS, Physics, PhysicsState

Say = Callable[[str], None]
ROWS = 64  # ants side by side in every measurement
BITS_ASKED = 0.999  # of MJX's contact bits, to be C's
THROWN = 3.0  # m/s at most along x and y, into the walls where there are any
_EVERY = 10  # control steps between two shared states; an action is held as long


class Ant(NamedTuple):
    """Who is compared."""

    engine: str
    robot: str

    @property
    def name(self) -> str:
        """Its address in the report."""
        return f"{self.engine}/{self.robot}"


ANTS = (
    Ant("bullet", "heavy"),
    Ant("mujoco", "heavy"),
    Ant("mujoco", "bullet"),
    Ant("mujoco", "stiff"),
    Ant("mujoco", "light"),
    Ant("mjx", "heavy"),
)
REFERENCE, SHIPPED, DEVICE = ANTS[0], ANTS[1], ANTS[5]
WALKERS = ("walker/plain", "walker/appropriate-bias", "walker/interleaved", "walker/symmetric-interleaved")


@dataclass(frozen=True)
class Size:
    """How much is measured."""

    states: int  # shared by C and MJX, in each of two arenas
    episode: int  # control steps of random torque
    handover_ants: int  # per pair of directions
    walkers: int  # packaged rows, of WALKERS
    rounds: int
    seconds: float  # of a sample of speed


FULL = Size(10_240, 1000, 16, 4, 5, 3.0)
QUICK = Size(128, 60, 1, 1, 1, 0.5)


@dataclass
class Parity:
    """A comparison in progress: what it is to do, and what it knows so far.

    Args:
        size: how much.
        runs: a folder of runs with learning curves of ``walker/plain`` on each engine; None: no curves.
        say: told what is being done.
    """

    size: Size
    runs: Path | None
    say: Say
    ants: tuple[Ant, ...] = ()
    found: dict[str, Any] = field(default_factory=dict)
    complete: bool = False

    def run(self) -> None:
        """Measure everything; a KeyboardInterrupt ends it early, and what is known stays known."""
        begun = time.monotonic()
        self.found = {"skipped": {}, "machine": machine(), "versions": versions(), "size": vars(self.size)}
        self.ants = tuple(ant for ant in ANTS if self._is_there(ant))
        stages = (self._bodies, self._single_steps, self._statistics, self._transfer, self._speed, self._curves)
        try:
            for stage in stages:
                stage()
            self.complete = True
        except KeyboardInterrupt:
            self.say("interrupted: this is what was measured so far")
        self.found |= {"complete": self.complete, "seconds": time.monotonic() - begun}

    def _is_there(self, ant: Ant) -> bool:
        try:
            require_engine(ant.engine, ROBOTS[ant.robot])
        except ImportError as error:
            self.found["skipped"][ant.name] = str(error)
            self.say(f"skipping {ant.name}: {error}")
            return False
        return True

    def _bodies(self) -> None:
        self.say("masses, limits, and how joints answer to torque")
        self.found["bodies"] = {ant.name: body(ant) for ant in self.ants}

    def _single_steps(self) -> None:
        if DEVICE not in self.ants:
            return
        self.found["single_steps"] = {
            arena.name: single_steps(arena, self.size.states, self.say) for arena in (ANT_WALKER.arena, DEFAULT_MAZE)
        }

    def _statistics(self) -> None:
        self.found["statistics"] = {}
        for ant in self.ants:
            self.say(f"{ant.name}: torques {'; '.join(TORQUES)}")
            self.found["statistics"][ant.name] = wander(ant, self.size.episode)

    def _transfer(self) -> None:
        """Policies that were trained on one engine, handed over on each."""
        self.found["transfer"] = {}
        for address, trained in self._walkers():
            self.found["transfer"][address] = {}
            for ant in self.ants:
                if ROBOTS[ant.robot].hip_range_deg != ROBOTS[SHIPPED.robot].hip_range_deg:
                    continue  # another animal: its observations mean something else
                self.say(f"{address} on {ant.name}")
                self.found["transfer"][address][ant.name] = handover(trained, ant, self.size.handover_ants)

    def _walkers(self) -> Iterator[tuple[str, Trained]]:
        for row in WALKERS[: self.size.walkers]:
            yield row, find_trained(row, Path())
        if self.runs is not None:
            for engine in ENGINES:
                runs = finished_runs(f"{engine}/{WALKERS[0]}", self.runs)
                yield from ((f"{engine}/{WALKERS[0]}", load_run(run)) for run in runs[:1])

    def _speed(self) -> None:
        self.found["speed"], failed = race(self.ants, self.size, self.say)
        self.found["skipped"] |= {f"{name}, speed": why for name, why in failed.items()}

    def _curves(self) -> None:
        self.found["curves"] = {} if self.runs is None else read_curves(self.runs, self.say)


# Bodies ---------------------------------------------------------------------------------------------------------------


def body(ant: Ant) -> dict[str, Any]:
    """Masses (kg), limits (deg), torques (N m), and the inertia (kg m^2) that a hip and an ankle feel.

    The inertia is what is found from outside: one control step of a small torque on one joint of an ant at rest
    in the air, its joints in the middle of their ranges, and how fast the joint turns after it.
    """
    robot = ROBOTS[ant.robot]
    describe = getattr(import_module(f"footwork.physics.{ENGINES[ant.engine].module}"), "describe", mjcf.describe)
    share, torque = 0.02, np.array([robot.hip_torque, robot.ankle_torque])
    with closing(physics_for(ant.engine, robot, ANT_WALKER.arena, NUM_JOINTS, 1)) as physics:
        state = place(physics, in_the_air(robot))
        speed = np.diagonal(np.asarray(physics.step(state, share * np.eye(NUM_JOINTS)).qvel)[:, 6:])
    felt = share * np.tile(torque, 4) * robot.control_dt / speed
    return {
        **describe(robot),
        "hip_torque": robot.hip_torque,
        "ankle_torque": robot.ankle_torque,
        "hip_inertia": float(felt[::2].mean()),
        "ankle_inertia": float(felt[1::2].mean()),
    }


def in_the_air(robot: Robot) -> np.ndarray:
    """Poses [8, 15] well above the floor, every joint in the middle of its range."""
    qpos = np.zeros((NUM_JOINTS, 15), np.float32)
    qpos[:, 2:4] = 5.0, 1.0
    qpos[:, 7:] = np.mean(robot.joint_limits(), axis=1)
    return qpos


def place(physics: Physics, qpos: Any, qvel: Any = None) -> PhysicsState:
    """All rows there, at rest unless said otherwise."""
    qvel = np.zeros((physics.num_envs, 14), np.float32) if qvel is None else qvel
    return physics.reset(physics.initial(), np.ones(physics.num_envs, bool), qpos, qvel)


# Single steps ---------------------------------------------------------------------------------------------------------


def single_steps(arena: Arena, num_states: int, say: Say) -> dict[str, Any]:
    """One control step from the same state with the same action in C and in MJX, over states of random torque in C.

    Returns:
        Quantiles over states of the largest difference in a state's qpos (m, rad) and qvel (m/s, rad/s), and
        the share of foot contact bits that are equal.
    """
    robot, generator = ROBOTS[SHIPPED.robot], np.random.default_rng(0)
    host, device, driver = (physics_for(e, robot, arena, ROWS) for e in ("mujoco", "mjx", "mujoco"))
    qpos, qvel, equal, touching = [], [], [], []
    for number, (state, action) in enumerate(shared_states(driver, robot, arena, generator, -(-num_states // ROWS))):
        if number % 10 == 0:
            say(f"{arena.name}: {number * ROWS} of {num_states} single steps in C and MJX")
        c, mjx = (engine.step(place(engine, state.qpos, state.qvel), action) for engine in (host, device))
        qpos.append(np.abs(np.asarray(mjx.qpos) - c.qpos).max(axis=1))
        qvel.append(np.abs(np.asarray(mjx.qvel) - c.qvel).max(axis=1))
        equal.append(np.asarray(mjx.foot_contact) == c.foot_contact)
        touching.append(c.foot_contact)
    return {
        "states": len(qpos) * ROWS,
        "qpos": quantiles(np.concatenate(qpos)),
        "qvel": quantiles(np.concatenate(qvel)),
        "bits_equal": float(np.mean(equal)),
        "bits_on": float(np.mean(touching)),
        "reached": bool(np.mean(equal) >= BITS_ASKED),
    }


def shared_states(
    physics: Physics, robot: Robot, arena: Arena, generator: np.random.Generator, rounds: int
) -> Iterator[tuple[PhysicsState, np.ndarray]]:
    """States [ROWS] that ants under random torque come to, and the next action of each; thrown anew every 20 rounds."""
    for number in range(rounds):
        if number % 20 == 0:
            key = jax.random.key(number)
            qpos = np.array(replace(ANT_WALKER, robot=robot).reset_pose(key, ROWS)[0])
            qpos[:, :2], qvel = beside_walls(arena, generator), np.zeros((ROWS, 14), np.float32)
            qvel[:, :2] = generator.uniform(-THROWN, THROWN, (ROWS, 2))
            state = place(physics, qpos, qvel)
        action = generator.uniform(-1.0, 1.0, (ROWS, NUM_JOINTS)).astype(np.float32)
        for _ in range(_EVERY):
            state = physics.step(state, action)
        yield state, action


def beside_walls(arena: Arena, generator: np.random.Generator) -> np.ndarray:
    """Places [ROWS, 2], within a stride of a wall where there are any, and no leg in it."""
    if not arena.walls:
        return np.zeros((ROWS, 2))
    reach = max(abs(wall.x) + wall.half_x for wall in arena.walls)
    near = generator.uniform(-reach, reach, (4000, 2))
    near = near[inside_walls(arena, near, 1.6) & ~inside_walls(arena, near, 1.2)]
    return near[:ROWS]


def quantiles(values: np.ndarray) -> dict[str, float]:
    """Median, 99 %, 99.9 % and largest."""
    return dict(
        zip(("median", "p99", "p99_9", "max"), np.quantile(values, (0.5, 0.99, 0.999, 1)).tolist(), strict=True)
    )


# Statistics -----------------------------------------------------------------------------------------------------------

TORQUES = {"zero": (0.0, 1), "random": (1.0, 1), "random, held 10 steps": (1.0, 10)}  # scale, and steps held


def wander(ant: Ant, num_steps: int) -> dict[str, dict[str, float]]:
    """ROWS ants under torque that nobody chose, by its kind; the same torques for every ant.

    Returns:
        Share still alive at the end (torso never at or below the fall height), share upside down at the end; while
        alive, the mean height (m) and horizontal speed (m/s) of the torso and the share of feet on the floor.
    """
    robot = ROBOTS[ant.robot]
    pose = replace(ANT_WALKER, robot=robot).reset_pose(jax.random.key(0), ROWS)
    found = {}
    with closing(physics_for(ant.engine, robot, ANT_WALKER.arena, ROWS)) as physics:
        run = loop_over(physics, partial(_wandering, physics))
        for kind, (scale, held) in TORQUES.items():
            shape = (-(-num_steps // held), ROWS, NUM_JOINTS)
            drawn = np.random.default_rng(0).uniform(-scale, scale, shape).astype(np.float32)
            state, seen = run(place(physics, *map(np.asarray, pose)), drawn.repeat(held, axis=0)[:num_steps])
            found[kind] = _summary(robot, np.asarray(state.qpos), *map(np.asarray, seen))
    return found


def _wandering(physics: Physics, state: PhysicsState, action: Any) -> tuple[PhysicsState, Any]:
    """A control step, as the body of a loop."""
    xp = jnp if physics.traceable else np
    state = physics.step(state, action)
    speed = xp.sqrt((xp.asarray(state.qvel)[:, :2] ** 2).sum(axis=1))
    return state, (state.qpos[:, 2], speed, xp.asarray(state.foot_contact).mean(axis=1))


def _summary(robot: Robot, qpos: np.ndarray, height: np.ndarray, speed: np.ndarray, feet: np.ndarray) -> dict[str, Any]:
    alive = np.logical_and.accumulate(height > robot.fall_height, axis=0)
    return {
        "steps": len(height),
        "alive": float(alive[-1].mean()),
        "fallen_at": float(np.median(alive.sum(axis=0)) + 1),
        "upside_down": float((1.0 - 2.0 * (qpos[:, 4] ** 2 + qpos[:, 5] ** 2) < 0.0).mean()),
        "height_m": float(height[alive].mean()),
        "speed_mps": float(speed[alive].mean()),
        "feet_down": float(feet[alive].mean()),
    }


# Transfer -------------------------------------------------------------------------------------------------------------


def handover(trained: Trained, ant: Ant, ants: int) -> dict[str, float]:
    """The first seed's sub-policies on this ant: speed straight on (m/s), and hand-overs at right angles."""
    task = replace(trained.experiment.task, robot=ROBOTS[ant.robot])
    matrix = handover_matrix(trained.sub_policies(), task, ants, engine=ant.engine)
    straight = [matrix[i][i] for i in range(4)]
    across = [matrix[i][(i + turn) % 4] for i in range(4) for turn in (1, 3)]
    mean = lambda pairs, name: float(np.mean([pair[name] for pair in pairs]))  # noqa: E731
    return {
        "straight_mps": mean(straight, "speed_mps"),
        "across_mps": mean(across, "speed_mps"),
        "success": mean(across, "success"),
        "fall": mean(across, "fall"),
        "flip": mean(across, "flip"),
    }


# Speed ----------------------------------------------------------------------------------------------------------------


def race(ants: tuple[Ant, ...], size: Size, say: Say) -> tuple[dict[str, Any], dict[str, str]]:
    """Control steps per second through the protocol, each engine in a process of its own, asked in turn.

    Returns:
        The rates of those that were measured, and why others were not.
    """
    records: dict[str, Record] = {}
    teams: dict[str, Team] = {}
    try:
        for ant in ants:
            spec = {"kind": "engine", "engine": ant.engine, "robot": ant.robot, "rows": ROWS}
            say(f"starting {ant.name}")
            records[ant.name] = Record()
            _start(Contestant(ant.name, (spec,), seconds=size.seconds), teams, records[ant.name], say)
        for number in range(size.rounds):
            say(f"speed: round {number + 1} of {size.rounds}")
            for name in (*teams,)[:: 1 if number % 2 else -1]:
                _ask(teams, name, records[name], number, size.seconds, say)
    finally:
        for team in teams.values():
            team.close()
    shipped = records[SHIPPED.name].series()
    rates = {
        name: {"steps_per_second": spread(list(series.values())), "over_shipped": ratio(series, shipped)}
        for name, record in records.items()
        if (series := record.series())
    }
    return rates, {name: record.skipped for name, record in records.items() if record.skipped}


def _start(contestant: Contestant, teams: dict[str, Team], record: Record, say: Say) -> None:
    try:
        teams[contestant.name] = Team(contestant, sys.executable, os.environ.copy())
    except ContestantFailed as failure:
        record.skipped = str(failure)
        say(f"skipping {contestant.name}: {failure}")


def _ask(teams: dict[str, Team], name: str, record: Record, number: int, seconds: float, say: Say) -> None:
    try:
        record.samples[number] = teams[name].sample(seconds)
    except ContestantFailed as failure:
        record.skipped = str(failure)
        say(f"going on without {name}: {failure}")
        teams.pop(name).close()


# Learning curves ------------------------------------------------------------------------------------------------------


def read_curves(runs: Path, say: Say) -> dict[str, list[dict[str, Any]]]:
    """Of every run of ``walker/plain`` in a folder, finished or not, by its engine: control steps and speed (m/s)."""
    curves: dict[str, list[dict[str, Any]]] = {}
    for config in sorted(runs.rglob("config.json")):
        try:
            experiment = RunDir.open_existing(config.parent).config()["experiment"]
            engine, row = experiment["engine"], experiment["name"]
            if row.removeprefix(f"{engine}/") != WALKERS[0]:
                continue
            lines = read_metrics(config.parent / "metrics.jsonl")
        except (RunError, KeyError, TypeError) as error:
            say(f"left out {config.parent}: {error}")
            continue
        speed = [float(np.mean(line["rollout/progress"])) for line in lines]
        by_learner = np.array([line["rollout/progress"] for line in lines[-50:]], float).mean(axis=0)
        curve = {"step": [line["step"] for line in lines], "speed_mps": speed, "last_mps": by_learner.tolist()}
        curves.setdefault(engine, []).append({"run": config.parent.name, **curve})
    return curves


__all__ = ["ANTS", "FULL", "QUICK", "Ant", "Parity", "Size"]
