"""Runs by address: where they lie, how they are trained, and which trained policies an address means.

A run of ``maze/hrl/plain`` lies in ``RUNS/maze/hrl/plain/seed-0``. The policies it was
trained on top of are kept beside its own, so that it means the same for ever.

One rule says what an address means. A run counts as a row if its saved fields are those of
the row, its length aside; a row's address means the newest finished run that does, else the
packaged weights. A run with any other field (another robot, maze, learning rate) lies in a
folder of its own, ``RUNS/ROW/custom-1a2b3c4d-seed-0`` or ``RUNS/ROW/NAME``, and its address is
the path of that folder. Engines make rows of their own: ``bullet/maze/hrl/plain``.
"""

from __future__ import annotations

import hashlib
import json
import warnings
from dataclasses import replace
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import jax

from footwork import checkpoint
from footwork.checkpoint import CheckpointError
from footwork.physics import libraries_of, require_engine
from footwork.record import (
    RunDir,
    RunError,
    config_from_json,
    config_to_json,
    device_in,
    require_tensorboard,
    versions,
)
from footwork.study.experiments import find_row, is_row, with_robot
from footwork.train import Experiment, Trained, planned_steps, policy_meta, train

NEEDED = "needed.safetensors"
RUN_FILES = ("config.json", "DONE", "metrics.jsonl", "policy.safetensors")  # any of them: a run lies there
PACKAGED = "packaged weights"
MAX_SEED = 2**31 - 1


def how_to_train_again(run: RunDir, row: str) -> str:
    """What to do about a run of the study that cannot be mended from its own files."""
    runs = run.path.parents[row.count("/") + 1]
    return f"delete {run.path}, and {how_to_reproduce(runs, row)} trains it again"


def how_to_reproduce(runs: Path, row: str) -> str:
    """The command that makes whatever is missing of a row."""
    return f"footwork reproduce --rows {row}" + ("" if runs == Path("runs") else f" --runs {runs}")


def run_path(runs: Path, row: str, seeds: tuple[int, ...]) -> Path:
    """Where the run of a row with these seeds lies."""
    name = "seed-" if len(seeds) == 1 else "seeds-"
    return runs / row / (name + "-".join(map(str, seeds)))


def path_of_new_run(runs: Path, experiment: Experiment, seeds: tuple[int, ...]) -> Path:
    """Where a run lies that was given no name: the row's own place only if its fields are the row's."""
    path = run_path(runs, experiment.name, seeds)
    if not is_row(experiment.name) or _is_the_tables(experiment):  # not in the table: the name is all its own
        return path
    fields = json.dumps(config_to_json(_without_length(experiment)), sort_keys=True).encode()
    return path.with_name(f"custom-{hashlib.blake2b(fields, digest_size=4).hexdigest()}-{path.name}")


def _is_the_tables(experiment: Experiment) -> bool:
    """Whether it is a row as the table has it, its length aside, and not with another ant or learner."""
    return is_row(experiment.name) and same_row(experiment, find_row(experiment.name))


def place_of(runs: Path, experiment: Experiment, seeds: tuple[int, ...], name: str | None) -> Path:
    """Where a run lies that was given this name, or none."""
    return path_of_new_run(runs, experiment, seeds) if name is None else runs / experiment.name / name


def same_row(one: Experiment, other: Experiment) -> bool:
    """Whether two runs with these fields are runs of the same row: they may differ in length."""
    return _without_length(one) == _without_length(other)


def _without_length(experiment: Experiment) -> Experiment:
    return replace(experiment, total_steps=1)


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

    The directory is that of :func:`place_of`.

    With ``resume``, goes on from the newest checkpoint, or returns a finished run as it
    is; a larger ``total_steps`` than it was finished with is trained on to (on PyBullet from
    the newest checkpoint too, which may lie before its end).

    Raises:
        ValueError: bad seeds, the run was begun with another config, or its engine cannot resume (bullet-original).
        ImportError: its engine is not installed.
        RunError: the directory is in use, or occupied and not to be resumed; or the extra ``footwork[tb]`` is missing.
        CheckpointError: a checkpoint is damaged, or the disk is full.
    """
    _check_seeds(seeds)
    require_engine(experiment.engine, experiment.task.robot)
    if tensorboard:
        require_tensorboard()
    path = place_of(runs, experiment, seeds, name)
    config = {"experiment": config_to_json(experiment), "seeds": list(seeds)}
    found = None
    if resume and (path / "config.json").is_file():
        run = _reopen(path, config, experiment)
    else:
        found = _find_or_train_needed(experiment, runs, num_threads)  # a refusal leaves no directory behind
        run = RunDir.create(path, config)
    with run.lock():
        if _has_ended(run, experiment):
            return load_run(run)
        needed = _keep_needed(experiment, run, runs, num_threads, found)
        return train(experiment, seeds, run, needed, num_threads, tensorboard=tensorboard)


def _check_seeds(seeds: tuple[int, ...]) -> None:
    if not seeds or len(set(seeds)) != len(seeds):
        raise ValueError(f"seeds must be one or more different numbers, got {seeds}")
    for seed in seeds:
        if not 0 <= seed <= MAX_SEED:
            raise ValueError(f"a seed must be in 0..{MAX_SEED}, got {seed}")


def _has_ended(run: RunDir, experiment: Experiment) -> bool:
    """Whether it is finished, and long enough."""
    return run.finished and run.summary()["steps"] >= planned_steps(experiment)


def _reopen(path: Path, config: dict[str, Any], experiment: Experiment) -> RunDir:
    """The run there, if it is the same but for its length."""
    run = RunDir.open_existing(path)
    old = run.config()
    if _without_steps(old) != _without_steps(config):
        raise ValueError(f"{path} was begun with another config: resume with that one, or choose another --name")
    if _has_ended(run, experiment):
        return run
    then, now = run.versions(), versions()
    for name in libraries_of(experiment.engine):  # with another, the numbers would not be those of an uninterrupted run
        if name not in then:
            raise ValueError(f"{path} did not record its {name}, so it cannot go on bit for bit: choose another --name")
        if then[name] != now.get(name):
            raise ValueError(
                f"{path} was begun with {name} {then[name]}, this is {now.get(name)}: use that, or begin anew"
            )
    before, here = device_in(then), device_in(now)
    if before != here:
        raise ValueError(
            f"{path} was begun on {before}, JAX computes on {here} now: set JAX_PLATFORMS to where it was begun "
            f"(cuda, cpu), or begin anew"
        )
    return run


def _without_steps(config: dict[str, Any]) -> dict[str, Any]:
    try:  # a field that was added since then has the value that changed nothing
        experiment = config_from_json(Experiment, config["experiment"])
    except (KeyError, ValueError):
        return config
    return {**config, "experiment": config_to_json(_without_length(experiment))}


def _find_or_train_needed(experiment: Experiment, runs: Path, num_threads: int) -> Trained | None:
    """The policies that a new run would stand on, trained now where there are none."""
    if experiment.needs is None:
        return None
    if _run_at(experiment.needs) is not None:
        needed = find_trained(experiment.needs, runs)
    else:
        row = with_robot(_row_at(experiment.needs), experiment.task.robot)
        found, reasons = _look_up(row, runs)
        instead = f"{row.name} is trained first" if found is None else f"{row.name} means {found.source}"
        _warn_of_passed_over(reasons, instead)
        needed = found or train_row(row, (0,), runs, resume=True, num_threads=num_threads)
    _check_fit(experiment, needed)
    return needed


def _keep_needed(
    experiment: Experiment, run: RunDir, runs: Path, num_threads: int, found: Trained | None
) -> Trained | None:
    """The policies a run stands on: those it kept, else those found before or now, or trained now; and then kept.

    Their source is where they came from.
    """
    kept = run.path / NEEDED
    if not kept.is_file():
        needed = found or _find_or_train_needed(experiment, runs, num_threads)
        if needed is None:
            return None
        first = one_seed(needed, 0)
        meta = policy_meta(needed.experiment, first.seeds, planned_steps(needed.experiment))
        checkpoint.save(kept, first.params, {**meta, "from": needed.source})
    return load_policies(kept)._replace(source=_origin(kept))


def _origin(kept: Path) -> str:
    """Where policies came from that a run keeps beside its own."""
    return str(checkpoint.load_arrays(kept)[1].get("from", kept))


def stands_on(trained: Trained) -> str | None:
    """Where the policies came from that a run trained on, and keeps beside its own; None if it has none.

    Raises:
        CheckpointError: their file is damaged.
    """
    kept = Path(trained.source).parent / NEEDED
    return _origin(kept) if kept.is_file() else None


def _check_fit(experiment: Experiment, needed: Trained) -> None:
    """Refuse policies that do not walk, or that learned to on another ant."""
    if not needed.experiment.is_walker:
        raise ValueError(f"{experiment.name} stands on sub-policies (walker/...), not on {needed.experiment.name}")
    wanted, found = experiment.task.robot, needed.experiment.task.robot
    if wanted != found:
        raise ValueError(
            f"{experiment.name} is for ant {wanted.name!r}, {needed.experiment.name} ({needed.source}) is "
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


def read_actors(policies: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Policies without their critics, enough to act, and what their file says of them.

    Raises:
        CheckpointError: the file is damaged or foreign.
    """
    return {"actor": load_policies(policies).params["actor"]}, checkpoint.load_arrays(policies)[1]


def finished_runs(row: str, runs: Path) -> list[RunDir]:
    """Finished runs that count as the row, newest first."""
    return _finished(find_row(row), runs)


def _finished(experiment: Experiment, runs: Path) -> list[RunDir]:
    done = sorted((runs / experiment.name).glob("*/DONE"), key=lambda path: path.stat().st_mtime, reverse=True)
    return [run for run in (RunDir(path.parent) for path in done) if _counts_as(run, experiment)]


def _counts_as(run: RunDir, experiment: Experiment) -> bool:
    try:
        run.summary()
        return same_row(experiment_of(run), experiment)
    except ValueError:  # damaged, or of a version with other fields: passed_over tells of it
        return False


def experiment_of(run: RunDir) -> Experiment:
    """What a run trained.

    Raises:
        RunError: its config.json is missing, damaged or of a version with other fields.
    """
    try:
        return config_from_json(Experiment, run.config().get("experiment"))
    except RunError:
        raise
    except ValueError as error:
        version = run.versions().get("footwork", "unknown")
        raise RunError(f"{run.path} is of another version of footwork ({version}): {error}") from None


def passed_over(experiment: Experiment, runs: Path) -> tuple[list[str], list[str]]:
    """What lies in the row's folder and is not what its address means: what cannot be used, why; and unfinished runs.

    Runs that were asked to be otherwise (``custom-...``, a name of their own) lie there by right and are not told of.
    """
    folder = runs / experiment.name
    if folder.is_symlink() and not folder.exists():
        return [f"{folder} is a link to nothing"], []
    if not folder.is_dir():
        return [f"{folder} is no folder"] if folder.exists() else [], []
    unusable, unfinished = [], []
    for path in sorted(folder.iterdir()):
        if path.is_symlink() and not path.exists():
            unusable.append(f"{path} is a link to nothing")
        elif any((path / name).exists() for name in RUN_FILES):
            run = RunDir(path)
            try:
                ours = same_row(experiment_of(run), experiment)
                if ours and run.finished:
                    run.summary()
            except ValueError as error:  # it names the file
                unusable.append(str(error))
                continue
            if ours and not run.finished:
                unfinished.append(path.name)
            elif not ours and path.name.startswith("seed") and _is_the_tables(experiment):  # the row's own place
                unusable.append(f"{path} was trained with other fields than {experiment.name} has now")
    return unusable, unfinished


def packaged(row: str) -> Traversable:
    """Where the package would keep the weights of a row."""
    return resources.files("footwork").joinpath("weights", *f"{row}.safetensors".split("/"))


def find_trained(address: str, runs: Path) -> Trained:
    """What an address means: a row's newest finished run, else its packaged weights; or the run in that folder.

    Raises:
        ValueError: it is neither a row nor the folder of a run.
        RunError: it is a row, and there is neither a run nor packaged weights; or the run is not finished.
        CheckpointError: what was found is damaged.

    Warns of what of the row lies in ``runs`` and was passed over.
    """
    run = _run_at(address)
    if run is None:
        return _find(_row_at(address), runs)
    if not run.finished:
        name = experiment_of(run).name
        raise RunError(
            f"{address} holds an unfinished run: footwork train {name} --resume, and whatever options it was begun "
            f"with, goes on with it"
        )
    return load_run(run)


def which_policies(trained: Trained) -> str:
    """Says which policies an address turned out to mean."""
    return f"{trained.experiment.name}: policies from {trained.source}"


def _run_at(address: str) -> RunDir | None:
    """The run in the folder of that path, unless it is a row's address."""
    try:
        find_row(address)
    except ValueError:
        return RunDir(Path(address)) if (Path(address) / "config.json").is_file() else None
    return None


def _row_at(address: str) -> Experiment:
    """The row of that address, or why it is none.

    Of a path that exists, it says why no run is there: the table of rows would not help.
    """
    path = Path(address)
    if is_row(address) or not path.exists():
        try:
            return find_row(address)
        except ValueError as error:
            raise ValueError(f"no run lies at {address!r}; {error}") from None
    if path.is_dir():
        raise ValueError(f"{address} is a folder, but not of a run or an export: it has no config.json")
    hint = f": name its folder, {path.parent}" if (path.parent / "config.json").is_file() else ""
    raise ValueError(f"{address} is a file, and a row's name or the folder of a run is wanted{hint}")


def _find(experiment: Experiment, runs: Path) -> Trained:
    """What the row's address means, said where that is not all that lies there.

    Raises:
        RunError: nothing; names what lies there.
        CheckpointError: what it means is damaged.
    """
    found, reasons = _look_up(experiment, runs)
    if found is None:
        row, what_lies_there = experiment.name, "".join(f"; {reason}" for reason in reasons)
        raise RunError(
            f"no finished run of {row} in {runs} and none in the package: footwork train {row}{what_lies_there}"
        )
    _warn_of_passed_over(reasons, f"{experiment.name} means {found.source}")
    return found


def _look_up(experiment: Experiment, runs: Path) -> tuple[Trained | None, list[str]]:
    """The newest finished run with these fields, else packaged weights that have them; and what was passed over.

    A report's results keep the policies of one run of a row: those without come last, and are then missed aloud.
    Unfinished runs are told of where none is finished.
    """
    reasons, unfinished = passed_over(experiment, runs)
    for run in sorted(_finished(experiment, runs), key=lambda run: not run.policy_path.is_file()):
        return load_run(run), reasons
    if unfinished:
        names = ", ".join(unfinished[:3]) + (f" and {len(unfinished) - 3} more" if len(unfinished) > 3 else "")
        reasons.append(f"not finished in {runs / experiment.name}: {names}")
    if packaged(experiment.name).is_file():
        trained = _load_packaged(experiment.name)
        if same_row(trained.experiment, experiment):
            return trained, reasons
    return None, reasons


def _warn_of_passed_over(reasons: list[str], instead: str) -> None:
    for reason in reasons:
        warnings.warn(f"passed over: {reason}; {instead}", stacklevel=1)


def _load_packaged(row: str) -> Trained:
    with resources.as_file(packaged(row)) as path:
        return load_policies(path)._replace(source=PACKAGED)


def find_needed(trained: Trained, runs: Path) -> Trained | None:
    """The policies that ``trained`` stands on: kept beside it or packaged with it, else what their row name means.

    In a report's results they are not kept twice: there the row has a run of the same seed.
    """
    needs = trained.experiment.needs
    if needs is None or not trained.experiment.is_master:
        return None
    if trained.source == PACKAGED and packaged(needs).is_file():
        return _load_packaged(needs)  # a run of the same name in ``runs`` is not what it was trained on
    kept = Path(trained.source).parent / NEEDED
    if trained.source != PACKAGED and kept.is_file():
        return load_policies(kept)
    same_seed = None if trained.source == PACKAGED else _beside(trained, needs)
    return find_trained(needs, runs) if same_seed is None else same_seed


def _beside(trained: Trained, needs: str) -> Trained | None:
    """The policies of another row and the same seed, in the folder of runs that ``trained`` lies in."""
    folder = Path(trained.source).resolve().parent
    depth = len(Path(trained.experiment.name).parts)
    if len(folder.parents) <= depth:
        return None
    for path in sorted((folder.parents[depth] / needs).glob("seed*/policy.safetensors")):
        found = load_policies(path)
        if trained.seeds[0] in found.seeds:
            return one_seed(found, found.seeds.index(trained.seeds[0]))
    return None


def one_seed(trained: Trained, index: int) -> Trained:
    """One of the seeds of a run, as if it had been trained alone."""
    params = jax.tree.map(lambda leaf: leaf[index : index + 1], trained.params)
    return trained._replace(seeds=trained.seeds[index : index + 1], params=params)
