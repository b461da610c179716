"""The table: every row that Footwork trains. A row's name is its address, its folder and its legend.

Rows are data. Training, evaluation, packaged weights and smoke tests are derived from
:data:`EXPERIMENTS`; Table 1 of the paper stands once, in ``footwork.learn.config.PAPER``.
Every row exists on every engine: ``bullet/walker/plain`` is ``walker/plain`` on PyBullet.
Ablations are grids (:data:`GRIDS`): one line here is as many rows as it has values.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from difflib import get_close_matches
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from footwork.arena import MAZES, Arena, bandit, maze, open_field
from footwork.learn.config import PAPER, PPOConfig
from footwork.physics import DEFAULT_ENGINE, ENGINES, check_engine
from footwork.regularisers import AppropriateBias, Interleaved, RandomRepeated, RandomStart
from footwork.robot import HEAVY, ROBOTS, Robot
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
FLAT_STEPS = 10_000_000  # as many as four sub-policies and a master on AntMaze together (not counting partners)

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

KINDS = tuple(row.name.removeprefix("walker/") for row in WALKERS)  # of sub-policies


def _guided(task: Task) -> Task:
    """Ours: arriving pays what some 3 m of progress pay, and coordinates are scaled to about +-1."""
    return replace(task, weights=replace(task.weights, goal=200.0), xy_scale=0.125)


def _penalised(task: Task) -> Task:
    """With the stability penalties in the reward, whatever else is in it."""
    return replace(task, weights=replace(PENALISED_WEIGHTS, goal=task.weights.goal))


def _masters(task: Task, kind: str, ppo: PPOConfig, total_steps: int) -> list[Experiment]:
    """A master on each kind of sub-policies."""
    place = task.name.removeprefix("Ant").lower()
    return [
        Experiment(
            f"{place}/{kind}/{walker.name.removeprefix('walker/')}", task, ppo, total_steps, sub_policies=walker.name
        )
        for walker in WALKERS
    ]


def _flat(task: Task, kind: str = "") -> list[Experiment]:
    """One policy for everything, with and without stability penalties (paper, section 5)."""
    place = task.name.removeprefix("Ant").lower()
    return [
        Experiment(f"{place}/flat/{kind}penalised", _penalised(task), PAPER, FLAT_STEPS),
        Experiment(f"{place}/flat/{kind}free", task, PAPER, FLAT_STEPS),
    ]


# Two settings of a task. Flat policies keep Table 1's schedule with either reward.
SCHEDULES = {"paper": "the paper's reward and schedule", "hrl": "our reward, our masters' schedule"}

GUIDED_BANDIT = _guided(ANT_BANDIT)
GUIDED_MAZE = replace(_guided(ANT_MAZE), potential="geodesic")


def _study_of(paper: Task, guided: Task, total_steps: int) -> tuple[Experiment, ...]:
    """All rows of a task: the paper's reward and schedule, and ours; flat policies with either reward."""
    paper_ppo = PAPER_MASTER_MAZE if paper.name == "AntMaze" else PAPER_MASTER_BANDIT
    return (
        *_masters(guided, "hrl", MASTER_PPO, total_steps),
        *_masters(_penalised(guided), "hrl-penalised", MASTER_PPO, total_steps),
        *_masters(paper, "paper", paper_ppo, total_steps),
        *_masters(_penalised(paper), "paper-penalised", paper_ppo, total_steps),
        *_flat(paper),
        *_flat(guided, "guided-"),
    )


MAIN: dict[str, Experiment] = {
    row.name: row
    for row in (
        *WALKERS,
        *_study_of(ANT_BANDIT, GUIDED_BANDIT, 500_000),
        *_study_of(ANT_MAZE, GUIDED_MAZE, 2_000_000),
    )
}


@dataclass(frozen=True)
class Grid:
    """Rows that differ from a row in one field: ``NAME/VALUE`` for each value.

    Args:
        name: the rows' common address.
        base: the row that they vary; its own value is a point of the grid too.
        field: of the row, with dots into what it holds, e.g. ``regulariser.steps``.
        values: of the field.
        words: what the field is, for axes and tables.
    """

    name: str
    base: str
    field: str
    values: tuple[Any, ...]
    words: str

    def rows(self) -> list[Experiment]:
        """The rows, in the order of the values."""
        base = MAIN[self.base]
        return [replace(_with_field(base, self.field, value), name=f"{self.name}/{value}") for value in self.values]

    def points(self) -> dict[Any, str]:
        """Row by value, the base's among them, in rising order where the values are numbers."""
        points = {value: f"{self.name}/{value}" for value in self.values}
        own: Any = MAIN[self.base]
        for part in self.field.split("."):
            own = getattr(own, part)
        points.setdefault(own, self.base)
        numbers = all(isinstance(value, int | float) for value in points)
        return dict(sorted(points.items())) if numbers else points


def _with_field(config: Any, field: str, value: Any) -> Any:
    """A dataclass with one field, possibly of something inside it, replaced."""
    first, _, rest = field.partition(".")
    return replace(config, **{first: _with_field(getattr(config, first), rest, value) if rest else value})


# The paper names neither k nor any t; its B = 32 is a number of batches here, and a size below.
GRIDS: tuple[Grid, ...] = (
    Grid("ablation/bandit/k", "bandit/hrl/interleaved", "option_steps", (10, 20, 100, 200, 400), "k (control steps)"),
    Grid("ablation/maze/k", "maze/hrl/interleaved", "option_steps", (10, 20, 100, 200, 400), "k (control steps)"),
    Grid("ablation/maze/k-paper", "maze/paper/interleaved", "option_steps", (100, 200, 400), "k (control steps)"),
    Grid(
        "ablation/random-start/t", "walker/random-start", "regulariser.steps", (10, 25, 100, 200), "t (control steps)"
    ),
    Grid(
        "ablation/random-repeated/t",
        "walker/random-repeated",
        "regulariser.every",
        (25, 50, 200, 400),
        "t (control steps)",
    ),
    Grid(
        "ablation/appropriate-bias/t",
        "walker/appropriate-bias",
        "regulariser.steps",
        (25, 50, 200, 400),
        "t (control steps)",
    ),
    Grid(
        "ablation/interleaved/t",
        "walker/interleaved",
        "regulariser.mean_steps",
        (16, 80, 160, 320),
        "mean stay (control steps)",
    ),
    Grid("ablation/walker/B-as-size", "walker/plain", "ppo.minibatch_size", (32,), "B as a size"),
    Grid("ablation/walker/bonus", "walker/plain", "ppo.ent_coef", (0.0, 0.005), "entropy bonus"),
    Grid("ablation/bandit/B-as-size", "bandit/paper/interleaved", "ppo.minibatch_size", (32,), "B as a size"),
    Grid("ablation/maze/B-as-size", "maze/paper/interleaved", "ppo.minibatch_size", (32,), "B as a size"),
    Grid("ablation/maze/potential", "maze/hrl/interleaved", "task.potential", ("straight",), "potential"),
    Grid("ablation/maze/potential-paper", "maze/paper/interleaved", "task.potential", ("geodesic",), "potential"),
    # The bonus and the cap are ours too, and only penalties hold a deviation back; and Table 1's step stays constant.
    # Do flat policies fail because of any of these?
    Grid("ablation/bandit/flat-free-bonus", "bandit/flat/free", "ppo.ent_coef", (0.0,), "entropy bonus"),
    Grid("ablation/bandit/flat-free-deviation", "bandit/flat/free", "ppo.max_log_std", (0.5,), "cap of log-deviation"),
    Grid(
        "ablation/bandit/flat-free-annealing",
        "bandit/flat/free",
        "ppo.anneal_updates",
        (_annealed(FLAT_STEPS).anneal_updates,),
        "updates in which bonus and step fall",
    ),
    Grid("ablation/bandit/flat-penalised-bonus", "bandit/flat/penalised", "ppo.ent_coef", (0.0,), "entropy bonus"),
)
# Those of them that vary a flat policy, and in what.
FLAT_GRIDS: dict[str, str] = {
    "ablation/bandit/flat-free-bonus": "without an entropy bonus",
    "ablation/bandit/flat-free-deviation": "its deviation capped at 1.6 instead of 7.4",
    "ablation/bandit/flat-free-annealing": "annealed",
    "ablation/bandit/flat-penalised-bonus": "without an entropy bonus",
}
GRIDS_BY_NAME: dict[str, Grid] = {grid.name: grid for grid in GRIDS}


def grids_of(what: str) -> tuple[Grid, ...]:
    """The grids of one length, ``k`` of options or ``t`` of regularisers."""
    field = {"k": "option_steps", "t": "regulariser."}[what]
    return tuple(grid for grid in GRIDS if grid.field.startswith(field))


_ON_GRIDS = {row.name: row for grid in GRIDS for row in grid.rows()}

# Annealing is one of the things that interleaved rows have besides their regulariser. The paper's rows with it.
ANNEALED: tuple[Experiment, ...] = tuple(
    replace(
        row,
        name=f"ablation/annealed/{row.name.removeprefix('walker/')}",
        ppo=_annealed(row.total_steps),
        regulariser=AppropriateBias(partners="ablation/annealed/plain")
        if isinstance(row.regulariser, AppropriateBias)
        else row.regulariser,
    )
    for row in WALKERS[:4]
)
# What makes interleaved ones what they are: each of their parts taken away, and all but the exchange of ants.
_INTERLEAVED = MAIN["walker/interleaved"]
_UNCOOPERATIVE = _with_field(_INTERLEAVED, "regulariser.cooperative", False)
INTERLEAVED_WITHOUT: tuple[Experiment, ...] = tuple(
    replace(row, name=f"ablation/interleaved-without/{part}")
    for part, row in {
        "cooperation": _UNCOOPERATIVE,
        "annealing": replace(_INTERLEAVED, ppo=PAPER),
        "ends-on-the-back": replace(_INTERLEAVED, task=ANT_WALKER),
        "all-three": replace(_UNCOOPERATIVE, ppo=PAPER, task=ANT_WALKER),
    }.items()
)


def _masters_on(rows: Iterable[Experiment], kind: str | None = None) -> tuple[Experiment, ...]:
    """The masters of a kind, each row's own for none, on these sub-policies, under ``ablation/PLACE/hrl-...``."""
    return tuple(
        replace(
            MAIN[f"{place}/hrl/{kind or row.name.rpartition('/')[2]}"],
            name=row.name.replace("ablation/", f"ablation/{place}/hrl-"),
            sub_policies=row.name,
        )
        for place in ("bandit", "maze")
        for row in rows
    )


# The grids of k and B vary masters on interleaved sub-policies. The paper's own kinds where that mattered: an option so
# long that masters with the paper's reward got past the wall, and B = 32 as a size on AntBandit.
PAPER_MASTERS_VARIED: tuple[Experiment, ...] = tuple(
    replace(_with_field(MAIN[f"{group}/{kind}"], field, value), name=f"{name}/{kind}")
    for name, group, field, value in (
        ("ablation/maze/k-paper-200", "maze/paper", "option_steps", 200),
        ("ablation/bandit/B-as-size-paper", "bandit/paper", "ppo.minibatch_size", 32),
    )
    for kind in KINDS[:4]
)

ANNEALED_MASTERS = _masters_on(ANNEALED)
INTERLEAVED_WITHOUT_MASTERS = _masters_on(INTERLEAVED_WITHOUT, "interleaved")
# Sub-policies that are regularised more than we do, and that were seen (seed 0) to hand over more safely and to walk
# slower: is that worth it to a master?
MORE_REGULARISED_MASTERS = (
    *_masters_on([_ON_GRIDS["ablation/random-repeated/t/25"]], "random-repeated"),
    *_masters_on([_ON_GRIDS["ablation/appropriate-bias/t/400"]], "appropriate-bias"),
)


def _without_bonus(row: Experiment) -> Experiment:
    return replace(row, ppo=replace(row.ppo, ent_coef=0.0))


# Rows of the light ant: what claims 7 to 12 and 14 read, and those of them annealed. Its sub-policies get no entropy
# bonus: with the heavy ant's, plain ones and the paper's do not learn to walk (LIGHT_WITH_BONUS).
LIGHT_KINDS = ("plain", "random-start", "random-repeated", "appropriate-bias", "interleaved")
LIGHT: tuple[Experiment, ...] = (
    *(_without_bonus(MAIN[f"walker/{kind}"]) for kind in LIGHT_KINDS),
    *(MAIN[f"{place}/hrl/{kind}"] for place in ("bandit", "maze") for kind in LIGHT_KINDS),
    *map(_without_bonus, ANNEALED),
    *ANNEALED_MASTERS,
)


def _of_robot(row: Experiment, robot: Robot) -> Experiment:
    """The row for another ant, with everything it stands on: a row of its own, addressed ``ROBOT/ROW``."""
    regulariser = row.regulariser
    if isinstance(regulariser, AppropriateBias):
        regulariser = replace(regulariser, partners=f"{robot.name}/{regulariser.partners}")
    needed = None if row.sub_policies is None else f"{robot.name}/{row.sub_policies}"
    moved = replace(row, name=f"{robot.name}/{row.name}", regulariser=regulariser, sub_policies=needed)
    return with_robot(moved, robot)


def is_row(name: str) -> bool:
    """Whether there is a row of that name."""
    first, _, rest = name.partition("/")
    return name in EXPERIMENTS or (first in ENGINES and rest in EXPERIMENTS)


def with_robot(experiment: Experiment, robot: Robot) -> Experiment:
    """The row with another ant."""
    return replace(experiment, task=replace(experiment.task, robot=robot))


LIGHT_WITH_BONUS = _of_robot(
    replace(MAIN["walker/plain"], name=f"ablation/walker/bonus/{PAPER.ent_coef}"), ROBOTS["light"]
)

EXPERIMENTS: dict[str, Experiment] = {
    **MAIN,
    **_ON_GRIDS,
    **{row.name: row for row in PAPER_MASTERS_VARIED},
    **{
        row.name: row
        for row in (
            *(*ANNEALED, *ANNEALED_MASTERS),
            *(*INTERLEAVED_WITHOUT, *INTERLEAVED_WITHOUT_MASTERS),
            *MORE_REGULARISED_MASTERS,
        )
    },
    **{row.name: row for row in (*(_of_robot(row, ROBOTS["light"]) for row in LIGHT), LIGHT_WITH_BONUS)},
}


ANTS = ("", "light/")  # the ants whose rows stand in the table: what their addresses begin with


def group_of(name: str) -> str:
    """What a row is listed under: all but the last part of its address."""
    return name.rpartition("/")[0]


def in_braces(names: Iterable[str]) -> str:
    """Addresses in a line, those of a group in braces, as a shell takes them."""
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(group_of(name), []).append(name.rpartition("/")[2])
    return " ".join(f"{g}/{{{','.join(last)}}}" if len(last) > 1 else f"{g}/{last[0]}" for g, last in groups.items())


def match_rows(patterns: Iterable[str]) -> list[str]:
    """The rows that patterns such as ``maze/*`` or ``*/plain`` mean, in the order of the table; all for none.

    A pattern may be a row's whole address, also of one that :func:`find_row` knows without the table.

    Raises:
        ValueError: a pattern matches no row; lists the groups there are, or names the nearest rows to an address.
    """
    chosen: dict[str, None] = {}
    wanted = tuple(patterns)
    for pattern in wanted:
        found = _matching(pattern)
        if not found:
            if not any(sign in pattern for sign in "*?["):
                raise ValueError(_unknown(pattern))
            groups = ", ".join(dict.fromkeys(f"{group_of(name)}/*" for name in EXPERIMENTS))
            raise ValueError(f"no row matches {pattern!r}; known rows: {groups} (footwork list)")
        chosen.update(dict.fromkeys(found))
    return list(chosen) if wanted else list(EXPERIMENTS)


def _matching(pattern: str) -> list[str]:
    found = [name for name in EXPERIMENTS if fnmatchcase(name, pattern)]
    if found:
        return found
    first, _, rest = pattern.partition("/")  # rows that stand in the table under another first part
    found = [f"{first}/{name}" for name in EXPERIMENTS if rest and fnmatchcase(name, rest)]
    try:
        return [find_row(name).name for name in found]
    except ValueError:
        return []


def find_row(name: str) -> Experiment:
    """The row of that name; on another engine than the default where that engine's name comes first.

    Raises:
        ValueError: there is none; names those that are nearest, and where all are listed.
    """
    first, _, rest = name.partition("/")
    if first in ENGINES and rest in EXPERIMENTS:
        return with_engine(EXPERIMENTS[rest], first)
    if name not in EXPERIMENTS:
        raise ValueError(_unknown(name))
    return EXPERIMENTS[name]


def _unknown(name: str) -> str:
    """What is said of an address that is none."""
    engine, _, rest = name.partition("/")
    engine, wanted = (f"{engine}/", rest) if engine in ENGINES else ("", name)
    near = [engine + row for row in get_close_matches(wanted, EXPERIMENTS, n=4, cutoff=0.5)]
    groups = ", ".join(dict.fromkeys(f"{row.partition('/')[0]}/..." for row in EXPERIMENTS))
    others = ", ".join(f"{engine}/" for engine in ENGINES if engine != DEFAULT_ENGINE)
    return (
        f"unknown row {name!r}; {f'nearest: {in_braces(near)}; ' if near else ''}"
        f"known rows: {groups} (footwork list --all shows each), and the same after {others}"
    )


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
