"""Training curves of finished runs, in bins: read from the lines that training wrote, and kept beside the policy."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from footwork.checkpoint import CheckpointError, write_atomically
from footwork.record import RunDir, RunError, read_metrics
from footwork.statistics import Floats
from footwork.study.runs import how_to_train_again
from footwork.train import Experiment, steps_per_iteration

CURVE = "curve.json"
BINS = 100  # points of a training curve
_FORMAT = 2
_KEYS = {"return": "episode/return", "progress": "episode/progress"}  # means over a bin's episodes
_VALUES = (*_KEYS, "success")
_MOST = 1e9  # of a return: beyond it a file is damaged


class Curve(NamedTuple):
    """A run's training in :data:`BINS` bins of equally many updates; arrays [X] or [X, R], R learners of the run."""

    step: Floats  # control steps of one learner at the end of each bin
    seconds: Floats  # of training, at the end of each bin: of the whole run, or of a seed an equal share of that
    episodes: Floats  # that ended in the bin
    values: dict[str, Floats]  # mean over these episodes, NaN where none ended; "success" is a share


def read_curve(run: RunDir, experiment: Experiment) -> Curve:
    """The binned training curve of a finished run, from ``curve.json`` or from its metrics, then kept there.

    Raises:
        RunError: the metrics are missing, damaged, or end before the run does.
    """
    kept = run.path / CURVE
    size = run.metrics_path.stat().st_size if run.metrics_path.is_file() else None
    whose = _whose(run, experiment)
    learners = experiment.runs_per_seed * len(run.config()["seeds"])
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
        content = json.loads(kept.read_bytes())
        same = content["format"] == _FORMAT and content["of"] == whose
        if same and size in (None, content["metrics_bytes"]):
            curve = _curve_from_json(content, learners)
            if curve.step[-1] == whose["steps"]:
                return curve
    remedy = how_to_train_again(run, experiment.name)
    if size is None:
        what = "damaged, or of another run or version of footwork" if kept.is_file() else "missing"
        raise RunError(f"{kept} is {what}, and {run.metrics_path} is not there to make it from: {remedy}")
    lines = read_metrics(run.metrics_path)
    end = run.summary()["steps"]
    if not lines or lines[-1]["step"] != end:
        last = lines[-1]["step"] if lines else "none"
        said = f"{run.metrics_path} is truncated: the run has {end} steps, its last line is of step {last}"
        raise RunError(f"{said}: {remedy}")
    try:
        curve = _bin(lines, steps_per_iteration(experiment), len(run.config()["seeds"]))
    except (KeyError, TypeError, ValueError) as error:
        raise RunError(f"{run.metrics_path} is of another version of footwork: {error!r}") from None
    curve = _curve_from_json(
        _curve_to_json(curve, whose, size), learners
    )  # rounded now as it will be when it is read again
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
        "format": _FORMAT,
        "of": whose,
        "metrics_bytes": metrics_bytes,
        "step": curve.step.astype(int).tolist(),
        "seconds": np.round(curve.seconds, 1).tolist(),
        "episodes": curve.episodes.astype(int).tolist(),
        "values": rounded,
    }


def _curve_from_json(content: dict[str, Any], learners: int) -> Curve:
    """The curve in a file, of so many learners.

    Raises:
        ValueError, KeyError, TypeError: it is none.
    """
    step, seconds, episodes = (np.array(content[name], np.float64) for name in ("step", "seconds", "episodes"))
    arrays = {name: np.array(content["values"][name], np.float64) for name in _VALUES}  # None becomes NaN
    if step.ndim != 1 or not step.size or seconds.shape != step.shape or episodes.shape[:1] != step.shape:
        raise ValueError("steps, seconds and episodes of different numbers of bins")
    if episodes.shape[1:] != (learners,) or any(value.shape != episodes.shape for value in arrays.values()):
        raise ValueError("values of different numbers of bins or learners")
    counts = (step, seconds, episodes)
    if not all(np.isfinite(count).all() and (count >= 0).all() for count in counts) or (np.diff(step) <= 0).any():
        raise ValueError("steps, seconds or episodes that are none")
    if any((np.abs(value) > _MOST).any() for value in arrays.values()):  # NaN is where no episode ended
        raise ValueError("a value beyond all bounds")
    return Curve(step, seconds, episodes, arrays)


def of_seed(curve: Curve, experiment: Experiment, index: int) -> Curve:
    """The learners of a run's seed, by its index, and an equal share of the time that all its seeds took."""
    each = experiment.runs_per_seed
    mine = slice(index * each, (index + 1) * each)
    values = {name: value[:, mine] for name, value in curve.values.items()}
    share = each / curve.episodes.shape[1]
    return Curve(curve.step, curve.seconds * share, curve.episodes[:, mine], values)


def mean_between(curve: Curve, name: str, begin: float, end: float) -> Floats:
    """Mean over the episodes that ended between two shares of the training, per learner [R]; NaN where none did.

    Args:
        curve: of one seed.
        name: of its values.
        begin: 0 to 1, not included.
        end: 0 to 1, included.
    """
    share = curve.step / curve.step[-1]
    then = (share > begin) & (share <= end)
    weights = np.where(np.isnan(curve.values[name][then]), 0.0, curve.episodes[then])
    with np.errstate(invalid="ignore"):
        return np.asarray((np.nan_to_num(curve.values[name][then]) * weights).sum(axis=0) / weights.sum(axis=0))


__all__ = ["BINS", "CURVE", "Curve", "copy_curve", "mean_between", "of_seed", "read_curve", "write_curve"]
