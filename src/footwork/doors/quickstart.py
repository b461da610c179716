"""The quickstart: a master learns AntMaze from nothing while one watches, then meets the packaged flat policy."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path

from footwork.checkpoint import write_atomically
from footwork.doors import tables
from footwork.evaluate import Episodes, evaluate, play_episodes
from footwork.record import RunDir, read_metrics
from footwork.study.experiments import find_row
from footwork.study.figures import learning_curve, paths_figure
from footwork.study.runs import find_needed, find_trained, run_path, train_row
from footwork.train import Trained, choices_of

MASTER_ROW = "maze/hrl/symmetric-interleaved"
FLAT_ROW = "maze/flat/free"
STEPS = 1_000_000  # control steps of the master
EPISODES = 200


def quickstart(to: Path, seed: int, steps: int | None, num_threads: int) -> None:
    """Train, evaluate beside the flat policy, and leave a table, a picture of the paths and the learning curve.

    Going on with an unfinished quickstart in ``to`` is what a second call does.

    Raises:
        RunError: ``to`` is in use, or the packaged weights are missing.
    """
    begun = time.monotonic()
    experiment = replace(find_row(MASTER_ROW), total_steps=STEPS if steps is None else steps)
    print(f"Training a master on {experiment.task.arena.name!r} on top of the packaged {experiment.needs}.")
    print(f"Every {experiment.option_steps} control steps it chooses which way the ant walks. No joint is ever reset.")
    runs = to / "runs"
    flat = find_trained(FLAT_ROW, runs)  # before the training: what is missing is said at once
    find_trained(str(experiment.needs), runs)
    master = train_row(experiment, (seed,), runs, resume=True, num_threads=num_threads)
    print(f"Evaluating {MASTER_ROW} and the packaged {FLAT_ROW} on {EPISODES} episodes each.")
    reports = [
        evaluate(trained, find_needed(trained, runs), EPISODES, num_threads=num_threads) for trained in (master, flat)
    ]
    figures = _draw(to, experiment.name, run_path(runs, experiment.name, (seed,)), master, flat, num_threads)
    table = to / "results.json"
    write_atomically(table, json.dumps(reports, indent=2).encode() + b"\n")
    tables.show(tables.evaluation_table(reports))
    for path in (table, *figures):
        print(f"wrote {path}")
    print(f"{time.monotonic() - begun:.0f} s in all")


def _draw(to: Path, row: str, run: Path, master: Trained, flat: Trained, num_threads: int) -> list[Path]:
    arena, radius = master.experiment.task.arena, master.experiment.task.goal_radius
    panels = {
        f"{row}: the master's paths": _episodes(master, to / "runs", num_threads),
        f"{FLAT_ROW}: the flat policy's": _episodes(flat, to / "runs", num_threads),
    }
    metrics = read_metrics(RunDir.open_existing(run).metrics_path)
    return [
        paths_figure(to / "paths.png", arena, panels, radius),
        learning_curve(to / "learning_curve.png", metrics, row),
    ]


def _episodes(trained: Trained, runs: Path, num_threads: int) -> Episodes:
    subs = choices_of(trained.experiment, find_needed(trained, runs))
    return play_episodes(trained, subs, 40, seed=7, num_threads=num_threads)
