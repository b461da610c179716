"""Every row of the table trains; what a run refuses. (Resuming bit for bit: test_resume.py.)"""

from __future__ import annotations

import dataclasses
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from footwork import checkpoint
from footwork import train as training
from footwork.doors.cli import run, show_warning
from footwork.record import RunDir, RunError, config_to_json, read_metrics
from footwork.robot import ROBOTS
from footwork.study import runs as runs_module
from footwork.study.experiments import EXPERIMENTS, find_row, with_engine, with_robot
from footwork.study.runs import (
    PACKAGED,
    find_trained,
    finished_runs,
    load_policies,
    path_of_new_run,
    run_path,
    train_row,
)
from footwork.train import Interrupted, Trained, begin_learning, build_environment, iterate, steps_per_iteration


def tiny(row, iterations=1):
    """The row as the table has it, but for its sizes."""
    experiment = EXPERIMENTS[row]
    ppo = replace(
        experiment.ppo,
        num_envs=4,
        num_steps=3,
        num_minibatches=2,
        minibatch_size=None,
        update_epochs=1,
        hidden_sizes=(4,),
    )
    task = replace(experiment.task, episode_steps=4)
    small = replace(experiment, ppo=ppo, task=task, option_steps=2)
    return replace(small, total_steps=iterations * steps_per_iteration(small))


def untrained(row, seeds=(0,)):
    """Policies of a row that have learned nothing."""
    experiment = tiny(row)
    shapes = jax.eval_shape(experiment.policy().init, jax.random.key(0))
    lead = (len(seeds), experiment.runs_per_seed)
    return Trained(experiment, seeds, jax.tree.map(lambda leaf: jnp.zeros((*lead, *leaf.shape)), shapes), "nowhere")


def needed_by(experiment):
    return None if experiment.needs is None else untrained(experiment.needs)


# ---------------------------------------------------------------- the table


def structure(row):
    """What makes one row's program differ from another's: the values of its fields, without sizes and weights."""
    experiment = tiny(row)
    task = experiment.task
    return {
        ("task", task.name, task.potential, experiment.is_master),
        ("learner", type(experiment.regulariser).__name__, experiment.symmetric, experiment.is_master),
        ("rule", task.fall_rule, task.goal_radius is None),
        ("loss", experiment.ppo.loss),
    }


def representatives():
    """Rows among which every such value occurs, each bringing one that those before it do not have."""
    chosen, met = [], set()
    for row in EXPERIMENTS:
        if structure(row) - met:
            chosen.append(row)
            met |= structure(row)
    return chosen


@pytest.mark.parametrize("row", representatives())
def test_a_row_trains(row):
    experiment = tiny(row)
    env = build_environment(experiment, 1, needed_by(experiment), 1)
    learning = begin_learning(experiment, env, (0,))
    after, metrics = iterate(experiment, env, learning, 0)
    assert after.iteration == 1
    assert (np.asarray(after.learners.num_updates) == 1).all()
    for name in ("policy_loss", "value_loss", "entropy", "approx_kl", "grad_norm", "rollout/progress"):
        assert np.isfinite(metrics[name]).all(), name
        assert metrics[name].shape == (experiment.runs_per_seed,)
    moved = jax.tree.map(lambda a, b: bool(jnp.any(a != b)), after.learners.params, learning.learners.params)
    learned = np.asarray(metrics["valid_fraction"]).any()
    assert any(jax.tree.leaves(moved)) == learned
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(after.learners.params))


def test_every_row_builds_its_environment_and_its_policy():
    for row in EXPERIMENTS:
        experiment = tiny(row)
        assert (find_row(row).name, experiment.name) == (row, row)
        env = build_environment(experiment, 2, needed_by(experiment), 1)
        assert env.num_envs == 2 * 4 * experiment.runs_per_seed
        assert experiment.policy().obs_size == experiment.task.obs_size
        assert experiment.needs is None or experiment.needs in EXPERIMENTS
        if experiment.needs is not None:
            with pytest.raises(ValueError, match=f"needs the policies of {experiment.needs}"):
                build_environment(experiment, 1, None)


def test_rows_say_how_many_steps_they_take():
    for row, experiment in EXPERIMENTS.items():
        assert steps_per_iteration(experiment) <= experiment.total_steps, row
    walker, master = tiny("walker/plain"), tiny("maze/hrl/plain")
    assert (steps_per_iteration(walker), steps_per_iteration(master)) == (12, 24)


# ---------------------------------------------------------------- runs


def test_an_interrupted_run_goes_on_as_if_it_had_not_been(tmp_path, monkeypatch):
    """Of a master, with the sub-policies that it stands on."""
    row, needs = "bandit/hrl/plain", "walker/plain"
    walker = untrained(needs)
    monkeypatch.setitem(EXPERIMENTS, row, tiny(row, 4))
    monkeypatch.setitem(EXPERIMENTS, needs, walker.experiment)
    for place in ("whole", "parts"):
        path = run_path(tmp_path / place, needs, (0,))
        run = RunDir.create(path, {"experiment": config_to_json(walker.experiment)})
        run.save_policy(walker.params, training.policy_meta(walker.experiment, (0,), 0))
        run.finish({"steps": 0})
    train_row(tiny(row, 4), (0,), tmp_path / "whole", num_threads=1)
    real, steps = training.iterate, []

    def interrupted(*arguments):
        steps.append(1)
        if len(steps) == 2:
            os.kill(os.getpid(), signal.SIGINT)
        return real(*arguments)

    monkeypatch.setattr(training, "iterate", interrupted)
    with pytest.raises(
        Interrupted, match=r"stopped at step 48 of 96; saved at step 48 in .*, the same command with --resume goes on"
    ):
        train_row(tiny(row, 4), (0,), tmp_path / "parts", num_threads=1)
    monkeypatch.setattr(training, "iterate", real)
    with pytest.raises(RunError, match="holds an unfinished run: use --resume"):
        train_row(tiny(row, 4), (0,), tmp_path / "parts", num_threads=1)
    train_row(tiny(row, 4), (0,), tmp_path / "parts", resume=True, num_threads=2)
    ends = []
    for place in ("whole", "parts"):
        run = RunDir(run_path(tmp_path / place, row, (0,)))
        arrays, _ = checkpoint.load_arrays(run.policy_path)
        metrics = [
            {k: v for k, v in line.items() if not k.startswith("time/")} for line in read_metrics(run.metrics_path)
        ]
        ends.append((arrays, json.dumps(metrics)))
    for name, array in ends[0][0].items():
        np.testing.assert_array_equal(array, ends[1][0][name], err_msg=name)
    assert ends[0][1] == ends[1][1]
    assert find_trained(row, tmp_path / "parts").experiment == tiny(row, 4)


HOLD = """
import sys, time
from pathlib import Path
from footwork.record import RunDir
run = RunDir(Path(sys.argv[1]))
with run.lock():
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_run_in_use_is_left_alone(tmp_path, monkeypatch):
    experiment = tiny("walker/symmetric")
    monkeypatch.setitem(EXPERIMENTS, experiment.name, experiment)
    config = {"experiment": config_to_json(experiment), "seeds": [0]}
    run = RunDir.create(run_path(tmp_path, experiment.name, (0,)), config)
    process = subprocess.Popen([sys.executable, "-c", HOLD, str(run.path)], stdout=subprocess.PIPE)
    try:
        assert process.stdout.readline() == b"held\n"
        before = sorted(path.name for path in run.path.iterdir())
        with pytest.raises(RunError, match=f"is in use by process {process.pid}"):
            train_row(experiment, (0,), tmp_path, resume=True)
        assert sorted(path.name for path in run.path.iterdir()) == before
    finally:
        process.kill()
        process.wait()
    with run.lock():  # a killed process lets go
        pass


def finished(runs, experiment, name):
    """A finished run that holds policies which learned nothing, newer than the ones before it."""
    run = RunDir.create(runs / experiment.name / name, {"experiment": config_to_json(experiment), "seeds": [0]})
    params = jax.vmap(jax.vmap(experiment.policy().init))(
        jax.random.split(jax.random.key(0), (1, experiment.runs_per_seed))
    )
    run.save_policy(params, training.policy_meta(experiment, (0,), 0))
    run.finish({"steps": 0})
    return str(run.path)


def test_only_a_run_with_the_rows_own_fields_is_what_its_address_means(tmp_path):
    row = EXPERIMENTS["walker/plain"]
    longer = finished(tmp_path, replace(row, total_steps=9_000_000), "longer")
    others = {
        "robot": with_robot(row, ROBOTS["stiff"]),
        "learner": replace(row, ppo=replace(row.ppo, gamma=0.9)),
        "task": replace(row, task=replace(row.task, episode_steps=7)),
        "engine": replace(row, engine="bullet"),
    }
    for name, experiment in others.items():
        path = finished(tmp_path, experiment, name)
        assert find_trained(path, tmp_path).experiment == experiment  # by the path of its folder
    assert [run.path.name for run in finished_runs("walker/plain", tmp_path)] == ["longer"]
    assert find_trained("walker/plain", tmp_path).source.startswith(longer)
    assert find_trained("walker/plain", tmp_path / "nothing").source == PACKAGED


def test_a_run_with_other_fields_lies_in_a_place_of_its_own(tmp_path):
    row = EXPERIMENTS["walker/plain"]
    short = replace(row, total_steps=5000)
    own = run_path(tmp_path, row.name, (0,))
    assert path_of_new_run(tmp_path, row, (0,)) == path_of_new_run(tmp_path, short, (0,)) == own
    stiff = with_robot(row, ROBOTS["stiff"])
    places = [path_of_new_run(tmp_path, e, (0,)) for e in (stiff, with_robot(short, ROBOTS["light"]))]
    assert len({own, *places}) == 3
    assert {place.parent for place in places} == {own.parent}
    assert path_of_new_run(tmp_path, replace(stiff, total_steps=5000), (0,)) == places[0]


def test_an_engine_makes_a_row_of_its_own(tmp_path):
    master = find_row("bullet/maze/hrl/appropriate-bias")
    assert (master.name, master.engine) == ("bullet/maze/hrl/appropriate-bias", "bullet")
    assert master.needs == "bullet/walker/appropriate-bias"
    assert find_row(master.needs).needs == "bullet/walker/plain"
    assert with_engine(master, "mujoco") == find_row("mujoco/maze/hrl/appropriate-bias") == EXPERIMENTS[master.name[7:]]
    assert path_of_new_run(tmp_path, master, (0,)) == tmp_path / "bullet/maze/hrl/appropriate-bias/seed-0"
    with pytest.raises(ValueError, match="unknown engine 'ode'; known engines: mujoco, mjx, bullet"):
        replace(master, engine="ode")
    with pytest.raises(RunError, match="no finished run of bullet/walker/plain in"):
        find_trained("bullet/walker/plain", tmp_path)


def test_a_master_on_another_ant_stands_on_policies_of_that_ant(tmp_path):
    row = with_robot(tiny("bandit/hrl/plain"), ROBOTS["stiff"])
    walker = with_robot(EXPERIMENTS["walker/plain"], ROBOTS["stiff"])
    path = finished(tmp_path, walker, "mine")
    finished(tmp_path, EXPERIMENTS["walker/plain"], "seed-0")  # newer, and in its own place by right
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="passed over")
        trained = train_row(row, (0,), tmp_path, num_threads=1)
    kept = load_policies(Path(trained.source).parent / "needed.safetensors")
    assert kept.experiment == walker
    by_path = replace(row, sub_policies=path)
    assert train_row(by_path, (0,), tmp_path, num_threads=1).source != trained.source


def test_a_master_on_what_is_no_run_says_so_and_writes_nothing(tmp_path):
    empty, file = tmp_path / "empty", tmp_path / "file.txt"
    empty.mkdir()
    file.touch()
    for address, message in {
        str(empty): "empty is a folder, but not of a run or an export",
        str(file): "file.txt is a file, and a row's name or the folder of a run is wanted",
        "walker/plan": "no run lies at 'walker/plan'; unknown row 'walker/plan'",
    }.items():
        with pytest.raises(ValueError, match=message):
            train_row(replace(tiny("bandit/hrl/plain"), sub_policies=address), (0,), tmp_path / "runs", num_threads=1)
    assert not (tmp_path / "runs").exists()


def test_an_unfinished_run_is_no_address(tmp_path):
    experiment = tiny("walker/plain")
    run = RunDir.create(tmp_path / "begun", {"experiment": config_to_json(experiment), "seeds": [0]})
    with pytest.raises(RunError, match=r"unfinished run: footwork train \S+ --resume, "):
        find_trained(str(run.path), tmp_path)


def test_runs_that_an_address_passes_over_are_warned_of(tmp_path):
    row = EXPERIMENTS["walker/plain"]
    folder = tmp_path / row.name
    finished(tmp_path, replace(row, engine="bullet"), "of-another-row")
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # that one is another row's, and its own folder is its address
        assert find_trained(row.name, tmp_path).source == PACKAGED
    begun = RunDir.create(folder / "begun", {"experiment": config_to_json(row), "seeds": [0]})
    with pytest.warns(UserWarning, match=r"passed over: not finished in .*walker/plain: begun; .*packaged"):
        assert find_trained(row.name, tmp_path).source == PACKAGED
    mine = finished(tmp_path, row, "mine")
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a run under way is no news where another has finished
        assert find_trained(row.name, tmp_path).source.startswith(mine)
    (begun.path / "config.json").unlink()
    for name, text in {"torn": '{"config": {"exp', "foreign": '{"config": {"experiment": {"colour": "red"}}}'}.items():
        path = Path(finished(tmp_path, row, name))
        (path / "config.json").write_text(text)
    (folder / "gone").symlink_to(tmp_path / "nowhere")
    (Path(finished(tmp_path, row, "half")) / "DONE").write_text('{"steps"')
    finished(tmp_path, replace(row, ppo=replace(row.ppo, gamma=0.9)), "seed-7")  # the row's own place
    (folder / "headless").mkdir()
    (folder / "headless" / "policy.safetensors").write_text("")
    for without, instead in ((), re.escape(mine)), (("mine/DONE",), PACKAGED):
        for name in without:
            (folder / name).unlink()
        with pytest.warns(UserWarning, match="passed over") as warned:
            find_trained(row.name, tmp_path)
        for name in ("torn", "foreign", "gone", "half", "seed-7", "headless"):
            (said,) = (str(one.message) for one in warned if f"/{name}" in str(one.message))
            assert re.search(f"passed over: .*{name}.*; walker/plain means {instead}", said)


def test_where_nothing_else_is_at_hand_the_refusal_says_what_was_passed_over(tmp_path):
    path = Path(finished(tmp_path, find_row("bullet/walker/plain"), "seed-0"))
    (path / "config.json").write_text("{")
    with pytest.raises(RunError, match=r"no finished run of bullet/walker/plain .*seed-0/config\.json"):
        find_trained("bullet/walker/plain", tmp_path)
    shutil.rmtree(path.parent)
    path.parent.symlink_to(tmp_path / "nowhere")
    with pytest.raises(RunError, match=r"bullet/walker/plain is a link to nothing"):
        find_trained("bullet/walker/plain", tmp_path)


def test_what_a_run_stands_on_is_trained_anew_with_the_reason_said(tmp_path, monkeypatch):
    row = tiny("light/maze/hrl/plain")
    below = EXPERIMENTS["light/walker/plain"]
    path = Path(finished(tmp_path, below, "seed-1"))
    (path / "config.json").write_text("{")
    whole = runs_module.train_row

    def small(experiment, *arguments, **options):
        if experiment.is_walker:
            finished(tmp_path, experiment, "instead")
            return find_trained(str(tmp_path / below.name / "instead"), tmp_path)
        return whole(experiment, *arguments, **options)

    monkeypatch.setattr(runs_module, "train_row", small)
    with pytest.warns(UserWarning, match=r"passed over: .*seed-1/config\.json.*; light/walker/plain is trained first"):
        small(row, (0,), tmp_path, num_threads=1)


def test_a_missing_extra_leaves_no_run_behind(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    with pytest.raises(RunError, match=r"footwork\[tb\]"):
        train_row(tiny("walker/plain"), (0,), tmp_path, tensorboard=True)
    assert not list(tmp_path.iterdir())


def test_places_that_are_no_runs_are_told_apart_from_unknown_rows(tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    with pytest.raises(ValueError, match=r"run is a folder, but not of a run or an export: it has no config\.json"):
        find_trained(str(run), tmp_path)
    (tmp_path / "notes.txt").write_text("")
    with pytest.raises(ValueError, match=r"notes\.txt is a file, and a row's name or the folder of a run is wanted$"):
        find_trained(str(tmp_path / "notes.txt"), tmp_path)
    (run / "config.json").write_text("{}")
    (run / "policy.safetensors").write_text("")
    with pytest.raises(ValueError, match=r"is wanted: name its folder, .*run$"):
        find_trained(str(run / "policy.safetensors"), tmp_path)


def test_unknown_and_untrained_rows_are_named(tmp_path):
    with pytest.raises(
        ValueError, match=r"unknown row 'walker/fast'; nearest: .*known rows: walker/\.\.\., "
    ) as caught:
        find_trained("walker/fast", tmp_path)
    assert all(f"{row.partition('/')[0]}/" in str(caught.value) for row in EXPERIMENTS)
    assert len(str(caught.value).splitlines()[0]) < 400
    for wrong, near in [
        ("walker/plian", "walker/plain"),
        ("maze/hrl/apropriate-bias", "maze/hrl/appropriate-bias"),
        ("bullet/walker/plian", "bullet/walker/plain"),
        ("ligth/walker/plain", "light/walker/plain"),
    ]:
        with pytest.raises(ValueError, match="nearest: ") as caught:
            find_row(wrong)
        group, _, last = near.rpartition("/")
        assert re.search(rf" {group}/({last}|{{[^}}]*\b{last}\b)", str(caught.value)), caught.value


@pytest.mark.parametrize(
    ("seeds", "message"),
    [((), "seeds must be one or more"), ((1, 1), "seeds must be one or more"), ((-1,), "a seed must be in 0")],
)
def test_bad_seeds_are_refused(tmp_path, seeds, message):
    with pytest.raises(ValueError, match=message):
        train_row(tiny("walker/plain"), seeds, tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("row", "change", "message"),
    [
        ("walker/plain", {"total_steps": 0}, "total_steps must be >= 1, got 0"),
        ("maze/hrl/plain", {"option_steps": 0}, "option_steps must be >= 1, got 0"),
        ("maze/flat/free", {"regulariser": EXPERIMENTS["walker/random-start"].regulariser}, "only sub-policies are"),
    ],
)
def test_bad_fields_of_a_row_are_refused(row, change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(EXPERIMENTS[row], **change)


# ---------------------------------------------------------------- at the command line

SMALL = [
    *("--ppo.num-envs", "4", "--ppo.num-steps", "3", "--ppo.num-minibatches", "2", "--ppo.update-epochs", "1"),
    *("--ppo.hidden-sizes", "4", "--option-steps", "2", "--task.episode-steps", "4", "--threads", "1"),
]


def test_the_command_says_what_a_run_stands_on_and_where_it_goes_on(tmp_path, capsys):
    command = ["train", "bandit/hrl/plain", "--runs", str(tmp_path), "--resume", *SMALL]
    assert run([*command, "--total-steps", "30"]) == 0
    said = capsys.readouterr()
    assert re.search(r"nothing to resume in .*/bandit/hrl/plain/custom-\w+-seed-0: it begins there", said.err)
    assert "takes 24 control steps, whole iterations of 24" in said.err
    assert f"stands on walker/plain, {PACKAGED}" in said.err
    assert f"trained on those of walker/plain: {PACKAGED}" in said.out
    assert run([*command, "--total-steps", "48"]) == 0
    said = capsys.readouterr()
    assert re.search(f"stands on walker/plain, {PACKAGED}.*goes on from step 24 of 48", said.err, re.DOTALL)
    assert "nothing to resume" not in said.err
    assert "takes" not in said.err
    place = next(tmp_path.glob("bandit/hrl/plain/custom-*"))
    evaluate = ["evaluate", str(place), "--episodes", "1", "--threads", "1"]
    assert run(evaluate) == 0
    assert f"policies from {place / 'policy.safetensors'}" in capsys.readouterr().err
    for asked, steps in {"": 4, "6": 6}.items():
        assert run([*evaluate, "--json", *(["--episode-steps", asked] if asked else [])]) == 0
        assert json.loads(capsys.readouterr().out)["episode_steps"] == steps
    for bad in ("0", "2147483648"):
        assert run([*evaluate, "--episode-steps", bad]) == 1
        assert f"episode_steps must be >= 1 and < 2**31, got {bad}" in capsys.readouterr().err


def test_a_warning_of_ours_is_one_line_said_once_and_others_say_where_they_come_from(tmp_path, capsys):
    path = Path(finished(tmp_path, EXPERIMENTS["walker/plain"], "torn"))
    (path / "config.json").write_text("{")
    command = [sys.executable, "-m", "footwork", "train", "bandit/hrl/plain", "--runs", str(tmp_path), *SMALL]
    said = subprocess.run([*command, "--total-steps", "24"], capture_output=True, text=True, check=True)
    passed_over = [line for line in said.stderr.splitlines() if "passed over" in line]
    assert len(passed_over) == 1, said.stderr
    assert passed_over[0].startswith("footwork: passed over: ")
    for kind in (RuntimeWarning, UserWarning):
        show_warning(kind("overflow"), kind, "other.py", 7)
        assert f"other.py:7: {kind.__name__}: overflow" in capsys.readouterr().err
