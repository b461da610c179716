"""Who takes part in ``footwork bench``: ours, those that others use, and the points along which cost grows."""

from __future__ import annotations

from typing import Any

from footwork.study.contest import Contestant, usable_cores

ROWS, RUNS = 32, 4  # ants per learner (PAPER), and learners side by side
TASKS = {"antbullet": "AntBulletEnv-v0", "antv5": "Ant-v5"}
LIBRARIES = {"sb3": "stable_baselines3", "sbx": "sbx"}

FOUR, ONE, BATCHED = "walker, four side by side", "walker, one run", "walker, four in one batch"
PHYSICS_ONE, PHYSICS_ALL = "physics alone, one thread", "physics alone, all threads"
MASTER, UPDATE = "maze master", "update alone"


def contestants(quick: bool) -> list[Contestant]:
    """Who takes part, ours first."""
    cores = len(usable_cores())
    found = [
        physics_alone(PHYSICS_ONE, 1),
        physics_alone(PHYSICS_ALL, 0),
        Contestant(ONE, ({"kind": "walkers", "runs": 1, "threads": 0},)),
        Contestant(BATCHED, ({"kind": "walkers", "runs": RUNS, "threads": 0},)),
        side_by_side(FOUR, RUNS),
        Contestant(MASTER, ({"kind": "maze_master", "option_steps": 50, "threads": 1},), 1),
        Contestant(UPDATE, ({"kind": "update", "runs": 1},), 1),
    ]
    for library in ("sb3",) if quick else LIBRARIES:
        for task in TASKS.values():
            found += _rivals(library, task, cores, quick)
    return found


def physics_alone(name: str, threads: int) -> Contestant:
    """The engine alone, with the rows of four runs."""
    return Contestant(name, ({"kind": "physics", "rows": ROWS * RUNS, "threads": threads},), threads, seconds=2.0)


def side_by_side(name: str, runs: int) -> Contestant:
    """``runs`` learners dealt out to one process per core, each of one thread: neither core waits for an update."""
    teams = min(len(usable_cores()), runs)
    shares = [runs // teams + (number < runs % teams) for number in range(teams)]
    return Contestant(name, tuple({"kind": "walkers", "runs": share, "threads": 1} for share in shares), 1, seconds=4.0)


def _rivals(library: str, task: str, cores: int, quick: bool) -> list[Contestant]:
    spec = {"library": LIBRARIES[library], "task": task, "num_envs": 1, "processes": False}
    eight = {**spec, "num_envs": 8}
    settings = [
        Contestant(f"{library} {task}, 1 env", (spec,), rival=True),
        Contestant(f"{library} {task}, 8 envs", (eight,), rival=True),
    ]
    if quick or library != "sb3":
        return settings
    return [
        *settings,
        Contestant(f"{library} {task}, 8 envs in processes", ({**eight, "processes": True},), rival=True),
        Contestant(f"{library} {task}, 8 envs, a run per core", (eight,) * cores, 1, rival=True),
    ]


def growth_axes(quick: bool) -> dict[str, dict[int, Contestant]]:
    """Along what cost grows: sizes and who is measured there."""

    def ours(name: str, threads: int = 1, **spec: Any) -> Contestant:
        return Contestant(name, ({**spec, "threads": threads},), threads)

    rows = (1, 64, 1024) if quick else (1, 8, 64, 512, 4096)
    runs = (1, 4) if quick else (1, 2, 4, 8)
    return {
        "rows": {n: ours("rows", kind="walkers", runs=1, rows=n) for n in rows},
        "runs": {n: side_by_side("runs", n) for n in runs},
        "walls": {n: ours("walls", kind="walls", count=n) for n in ((0, 50) if quick else (0, 10, 50, 200))},
        "k": {n: ours("k", kind="maze_master", option_steps=n) for n in ((10, 50) if quick else (10, 50, 200))},
    }
