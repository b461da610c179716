"""One run of a study, whole: train a row with one seed, then measure it. ``python -m footwork.study.job '{...}'``.

A process of its own, that whoever starts it pins to a core. It may be killed at any moment and
started again; what is done is not done twice. It ends itself, saved as far as its engine
allows, when its standard input closes: that is, when the process that started it is gone.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

from footwork import checkpoint
from footwork.record import RunDir, RunError, RunInUse, config_to_json
from footwork.study.measure import measure, measured
from footwork.study.plan import Job, Size, Study
from footwork.study.results import find_samples
from footwork.study.runs import NEEDED, load_run, one_seed, run_path, train_row
from footwork.study.training_curves import read_curve
from footwork.train import Experiment, Interrupted, TrainingDiverged, policy_meta

WAIT_FOR_LOCK = 120.0  # s; a run whose last process was killed may still be saving
STOPPED = 130  # exit status of a run that was asked to stop; it goes on later


def find_run(study: Study, row: str, seed: int) -> RunDir | None:
    """The finished run that has this seed of the row, alone or among others."""
    samples, _ = find_samples(study, row)
    return next((sample.run for sample in samples if sample.seed == seed), None)


def completed(study: Study, jobs: Sequence[Job]) -> tuple[set[Job], list[str]]:
    """The runs for which nothing is left to do, trained to their length and measured; and what else is in the way."""
    done, problems = set(), []
    for row in dict.fromkeys(job.row for job in jobs):
        samples, left_out = find_samples(study, row)
        problems += [run.why for run in left_out if not run.unfinished]
        runs = {sample.seed: sample.run for sample in samples}
        mine = [job for job in jobs if job.row == row and job.seed in runs]
        done |= {job for job in mine if _is_whole(runs[job.seed], study.row(row), study.size)}
    return done, problems


def _is_whole(run: RunDir, experiment: Experiment, size: Size) -> bool:
    """Whether a finished run has its measurements and its curve."""
    try:
        read_curve(run, experiment)
    except RunError:
        return False
    return measured(run, experiment, size)


def complete(study: Study, row: str, seed: int) -> None:
    """Train and measure what of it is not there yet.

    Raises:
        RunError, ValueError, CheckpointError: as training and measuring do; the run it needs is missing.
    """
    run = find_run(study, row, seed)
    if run is None:
        run = _train(study, study.row(row), seed)
    with run.lock():
        if not measured(run, study.row(row), study.size):
            measure(run, study.size)
        read_curve(run, study.row(row))


def _train(study: Study, experiment: Experiment, seed: int) -> RunDir:
    """Train into the run's own directory, on the policies of the same seed that it needs."""
    path = run_path(study.runs, experiment.name, (seed,))
    if experiment.needs is not None and not (path / NEEDED).is_file():
        _place_needed(study, experiment, seed, path)
    train_row(experiment, (seed,), study.runs, name=path.name, resume=True, num_threads=1)
    return RunDir.open_existing(path)


def _place_needed(study: Study, experiment: Experiment, seed: int, path: Path) -> None:
    """Keep seed i's sub-policies beside the run of seed i, before it begins."""
    needed = find_run(study, str(experiment.needs), seed)
    if needed is None:
        raise RunError(f"{experiment.name} seed {seed} needs {experiment.needs} seed {seed}, which is not finished")
    trained = load_run(needed)
    params = one_seed(trained, trained.seeds.index(seed)).params
    if not (path / "config.json").is_file():
        RunDir.create(path, {"experiment": config_to_json(experiment), "seeds": [seed]})
    run = RunDir.open_existing(path)
    with run.lock():
        meta = policy_meta(trained.experiment, (seed,), int(needed.summary()["steps"]))
        checkpoint.save(path / NEEDED, params, {**meta, "from": trained.source})


def main(arguments: list[str]) -> int:
    """Do the run that is described; what went wrong is the last line on standard error."""
    asked = json.loads(arguments[0])
    if asked.get("core") is not None and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {asked["core"]})
    threading.Thread(target=_end_with_parent, daemon=True).start()
    study = Study(Path(asked["runs"]), Size.from_json(asked["size"]))
    deadline = time.monotonic() + WAIT_FOR_LOCK
    while True:
        try:
            complete(study, asked["row"], asked["seed"])
            return 0
        except Interrupted as error:
            print(error, file=sys.stderr)
            return STOPPED
        except RunInUse as error:  # of a finished run with several seeds another process measures all of them
            if time.monotonic() > deadline and find_run(study, asked["row"], asked["seed"]) is None:
                return _failed(error)
            time.sleep(0.5)
        except (ValueError, OSError, TrainingDiverged) as error:
            return _failed(error)


def _failed(error: Exception) -> int:
    print(f"{type(error).__name__}: {error}", file=sys.stderr)
    return 1


def _end_with_parent() -> None:
    """Ask this process to stop in good order when nobody holds the other end of its standard input."""
    while os.read(0, 4096):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
