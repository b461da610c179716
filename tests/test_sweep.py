"""The sweep: order, resuming, killing, failing; with runs that are copied from a shelf instead of trained."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import time

import pytest

from fake_study import fake_run
from footwork.physics import free_megabytes
from footwork.record import RunDir, RunError, RunInUse
from footwork.study import job, sweep
from footwork.study.measure import measured
from footwork.study.plan import FULL, Job, Study, plan
from footwork.study.report_files import export
from footwork.study.results import Results
from footwork.study.runs import run_path

ROWS = ("walker/plain", "walker/appropriate-bias", "maze/hrl/appropriate-bias", "walker/symmetric")

# In place of a training: begin in the run's place, take some time, and copy the finished run from the shelf.
STAND_IN = """
import json, os, pathlib, shutil, signal, sys, threading, time
shelf, log, asked = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]), json.loads(sys.argv[3])
def watch():
    while os.read(0, 4096):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
threading.Thread(target=watch, daemon=True).start()
place = f"{asked['row']}/seed-{asked['seed']}"
with log.open("a") as file:
    file.write(place + "\\n")
trouble = shelf / "trouble.json"
kind = json.loads(trouble.read_text()).get(place) if trouble.is_file() else None
if kind == "fails":
    print("ValueError: the ant has lost a leg", file=sys.stderr)
    sys.exit(1)
if kind == "killed once" and log.read_text().count(place) == 1:
    os.kill(os.getpid(), signal.SIGKILL)
target = pathlib.Path(asked["runs"]) / place
target.mkdir(parents=True, exist_ok=True)
shutil.copy(shelf / place / "config.json", target)
time.sleep(float(os.environ.get("STAND_IN_SECONDS", "0.05")))
shutil.copytree(shelf / place, target, dirs_exist_ok=True, ignore=shutil.ignore_patterns("DONE"))
shutil.copy(shelf / place / "DONE", target)
"""


class Stage:
    """A study to be made, the shelf of its finished runs, and the log of what was started."""

    def __init__(self, path):
        self.study, self.shelf, self.started_at = Study(path / "runs"), path / "shelf", path / "started.log"
        self.jobs = plan(self.study, ROWS, seeds=2)
        for one in self.jobs:
            fake_run(Study(self.shelf), one.row, one.seed, lines=10)

    def command(self, study, one, core):
        asked = {"runs": str(study.runs), "row": one.row, "seed": one.seed}
        return [sys.executable, "-c", STAND_IN, str(self.shelf), str(self.started_at), json.dumps(asked)]

    def started(self):
        return self.started_at.read_text().split() if self.started_at.is_file() else []

    def trouble(self, **places):
        (self.shelf / "trouble.json").write_text(json.dumps(places["places"]))

    def run(self, **how):
        self.said = []
        return sweep.run_study(self.study, self.jobs, log=self.said.append, **how)


@pytest.fixture
def stage(tmp_path, monkeypatch):
    stage = Stage(tmp_path)
    monkeypatch.setattr(sweep, "job_command", stage.command)
    monkeypatch.setattr(sweep, "POLL", 0.01)
    return stage


def test_everything_is_made_once_and_in_order(stage):
    board = stage.run(workers=2)
    assert (len(board.done), board.failed) == (8, {})
    started = stage.started()
    assert sorted(started) == sorted(f"{one.row}/seed-{one.seed}" for one in stage.jobs)
    for one in stage.jobs:
        if one.needs:
            assert started.index(f"{one.needs}/seed-{one.seed}") < started.index(f"{one.row}/seed-{one.seed}")
    again = stage.run(workers=2)
    assert len(again.done) == 8
    assert stage.started() == started  # nothing is made twice
    shutil.rmtree(run_path(stage.study.runs, "walker/symmetric", (1,)))
    stage.run()
    assert stage.started()[8:] == ["walker/symmetric/seed-1"]


def test_a_failure_is_reported_with_all_that_stood_on_it(stage):
    stage.trouble(places={"walker/appropriate-bias/seed-1": "fails", "walker/symmetric/seed-0": "killed once"})
    board = stage.run(workers=2)
    assert len(board.done) == 6
    reasons = {one.name: reason for one, reason in board.failed.items()}
    assert "the ant has lost a leg" in reasons["walker/appropriate-bias seed 1"]
    assert reasons["maze/hrl/appropriate-bias seed 1"] == "needs walker/appropriate-bias seed 1, which failed"
    assert any("walker/symmetric seed 0: its process was ended" in line for line in stage.said)
    assert sum("FAILED" in line for line in stage.said) == 2
    stage.trouble(places={})
    assert len(stage.run().done) == 8  # called again, it goes on


def test_one_sweep_at_a_time(stage):
    with sweep._only_one(stage.study.runs), pytest.raises(RunError, match="another footwork reproduce is at work"):
        stage.run()


KILLED = """
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
from test_sweep import Stage
from footwork.study import sweep
class Again(Stage):
    def __init__(self, path):
        super().__init__(path) if not (path / "shelf").is_dir() else self.reuse(path)
    def reuse(self, path):
        from test_sweep import ROWS, Study, plan
        self.study, self.shelf, self.started_at = Study(path / "runs"), path / "shelf", path / "started.log"
        self.jobs = plan(self.study, ROWS, seeds=2)
stage = Again(Path({path!r}))
sweep.job_command, sweep.POLL = stage.command, 0.01
stage.run(workers=2)
"""


def test_kill_minus_nine_of_the_sweep_loses_nothing(stage, tmp_path):
    code = KILLED.format(tests=os.path.dirname(__file__), path=str(tmp_path))
    environment = {**os.environ, "STAND_IN_SECONDS": "0.3"}
    for kill in (1, 2):
        process = subprocess.Popen([sys.executable, "-c", code], env=environment, start_new_session=True)
        deadline = time.monotonic() + 60
        while len(stage.started()) < 2 * kill and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.005)
        time.sleep(0.1 * kill)
        process.send_signal(signal.SIGKILL)
        process.wait()
        time.sleep(0.5)  # the runs see that they are alone, and end
        finished = {str(done.parent.relative_to(stage.study.runs)) for done in stage.study.runs.rglob("DONE")}
        for place in finished:  # what is marked as done is whole
            kept, whole = stage.study.runs / place, stage.shelf / place
            assert all((kept / file.name).read_bytes() == file.read_bytes() for file in whole.iterdir())
    done = {str(path.parent.relative_to(stage.study.runs)) for path in stage.study.runs.rglob("DONE")}
    before = len(stage.started())
    board = stage.run(workers=2)
    assert (len(board.done), board.failed) == (8, {})
    assert not done & set(stage.started()[before:])  # a finished run is not run again
    for one in stage.jobs:
        place = run_path(stage.study.runs, one.row, (one.seed,))
        assert (place / "metrics.jsonl").read_bytes() == (
            run_path(stage.shelf, one.row, (one.seed,)) / "metrics.jsonl"
        ).read_bytes()


def test_a_sweep_that_is_asked_to_stop_lets_its_runs_save_and_says_how_to_go_on(stage, tmp_path):
    """SIGTERM in the middle: every run is asked to end, none is left behind, and the next sweep makes the rest."""
    code = KILLED.format(tests=os.path.dirname(__file__), path=str(tmp_path))
    command = [sys.executable, "-c", code]
    environment = {**os.environ, "STAND_IN_SECONDS": "30"}
    process = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True, start_new_session=True)
    deadline = time.monotonic() + 60
    while len(stage.started()) < 2 and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    begun = time.monotonic()
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=60)
    assert time.monotonic() - begun < 20  # the runs, of 30 s, did not have to be waited for
    assert "SweepStopped: stopped: 0 of 8 runs done, 0 running" in said
    assert "call it again to go on" in said
    board = stage.run(workers=2)
    assert (len(board.done), board.failed) == (8, {})


def test_two_sweeps_do_not_share_cores(monkeypatch, tmp_path):
    monkeypatch.setattr(sweep.tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr(sweep.os, "sched_getaffinity", lambda _: {0, 1, 2}, raising=False)
    with sweep._cores(2) as one:
        assert one == [0, 1]
        with sweep._cores(1) as other:
            assert other == [2]
        with sweep._cores(2) as too_many:
            assert too_many == [None, None]  # the system shares out what is left
    with sweep._cores(0) as again:
        assert again == [0, 1, 2]
    with sweep._cores(4) as more_than_there_are:
        assert more_than_there_are == [None] * 4


@pytest.mark.parametrize(("runs_of_room", "most"), [(0.5, 1), (1.9, 1), (2.1, 2), (None, 2)])
def test_no_more_runs_at_once_than_memory_holds(stage, monkeypatch, runs_of_room, most):
    monkeypatch.setenv("STAND_IN_SECONDS", "0.3")
    need = sweep.megabytes_of(stage.study, stage.jobs[0])
    monkeypatch.setattr(sweep, "free_megabytes", lambda: None if runs_of_room is None else runs_of_room * need)
    begin, at_once = sweep._start, []

    def start(board_study, *rest):
        worker = begin(board_study, *rest)
        workers.append(worker.process)
        at_once.append(sum(process.poll() is None for process in workers))
        return worker

    workers = []
    monkeypatch.setattr(sweep, "_start", start)
    board = stage.run(workers=2)
    assert len(board.done) == len(stage.jobs)
    assert max(at_once) == most
    assert any("not enough memory" in line for line in stage.said) == (most < 2)


def test_a_run_waits_while_others_hold_the_memory_that_was_free_at_the_start(stage, monkeypatch):
    need = sweep.megabytes_of(stage.study, stage.jobs[0])
    free = iter([10 * need, 10 * need])  # at the start, and when the first runs begin; then another program grows
    monkeypatch.setattr(sweep, "free_megabytes", lambda: next(free, 0.5 * need))
    board = stage.run(workers=2)
    assert len(board.done) == len(stage.jobs)  # one at a time
    assert any("not enough memory" in line for line in stage.said)


def test_runs_of_large_ants_need_more_memory():
    def gigabytes(row):
        return sweep.megabytes_of(Study("runs", FULL), Job(row, 0, None, 1)) / 1e3

    assert 4 < gigabytes("bullet/walker/plain") < 6  # 128 ants
    assert 6 < gigabytes("bullet/maze/hrl/plain") < 8  # 200 episodes at once
    assert gigabytes("walker/plain") == gigabytes("maze/hrl/plain") < 1


@pytest.mark.parametrize(
    ("limit", "free"), [("max\n", 8_000), ("3000000000\n", 2_500), ("90000000000\n", 8_000), (None, 8_000)]
)
def test_a_container_has_no_more_memory_than_its_limit(tmp_path, limit, free):
    meminfo = tmp_path / "meminfo"
    meminfo.write_text("MemTotal: 9765625 kB\nMemAvailable: 7812500 kB\n")
    job = tmp_path / "slice" / "job"
    job.mkdir(parents=True)
    own = tmp_path / "own"
    for name, group in {"/": tmp_path, "/slice": job.parent, "/slice/job": job}.items():
        for file, text in {"memory.max": limit, "memory.current": "1500000000\n"}.items():
            if text is not None:
                (group / file).write_text(text)
        (group / "memory.stat").write_text("anon 500000000\ninactive_file 1000000000\n")
        for inside in {name, "/slice/job"}:  # its limit, or one of those around it
            own.write_text(f"4:memory:/other\n0::{inside}\n")
            assert free_megabytes(meminfo, tmp_path, own) == free
        (group / "memory.max").unlink(missing_ok=True)
    assert free_megabytes(meminfo, tmp_path, tmp_path / "none") == 8_000
    assert free_megabytes(tmp_path / "none", tmp_path, own) is None


def test_a_cluster_is_asked_for_no_more_memory_than_a_node_has():
    study, job = Study("runs", FULL), Job("bullet/walker/plain", 0, None, 1)
    need = sweep.megabytes_of(study, job) * 10**6

    def node(memory, cores=1.0, alive=True):
        return {"Alive": alive, "Resources": {"CPU": cores, "memory": float(memory)} if cores else {"memory": memory}}

    assert sweep._memory_to_ask_for(study, job, [node(2 * need), node(3 * need)]) == need
    assert sweep._memory_to_ask_for(study, job, [node(2 * need), node(need // 2), node(0)]) == need  # not on the small
    assert sweep._memory_to_ask_for(study, job, [node(need // 2), node(need // 4)]) == need // 2  # the largest tries
    gone = [node(9 * need, cores=None), node(9 * need, alive=False)]
    assert sweep._memory_to_ask_for(study, job, [node(need // 2), *gone]) == need // 2
    assert sweep._memory_to_ask_for(study, job, [{"Alive": True, "Resources": {"CPU": 1.0}}]) is None
    assert sweep._memory_to_ask_for(study, job, []) is None


def test_what_earlier_sweeps_did_is_not_this_ones_speed(stage):
    one, other = stage.jobs[0], stage.jobs[1]
    place = run_path(stage.study.runs, one.row, (one.seed,))
    place.mkdir(parents=True)
    taken = int(0.9 * one.steps) // 4
    (place / "metrics.jsonl").write_text(json.dumps({"step": taken}) + "\n")
    board = sweep.Board.of(stage.study, stage.jobs, set())
    board.begun -= 100.0
    board.begin(one)
    assert board.rate() == 0
    assert board.seconds_left() is None
    (place / "metrics.jsonl").write_text(json.dumps({"step": taken + 1000}) + "\n")
    assert board.rate() == pytest.approx(0.85 * 4 * 1000 / 100, rel=0.01)
    board.put_back(one)
    board.begin(other)
    assert board.rate() == pytest.approx(0.85 * 4 * 1000 / 100, rel=0.01)  # it is still counted


def test_the_board_counts_steps_and_time(stage):
    board = sweep.Board(stage.study, stage.jobs)
    assert board.seconds_left() is None
    one = stage.jobs[0]
    place = run_path(stage.study.runs, one.row, (one.seed,))
    place.mkdir(parents=True)
    half = one.steps // 4 // 2
    (place / "metrics.jsonl").write_text(json.dumps({"step": half}) + "\n" + '{"step": 1e9')  # the last line is torn
    board.active.add(one)
    assert board.steps_done() == pytest.approx(0.85 * one.steps / 2, rel=1e-6)
    board.begun -= 100.0
    left = sum(other.steps for other in stage.jobs) - board.steps_done()
    assert board.seconds_left() == pytest.approx(left / (board.steps_done() / 100), rel=0.01)
    assert sweep.board_table(board).row_count == 1
    assert "0 of 8 runs done, 1 running" in board.line()


def test_a_job_waits_for_whoever_measures_its_finished_run(tmp_path, monkeypatch):
    """Of a run with several seeds one job measures all; those of the other seeds are done when that is."""
    study = Study(tmp_path, FULL)
    fake_run(study, "maze/flat/free", 0)
    tries = []

    def lock_of_another(run):
        tries.append(run.path)
        if len(tries) < 3:
            raise RunInUse("in use")
        return contextlib.nullcontext()

    monkeypatch.setattr(RunDir, "lock", lock_of_another)
    monkeypatch.setattr(job, "_end_with_parent", lambda: None)
    monkeypatch.setattr(job, "WAIT_FOR_LOCK", -1.0)
    describe = lambda seed: [json.dumps({**sweep._as_json(study), "row": "maze/flat/free", "seed": seed})]  # noqa: E731
    assert job.main(describe(0)) == 0
    assert len(tries) == 3
    tries.clear()
    assert job.main(describe(1)) == 1  # of an unfinished run somebody else is the trainer


def test_seed_i_stands_on_seed_i(tmp_path, monkeypatch):
    """What a job trains on, of a run with several seeds too; and that it measures what it trained."""
    from footwork import checkpoint
    from footwork.record import RunDir, config_to_json
    from footwork.study.runs import NEEDED, find_needed, find_trained
    from footwork.train import policy_meta
    from test_train import tiny, untrained

    size = FULL.__class__("full", 2, 1, 3, 4, 4, (1000,))
    study = Study(tmp_path, size)
    monkeypatch.setattr(Study, "row", lambda self, name: tiny(name))
    walkers = untrained("walker/symmetric", (0, 1))
    walkers.params["actor"]["output"]["bias"] = walkers.params["actor"]["output"]["bias"].at[1].set(0.25)
    run = RunDir.create(
        tmp_path / "walker/symmetric/seeds-0-1", {"experiment": config_to_json(walkers.experiment), "seeds": [0, 1]}
    )
    run.save_policy(walkers.params, policy_meta(walkers.experiment, (0, 1), 0))
    run.finish({"row": walkers.experiment.name, "seeds": [0, 1], "steps": walkers.experiment.total_steps})
    job.complete(study, "bandit/hrl/symmetric", 1)
    master = RunDir.open_existing(run_path(tmp_path, "bandit/hrl/symmetric", (1,)))
    arrays, meta = checkpoint.load_arrays(master.path / NEEDED)
    assert meta["seeds"] == [1]
    assert (arrays["actor/output/bias"] == 0.25).all()
    assert measured(master, tiny("bandit/hrl/symmetric"), size)
    (entry,) = json.loads((master.path / "evaluation.json").read_text())["by_seed"]
    assert entry["seed"] == 1
    assert len(entry["ends"]) == 3
    with pytest.raises(RunError, match="needs walker/symmetric seed 2, which is not finished"):
        job.complete(study, "bandit/hrl/symmetric", 2)
    # and elsewhere, where only the small files of the report are
    results = Results(study)
    assert len(results.samples("walker/symmetric")) == 2
    export(results, tmp_path / "out/copy")
    job.complete(Study(tmp_path / "out/copy", size), "bandit/hrl/symmetric", 1)
    again = checkpoint.load_arrays(
        run_path(tmp_path / "out/copy", "bandit/hrl/symmetric", (1,)) / "policy.safetensors"
    )[0]
    assert all((again[name] == array).all() for name, array in checkpoint.load_arrays(master.policy_path)[0].items())
    # of a row's first seed the report keeps a master too, with what it stands on
    assert len(results.samples("bandit/hrl/symmetric")) == 1
    export(results, tmp_path / "out/whole")
    kept = run_path(tmp_path / "out/whole", "bandit/hrl/symmetric", (1,))
    small = find_trained(str(kept), tmp_path)
    assert small.params.keys() == {"actor"}
    assert (
        small.params["actor"]["output"]["bias"] == checkpoint.load_arrays(master.policy_path)[0]["actor/output/bias"]
    ).all()
    beside = find_needed(small, tmp_path)
    assert beside.seeds == (1,)
    assert (beside.params["actor"]["output"]["bias"] == 0.25).all()
    # a master on anything else is named
    assert not any("stands on" in problem for problem in results.problems)
    other = untrained("walker/symmetric", (1,))
    checkpoint.save(master.path / NEEDED, other.params, policy_meta(other.experiment, (1,), 0))
    export(results, tmp_path / "out/other")
    assert f"{master.path} stands on other policies than those of {run.path}" in results.problems
    (run.path / "DONE").unlink()
    results = Results(study)
    results.samples("bandit/hrl/symmetric")
    export(results, tmp_path / "out/alone")
    said = f"{master.path} stands on walker/symmetric seed 1, of which there is no run that counts"
    assert said in results.problems


@pytest.mark.skipif(importlib.util.find_spec("ray") is not None, reason="ray is installed")
def test_without_ray_the_extra_is_named(stage):
    with pytest.raises(ImportError, match=r"pip install 'footwork\[ray\]'"):
        stage.run(launcher="ray")


def test_jobs_are_named_and_run_alone_on_one_thread(tmp_path):
    one = Job("walker/plain", 3, None, 10)
    assert one.name == "walker/plain seed 3"
    environment = sweep.job_environment({"XLA_FLAGS": "--xla_foo=1"}, tmp_path)
    assert environment["XLA_FLAGS"] == "--xla_foo=1 --xla_cpu_multi_thread_eigen=false"
    assert environment["OMP_NUM_THREADS"] == "1"
