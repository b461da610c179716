"""What the keyword arguments of the Gymnasium environments mean: each task of the study as a function of its fields."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Literal

import numpy as np

from footwork.arena import DIRECTIONS, Arena, Point, bandit, maze, shortest_path
from footwork.doors.policies import NOWHERE, find_policies
from footwork.options import SubPolicies
from footwork.robot import JOINT_NAMES, ROBOTS, Robot
from footwork.study.experiments import ANT_BANDIT, ANT_MAZE, ANT_WALKER, find_row, read_maze
from footwork.study.runs import find_needed, packaged
from footwork.tasks.observe import JOINT_SPEED_SCALE, OBS_CLIP, VELOCITY_SCALE
from footwork.tasks.task import FallRule, Task
from footwork.tasks.terms import FREE_WEIGHTS, PENALISED_WEIGHTS, RewardWeights
from footwork.train import Experiment
from footwork.types import NUM_FEET

Potential = Literal["straight", "geodesic"]
RewardKind = Literal["task", "sparse", "dense"]
MazeMap = str | Sequence[Any]

FASTEST = 5.0  # m/s that no ant walks for long: how far a coordinate can get on a floor without walls
MASTER_ROW = "maze/hrl/symmetric-interleaved"  # whose fields a master's environment has unless told otherwise
MASTER_STEPS = find_row(MASTER_ROW).option_steps
_MASTER_TASK = find_row(MASTER_ROW).task
MASTER_SUB_POLICIES = "walker/symmetric-interleaved"


@dataclass(frozen=True, eq=False)
class Setting:
    """One environment: a task and how it is offered.

    Args:
        task: what is to be done.
        direction: index of the walker's direction; None elsewhere.
        sub_policies: what a master chooses among; None: the action is 8 torques.
        option_steps: control steps per choice of a master.
        reward: the task's own, or one of arrival and distance alone.
        goal_conditioned: observe ``observation``, ``achieved_goal`` and ``desired_goal`` apart.
    """

    task: Task
    direction: int | None = None
    sub_policies: SubPolicies | None = None
    option_steps: int = 1
    reward: RewardKind = "task"
    goal_conditioned: bool = False

    def __post_init__(self) -> None:
        if self.option_steps < 1:
            raise ValueError(f"option_steps must be >= 1, got {self.option_steps}")
        if self.reward not in ("task", "sparse", "dense"):
            raise ValueError(f"reward must be task, sparse or dense, got {self.reward!r}")
        if self.goal_conditioned and self.reward == "task":
            raise ValueError(
                "goal_conditioned needs reward='sparse' or 'dense': the task's own reward is no function of the goals"
            )
        if self.reward != "task" and self.task.goal_radius is None:
            raise ValueError(f"reward={self.reward!r} needs a goal_radius")

    @property
    def has_goal(self) -> bool:
        """Whether there is a place to arrive at."""
        return self.direction is None

    @property
    def most_steps(self) -> int:
        """Steps of the environment to the truncation of an episode."""
        return -(-self.task.episode_steps // self.option_steps)

    def at_most(self, steps: int) -> Setting:
        """The setting with episodes of no more than ``steps`` steps of the environment."""
        length = min(self.task.episode_steps, steps * self.option_steps)
        return replace(self, task=replace(self.task, episode_steps=length))


def term_names(task: Task) -> tuple[str, ...]:
    """The terms that the task's reward consists of: those with a weight."""
    return tuple(field.name for field in fields(task.weights) if getattr(task.weights, field.name) != 0.0)


def ant_walker(
    direction: str = "right",
    robot: str = "heavy",
    episode_steps: int = 1000,
    fall_rule: FallRule = "height",
    reward_weights: Mapping[str, float] | None = None,
) -> Setting:
    """AntWalker: walk in one direction; the target is 10 km away.

    Args:
        direction: right, up, left or down.
        robot: heavy, bullet, stiff or light.
        episode_steps: control steps to truncation.
        fall_rule: what ends an episode: height, flip, either or none.
        reward_weights: weights by name that replace the defaults.
    """
    if direction not in DIRECTIONS:
        raise ValueError(f"unknown direction {direction!r}; known: {', '.join(DIRECTIONS)}")
    task = replace(ANT_WALKER, robot=_robot(robot), episode_steps=episode_steps, fall_rule=fall_rule)
    return Setting(_weighed(task, reward_weights), DIRECTIONS.index(direction))


def ant_bandit(
    half_size: float = 8.0,
    penalties: bool = False,
    goal_radius: float | None = 0.5,
    goal_reward: float = 0.0,
    xy_scale: float = 1.0,
    robot: str = "heavy",
    episode_steps: int = 2000,
    fall_rule: FallRule = "none",
    reward_weights: Mapping[str, float] | None = None,
) -> Setting:
    """AntBandit: reach the corner of a square that was drawn for this episode and is observed.

    Args:
        half_size: half the side of the square, m.
        penalties: electricity, stall torque, joints at their limit and colliding feet cost.
        goal_radius: m; the episode ends inside it. None: never.
        goal_reward: once, on arrival.
        xy_scale: factor on observed coordinates.
        robot: heavy, bullet, stiff or light.
        episode_steps: control steps to truncation.
        fall_rule: what ends an episode: height, flip, either or none.
        reward_weights: weights by name that replace the defaults.
    """
    task = replace(
        ANT_BANDIT,
        robot=_robot(robot),
        arena=bandit(half_size),
        weights=replace(PENALISED_WEIGHTS if penalties else FREE_WEIGHTS, goal=goal_reward),
        goal_radius=goal_radius,
        xy_scale=xy_scale,
        episode_steps=episode_steps,
        fall_rule=fall_rule,
    )
    return Setting(_weighed(task, reward_weights))


def ant_maze(
    maze_map: MazeMap = "u",
    goal: Point | Sequence[Point] | None = None,
    potential: Potential = "straight",
    penalties: bool = False,
    reward: RewardKind = "task",
    goal_conditioned: bool = False,
    goal_radius: float | None = 0.5,
    goal_reward: float = 0.0,
    xy_scale: float = 1.0,
    cell: float | None = None,
    start_noise: float | None = None,
    robot: str = "heavy",
    episode_steps: int = 2000,
    fall_rule: FallRule = "none",
    reward_weights: Mapping[str, float] | None = None,
) -> Setting:
    """AntMaze: reach the goal of a maze, which is not observed (unless there are several).

    Args:
        maze_map: u, spiral, medium or large; rows as Gymnasium-Robotics has them, with one start ("r") and one goal
            ("g"; "c" stands for either); a text of several lines; a text file.
        goal: (x, y) in m instead of the map's; or several, one of which is drawn for each episode and observed.
        potential: progress along the straight line, or around the walls (for one goal).
        penalties: electricity, stall torque, joints at their limit and colliding feet cost.
        reward: ``task``; or ``sparse``, 1 within ``goal_radius`` else 0; or ``dense``, minus the distance in m.
        goal_conditioned: observations are dicts of ``observation``, ``achieved_goal`` and ``desired_goal``.
        goal_radius: m; the episode ends inside it. None: never.
        goal_reward: once, on arrival; of the task's reward.
        xy_scale: factor on observed coordinates; never on ``achieved_goal`` and ``desired_goal``.
        cell: side of a cell in m; default: the named maze's own, else 4.
        start_noise: the start is uniform within +- this in x and y, m.
        robot: heavy, bullet, stiff or light.
        episode_steps: control steps to truncation.
        fall_rule: what ends an episode: height, flip, either or none.
        reward_weights: weights by name that replace the defaults.
    """
    arena = _arena(maze_map, cell, start_noise)
    if goal is not None:
        arena = _with_goals(arena, goal)
    task = replace(
        ANT_MAZE,
        robot=_robot(robot),
        arena=arena,
        weights=replace(PENALISED_WEIGHTS if penalties else FREE_WEIGHTS, goal=goal_reward),
        observe_goal=len(arena.goals) > 1 and not goal_conditioned,
        potential=potential,
        goal_radius=goal_radius,
        xy_scale=1.0 if goal_conditioned else xy_scale,
        episode_steps=episode_steps,
        fall_rule=fall_rule,
    )
    return Setting(_weighed(task, reward_weights), reward=reward, goal_conditioned=goal_conditioned)


def ant_maze_options(
    sub_policies: str | Path | SubPolicies = MASTER_SUB_POLICIES,
    option_steps: int = MASTER_STEPS,
    deterministic_sub_policies: bool = False,
    potential: Potential = "geodesic",
    goal_reward: float = _MASTER_TASK.weights.goal,
    xy_scale: float = _MASTER_TASK.xy_scale,
    **maze_fields: Any,
) -> Setting:
    """AntMaze for a master: one of four sub-policies acts for ``option_steps`` control steps, whose rewards are summed.

    The defaults are those of the study's rows ``maze/hrl/*``.

    Args:
        sub_policies: a row (the packaged one is preferred), the folder of a run or of ``footwork export``, or the
            policies. Of a master, those that it stands on.
        option_steps: control steps per choice, the paper's k.
        deterministic_sub_policies: they act by their mode instead of a sample.
        potential: progress along the straight line, or around the walls (for one goal).
        goal_reward: once, on arrival; of the task's reward.
        xy_scale: factor on observed coordinates; never on ``achieved_goal`` and ``desired_goal``.
        **maze_fields: the other fields of :func:`ant_maze`.
    """
    setting = ant_maze(potential=potential, goal_reward=goal_reward, xy_scale=xy_scale, **maze_fields)
    if isinstance(sub_policies, str | Path):
        sub_policies = _load(str(sub_policies), setting.task.robot)
    if not isinstance(sub_policies, SubPolicies):
        raise ValueError(
            f"sub_policies must be a row's name, the folder of a run, or the policies, got {sub_policies!r}"
        )
    sub_policies = _acting(sub_policies, deterministic_sub_policies)
    return replace(setting, sub_policies=sub_policies, option_steps=option_steps)


MAKERS: dict[str, Callable[..., Setting]] = {
    "AntWalker": ant_walker,
    "AntBandit": ant_bandit,
    "AntMaze": ant_maze,
    "AntMazeOptions": ant_maze_options,
}


def known_fields(kind: str) -> dict[str, Any]:
    """The keyword arguments of a kind of environment, one of :data:`MAKERS`, and their defaults."""
    parameters = dict(inspect.signature(MAKERS[kind]).parameters)
    if parameters.pop("maze_fields", None) is not None:
        of_maze = inspect.signature(ant_maze).parameters
        parameters |= {name: parameter for name, parameter in of_maze.items() if name not in parameters}
    return {name: parameter.default for name, parameter in parameters.items()}


def read_fields(kind: str, fields: Mapping[str, Any]) -> Setting:
    """The setting that keyword arguments mean.

    Raises:
        TypeError: some are unknown; lists those that are known.
        ValueError: a value is.
    """
    known = known_fields(kind)
    unknown = [name for name in fields if name not in known]
    if unknown:
        raise TypeError(f"{kind} has no field {', '.join(map(repr, unknown))}; its fields: {', '.join(known)}")
    return MAKERS[kind](**{name: _checked(name, value) for name, value in fields.items()})


# What a value must be, by the name of its field: a kind, and whether None will do. Other fields check themselves.
_KINDS: dict[str, tuple[str, bool]] = {
    "episode_steps": ("count", False),
    "option_steps": ("count", False),
    "half_size": ("length", False),
    "goal_radius": ("length", True),
    "xy_scale": ("length", False),
    "cell": ("length", True),
    "start_noise": ("distance", True),
    "goal_reward": ("number", False),
    "penalties": ("switch", False),
    "goal_conditioned": ("switch", False),
    "deterministic_sub_policies": ("switch", False),
    "direction": ("word", False),
    "robot": ("word", False),
    "potential": ("word", False),
    "reward": ("word", False),
    "fall_rule": ("word", False),
}
_MOST = 1e9  # what is larger does not go together with single precision
_WANTED = {
    "count": "a whole number >= 1",
    "length": "a finite number > 0 (and <= 1e9)",
    "distance": "a finite number >= 0 (and <= 1e9)",
    "number": "a finite number (within +-1e9)",
    "switch": "True or False",
    "word": "a word",
}


def _checked(name: str, value: Any) -> Any:
    """The value as Python's own int, float, bool or str.

    Raises:
        ValueError: it is of another kind, or out of range.
    """
    kind, may_be_none = _KINDS.get(name, ("", False))
    if not kind or (value is None and may_be_none):
        return value
    read = _READERS[kind](value)
    if read is None:
        other = ", or None" if may_be_none else ""
        raise ValueError(f"{name} must be {_WANTED[kind]}{other}, got {value!r}")
    return read


def _read_number(value: Any, lowest: float = -_MOST, open_below: bool = False) -> float | None:
    if isinstance(value, bool | np.bool_) or not isinstance(value, Real) or not math.isfinite(value):
        return None
    number = float(value)
    return None if not lowest <= number <= _MOST or (open_below and number == lowest) else number


def _read_count(value: Any) -> int | None:
    whole = isinstance(value, Integral) and not isinstance(value, bool)
    return int(value) if whole and value >= 1 else None


_READERS: dict[str, Callable[[Any], Any]] = {
    "count": _read_count,
    "length": lambda value: _read_number(value, 0.0, open_below=True),
    "distance": lambda value: _read_number(value, 0.0),
    "number": _read_number,
    "switch": lambda value: bool(value) if isinstance(value, bool | np.bool_) else None,
    "word": lambda value: str(value) if isinstance(value, str) else None,
}


@lru_cache(maxsize=64)  # the same object for the same policies: what is compiled for them is shared
def _acting(sub_policies: SubPolicies, deterministic: bool) -> SubPolicies:
    return replace(sub_policies, deterministic=deterministic)


@lru_cache(maxsize=64)
def _packaged(address: str) -> tuple[Experiment, SubPolicies | None]:
    return _found(address)


def _found(address: str) -> tuple[Experiment, SubPolicies | None]:
    trained = find_policies(address)
    trained = find_needed(trained, NOWHERE) or trained  # of a master, what it chooses among
    return trained.experiment, trained.sub_policies() if trained.experiment.is_walker else None


def _load(address: str, robot: Robot) -> SubPolicies:
    experiment, sub_policies = (_packaged if packaged(address).is_file() else _found)(address)
    if sub_policies is None:
        raise ValueError(
            f"sub_policies must walk in four directions (walker/..., or a master's), got {experiment.name}"
        )
    if experiment.task.robot != robot:
        raise ValueError(f"the environment has ant {robot.name!r}, {address} is for {experiment.task.robot.name!r}")
    return sub_policies


def _robot(name: str) -> Robot:
    if name not in ROBOTS:
        raise ValueError(f"unknown robot {name!r}; known robots: {', '.join(ROBOTS)}")
    return ROBOTS[name]


def _weighed(task: Task, reward_weights: Mapping[str, float] | None) -> Task:
    if not reward_weights:
        return task
    if not isinstance(reward_weights, Mapping):
        raise ValueError(f"reward_weights must be weights by name, got {reward_weights!r}")
    known = [field.name for field in fields(RewardWeights)]
    unknown = [name for name in reward_weights if name not in known]
    if unknown:
        raise ValueError(f"unknown reward_weights {', '.join(map(repr, unknown))}; known: {', '.join(known)}")
    changed = {}
    for name, value in reward_weights.items():
        weight = _read_number(value)
        if weight is None:
            raise ValueError(f"reward_weights[{name!r}] must be {_WANTED['number']}, got {value!r}")
        changed[name] = weight
    return replace(task, weights=replace(task.weights, **changed))


def _arena(maze_map: MazeMap, cell: float | None, start_noise: float | None) -> Arena:
    if isinstance(maze_map, str | Path) and "\n" not in str(maze_map):
        arena = read_maze(str(maze_map))
    else:
        arena = maze(maze_map)
    if cell is None and start_noise is None:
        return arena
    cell = arena.cell if cell is None else cell
    return maze(arena.grid, arena.name, cell, arena.start_noise if start_noise is None else start_noise)


def _with_goals(arena: Arena, goal: Any) -> Arena:
    """The arena with other goals, each of them in reach."""
    try:
        points = np.atleast_2d(np.array(goal, np.float64))
    except (TypeError, ValueError):
        points = np.zeros((0, 0))
    if points.ndim != 2 or points.shape[1:] != (2,) or not len(points):
        raise ValueError(f"goal must be (x, y) in m, or several of them, got {goal!r}")
    arena = replace(arena, goals=tuple((float(x), float(y)) for x, y in points))
    for point in arena.goals:
        shortest_path(arena, point)
    return arena


# What is observed ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Observed:
    """One number of an observation: what it means and where it can lie."""

    meaning: str
    unit: str
    low: float
    high: float


def observed(task: Task) -> tuple[Observed, ...]:
    """The numbers of a task's observation, in order."""
    numbers = []
    for joint in JOINT_NAMES:
        numbers.append(Observed(f"{joint}: angle, its limits at -1 and 1", "1", -OBS_CLIP, OBS_CLIP))
        numbers.append(Observed(f"{joint}: {JOINT_SPEED_SCALE:g} x speed", "rad/s", -OBS_CLIP, OBS_CLIP))
    numbers += [Observed(f"foot {leg + 1} touches the floor", "0 or 1", 0.0, 1.0) for leg in range(NUM_FEET)]
    numbers.append(Observed("torso height above the reset height", "m", -OBS_CLIP, OBS_CLIP))
    for axis in ("forward", "left", "up"):
        meaning = f"{VELOCITY_SCALE:g} x torso velocity {axis}, in the frame turned by yaw only"
        numbers.append(Observed(meaning, "m/s", -OBS_CLIP, OBS_CLIP))
    half_turn = float(np.float32(np.pi))
    numbers.append(Observed("roll", "rad", -half_turn, half_turn))
    numbers.append(Observed("pitch", "rad", -half_turn / 2, half_turn / 2))
    for function in ("sine", "cosine"):
        numbers += [Observed(f"{function} of {angle}", "1", -1.0, 1.0) for angle in ("roll", "pitch", "yaw")]
    scale = "" if task.xy_scale == 1.0 else f"{task.xy_scale:g} x "
    farthest = reach(task)
    for wanted, what in ((task.observe_xy, "torso"), (task.observe_goal, "goal")):
        if wanted:
            for axis, far in zip("xy", task.xy_scale * farthest, strict=True):
                numbers.append(Observed(f"{scale}{axis} of the {what}", "m", -float(far), float(far)))
    return tuple(numbers)


def reach(task: Task) -> np.ndarray:
    """How far from the origin an ant can get along x and y, in m: to the outer faces of a maze, else on foot."""
    arena = task.arena
    if arena.grid:
        return np.array([len(arena.grid[0]), len(arena.grid)]) * arena.cell / 2
    points = np.abs(np.array([arena.start, *arena.goals]))
    return points.max(axis=0) + FASTEST * task.episode_steps * task.robot.control_dt


def bounds(task: Task) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest observation, [D] float32 each."""
    numbers = observed(task)
    return np.array([n.low for n in numbers], np.float32), np.array([n.high for n in numbers], np.float32)


__all__ = [
    "MAKERS",
    "Observed",
    "Setting",
    "ant_bandit",
    "ant_maze",
    "ant_maze_options",
    "ant_walker",
    "bounds",
    "known_fields",
    "observed",
    "reach",
    "read_fields",
    "term_names",
]
