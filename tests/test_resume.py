"""A run that was stopped, killed or run on other threads gives the numbers of one that was not."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from footwork import checkpoint
from footwork.record import RunError
from footwork.study import runs as study
from footwork.study.experiments import find_row
from footwork.study.runs import load_run, run_path
from footwork.train import TrainingDiverged

TINY = {"num_envs": 4, "num_steps": 4, "num_minibatches": 2, "update_epochs": 1}


def tiny(row, iterations, **task):
    experiment = find_row(row)
    ppo = replace(experiment.ppo, **TINY)
    per_iteration = 16 * (2 if experiment.is_master else 1)
    task = replace(experiment.task, episode_steps=30, **task)
    return replace(experiment, ppo=ppo, task=task, total_steps=iterations * per_iteration, option_steps=2)


# These rows are smaller than the table's: their runs would not lie in the row's own place.
train_row = partial(study.train_row, name="seed-0")


def outcome(runs, row):
    """Everything a run leaves that must not depend on how it got there."""
    path = run_path(runs, row, (0,))
    policy, _ = checkpoint.load_arrays(path / "policy.safetensors")
    newest = max((path / "checkpoints").iterdir())
    state, _ = checkpoint.load_arrays(newest)
    lines = [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]
    metrics = [{k: v for k, v in line.items() if not k.startswith("time/")} for line in lines]
    return policy, state, metrics


def assert_same(one, other):
    for a, b in zip(one[:2], other[:2], strict=True):
        assert a.keys() == b.keys()
        for name in a:
            np.testing.assert_array_equal(a[name], b[name], err_msg=name)
    assert one[2] == other[2]


@pytest.mark.parametrize("row", ["walker/interleaved", "bandit/hrl/symmetric-interleaved"])
def test_two_and_two_iterations_are_four(tmp_path, row):
    train_row(tiny(row, 4), (0,), tmp_path / "whole", num_threads=1)
    train_row(tiny(row, 2), (0,), tmp_path / "parts", num_threads=1)
    train_row(tiny(row, 4), (0,), tmp_path / "parts", num_threads=2, resume=True)  # and 1 thread is 2 threads
    assert_same(outcome(tmp_path / "whole", row), outcome(tmp_path / "parts", row))


KILLS = int(os.environ.get("FOOTWORK_KILLS", "3"))  # a start each, so few in an everyday run

KILLED = """
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
from test_resume import tiny
import footwork.train, footwork.study.runs as runs
from functools import partial
runs.train = partial(footwork.train.train, checkpoint_seconds=0.0)
runs.train_row(tiny("walker/plain", {iterations}), (0,), Path({runs!r}), "seed-0", resume=True, num_threads=1)
"""


def test_kill_minus_nine_loses_nothing(tmp_path):
    code = KILLED.format(tests=os.path.dirname(__file__), runs=str(tmp_path / "killed"), iterations=20 * KILLS)
    metrics = run_path(tmp_path / "killed", "walker/plain", (0,)) / "metrics.jsonl"
    chance = np.random.default_rng(0)
    kills, seen = 0, 0
    while kills < KILLS:
        process = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        deadline, enough = time.monotonic() + 120, seen + int(chance.integers(1, 11))
        while process.poll() is None and time.monotonic() < deadline:
            lines = metrics.read_bytes().count(b"\n") if metrics.is_file() else 0
            if lines > enough:
                time.sleep(chance.uniform(0.0, 0.2))  # in the middle of whatever it does then
                process.send_signal(signal.SIGKILL)
                break
            time.sleep(0.002)
        process.wait()
        assert process.returncode == -signal.SIGKILL, "the run ended before it was killed"
        kills, seen = kills + 1, metrics.read_bytes().count(b"\n")
    train_row(tiny("walker/plain", 20 * KILLS), (0,), tmp_path / "killed", resume=True, num_threads=1)
    train_row(tiny("walker/plain", 20 * KILLS), (0,), tmp_path / "whole", num_threads=1)
    assert_same(outcome(tmp_path / "whole", "walker/plain"), outcome(tmp_path / "killed", "walker/plain"))


def test_a_finished_run_is_kept_and_another_config_refused(tmp_path):
    done = train_row(tiny("walker/symmetric", 1), (0,), tmp_path, num_threads=1)
    with pytest.raises(RunError, match="holds a finished run"):
        train_row(tiny("walker/symmetric", 1), (0,), tmp_path)
    again = train_row(tiny("walker/symmetric", 1), (0,), tmp_path, resume=True)
    np.testing.assert_array_equal(done.params["actor"]["output"]["weight"], again.params["actor"]["output"]["weight"])
    with pytest.raises(ValueError, match="another config"):
        train_row(tiny("walker/symmetric", 1, fall_rule="flip"), (0,), tmp_path, resume=True)


def test_a_run_of_another_device_is_not_gone_on_with(tmp_path):
    train_row(tiny("walker/symmetric", 1), (0,), tmp_path, num_threads=1)
    path = run_path(tmp_path, "walker/symmetric", (0,)) / "config.json"
    content = json.loads(path.read_text())
    content["versions"]["device"] = "NVIDIA H200"
    path.write_text(json.dumps(content))
    assert train_row(tiny("walker/symmetric", 1), (0,), tmp_path, resume=True)  # it is finished
    with pytest.raises(ValueError, match="was begun on NVIDIA H200, JAX computes on the CPU now"):
        train_row(tiny("walker/symmetric", 2), (0,), tmp_path, resume=True)


def test_a_diverged_learner_names_step_metric_and_last_checkpoint(tmp_path):
    experiment = tiny("walker/symmetric", 8)
    broken = replace(experiment, ppo=replace(experiment.ppo, learning_rate=1e38))
    with pytest.raises(TrainingDiverged, match=r"is not finite at step \d+; there is no earlier checkpoint"):
        train_row(broken, (0,), tmp_path, num_threads=1)


def test_weights_of_the_wrong_shape_are_refused(tmp_path):
    train_row(tiny("walker/symmetric", 1), (0,), tmp_path, num_threads=1)
    from footwork.record import RunDir

    run = RunDir(run_path(tmp_path, "walker/symmetric", (0,)))
    arrays, meta = checkpoint.load_arrays(run.policy_path)
    arrays["actor/output/weight"] = arrays["actor/output/weight"][..., :-1]
    checkpoint.save(run.policy_path, _nested(arrays), meta)
    with pytest.raises(checkpoint.CheckpointError, match="actor/output/weight"):
        load_run(run)


def _nested(arrays):
    tree = {}
    for name, array in arrays.items():
        *parents, leaf = name.split("/")
        place = tree
        for parent in parents:
            place = place.setdefault(parent, {})
        place[leaf] = array
    return tree
