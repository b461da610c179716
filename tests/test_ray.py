"""The same runs on a Ray cluster of two nodes on this machine, one of which is lost; skipped where ray is absent."""

from __future__ import annotations

import json
import os
import threading
import time

import numpy as np
import pytest

from footwork import checkpoint
from footwork.study import sweep
from footwork.study.plan import Size, Study, plan
from footwork.study.runs import run_path

ray = pytest.importorskip("ray")
from ray.cluster_utils import Cluster  # noqa: E402

SMALL = Size("small", 2, 2, 4, 4, 4, (1000,), short=(2048, 20 * 2048, 12_800, 2048))
ROWS = ("walker/symmetric", "bandit/hrl/symmetric")


def outcome(study, job):
    """What a run leaves that must not depend on where it was made."""
    path = run_path(study.runs, job.row, (job.seed,))
    arrays, _ = checkpoint.load_arrays(path / "policy.safetensors")
    lines = [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]
    metrics = [{k: v for k, v in line.items() if not k.startswith("time/")} for line in lines]
    return arrays, metrics, json.loads((path / "evaluation.json").read_text())["by_seed"]


def test_a_lost_node_loses_no_run_and_changes_no_number(tmp_path, monkeypatch):
    monkeypatch.setenv(
        "PYTHONPATH", os.pathsep.join(map(str, [*_sources(), *os.environ.get("PYTHONPATH", "").split(":")]))
    )
    local, shared = Study(tmp_path / "local", SMALL), Study(tmp_path / "shared", SMALL)
    jobs = plan(local, ROWS, seeds=2)
    room = sweep.megabytes_of(shared, jobs[0]) * 10**6
    # no node has the memory that a run takes: each runs one all the same
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "memory": room // 2})
    lost = cluster.add_node(num_cpus=1, memory=room // 2)
    try:
        remover = threading.Thread(target=_remove_when_busy, args=(cluster, lost, shared, jobs))
        remover.start()
        said = []
        board = sweep.run_study(shared, jobs, launcher="ray", address=cluster.address, log=said.append)
        remover.join()
    finally:
        ray.shutdown()
        cluster.shutdown()
    assert (len(board.done), board.failed) == (4, {}), said
    assert len(sweep.run_study(local, jobs).done) == 4
    for job in jobs:
        ours, theirs = outcome(local, job), outcome(shared, job)
        for name, array in ours[0].items():
            np.testing.assert_array_equal(array, theirs[0][name], err_msg=f"{job.name} {name}")
        assert ours[1:] == theirs[1:]


def _sources():
    import footwork

    return [os.path.dirname(os.path.dirname(footwork.__file__))]


def _remove_when_busy(cluster, node, study, jobs):
    """Take a node away while both are in the middle of a run."""
    first = [run_path(study.runs, job.row, (job.seed,)) / "metrics.jsonl" for job in jobs if job.needs is None]
    deadline = time.monotonic() + 400
    while time.monotonic() < deadline and not all(path.is_file() and path.stat().st_size for path in first):
        time.sleep(0.05)
    cluster.remove_node(node, allow_graceful=False)


def test_an_address_that_does_not_answer_is_named(tmp_path):
    study = Study(tmp_path, SMALL)
    with pytest.raises(ValueError, match=r"no Ray cluster answers at '127\.0\.0\.1:1'"):
        sweep.run_study(study, plan(study, ["walker/symmetric"]), launcher="ray", address="127.0.0.1:1")
