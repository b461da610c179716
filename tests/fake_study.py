"""Folders that look like a study's, written in milliseconds: every file a run leaves but its checkpoints."""

from __future__ import annotations

import json
import zlib

import numpy as np

from footwork.arena import DIRECTIONS
from footwork.evaluate import SWITCHING_PERIODS
from footwork.record import config_to_json, versions
from footwork.study.measure import FORMAT, straight_line_stop
from footwork.study.plan import FULL
from footwork.study.runs import run_path
from footwork.study.training_curves import BINS
from footwork.train import planned_steps, steps_per_iteration

QUALITY = {"plain": 0.35, "random-start": 0.45, "random-repeated": 0.5, "appropriate-bias": 0.6, "free": 0.2}


def quality_of(row):
    """How well a row does in these studies, 0 to 1."""
    known = QUALITY.get(row.rpartition("/")[2], 0.9)
    return 0.05 if "penalised" in row else known


def fake_run(study, row, seed, quality=None, size=FULL, lines=BINS + 20):
    """A finished run of a row that does as well as ``quality`` says; its directory."""
    experiment = study.row(row)
    path = run_path(study.runs, row, (seed,))
    path.mkdir(parents=True)
    key = np.random.default_rng(zlib.crc32(f"{row} {seed}".encode()))
    good = float(np.clip((quality_of(row) if quality is None else quality) + key.normal(0, 0.04), 0, 1))
    steps = planned_steps(experiment)
    write(path / "config.json", {"config": config(experiment, seed), "versions": versions()})
    with (path / "metrics.jsonl").open("w") as file:
        for line in metrics(experiment, good, steps, key, lines):
            file.write(json.dumps(line) + "\n")
    write(path / "DONE", {"row": row, "seeds": [seed], "steps": steps})
    head = {"format": FORMAT, "size": size.name, "row": row, "robot": experiment.task.robot.name, "steps": steps}
    write(
        path / "evaluation.json", {**head, "versions": versions(), "by_seed": [evaluation(experiment, good, seed, key)]}
    )
    if experiment.is_walker:
        entry = {"seed": seed, "ants": 64, "handover": handover(good, key), "switching": switching(good, key)}
        write(path / "transitions.json", {**head, "versions": versions(), "by_seed": [entry]})
    return path


def write(path, content):
    path.write_text(json.dumps(content))


def config(experiment, seed):
    return {"experiment": config_to_json(experiment), "seeds": [seed]}


def metrics(experiment, good, steps, key, lines):
    runs = experiment.runs_per_seed
    total = steps // steps_per_iteration(experiment)
    whole = 8.0 / experiment.task.robot.control_dt
    for i in range(1, min(lines, total) + 1):
        share = i / min(lines, total)
        learned = good * (1 - np.exp(-5 * share)) + key.normal(0, 0.02, runs)
        count = np.maximum(key.integers(0, 6, runs), share == 1)
        yield {
            "step": round(total * share) * steps_per_iteration(experiment),
            "episode/count": count.tolist(),
            "episode/return": mean(2800 * learned, count),
            "episode/progress": mean(whole * learned, count),
            "count/reached": np.round(np.clip(learned, 0, 1) * count).astype(int).tolist(),
            "time/steps_per_second": 9000.0 + float(key.normal(0, 300)),
        }


def mean(value, count):
    """Of a bin's episodes, as metrics have it."""
    return [float(v) if n else "nan" for v, n in zip(value, count, strict=True)]


def evaluation(experiment, good, seed, key, episodes=60):
    figures = {"seed": seed, "episodes": episodes, "fall_rate": 0.1, "flip_rate": 0.05, "progress_m": 8 * good}
    if experiment.is_walker:
        return {**figures, "speed_mps": dict.fromkeys(DIRECTIONS, 1 + 1.5 * good)}
    arena = experiment.task.arena
    start, goal = np.array(arena.start), np.array(arena.goals[0])
    stop = straight_line_stop(arena)
    there = key.random(episodes) < good
    ends = np.where(there[:, None], goal, start if stop is None else stop) + key.normal(0, 0.3, (episodes, 2))
    return {
        **figures,
        "success": dict.fromkeys(("0.45", "0.5", "1.0", "5.0"), good),
        "way": good,
        "closest_m": 1.0,
        "time_to_goal_s": 12.0,
        "stuck": None if stop is None else float(1 - good),
        "ends": np.round(ends, 2).tolist(),
        "paths": [path(experiment, np.round(end, 2), key) for end in ends[:12]],
    }


def path(experiment, end, key):
    start = np.array(experiment.task.arena.start)
    corner = np.array([4.0, end[1] / 2 + start[1] / 2])
    legs = [np.linspace(a, b, 8, endpoint=False) for a, b in ((start, corner), (corner, end))]
    xy = np.concatenate([*legs, [end]]) + key.normal(0, 0.15, (17, 2))
    return {"xy": np.round(xy, 2).tolist(), "choices": key.integers(0, 4, 16).tolist() if experiment.is_master else []}


def handover(good, key):
    rates = np.clip(good + key.normal(0, 0.03, (4, 4)) + 0.3 * np.eye(4), 0, 1)
    return [
        [{"fall": 0.1, "flip": 0.1, "speed_mps": 2 * float(r), "success": float(r)} for r in line] for line in rates
    ]


def switching(good, key):
    idle, down = (1 - good) * 0.5, 0.2 / 200
    speeds = {k: good * (0.6 + k / 200) for k in SWITCHING_PERIODS}
    return {
        str(k): {"speed_mps": speed, "idle": idle, "upside_down": down * k, "fallen": 0.1}
        for k, speed in speeds.items()
    }
