"""Runs by row name: where they lie, how they are trained, and which trained policies a name means.

A run of ``maze/hrl/plain`` lies in ``RUNS/maze/hrl/plain/seed-0``. The policies it was
trained on top of are kept beside its own, so that it means the same for ever. A row
name means the newest finished run of that row under RUNS, else the packaged weights.
"""

from __future__ import annotations

from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import jax

from footwork import checkpoint
from footwork.checkpoint import CheckpointError
from footwork.record import RunDir, RunError, config_from_json, config_to_json, versions
from footwork.study.experiments import find_row, with_robot
from footwork.train import Experiment, Trained, planned_steps, policy_meta, train

NEEDED = "needed.safetensors"
PACKAGED = "packaged weights"
MAX_SEED = 2**31 - 1


def run_path(runs: Path, row: str, seeds: tuple[int, ...]) -> Path:
    """Where the run of a row with these seeds lies."""
    name = "seed-" if len(seeds) == 1 else "seeds-"
    return runs / row / (name + "-".join(map(str, seeds)))


def train_row(
    experiment: Experiment,
    seeds: tuple[int, ...],
    runs: Path,
    name: str | None = None,
    resume: bool = False,
    num_threads: int = 0,
    tensorboard: bool = False,
) -> Trained:
    """Train a row into its run directory, and first what it needs where no trained policies are found.

    With ``resume``, goes on from the newest checkpoint, or returns a finished run as it
    is; a larger ``total_steps`` than it was finished with is trained on to.

    Raises:
        ValueError: bad seeds, or the run was begun with another config.
        RunError: the directory is in use, or occupied and not to be resumed.
        CheckpointError: a checkpoint is damaged, or the disk is full.
    """
    _check_seeds(seeds)
    path = run_path(runs, experiment.name, seeds) if name is None else runs / experiment.name / name
    config = {"experiment": config_to_json(experiment), "seeds": list(seeds)}
    if resume and (path / "config.json").is_file():
        run = _reopen(path, config)
    else:
        _find_or_train_needed(experiment, runs, num_threads)  # a refusal leaves no directory behind
        run = RunDir.create(path, config)
    with run.lock():
        if run.finished and run.summary()["steps"] >= planned_steps(experiment):
            return load_run(run)
        needed = _keep_needed(experiment, run, runs, num_threads)
        return train(experiment, seeds, run, needed, num_threads, tensorboard=tensorboard)


def _check_seeds(seeds: tuple[int, ...]) -> None:
    if not seeds or len(set(seeds)) != len(seeds):
        raise ValueError(f"seeds must be one or more different numbers, got {seeds}")
    for seed in seeds:
        if not 0 <= seed <= MAX_SEED:
            raise ValueError(f"a seed must be in 0..{MAX_SEED}, got {seed}")


def _reopen(path: Path, config: dict[str, Any]) -> RunDir:
    """The run there, if it is the same but for its length."""
    run = RunDir.open_existing(path)
    old = run.config()
    if _without_length(old) != _without_length(config):
        raise ValueError(f"{path} was begun with another config: resume with that one, or choose another --name")
    then, now = run.versions(), versions()
    for name in ("jax", "mujoco"):  # with another, the numbers would not be those of an uninterrupted run
        if then.get(name) != now[name]:
            raise ValueError(
                f"{path} was begun with {name} {then.get(name)}, this is {now[name]}: use that, or begin anew"
            )
    return run


def _without_length(config: dict[str, Any]) -> dict[str, Any]:
    experiment = {k: v for k, v in config.get("experiment", {}).items() if k != "total_steps"}
    return {**config, "experiment": experiment}


def _find_or_train_needed(experiment: Experiment, runs: Path, num_threads: int) -> Trained | None:
    """The policies that a new run would stand on, trained now where there are none."""
    if experiment.needs is None:
        return None
    try:
        needed = find_trained(experiment.needs, runs)
    except RunError:
        row = with_robot(find_row(experiment.needs), experiment.task.robot)
        needed = train_row(row, (0,), runs, resume=True, num_threads=num_threads)
    _check_fit(experiment, needed)
    return needed


def _keep_needed(experiment: Experiment, run: RunDir, runs: Path, num_threads: int) -> Trained | None:
    """The policies a run stands on: those it kept, else found or trained now, and then kept."""
    kept = run.path / NEEDED
    if not kept.is_file():
        needed = _find_or_train_needed(experiment, runs, num_threads)
        if needed is None:
            return None
        first = jax.tree.map(lambda leaf: leaf[:1], needed.params)
        meta = policy_meta(needed.experiment, needed.seeds[:1], planned_steps(needed.experiment))
        checkpoint.save(kept, first, {**meta, "from": needed.source})
    return load_policies(kept)


def _check_fit(experiment: Experiment, needed: Trained) -> None:
    """Refuse policies that do not walk, or that learned to on another ant."""
    if not needed.experiment.is_walker:
        raise ValueError(f"{experiment.name} stands on sub-policies (walker/...), not on {needed.experiment.name}")
    wanted, found = experiment.task.robot, needed.experiment.task.robot
    if wanted != found:
        raise ValueError(
            f"{experiment.name} is for ant {wanted.name!r}, the {needed.experiment.name} found ({needed.source}) is "
            f"for another ({found.name!r}): footwork train {needed.experiment.name} --robot {wanted.name}"
        )


def load_policies(path: Path) -> Trained:
    """Policies from a file that this project wrote.

    Raises:
        CheckpointError: the file is missing, damaged or foreign, or its arrays are not of the
            shapes that its own config asks for.
    """
    arrays, meta = checkpoint.load_arrays(path)
    try:
        experiment = config_from_json(Experiment, meta["experiment"])
        seeds = tuple(int(seed) for seed in meta["seeds"])
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{path}: no policies of a known kind: {error}") from None
    keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), (len(seeds), experiment.runs_per_seed)))
    like = jax.eval_shape(jax.vmap(jax.vmap(experiment.policy().init)), keys)
    if not any(name.startswith("critic/") for name in arrays):  # packaged to act, not to learn on
        like = {"actor": like["actor"]}
    params, _ = checkpoint.load(path, like)
    return Trained(experiment, seeds, params, str(path))


def load_run(run: RunDir) -> Trained:
    """The policies of a finished run."""
    return load_policies(run.policy_path)


def finished_runs(row: str, runs: Path) -> list[RunDir]:
    """Finished runs of a row, newest first."""
    done = sorted((runs / row).glob("*/DONE"), key=lambda path: path.stat().st_mtime, reverse=True)
    return [RunDir(path.parent) for path in done]


def packaged(row: str) -> Traversable:
    """Where the package would keep the weights of a row."""
    return resources.files("footwork").joinpath("weights", *f"{row}.safetensors".split("/"))


def find_trained(row: str, runs: Path) -> Trained:
    """What a row name means: its newest finished run, else its packaged weights. Or the run in that folder.

    Raises:
        ValueError: it is neither a row nor the folder of a run.
        RunError: it is a row, and there is neither; or the run in the folder is not finished.
        CheckpointError: what was found is damaged.
    """
    run = _run_at(row)
    if run is not None:
        if not run.finished:
            raise RunError(f"{row} holds an unfinished run")
        return load_run(run)
    find_row(row)
    for run in finished_runs(row, runs):
        return load_run(run)
    if packaged(row).is_file():
        return _load_packaged(row)
    raise RunError(f"no finished run of {row} in {runs} and none in the package: footwork train {row}")


def _run_at(address: str) -> RunDir | None:
    """The run in the folder of that path, unless it is a row's address."""
    try:
        find_row(address)
    except ValueError:
        return RunDir(Path(address)) if (Path(address) / "config.json").is_file() else None
    return None


def _load_packaged(row: str) -> Trained:
    with resources.as_file(packaged(row)) as path:
        return load_policies(path)._replace(source=PACKAGED)


def find_needed(trained: Trained, runs: Path) -> Trained | None:
    """The policies that ``trained`` stands on: kept beside it, packaged with it, else what their row name means."""
    needs = trained.experiment.needs
    if needs is None or not trained.experiment.is_master:
        return None
    if trained.source == PACKAGED and packaged(needs).is_file():
        return _load_packaged(needs)  # a run of the same name in ``runs`` is not what it was trained on
    kept = Path(trained.source).parent / NEEDED
    if trained.source != PACKAGED and kept.is_file():
        return load_policies(kept)
    return find_trained(needs, runs)
