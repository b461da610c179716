"""Read a study back from its files: which runs count, their training curves, their measurements.

A run counts as a row if its saved config is the row's, and its length too. Whatever is
left out (unfinished, another config or length, a damaged or missing file, a seed that
is there twice) is named in :attr:`Results.problems`; nothing is skipped in silence.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from footwork.arena import DIRECTIONS, Arena, DistanceField, Point, geodesic_field
from footwork.checkpoint import CheckpointError, write_atomically
from footwork.record import RunDir, RunError, config_from_json, read_metrics
from footwork.statistics import Floats
from footwork.study.experiments import is_row
from footwork.study.measure import EVALUATION, TRANSITIONS, problem_with, straight_line_stop
from footwork.study.plan import Study
from footwork.train import Experiment, planned_steps, steps_per_iteration

CURVE = "curve.json"
RUN_FILES = ("config.json", "DONE", "metrics.jsonl", "policy.safetensors", EVALUATION)  # any of them: a run lies there
BINS = 100  # points of a training curve
LAST = 0.1  # share of training that "final" means
SAME_LENGTH = 0.01  # of the row's steps, by which a run may differ: whole iterations have been rounded up and down
_CURVE_FORMAT = 2
_KEYS = {"return": "episode/return", "progress": "episode/progress"}  # means over a bin's episodes


class Curve(NamedTuple):
    """A run's training in :data:`BINS` bins of equally many updates; arrays [X] or [X, R], R learners of the run."""

    step: Floats  # control steps of one learner at the end of each bin
    seconds: Floats  # of training, at the end of each bin
    episodes: Floats  # that ended in the bin
    values: dict[str, Floats]  # mean over these episodes, NaN where none ended; "success" is a share


@dataclass(frozen=True)
class Sample:
    """One seed of a finished run."""

    row: str
    seed: int
    run: RunDir
    index: int  # of the seed in the run
    experiment: Experiment


class LeftOut(NamedTuple):
    """A run that does not count, and why."""

    why: str
    unfinished: bool = False


@dataclass
class Results:
    """All that a folder of runs says, read when it is asked for, and what had to be left out.

    Args:
        study: the folder and its size.
        any_length: let runs of another length than their row's count too.
    """

    study: Study
    any_length: bool = False
    problems: dict[str, None] = field(default_factory=dict)  # an ordered set
    _samples: dict[str, tuple[Sample, ...]] = field(default_factory=dict)
    _curves: dict[Path, Curve] = field(default_factory=dict)
    _files: dict[tuple[Path, str], list[dict[str, Any]]] = field(default_factory=dict)

    def samples(self, row: str) -> tuple[Sample, ...]:
        """The seeds of a row, in their order.

        Raises:
            ValueError: there is no such row.
        """
        if row not in self._samples:
            found, left_out = find_samples(self.study, row, self.any_length)
            self._samples[row] = found
            self.problems.update(dict.fromkeys([*(run.why for run in left_out), *_mixed_versions(row, found)]))
        return self._samples[row]

    def curves(self, row: str) -> list[tuple[Sample, Curve]]:
        """The training curves of a row's seeds."""
        found = []
        for sample in self.samples(row):
            curve = self.whole_curve(sample)
            if curve is not None:
                found.append((sample, _of_seed(curve, sample)))
        return found

    def measurements(self, row: str, name: str) -> list[dict[str, Any]]:
        """The entries of a file of measurements, one per seed that has them."""
        entries = (self.entry(sample, name) for sample in self.samples(row))
        return [entry for entry in entries if entry is not None]

    def scores(self, row: str, metric: str) -> Floats:
        """A metric of a row's seeds: [S] or [S, T].

        Raises:
            ValueError: there is no such row or metric.
        """
        return np.array(list(self.scores_by_seed(row, metric).values()), np.float64)

    def scores_by_seed(self, row: str, metric: str) -> dict[int, Any]:
        """A metric of each of a row's seeds that has it.

        Raises:
            ValueError: there is no such row or metric.
        """
        if metric not in METRICS:
            raise ValueError(f"unknown metric {metric!r}; known metrics: {', '.join(METRICS)}")
        values = ((sample.seed, METRICS[metric].of(self, sample)) for sample in self.samples(row))
        return {seed: value for seed, value in values if value is not None}

    def all_samples(self) -> dict[str, tuple[Sample, ...]]:
        """Every row that has been asked for so far, and its seeds."""
        return dict(self._samples)

    def whole_curve(self, sample: Sample) -> Curve | None:
        """The curve of a sample's run, all its seeds; None, and a problem, where it cannot be read."""
        path = sample.run.path
        if path not in self._curves:
            try:
                self._curves[path] = read_curve(sample.run, sample.experiment)
            except RunError as error:
                self.problems[str(error)] = None
                return None
        return self._curves[path]

    def entry(self, sample: Sample, name: str) -> dict[str, Any] | None:
        """What a file of measurements says of a sample; None, and a problem, where it cannot be read."""
        key = (sample.run.path, name)
        if key not in self._files:
            problem = problem_with(sample.run, name, self.study.size)
            if problem:
                self.problems[f"{problem}: footwork reproduce --rows {sample.row} makes it again"] = None
            self._files[key] = [] if problem else json.loads((sample.run.path / name).read_bytes())["by_seed"]
        found = next((entry for entry in self._files[key] if entry["seed"] == sample.seed), None)
        if found is None and self._files[key]:
            self.problems[f"{sample.run.path / name} says nothing of seed {sample.seed}"] = None
        return found


def find_samples(study: Study, row: str, any_length: bool = False) -> tuple[tuple[Sample, ...], list[LeftOut]]:
    """The finished seeds of a row that count, and what does not and why.

    Where a seed is there twice, the run of that seed alone counts.

    Raises:
        ValueError: there is no such row.
    """
    experiment = study.row(row)
    found: dict[int, Sample] = {}
    left_out: list[LeftOut] = []
    configs = sorted((study.runs / row).glob("*/config.json"), key=lambda path: ("seeds-" in path.parent.name, path))
    for path in configs:
        run = RunDir(path.parent)
        try:
            saved, seeds = _saved(run)
            problem = _why_not(run, saved, experiment, any_length)
        except ValueError as error:
            problem = LeftOut(str(error))
        if problem:
            left_out.append(problem)
            continue
        for index, seed in enumerate(seeds):
            if seed in found:
                left_out.append(LeftOut(f"{run.path}: seed {seed} is in {found[seed].run.path} too, which counts"))
                continue
            found[seed] = Sample(row, seed, run, index, saved)
    return tuple(found[seed] for seed in sorted(found)), left_out


def strays(study: Study) -> list[str]:
    """Folders that look like runs and that no row would ever find."""
    problems = []
    for place, _, files in sorted(os.walk(study.runs)):
        if not any(name in files for name in RUN_FILES):
            continue
        path = Path(place)
        row = path.parent.relative_to(study.runs).as_posix() if path != study.runs else ""
        if not is_row(row):
            problems.append(f"{path} lies where no row of this version has its runs: left out")
        elif "config.json" not in files:
            problems.append(f"{path} has no config.json: left out")
    return problems


def _mixed_versions(row: str, samples: tuple[Sample, ...]) -> list[str]:
    """Runs of one row that other code or libraries made count all the same; it is said."""
    problems = []
    for library in ("footwork", "source", "jax", "mujoco"):
        found = sorted({str(sample.run.versions().get(library, "unknown")) for sample in samples})
        if len(found) > 1:
            problems.append(f"runs of {row} were made with different versions of {library}: {', '.join(found)}")
    return problems


def _saved(run: RunDir) -> tuple[Experiment, list[int]]:
    """What a run was begun as.

    Raises:
        RunError: config.json is damaged, or of a version with other fields.
    """
    config = run.config()
    try:
        return config_from_json(Experiment, config["experiment"]), [int(seed) for seed in config["seeds"]]
    except (KeyError, TypeError, ValueError) as error:
        version = run.versions().get("footwork", "unknown")
        raise RunError(f"{run.path} is of another version of footwork ({version}): {error}") from None


def _why_not(run: RunDir, saved: Experiment, row: Experiment, any_length: bool) -> LeftOut | None:
    if replace(saved, total_steps=row.total_steps) != row:
        return LeftOut(f"{run.path} was trained with other fields than {row.name} has now: left out")
    if not run.finished:
        return LeftOut(f"{run.path} is not finished: left out", unfinished=True)
    steps = run.summary().get("steps")
    if not isinstance(steps, int):
        return LeftOut(f"{run.path / 'DONE'} is damaged or of another version of footwork: it does not say steps")
    if abs(steps - planned_steps(row)) > SAME_LENGTH * planned_steps(row) and not any_length:
        return LeftOut(f"{run.path} is {steps:,} steps long, {row.name} takes {planned_steps(row):,}: left out")
    return None


# Training curves ------------------------------------------------------------------------------------------------------


def read_curve(run: RunDir, experiment: Experiment) -> Curve:
    """The binned training curve of a finished run, from ``curve.json`` or from its metrics, then kept there.

    Raises:
        RunError: the metrics are missing, damaged, or end before the run does.
    """
    kept = run.path / CURVE
    size = run.metrics_path.stat().st_size if run.metrics_path.is_file() else None
    whose = _whose(run, experiment)
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        content = json.loads(kept.read_bytes())
        same = content["format"] == _CURVE_FORMAT and content["of"] == whose
        if same and size in (None, content["metrics_bytes"]):
            return _curve_from_json(content)
    if size is None:
        what = "damaged, or of another run or version of footwork" if kept.is_file() else "missing"
        raise RunError(f"{kept} is {what}, and {run.metrics_path} is not there to make it from")
    lines = read_metrics(run.metrics_path)
    end = run.summary()["steps"]
    if not lines or lines[-1]["step"] != end:
        last = lines[-1]["step"] if lines else "none"
        raise RunError(f"{run.metrics_path} is truncated: the run has {end} steps, its last line is of step {last}")
    try:
        curve = _bin(lines, steps_per_iteration(experiment), len(run.config()["seeds"]))
    except (KeyError, TypeError, ValueError) as error:
        raise RunError(f"{run.metrics_path} is of another version of footwork: {error!r}") from None
    curve = _curve_from_json(_curve_to_json(curve, whose, size))  # rounded now as it will be when it is read again
    with contextlib.suppress(CheckpointError):  # a folder that cannot be written is read again the next time
        write_curve(kept, curve, whose, size)
    return curve


def _whose(run: RunDir, experiment: Experiment) -> dict[str, Any]:
    """What says that a curve is this run's."""
    config, summary = run.config(), run.summary()
    return {"row": experiment.name, "seeds": config.get("seeds"), "steps": summary.get("steps")}


def copy_curve(curve: Curve, run: RunDir, experiment: Experiment, to: Path) -> None:
    """Write a run's curve where its metrics are not.

    Raises:
        CheckpointError: it cannot be written.
    """
    write_curve(to, curve, _whose(run, experiment), None)


def write_curve(path: Path, curve: Curve, whose: dict[str, Any], metrics_bytes: int | None) -> None:
    """Write a curve, whose it is, and how large the file of metrics was that it was made from.

    Raises:
        CheckpointError: it cannot be written.
    """
    write_atomically(path, json.dumps(_curve_to_json(curve, whose, metrics_bytes)).encode() + b"\n")


def _bin(lines: list[dict[str, Any]], steps_per_line: int, num_seeds: int) -> Curve:
    count = np.array([line["episode/count"] for line in lines], np.float64)
    learners = count.shape[1]
    rate = np.array([line["time/steps_per_second"] for line in lines], np.float64)
    seconds = np.cumsum(steps_per_line * learners / rate)
    edges = np.unique(np.linspace(0, len(lines), min(BINS, len(lines)) + 1).astype(int))[:-1]
    sums = {name: _sum_of(lines, key, count) for name, key in _KEYS.items()}
    sums["success"] = np.array([line["count/reached"] for line in lines], np.float64)
    episodes = np.add.reduceat(count, edges, axis=0)
    ends = np.append(edges[1:], len(lines)) - 1
    with np.errstate(invalid="ignore", divide="ignore"):
        values = {name: np.add.reduceat(total, edges, axis=0) / episodes for name, total in sums.items()}
    return Curve(np.array([lines[i]["step"] for i in ends], np.float64), seconds[ends], episodes, values)


def _sum_of(lines: list[dict[str, Any]], key: str, count: Floats) -> Floats:
    """Means over episodes as sums; nothing where none ended."""
    mean = np.array([line[key] for line in lines], np.float64)
    return np.where(count > 0, mean, 0.0) * count


def _curve_to_json(curve: Curve, whose: dict[str, Any], metrics_bytes: int | None) -> dict[str, Any]:
    rounded = {
        name: [[None if np.isnan(x) else float(f"{x:.5g}") for x in row] for row in value]
        for name, value in curve.values.items()
    }
    return {
        "format": _CURVE_FORMAT,
        "of": whose,
        "metrics_bytes": metrics_bytes,
        "step": curve.step.astype(int).tolist(),
        "seconds": np.round(curve.seconds, 1).tolist(),
        "episodes": curve.episodes.astype(int).tolist(),
        "values": rounded,
    }


def _curve_from_json(content: dict[str, Any]) -> Curve:
    arrays = {name: np.array(value, np.float64) for name, value in content["values"].items()}  # None becomes NaN
    step, seconds, episodes = (np.array(content[name], np.float64) for name in ("step", "seconds", "episodes"))
    return Curve(step, seconds, episodes, arrays)


def _of_seed(curve: Curve, sample: Sample) -> Curve:
    """The learners of one seed."""
    each = sample.experiment.runs_per_seed
    mine = slice(sample.index * each, (sample.index + 1) * each)
    values = {name: value[:, mine] for name, value in curve.values.items()}
    return curve._replace(episodes=curve.episodes[:, mine], values=values)


def final(curve: Curve, name: str) -> Floats:
    """Mean over the episodes that ended in the last tenth of training, per learner [R]; NaN where none did."""
    late = curve.step > (1 - LAST) * curve.step[-1]
    weights = np.where(np.isnan(curve.values[name][late]), 0.0, curve.episodes[late])
    with np.errstate(invalid="ignore"):
        return np.asarray((np.nan_to_num(curve.values[name][late]) * weights).sum(axis=0) / weights.sum(axis=0))


# Metrics --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Metric:
    """A number that every seed of a row has.

    Args:
        words: what it is, for tables and axes.
        of: reads it; None where the files do not have it.
        percent: shown as a percentage.
    """

    words: str
    of: Callable[[Results, Sample], Any]
    percent: bool = False

    def show(self, value: float) -> str:
        """The value as text."""
        return f"{100 * value:.1f} %" if self.percent else f"{value:.4g}"


def _final_return(results: Results, sample: Sample) -> Any:
    curve = results.whole_curve(sample)
    if curve is None:  # and it was said why
        return None
    returns = final(_of_seed(curve, sample), "return")
    if np.isnan(returns).any():
        results.problems[f"{sample.run.path}: no episode ended in the last tenth of training"] = None
        return None
    return returns


def _mean_final_return(results: Results, sample: Sample) -> float | None:
    returns = _final_return(results, sample)
    return None if returns is None else float(returns.mean())


def _evaluated(name: str, results: Results, sample: Sample) -> float | None:
    entry = results.entry(sample, EVALUATION)
    value = None if entry is None else entry.get(name)
    return value["1.0"] if isinstance(value, dict) else value


def _speed(results: Results, sample: Sample) -> float | None:
    entry = results.entry(sample, EVALUATION)
    return None if entry is None else float(np.mean([entry["speed_mps"][name] for name in DIRECTIONS]))


def _handover(results: Results, sample: Sample) -> float | None:
    """Between orthogonal directions: the eight of the sixteen pairs that are a quarter turn apart."""
    entry = results.entry(sample, TRANSITIONS)
    if entry is None:
        return None
    pairs = [(i, (i + turn) % 4) for i in range(4) for turn in (1, 3)]
    return float(np.mean([entry["handover"][i][j]["success"] for i, j in pairs]))


def _fluctuation(results: Results, sample: Sample) -> Any:
    """Of each direction's training return about its own course, in the second half of training [R].

    Half the mean square of the differences between neighbouring bins is their variance, wherever the course goes
    (von Neumann 1941).
    """
    curve = results.whole_curve(sample)
    if curve is None:
        return None
    returns = _of_seed(curve, sample).values["return"]
    with warnings.catch_warnings():  # a direction of which no episode ended in two bins on end
        warnings.simplefilter("ignore", RuntimeWarning)
        found = np.sqrt(np.nanmean(np.diff(returns[len(returns) // 2 :], axis=0) ** 2, axis=0) / 2)
    return None if np.isnan(found).any() else found


@functools.cache
def _way_around(arena: Arena) -> DistanceField:
    return geodesic_field(arena)


def _route(results: Results, sample: Sample) -> float | None:
    """As ``way``, along the shortest way around the walls: on AntMaze a straight line leads into one."""
    arena, entry = sample.experiment.task.arena, results.entry(sample, EVALUATION)
    if entry is None or len(arena.goals) != 1:
        return None
    field = _way_around(arena)
    left = np.mean(field.at(np.array(entry["ends"], np.float64)))
    return float(1.0 - left / field.at(np.array(arena.start)))


def _ended_within(radius: float, place: Callable[[Arena], Point | None], results: Results, sample: Sample) -> Any:
    """Share of the episodes that ended so near to a place."""
    entry, where = results.entry(sample, EVALUATION), place(sample.experiment.task.arena)
    if entry is None or where is None:
        return None
    return float(np.mean(np.hypot(*(np.array(entry["ends"], np.float64) - np.array(where)).T) <= radius))


def _transitions(results: Results, sample: Sample) -> float | None:
    """How often a master changes from one sub-policy to another in an episode, mean over those whose paths are kept."""
    entry = results.entry(sample, EVALUATION)
    if entry is None or not sample.experiment.is_master:
        return None
    return float(np.mean([np.count_nonzero(np.diff(path["choices"])) for path in entry["paths"]]))


def seeds_in_words(count: int | str) -> str:
    """``1 seed``, ``2 seeds``, ``3 / 10 seeds``."""
    return f"{count} seed{'' if str(count) == '1' else 's'}"


METRICS: dict[str, Metric] = {
    "way": Metric("share of the straight-line way to the goal", lambda r, s: _evaluated("way", r, s), True),
    "success": Metric("episodes that come within 1 m of the goal", lambda r, s: _evaluated("success", r, s), True),
    "stuck": Metric(
        "episodes that end where the straight line meets the wall", lambda r, s: _evaluated("stuck", r, s), True
    ),
    "stuck close": Metric(
        "episodes that end within 0.5 m of there", lambda r, s: _ended_within(0.5, straight_line_stop, r, s), True
    ),
    "at the start": Metric(
        "episodes that end within 0.5 m of the start", lambda r, s: _ended_within(0.5, lambda a: a.start, r, s), True
    ),
    "route": Metric("share of the shortest way around the walls", _route, True),
    "fluctuation": Metric("training return's deviation from one hundredth of training to the next", _fluctuation),
    "return": Metric("training return per episode, last tenth of training", _mean_final_return),
    "return by direction": Metric("training return per episode and direction, last tenth of training", _final_return),
    "handover": Metric("orthogonal hand-overs that succeed", _handover, True),
    "transitions": Metric("changes of sub-policy per episode", _transitions),
    "speed": Metric("speed along the direction (m/s)", _speed),
}


__all__ = [
    "CURVE",
    "METRICS",
    "Curve",
    "LeftOut",
    "Metric",
    "Results",
    "Sample",
    "copy_curve",
    "final",
    "find_samples",
    "read_curve",
    "seeds_in_words",
    "strays",
]
