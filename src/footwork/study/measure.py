"""Measure a finished run: small files beside its policy, with one entry per seed.

``evaluation.json``   episodes of the row's task: success, the way covered, falls, where they end, some paths
``transitions.json``  of sub-policies: the hand-over matrix, and random switching at several periods

Claims and figures read these files and never a policy; so the files of a study, without its
checkpoints, are enough to draw and to judge it again.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from footwork.arena import CLEARANCE, DIRECTIONS, Arena, inside_walls
from footwork.checkpoint import write_atomically
from footwork.evaluate import Episodes, play_episodes, transitions
from footwork.record import RunDir, RunError, versions
from footwork.study.experiments import find_row, is_row
from footwork.study.plan import SIZES, Size
from footwork.study.runs import NEEDED, how_to_train_again, load_policies, load_run, one_seed
from footwork.tasks.task import SUCCESS_RADII
from footwork.train import Experiment, Trained, choices_of

EVALUATION, TRANSITIONS = "evaluation.json", "transitions.json"
FORMAT = 1
EVALUATION_SEED = 1_000_003  # of the episodes; the run's seed is added
STUCK_WITHIN = 1.0  # m around the point where the straight line to the goal meets a wall
_FASTEST, _FARTHEST = 100.0, 1e4  # m/s and m: beyond it no ant goes, and a number is damaged
KEPT_PATHS = 12  # episodes per seed whose paths are kept
_KEPT_POINTS = 100  # of a path, at most


def files_of(experiment: Experiment) -> tuple[str, ...]:
    """The files that measuring a run of this row leaves."""
    return (EVALUATION, TRANSITIONS) if experiment.is_walker else (EVALUATION,)


def measured(run: RunDir, experiment: Experiment, size: Size) -> bool:
    """Whether the finished run has its files, made from the policy it has now with at least this size."""
    return not any(problem_with(run, name, size) for name in files_of(experiment))


def problem_with(run: RunDir, name: str, size: Size | None = None) -> str | None:
    """What is wrong with a file of measurements of a finished run; None if nothing is."""
    path = run.path / name
    try:
        content = json.loads(path.read_bytes())
    except FileNotFoundError:
        return f"{path} is missing"
    except (OSError, ValueError, RecursionError):  # the last: thousands of brackets
        return f"{path} is truncated or damaged"
    if not isinstance(content, dict) or content.get("format") != FORMAT or not content.get("by_seed"):
        return f"{path} is damaged or of another version of footwork"
    done = run.summary()
    if content.get("row") != done.get("row"):
        return f"{path} is of {content.get('row')}, the run is of {done.get('row')}"
    if content.get("steps") != done.get("steps"):
        return f"{path} is of a policy {content.get('steps')} steps old, the run has {done.get('steps')}"
    if size is not None and content.get("size") != size.name:
        return f"{path} is of the {content.get('size')} study, not of the {size.name} one"
    malformed = _malformed(path, content["by_seed"], str(done.get("row")), SIZES.get(str(content.get("size"))))
    if malformed:
        return malformed
    measured_seeds, seeds = [entry["seed"] for entry in content["by_seed"]], done.get("seeds")
    if measured_seeds != seeds:
        return f"{path} is of seeds {measured_seeds}, the run has {seeds}"
    return None


def _malformed(path: Path, entries: Any, row: str, size: Size | None) -> str | None:
    """What is wrong with the entries of a file of measurements: whatever claims and figures read must be there."""
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        return f"{path} is damaged: it holds no entries"
    experiment = find_row(row) if is_row(row) else None
    try:
        for entry in entries:
            if path.name == TRANSITIONS:
                _check_transitions(entry, size.periods if size is not None else ())
            elif experiment is None or experiment.is_walker:
                _check_walking(entry)
            else:
                _check_arriving(entry, experiment)
        if len({entry["seed"] for entry in entries}) < len(entries):
            return f"{path} is damaged: it has two entries of one seed"
    except KeyError as missing:
        return f"{path} is of another version of footwork: it does not say {missing.args[0]}"
    except (TypeError, ValueError, AttributeError, OverflowError):
        return f"{path} is damaged: a number in it is none, or out of its bounds"
    return None


def _check_walking(entry: dict[str, Any]) -> None:
    _check([entry["seed"]], 0, math.inf, whole=True)
    _check([entry["fall_rate"], entry["flip_rate"]], 0, 1)
    _check([entry["speed_mps"][name] for name in DIRECTIONS], -_FASTEST, _FASTEST)


def _check_arriving(entry: dict[str, Any], experiment: Experiment) -> None:
    _check([entry["seed"]], 0, math.inf, whole=True)
    _check([entry["fall_rate"], entry["flip_rate"], *(entry["success"][str(r)] for r in SUCCESS_RADII)], 0, 1)
    _check([entry["way"]], -_FARTHEST, 1)
    if straight_line_stop(experiment.task.arena) is not None:
        _check([entry["stuck"]], 0, 1)
    for places in (entry["ends"], *(path["xy"] for path in entry["paths"])):
        _check([number for place in places for number in place], -_FARTHEST, _FARTHEST)
        if not places or any(len(place) != 2 for place in places):
            raise ValueError("places are pairs of numbers")
    for path in entry["paths"]:
        _check(path["choices"], 0, len(DIRECTIONS) - 1, whole=True)
        if experiment.is_master and len(path["choices"]) != len(path["xy"]) - 1:
            raise ValueError("a choice for every piece of a path")


def _check_transitions(entry: dict[str, Any], periods: tuple[int, ...]) -> None:
    _check([entry["seed"]], 0, math.inf, whole=True)
    if [len(line) for line in entry["handover"]] != [len(DIRECTIONS)] * len(DIRECTIONS) or not entry["switching"]:
        raise ValueError("from every direction to every direction, and switched at random")
    for missing in (k for k in periods if str(k) not in entry["switching"]):
        raise KeyError(f"how random switching every {missing} steps went")
    cells = [cell for line in entry["handover"] for cell in line]
    _check([cell["success"] for cell in cells], 0, 1)
    figures = list(entry["switching"].values())
    _check([found[name] for found in figures for name in ("idle", "upside_down")], 0, 1)
    _check([found["speed_mps"] for found in (*cells, *figures)], -_FASTEST, _FASTEST)
    _check([int(period) for period in entry["switching"]], 1, math.inf)


def _check(numbers: Any, low: float, high: float, whole: bool = False) -> None:
    """Refuse what is no number, or lies out of its bounds; NaN does."""
    kinds = (int,) if whole else (int, float)
    for number in numbers:
        if type(number) not in kinds or not low <= number <= high:
            raise ValueError(f"{number!r} is no number between {low} and {high}")


def measure(run: RunDir, size: Size, num_threads: int = 1) -> None:
    """Make the files of a finished run that are missing, stale or damaged.

    Raises:
        RunError: the run is not finished, or has no policy (a report keeps those of some seeds only).
        CheckpointError: its policy is damaged, or a file cannot be written.
    """
    if not run.finished:
        raise RunError(f"{run.path} is not finished: only finished runs are measured")
    if not run.policy_path.is_file():
        row = str(run.summary().get("row"))
        raise RunError(f"{run.path} has no policy to be measured with: {how_to_train_again(run, row)}")
    trained = load_run(run)
    makers = {EVALUATION: _evaluation, TRANSITIONS: _transitions}
    for name in files_of(trained.experiment):
        if problem_with(run, name, size) is None:
            continue
        alone = (one_seed(trained, index) for index in range(len(trained.seeds)))
        seeds = [makers[name](run, seed, size, num_threads) for seed in alone]
        task = trained.experiment.task
        content = {
            "format": FORMAT,
            "size": size.name,
            "row": trained.experiment.name,
            "robot": task.robot.name,
            "steps": run.summary()["steps"],
            "versions": versions(),
            "by_seed": seeds,
        }
        write_atomically(run.path / name, json.dumps(content, allow_nan=False).encode() + b"\n")


def _evaluation(run: RunDir, trained: Trained, size: Size, num_threads: int) -> dict[str, Any]:
    experiment = trained.experiment
    subs = choices_of(experiment, load_policies(run.path / NEEDED) if experiment.is_master else None)
    count = size.walker_episodes if experiment.is_walker else size.episodes
    seed = trained.seeds[0]
    episodes = play_episodes(trained, subs, count, EVALUATION_SEED + seed, num_threads=num_threads)
    figures: dict[str, Any] = {
        "seed": seed,
        "episodes": count,
        "fall_rate": float(episodes.fallen.mean()),
        "flip_rate": float(episodes.flipped.mean()),
        "progress_m": float(episodes.progress.mean()),
    }
    if experiment.is_walker:
        return {**figures, "speed_mps": _speeds(experiment, episodes)}
    return {**figures, **arrivals(experiment, episodes), "paths": _paths(episodes)}


def _speeds(experiment: Experiment, episodes: Episodes) -> dict[str, float]:
    """Mean speed over the whole episode time, per direction; time after a fall counts."""
    seconds = experiment.task.episode_steps * experiment.task.robot.control_dt
    blocks = np.split(episodes.progress, len(DIRECTIONS))
    return {name: float(block.mean() / seconds) for name, block in zip(DIRECTIONS, blocks, strict=True)}


def arrivals(experiment: Experiment, episodes: Episodes) -> dict[str, Any]:
    """How near to their goals episodes came and ended.

    ``way`` is the distance part of the reward in the paper's measure, the drop of the straight-line
    distance to the goal from start to end, as a share of the distance at the start: 1 at the goal.
    ``stuck`` is the share that ended within :data:`STUCK_WITHIN` of where the straight line meets a
    wall, without having been at the goal; None where no wall is in the way.
    """
    arena = experiment.task.arena
    start, ends = np.array(arena.start), episodes.paths[-1].astype(np.float64)
    distance = float(np.hypot(*(np.array(arena.goals[0]) - start)))  # every goal is equally far
    approach = episodes.progress  # where there are several goals, the potential is the straight line
    if len(arena.goals) == 1:
        approach = distance - np.hypot(*(np.array(arena.goals[0]) - ends).T)
    arrived = episodes.time_to_goal[np.isfinite(episodes.time_to_goal)]
    stop = straight_line_stop(arena)
    away = episodes.closest > 1.0
    stuck = None if stop is None else away & (np.hypot(*(np.array(stop) - ends).T) <= STUCK_WITHIN)
    return {
        "success": {str(radius): float((episodes.closest <= radius).mean()) for radius in SUCCESS_RADII},
        "way": float(approach.mean() / distance),
        "closest_m": float(episodes.closest.mean()),
        "time_to_goal_s": float(arrived.mean()) if arrived.size else None,
        "stuck": None if stuck is None else float(stuck.mean()),
        "ends": np.round(ends, 2).tolist(),
    }


def straight_line_stop(arena: Arena) -> tuple[float, float] | None:
    """Where the torso is stopped that walks straight from the start to the goal, to a centimetre; None if nowhere."""
    if len(arena.goals) != 1:
        return None
    start, goal = np.array(arena.start), np.array(arena.goals[0])
    length = float(np.hypot(*(goal - start)))
    points = start + np.linspace(0.0, 1.0, max(2, int(100 * length)))[:, None] * (goal - start)
    blocked = inside_walls(arena, points, CLEARANCE)
    if not blocked.any():
        return None
    x, y = points[max(int(blocked.argmax()) - 1, 0)]
    return float(x), float(y)


def _paths(episodes: Episodes) -> list[dict[str, Any]]:
    """The first episodes' paths, thinned, until they end; a master's with its choices."""
    every = max(1, len(episodes.paths) // _KEPT_POINTS) if not episodes.choices.size else 1
    kept = []
    for row in range(min(KEPT_PATHS, episodes.paths.shape[1])):
        last = len(episodes.paths)
        if episodes.choices.size:
            over = episodes.ended[:, row]
            last = int(over.argmax()) + 1 if over.any() else last
        xy = np.round(episodes.paths[:last:every, row].astype(np.float64), 2).tolist()
        kept.append({"xy": xy, "choices": episodes.choices[: last - 1, row].tolist() if episodes.choices.size else []})
    return kept


def _transitions(run: RunDir, trained: Trained, size: Size, num_threads: int) -> dict[str, Any]:
    seed = trained.seeds[0]
    report = transitions(trained, size.ants, EVALUATION_SEED + seed, num_threads=num_threads, periods=size.periods)
    return {"seed": seed, "ants": size.ants, "handover": report["handover"], "switching": report["switching"]}
