"""Policies out: a folder of weights, config, a replay, and a model card with figures measured now.

The folder is a finished run like any other, so that it is accepted wherever a row is.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

from footwork import checkpoint
from footwork.arena import DIRECTIONS
from footwork.checkpoint import write_atomically
from footwork.doors.replay import Replay, film_trained
from footwork.doors.settings import known_fields, read_fields
from footwork.evaluate import evaluate
from footwork.record import RunDir, RunError, config_to_json
from footwork.study.experiments import find_row, is_row
from footwork.study.runs import NEEDED, PACKAGED, find_needed, find_trained, packaged, which_policies
from footwork.tasks.task import SUCCESS_RADII
from footwork.tasks.terms import PENALISED_WEIGHTS
from footwork.train import Experiment, Trained

REPLAY = "replay.html"
_HEADER = (  # as model hubs read it
    "---",
    "library_name: footwork",
    "license: mit",
    "tags: [reinforcement-learning, hierarchical-reinforcement-learning, locomotion, mujoco, gymnasium]",
    "---",
    "",
)


def export(
    address: str,
    to: Path,
    runs: Path,
    episodes: int = 1000,
    seed: int = 1_000_003,
    num_threads: int = 0,
    onnx: bool = False,
    report: Callable[[str], None] | None = None,
) -> Path:
    """Write what an address means into the folder ``to``; returns the model card.

    Args:
        address: a row, or the folder of a run or export.
        to: a folder that does not exist or is empty.
        runs: where runs are kept.
        episodes: per seed, for the card's figures.
        seed: of the episodes.
        num_threads: of the physics; changes no number.
        onnx: also write ONNX files, those of the first seed; of a master, those of its sub-policies too.
        report: gets a line that says which policies the address means.

    Raises:
        ValueError: the address is unknown.
        RunError: nothing has been trained there, or the folder is not empty.
        ImportError: ``onnx`` is asked for and not installed.
        CheckpointError: a file cannot be written.
    """
    if onnx:
        from footwork.doors.onnx import write_onnx  # what is missing is said before anything is written
    if to.exists() and not (to.is_dir() and not any(to.iterdir())):
        raise RunError(f"{to} holds something already: choose another folder with --to")
    trained = find_trained(address, runs)
    if report is not None:
        report(which_policies(trained))
    needed = find_needed(trained, runs)
    meta = _meta(trained)
    run = RunDir.create(to, {"experiment": config_to_json(trained.experiment), "seeds": list(trained.seeds)})
    with run.lock():
        run.save_policy(trained.params, meta)
        if needed is not None:
            checkpoint.save(to / NEEDED, needed.params, _meta(needed))
        files: list[Path] = []
        if onnx:
            files = [
                path for policies in (trained, needed) if policies is not None for path in write_onnx(policies, to)
            ]
        shown = film_trained(trained, needed, 1, seed, num_threads=num_threads)
        Replay(tuple(shown), f"Footwork: {trained.experiment.name}").save(to / REPLAY)
        figures = evaluate(trained, needed, episodes, seed, num_threads=num_threads)
        figures["source"] = trained.experiment.name  # not where it lay on this machine
        write_atomically(to / "evaluation.json", json.dumps(figures, indent=2).encode() + b"\n")
        card = to / "README.md"
        write_atomically(card, _card(trained, needed, meta, figures, seed, files, to).encode())
        run.finish({"row": trained.experiment.name, "seeds": list(trained.seeds), "steps": meta["steps"]})
    return card


def _meta(trained: Trained) -> dict[str, Any]:
    """What the file of policies says of itself; of what was packaged with them, nothing that is not there."""
    if trained.source == PACKAGED:
        with resources.as_file(packaged(trained.experiment.name)) as path:
            meta = checkpoint.load_arrays(path)[1]
    else:
        meta = checkpoint.load_arrays(Path(trained.source))[1]
    return {name: value for name, value in meta.items() if name != "from"}


def _card(
    trained: Trained,
    needed: Trained | None,
    meta: dict[str, Any],
    report: dict[str, Any],
    seed: int,
    files: list[Path],
    to: Path,
) -> str:
    """The model card."""
    lines = [
        *_HEADER,
        f"# {trained.experiment.name}",
        "",
        _what_it_is(trained.experiment, needed),
        "",
        "## How it was trained",
        "",
        _how_it_was_trained(trained, meta),
        "",
        "## What it does",
        "",
        *_figures(report, seed),
        "",
        "## How to use it",
        "",
        *_usage(trained, to.name),
        "",
        "## Files",
        "",
        "* `policy.safetensors`: parameters with leading axes [seed, policy of that seed]; no pickle",
        *([f"* `{NEEDED}`: the sub-policies it stands on"] if needed else []),
        "* `config.json`, `evaluation.json`, `DONE`: the run, its figures, its end",
        f"* `{REPLAY}`: an episode in 3-D, of sub-policies one in each direction; opens in a browser, fetches nothing",
        *(f"* `{path.relative_to(to)}`" for path in files),
        "",
        "## Limits",
        "",
        "Trained and measured in simulation, on one kind of ant and in one arena. It knows nothing of another.",
    ]
    return "\n".join(lines) + "\n"


def _what_it_is(experiment: Experiment, needed: Trained | None) -> str:
    kind = "A master" if experiment.is_master else "Sub-policies" if experiment.is_walker else "A flat policy"
    task = experiment.task
    said = f"{kind} for {task.name} in arena `{task.arena.name}`, ant `{task.robot.name}`."
    if needed is None:
        return said
    return (
        f"{said} It chooses every {experiment.option_steps} control steps among the sub-policies of "
        f"`{needed.experiment.name}`, which are in this folder too."
    )


def _how_it_was_trained(trained: Trained, meta: dict[str, Any]) -> str:
    experiment, versions = trained.experiment, meta["versions"]
    batch = list(meta.get("batch", trained.seeds))
    seeds = " ".join(map(str, batch))
    which = "" if batch == list(trained.seeds) else f"; this is seed {', '.join(map(str, trained.seeds))}"
    tools = ", ".join(f"{name} {versions[name]}" for name in ("footwork", "jax", "mujoco"))
    return (
        f"`footwork train {experiment.name} --seeds {seeds}`, {meta['steps']:,} control steps per run{which}, with "
        f"{tools}. {_own_fields(experiment)}`config.json` holds every field."
    )


def _own_fields(experiment: Experiment) -> str:
    """Which fields are not those of the row of that name, as a sentence; nothing where all are."""
    if not is_row(experiment.name):
        return ""
    own, row = config_to_json(experiment), config_to_json(find_row(experiment.name))
    names = []
    for name in own.keys() - {"total_steps"}:  # the length is told beside
        if isinstance(own[name], dict) and isinstance(row[name], dict):
            names += [f"{name}.{part}" for part, value in own[name].items() if value != row[name].get(part)]
        elif own[name] != row[name]:
            names.append(name)
    return f"Other than the row's: {', '.join(f'`{name}`' for name in sorted(names))}. " if names else ""


def _figures(report: dict[str, Any], seed: int) -> list[str]:
    """The evaluation as a table."""
    interval = report["interval"]
    rows = []
    if report["success"] is not None:
        rows += [
            (
                f"came within {radius} m of the goal",
                _rate(report["success"][str(radius)], interval["success"][str(radius)]),
            )
            for radius in SUCCESS_RADII
        ]
    if "speed_mps" in report:
        speeds = report["speed_mps"]
        rows += [(f"speed {name}", f"{sum(speeds[name]) / len(speeds[name]):.2f} m/s") for name in DIRECTIONS]
    rows += [
        (f"{word} at some time", _rate(report[f"{what}_rate"], interval[f"{what}_rate"]))
        for what, word in (("fall", "fell"), ("flip", "turned over"))
    ]
    low, high = interval["progress_m"]
    rows.append(("progress per episode", f"{report['progress_m']:.2f} m [{low:.2f}, {high:.2f}]"))
    if report["time_to_goal_s"] is not None:
        rows.append(("time to the goal", f"{report['time_to_goal_s']:.1f} s"))
    seeds = ", ".join(map(str, report["seeds"]))
    over = "episodes" if len(report["seeds"]) == 1 else "seeds and episodes"
    count = f"{report['episodes']:,} episode{'' if report['episodes'] == 1 else 's'}"
    said = f"{count} (policy of seed {seeds}; episodes from seed {seed}), sampled actions, 95 %"
    said += f" intervals over {over}:"
    return [said, "", "| | |", "|---|---|", *(f"| {what} | {figure} |" for what, figure in rows)]


def _usage(trained: Trained, folder: str) -> list[str]:
    experiment = trained.experiment
    where = shlex.quote(folder)
    lines = ["```", f"footwork evaluate {where}"]
    if experiment.is_walker:
        lines += [f"footwork transitions {where}", f"footwork train maze/hrl/plain --sub-policies {where}"]
    lines += ["```", "", "```python"]
    lines += ["from footwork.doors.policies import load_policy", ""]
    if experiment.is_walker:
        lines += [f'policy = load_policy("{folder}", direction="up")']
    else:
        lines += [f'policy = load_policy("{folder}")']
    lines += ["action, _ = policy.predict(obs, deterministic=True)", "```"]
    made = _environment(experiment, folder)
    if made:
        lines += ["", "where it was trained, as a Gymnasium environment (extra `footwork[gym]`):", "", "```python"]
        lines += ["import gymnasium", "import footwork.doors.gym", "", f"env = {made}", "```"]
    return lines


def _environment(experiment: Experiment, folder: str) -> str | None:
    """The call that makes the Gymnasium environment of the row's task; None where no id has just these fields."""
    task = experiment.task
    kind = {"AntBandit": None if experiment.is_master else "AntBandit"}.get(task.name, task.name)
    if kind is None:
        return None
    fields: dict[str, Any] = {
        "direction": "up",
        "half_size": max(abs(x) for x, _ in task.arena.goals),
        "maze_map": task.arena.name,
        "potential": task.potential,
        "penalties": replace(task.weights, goal=0.0) == PENALISED_WEIGHTS,
        "goal_radius": task.goal_radius,
        "goal_reward": task.weights.goal,
        "xy_scale": task.xy_scale,
        "robot": task.robot.name,
        "episode_steps": task.episode_steps,
        "fall_rule": task.fall_rule,
    }
    fields = {name: value for name, value in fields.items() if name in known_fields(kind)}
    try:
        fits = read_fields(kind, fields).task == task
    except ValueError:  # a maze or an ant that has no name
        return None
    if not fits:
        return None
    if experiment.is_master:
        kind = f"{kind}Options"
        fields |= {"sub_policies": folder, "option_steps": experiment.option_steps}
    defaults = known_fields(kind)
    told = {name: value for name, value in fields.items() if name == "direction" or value != defaults[name]}
    words = (f"{name}={json.dumps(value) if isinstance(value, str) else repr(value)}" for name, value in told.items())
    return f"gymnasium.make({', '.join([json.dumps(f'footwork/{kind}-v0'), *words])})"


def _rate(rate: float, interval: list[float]) -> str:
    return f"{100 * rate:.1f} % [{100 * interval[0]:.1f}, {100 * interval[1]:.1f}]"
