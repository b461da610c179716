"""Read a study back from its files: which rows are at hand, which runs count, their curves and measurements.

A run counts as a row if its saved config is the row's, and its length too. Whatever is
left out (unfinished, another config or length, a damaged or missing file, a seed that
is there twice) is named by :meth:`Results.said`; nothing is skipped in silence.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from footwork.physics import libraries_of
from footwork.record import RunDir, RunError, device_in
from footwork.statistics import Effect, Floats, contrast, generator_for
from footwork.study.experiments import EXPERIMENTS, MAIN, in_braces, is_row
from footwork.study.measure import EVALUATION, problem_with
from footwork.study.metrics import METRICS
from footwork.study.plan import Study
from footwork.study.runs import (
    RUN_FILES,
    experiment_of,
    how_to_reproduce,
    how_to_train_again,
    same_row,
)
from footwork.study.training_curves import Curve, of_seed, read_curve
from footwork.train import Experiment, planned_steps

SAME_LENGTH = 0.01  # of the row's steps, by which a run may differ: whole iterations have been rounded up and down


@dataclass(frozen=True)
class Sample:
    """One seed of a finished run."""

    row: str
    seed: int
    run: RunDir
    index: int  # of the seed in the run
    experiment: Experiment

    @property
    def control_steps(self) -> int:
        """What this seed took, all its directions counted.

        Raises:
            RunError: the run's summary cannot be read.
        """
        return int(self.run.summary()["steps"]) * self.experiment.runs_per_seed


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
    unfinished: set[str] = field(default_factory=set)  # those of them that are only runs that are not done yet
    mixed: dict[str, list[str]] = field(default_factory=dict)  # rows whose runs are of more than one make, by which
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
            self.problems.update(dict.fromkeys(run.why for run in left_out))
            for makes in _makes(found):
                self.mixed.setdefault(makes, []).append(row)
            self.unfinished.update(run.why for run in left_out if run.unfinished)
        return self._samples[row]

    def said(self) -> list[str]:
        """What is to be said of the files that were read: problems, and which rows are of more than one make."""
        return [*self.problems, *(f"runs of {in_braces(rows)} were made {makes}" for makes, rows in self.mixed.items())]

    def curves(self, row: str) -> list[tuple[Sample, Curve]]:
        """The training curves of a row's seeds."""
        found = ((sample, self.curve(sample)) for sample in self.samples(row))
        return [(sample, curve) for sample, curve in found if curve is not None]

    def curve(self, sample: Sample) -> Curve | None:
        """The training curve of a sample; None, and a problem, where it cannot be read."""
        whole = self.whole_curve(sample)
        return None if whole is None else of_seed(whole, sample.experiment, sample.index)

    def training_seconds(self, row: str) -> list[float]:
        """How long each seed of a row trained; of seeds that trained side by side, an equal share of their time."""
        return [float(curve.seconds[-1]) for _, curve in self.curves(row)]

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

    def middle(self, row: str, metric: str) -> Effect | None:
        """A row's interquartile mean over seeds in a metric, with its interval: the same wherever it is shown.

        None if it has no runs; the interval of one seed is empty.

        Raises:
            ValueError: there is no such row or metric.
        """
        scores = self.scores(row, metric)
        return contrast([scores], (1,), generator_for(f"row {row} {metric}")) if len(scores) else None

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
                remedy = f"{how_to_reproduce(self.study.runs, sample.row)} makes it again"
                if not sample.run.policy_path.is_file():  # a report keeps those of some seeds only
                    remedy = how_to_train_again(sample.run, sample.row)
                self.problems[f"{problem}: {remedy}"] = None
            self._files[key] = [] if problem else json.loads((sample.run.path / name).read_bytes())["by_seed"]
        return next((entry for entry in self._files[key] if entry["seed"] == sample.seed), None)


def find_samples(study: Study, row: str, any_length: bool = False) -> tuple[tuple[Sample, ...], list[LeftOut]]:
    """The finished seeds of a row that count, and what does not and why.

    Where a seed is there twice, the run of that seed alone counts.

    Raises:
        ValueError: there is no such row.
    """
    experiment = study.row(row)
    found: dict[int, Sample] = {}
    left_out: list[LeftOut] = []
    place = study.runs / row
    left_out += [
        LeftOut(f"{path} is a file where a folder of runs was to be")
        for path in (place, *place.glob("seed*"))
        if path.is_file()
    ]
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
        if not any(name in files for name in (*RUN_FILES, EVALUATION)):
            problems += [f"{link} is a link to nothing: left out" for link in _dangling(study, Path(place), files)]
            continue
        path = Path(place)
        row = path.parent.relative_to(study.runs).as_posix() if path != study.runs else ""
        if not is_row(row):
            problems.append(f"{path} lies where no row of this version has its runs: left out")
        elif "config.json" not in files:
            problems.append(f"{path} has no config.json: left out")
    return problems


def _dangling(study: Study, place: Path, files: list[str]) -> list[Path]:
    """Links that lead nowhere, where a run or a row's folder would be; :func:`os.walk` takes them for files."""
    links = (path for path in (place / name for name in files) if path.is_symlink() and not path.exists())
    rows = {path: path.relative_to(study.runs) for path in links}
    return sorted(path for path, row in rows.items() if is_row(row.as_posix()) or is_row(row.parent.as_posix()))


def _makes(samples: tuple[Sample, ...]) -> list[str]:
    """Runs of one row that other code, libraries or devices made count all the same; it is said."""
    makes = []
    engines = {sample.experiment.engine for sample in samples}
    for library in ("footwork", "source", *dict.fromkeys(name for engine in engines for name in libraries_of(engine))):
        found = sorted({str(sample.run.versions().get(library, "unknown")) for sample in samples})
        if len(found) > 1:
            makes.append(f"with different versions of {library}: {', '.join(found)}")
    devices = sorted({device_in(sample.run.versions()) for sample in samples})
    if len(devices) > 1:
        makes.append(f"on different devices: {', '.join(devices)}")
    return makes


def _saved(run: RunDir) -> tuple[Experiment, list[int]]:
    """What a run was begun as.

    Raises:
        RunError: config.json is damaged, or of a version with other fields.
    """
    experiment, seeds = experiment_of(run), run.config().get("seeds")
    run.versions()
    if not isinstance(seeds, list) or not seeds or any(type(seed) is not int for seed in seeds):
        raise RunError(f"{run.path / 'config.json'} is damaged: its seeds are {seeds!r}")
    return experiment, list(seeds)


def _why_not(run: RunDir, saved: Experiment, row: Experiment, any_length: bool) -> LeftOut | None:
    if not same_row(saved, row):
        return LeftOut(f"{run.path} was trained with other fields than {row.name} has now: left out")
    if not run.finished:
        return LeftOut(f"{run.path} is not finished: left out", unfinished=True)
    done, config = run.summary(), run.config()
    steps = done.get("steps")
    if not isinstance(steps, int):
        return LeftOut(f"{run.path / 'DONE'} is damaged or of another version of footwork: it does not say steps")
    if (done.get("row"), done.get("seeds")) != (saved.name, config["seeds"]):
        other = f"{done.get('row')} seeds {done.get('seeds')}"
        return LeftOut(
            f"{run.path / 'DONE'} is of {other}, the run was begun as {saved.name} {config['seeds']}: left out"
        )
    if abs(steps - planned_steps(row)) > SAME_LENGTH * planned_steps(row) and not any_length:
        return LeftOut(f"{run.path} is {steps:,} steps long, {row.name} takes {planned_steps(row):,}: left out")
    return None


def seeds_in_words(count: int | str) -> str:
    """``1 seed``, ``2 seeds``, ``3 / 10 seeds``."""
    return f"{count} seed{'' if str(count) == '1' else 's'}"


def prefixes_at_hand(results: Results) -> tuple[str, ...]:
    """The default engine and ant, and those others that have finished runs in the study's folder."""
    runs = results.study.runs
    places = sorted(path.name for path in runs.iterdir() if path.is_dir()) if runs.is_dir() else []
    there = [f"{name}/" for name in places if is_prefix(f"{name}/")]
    return ("", *(prefix for prefix in there if any((runs / prefix).rglob("DONE"))))


def is_prefix(name: str) -> bool:
    """Whether rows of another engine or ant have names that begin so, as in ``light/``."""
    return any(is_row(name + row) for row in MAIN)


def all_rows(results: Results) -> list[str]:
    """Every row of the table of experiments, and those under each other engine or ant at hand."""
    elsewhere = [prefix + row for prefix in prefixes_at_hand(results) if prefix for row in EXPERIMENTS]
    known = [row for row in elsewhere if row not in EXPERIMENTS and is_row(row)]
    return [*EXPERIMENTS, *known]


__all__ = [
    "LeftOut",
    "Results",
    "Sample",
    "all_rows",
    "find_samples",
    "is_prefix",
    "prefixes_at_hand",
    "seeds_in_words",
    "strays",
]
