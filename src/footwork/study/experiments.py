"""The table: every row that Footwork trains. A row's name is its address, its folder and its legend.

Rows are data. Training, evaluation, packaged weights and smoke tests are derived from
:data:`EXPERIMENTS`; Table 1 of the paper stands once, in ``footwork.learn.config.PAPER``.
Every row exists on every engine: ``bullet/walker/plain`` is ``walker/plain`` on PyBullet.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from footwork.arena import MAZES, Arena, bandit, maze, open_field
from footwork.learn.config import PAPER, PPOConfig
from footwork.physics import DEFAULT_ENGINE, ENGINES, check_engine
from footwork.regularisers import AppropriateBias, Interleaved, RandomRepeated, RandomStart
from footwork.robot import HEAVY, Robot
from footwork.tasks.task import Task
from footwork.tasks.terms import FREE_WEIGHTS, PENALISED_WEIGHTS, WALKER_WEIGHTS
from footwork.train import Experiment

ANT_WALKER = Task("AntWalker", HEAVY, open_field(), WALKER_WEIGHTS)
ANT_BANDIT = Task(
    "AntBandit",
    HEAVY,
    bandit(),
    FREE_WEIGHTS,
    observe_xy=True,
    observe_goal=True,
    episode_steps=2000,
    fall_rule="none",
    goal_radius=0.5,
)
ANT_MAZE = Task(
    "AntMaze",
    HEAVY,
    MAZES["u"],
    FREE_WEIGHTS,
    observe_xy=True,
    episode_steps=2000,
    fall_rule="none",
    goal_radius=0.5,
)

WALKER_STEPS = 2_000_000  # control steps per direction; not in the paper
SYMMETRIC_STEPS = 2 * WALKER_STEPS  # of one policy, in four directions: half of what four take
FLAT_STEPS = 10_000_000  # as many as four sub-policies and a master together

# The master makes few decisions, and each is worth the sum of k rewards: more rows, a larger step, smaller numbers.
MASTER_PPO = replace(PAPER, num_envs=64, num_steps=4, num_minibatches=8, learning_rate=1e-3, reward_scale=0.02)
# Table 2's S for the masters, read as 8 rows side by side.
PAPER_MASTER_MAZE = replace(PAPER, num_envs=8, num_steps=16)
PAPER_MASTER_BANDIT = replace(PAPER, num_envs=8, num_steps=5)


def _annealed(total_steps: int) -> PPOConfig:
    """Ours: the entropy bonus ends, and steps shrink, over the whole training; with Table 1 alone late updates undo."""
    return replace(PAPER, anneal_updates=total_steps // PAPER.batch_size)


WALKERS: tuple[Experiment, ...] = (
    Experiment("walker/plain", ANT_WALKER, PAPER, WALKER_STEPS),
    Experiment("walker/random-start", ANT_WALKER, PAPER, WALKER_STEPS, RandomStart()),
    Experiment("walker/random-repeated", ANT_WALKER, PAPER, WALKER_STEPS, RandomRepeated()),
    Experiment("walker/appropriate-bias", ANT_WALKER, PAPER, WALKER_STEPS, AppropriateBias()),
    Experiment(
        "walker/interleaved",
        replace(ANT_WALKER, fall_rule="either"),
        _annealed(WALKER_STEPS),
        WALKER_STEPS,
        Interleaved(),
    ),
    Experiment("walker/symmetric", ANT_WALKER, PAPER, SYMMETRIC_STEPS, symmetric=True),
    Experiment(
        "walker/symmetric-interleaved",
        replace(ANT_WALKER, fall_rule="either"),
        _annealed(SYMMETRIC_STEPS),
        SYMMETRIC_STEPS,
        Interleaved(),
        symmetric=True,
    ),
)


def _guided(task: Task) -> Task:
    """Ours: arriving pays what some 3 m of progress pay, and coordinates are scaled to about +-1."""
    return replace(task, weights=replace(task.weights, goal=200.0), xy_scale=0.125)


def _masters(task: Task, kind: str, ppo: PPOConfig, total_steps: int) -> list[Experiment]:
    """A master on each kind of sub-policies."""
    place = task.name.removeprefix("Ant").lower()
    return [
        Experiment(
            f"{place}/{kind}/{walker.name.removeprefix('walker/')}", task, ppo, total_steps, sub_policies=walker.name
        )
        for walker in WALKERS
    ]


def _flat(task: Task) -> list[Experiment]:
    """One policy for everything, with and without stability penalties (paper, section 5)."""
    place = task.name.removeprefix("Ant").lower()
    return [
        Experiment(f"{place}/flat/penalised", replace(task, weights=PENALISED_WEIGHTS), PAPER, FLAT_STEPS),
        Experiment(f"{place}/flat/free", task, PAPER, FLAT_STEPS),
    ]


EXPERIMENTS: dict[str, Experiment] = {
    row.name: row
    for row in (
        *WALKERS,
        *_masters(_guided(ANT_BANDIT), "hrl", MASTER_PPO, 500_000),
        *_masters(replace(_guided(ANT_MAZE), potential="geodesic"), "hrl", MASTER_PPO, 2_000_000),
        *_masters(ANT_BANDIT, "paper", PAPER_MASTER_BANDIT, 500_000),
        *_masters(ANT_MAZE, "paper", PAPER_MASTER_MAZE, 2_000_000),
        *_flat(ANT_BANDIT),
        *_flat(ANT_MAZE),
    )
}


def find_row(name: str) -> Experiment:
    """The row of that name; on another engine than the default where that engine's name comes first.

    Raises:
        ValueError: there is none; lists those there are.
    """
    first, _, rest = name.partition("/")
    if first in ENGINES and rest in EXPERIMENTS:
        return with_engine(EXPERIMENTS[rest], first)
    if name not in EXPERIMENTS:
        raise ValueError(f"unknown row {name!r}; known rows: {', '.join(EXPERIMENTS)}")
    return EXPERIMENTS[name]


def with_robot(experiment: Experiment, robot: Robot) -> Experiment:
    """The row with another ant."""
    return replace(experiment, task=replace(experiment.task, robot=robot))


def with_engine(row: Experiment, engine: str) -> Experiment:
    """The row on another engine, with everything it stands on: a row of its own, addressed ``ENGINE/ROW``.

    Raises:
        ValueError: there is no such engine.
    """
    check_engine(engine)
    regulariser = row.regulariser
    if isinstance(regulariser, AppropriateBias):
        regulariser = replace(regulariser, partners=_on_engine(regulariser.partners, engine))
    needed = None if row.sub_policies is None else _on_engine(row.sub_policies, engine)
    name = _on_engine(row.name, engine)
    return replace(row, name=name, engine=engine, regulariser=regulariser, sub_policies=needed)


def _on_engine(address: str, engine: str) -> str:
    first, _, rest = address.partition("/")
    bare = rest if first in ENGINES else address
    return bare if engine == DEFAULT_ENGINE else f"{engine}/{bare}"


def read_maze(name_or_file: str) -> Arena:
    """A maze by name, or from a text file of rows.

    Raises:
        ValueError: neither a known name nor a file, or the file draws no maze.
    """
    if name_or_file in MAZES:
        return MAZES[name_or_file]
    path = Path(name_or_file)
    if not path.is_file():
        raise ValueError(f"no maze {name_or_file!r}: neither a file nor one of {', '.join(MAZES)}")
    try:
        return maze(path.read_text(encoding="utf-8").strip("\n"), name=path.stem)
    except UnicodeDecodeError:
        raise ValueError(f"{path} is no text file") from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
