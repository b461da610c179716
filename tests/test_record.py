"""Laws of run directories: never overwritten, used by one process at a time, resumed as if never stopped."""

from __future__ import annotations

import io
import json
import math
import os
import re
import resource
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from footwork import checkpoint, record
from footwork.checkpoint import CheckpointError
from footwork.record import MetricsWriter, Progress, RunDir, RunError

CONFIG = {"row": "maze/flat", "seed": 3}


@pytest.fixture
def run(tmp_path: Path) -> RunDir:
    return RunDir.create(tmp_path / "run", CONFIG)


def test_a_run_directory_tells_what_it_was_made_with(run):
    again = RunDir.open_existing(run.path)
    assert again.config() == CONFIG
    stored = json.loads((run.path / "config.json").read_text())["versions"]
    assert stored == record.versions()
    extras = {"commit", "pybullet", "mujoco-mjx"}  # where they are there
    assert set(stored) - extras == {"footwork", "source", "python", "jax", "mujoco", "numpy", "platform"}


def test_a_commit_is_named_only_of_a_source_that_is_as_it_was_committed(tmp_path, monkeypatch):
    for name in [name for name in os.environ if name.startswith("GIT_")]:  # as in a hook, of another repository
        monkeypatch.delenv(name)
    monkeypatch.setenv("GIT_CONFIG_GLOBAL", os.devnull)
    monkeypatch.setenv("GIT_CONFIG_NOSYSTEM", "1")

    def git(*arguments: str) -> str:
        who = ("-c", "user.name=A", "-c", "user.email=a@b.invalid")
        done = subprocess.run(("git", *who, *arguments), cwd=tmp_path, check=True, capture_output=True, text=True)
        return done.stdout.strip()

    def commit() -> str:
        record.source_commit.cache_clear()
        return record.source_commit()

    package = tmp_path / "src" / "footwork" / "__init__.py"
    package.parent.mkdir(parents=True)
    package.write_text("one = 1\n")
    monkeypatch.setattr(record.footwork, "__file__", str(package))
    try:
        git("init", "-q")
        assert commit() == ""  # in a repository that does not hold it, as in somebody's .venv
        git("add", ".")
        git("commit", "-q", "-m", "first")
        first = git("rev-parse", "HEAD")[:7]
        assert commit() == first
        assert record.versions()["commit"] == first
        (tmp_path / "notes.txt").write_text("not the package's")
        assert commit() == first
        git("add", ".")
        git("commit", "-q", "-m", "notes")
        assert commit() == first
        monkeypatch.setenv("GIT_DIR", str(tmp_path / "elsewhere"))  # in a hook
        assert commit() == first
        monkeypatch.delenv("GIT_DIR")
        package.write_text("one = 2\n")
        assert commit() == ""
        package.write_text("one = 1\n")
        (package.parent / "new.py").write_text("")
        assert commit() == ""
        monkeypatch.setenv("PATH", "")
        assert commit() == ""  # no git
    finally:
        record.source_commit.cache_clear()


def test_a_run_is_never_overwritten(run):
    before = (run.path / "config.json").read_bytes()
    with pytest.raises(RunError, match=r"unfinished run: use --resume, or choose another --runs or --name"):
        RunDir.create(run.path, {})
    run.finish({"success": np.float32(0.5), "time": math.nan})
    with pytest.raises(RunError, match=r"finished run: choose another"):
        RunDir.create(run.path, {})
    assert run.finished
    assert run.summary() == {"success": 0.5, "time": "nan"}
    assert (run.path / "config.json").read_bytes() == before


def test_other_directories_are_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(RunError, match="not empty and holds no run"):
        RunDir.create(tmp_path, CONFIG)
    assert [entry.name for entry in tmp_path.iterdir()] == ["thesis.tex"]
    with pytest.raises(RunError, match="cannot make"):
        RunDir.create(tmp_path / "thesis.tex" / "run", CONFIG)
    for absent in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(RunError, match=r"no config\.json"):
            RunDir.open_existing(absent)
    with pytest.raises(RunError, match="must be JSON"):
        RunDir.create(tmp_path / "new", {"x": object()})
    assert not (tmp_path / "new").exists()


def test_what_a_killed_creation_leaves_is_no_obstacle(tmp_path):
    (tmp_path / ".config.json.123.tmp").write_text("{")
    (tmp_path / "lock").write_text("123\n")
    assert RunDir.create(tmp_path, CONFIG).config() == CONFIG


@pytest.mark.parametrize("damage", [b"{", b"[]", b'{"config": 3}', b"\xff"])
def test_a_damaged_config_is_refused(run, damage):
    (run.path / "config.json").write_bytes(damage)
    with pytest.raises(RunError, match=r"config\.json is damaged"):
        RunDir.open_existing(run.path)


HOLDER = """
import sys, time
from pathlib import Path
from footwork.record import RunDir
with RunDir(Path(sys.argv[1])).lock():
    print("held", flush=True)
    time.sleep(60)
"""


def test_the_lock_keeps_other_processes_out_and_dies_with_its_holder(run):
    environment = {"PYTHONPATH": os.pathsep.join(sys.path), "PATH": os.environ["PATH"]}
    command = [sys.executable, "-c", HOLDER, str(run.path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment) as child:
        assert child.stdout.readline() == b"held\n"
        with pytest.raises(RunError, match=f"{run.path} is in use by process {child.pid}$"), run.lock():
            pass
        child.send_signal(signal.SIGKILL)
    with run.lock(), pytest.raises(RunError, match=f"process {os.getpid()}$"), run.lock():
        pass
    with run.lock():  # let go after use
        pass


def test_an_error_inside_lets_go_of_the_lock(run):
    with pytest.raises(KeyError), run.lock():
        raise KeyError
    with run.lock():
        pass


def test_the_newest_two_checkpoints_are_kept(run):
    assert run.latest_checkpoint() == (None, -1, ())
    for step in (100, 2_000, 30_000, 400_000):
        run.save_checkpoint(step, {"a": jnp.full(3, step)}, {"row": "maze/flat"})
    assert [step for step, _ in run.checkpoints()] == [30_000, 400_000]
    latest = run.latest_checkpoint()
    assert latest.path.name == "step_0000400000.safetensors"
    assert (latest.step, latest.skipped) == (400_000, ())
    _, meta = checkpoint.load(latest.path, {"a": jnp.zeros(3, int)})
    assert meta == {"row": "maze/flat", "step": 400_000}


def test_damaged_checkpoints_are_passed_over_and_named(run):
    run.save_checkpoint(10, {"a": np.zeros(9)}, {})
    damaged = run.save_checkpoint(20, {"a": np.zeros(9)}, {})
    damaged.write_bytes(damaged.read_bytes()[:-5])
    latest = run.latest_checkpoint()
    assert latest.step == 10
    assert len(latest.skipped) == 1
    assert str(damaged) in latest.skipped[0]
    run.rewind(10)
    assert [step for step, _ in run.checkpoints()] == [10]


def test_the_final_parameters_come_back(run):
    path = run.save_policy({"w": np.arange(3.0)}, {"row": "walker/plain"})
    assert path == run.policy_path
    np.testing.assert_array_equal(checkpoint.load_arrays(path)[0]["w"], np.arange(3.0))


def write_steps(run: RunDir, steps: range) -> None:
    with run.open_metrics() as metrics:
        for step in steps:
            metrics.write(step, {"reward": np.float32(step) / 3, "terms": {"alive": jnp.array([step, step + 1])}})


@pytest.mark.parametrize("torn", [b"", b'{"step": 9, "rew', b"\0" * 40, b'{"step": 9}'])
def test_the_metrics_of_a_resumed_run_equal_those_of_one_that_never_stopped(tmp_path, torn):
    straight, stopped = (RunDir.create(tmp_path / name, CONFIG) for name in ("straight", "stopped"))
    write_steps(straight, range(12))
    write_steps(stopped, range(9))
    with open(stopped.metrics_path, "ab") as file:
        file.write(torn)
    (stopped.path / ".DONE.77.tmp").write_text("{")
    stopped.rewind(5)
    write_steps(stopped, range(6, 12))
    assert stopped.metrics_path.read_bytes() == straight.metrics_path.read_bytes()
    assert not list(stopped.path.glob(".*.tmp"))


def test_rewinding_to_before_the_start_forgets_all_metrics(run):
    run.rewind(-1)
    write_steps(run, range(3))
    run.rewind(-1)
    assert run.metrics_path.read_bytes() == b""


def test_every_line_is_json_and_numbers_that_are_not_finite_come_back(run):
    figures = {
        "a": math.nan,
        "b": np.float32("inf"),
        "c": jnp.array([-jnp.inf, 1.0]),
        "d": None,
        "e": True,
        "f": "text",
    }
    with run.open_metrics() as metrics:
        metrics.write(7, figures)

    def refuse(word: str) -> Any:
        raise AssertionError(f"{word} is not JSON")

    line = json.loads(run.metrics_path.read_text(), parse_constant=refuse)
    assert line == {"step": 7, "a": "nan", "b": "inf", "c": ["-inf", 1.0], "d": None, "e": True, "f": "text"}
    (found,) = record.read_metrics(run.metrics_path)
    assert math.isnan(found["a"])
    assert found["b"] == math.inf
    assert found["c"] == [-math.inf, 1.0]


def test_a_line_that_makes_no_sense_is_refused_before_it_is_written(run):
    with run.open_metrics() as metrics:
        metrics.write(7, {"a": 1})
        with pytest.raises(RunError, match="step 6 after those of step 7"):
            metrics.write(6, {"a": 1})
        with pytest.raises(RunError, match="step 8: a: neither a number"):
            metrics.write(8, {"a": object()})
    with run.open_metrics() as metrics, pytest.raises(RunError, match="step 6 after"):
        metrics.write(6, {"a": 1})
    assert record.read_metrics(run.metrics_path) == [{"step": 7, "a": 1}]


def test_damage_before_the_last_line_is_not_passed_over(run):
    run.metrics_path.write_bytes(b'{"step": 1}\nrubbish\n{"step": 3}\n')
    for act in (run.open_metrics, lambda: record.read_metrics(run.metrics_path), lambda: run.rewind(3)):
        with pytest.raises(RunError, match=r"metrics\.jsonl is damaged: line 2"):
            act()


def test_a_full_disk_keeps_whole_lines_checkpoints_and_summary(run):
    write_steps(run, range(3))
    run.save_checkpoint(2, {"a": np.zeros(9)}, {})
    before = run.metrics_path.read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with run.open_metrics() as metrics:
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) + 10, hard))
        try:
            with pytest.raises(RunError, match=r"no space left writing .*metrics\.jsonl; the lines before are intact"):
                metrics.write(3, {"reward": 1.0})
            with pytest.raises(CheckpointError, match="no space left"):
                run.save_checkpoint(3, {"a": np.zeros(9)}, {})
            with pytest.raises(CheckpointError, match=r"no space left writing .*DONE"):
                run.finish({"text": "x" * 1000})
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert run.metrics_path.read_bytes() == before
    assert run.latest_checkpoint().step == 2
    assert not run.finished


def test_event_files_need_their_extra(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    with pytest.raises(RunError, match=r"footwork\[tb\]"):
        run.open_metrics(tensorboard=True)


def test_event_files_are_written(run):
    pytest.importorskip("tensorboardX")
    with run.open_metrics(tensorboard=True) as metrics:
        metrics.write(1, {"loss": 0.25, "terms": {"alive": [1.0, 2.0]}, "name": "text"})
    (events,) = (run.path / "tensorboard").iterdir()
    for name in (b"loss", b"terms/alive/1"):
        assert name in events.read_bytes()
    assert b"text" not in events.read_bytes()


def test_metrics_in_a_place_that_is_not_there_are_refused(tmp_path):
    with pytest.raises(RunError, match="cannot open"):
        MetricsWriter(tmp_path / "nowhere" / "metrics.jsonl")


@dataclass(frozen=True)
class Bias:
    t: tuple[int, int]
    name: str = "bias"


@dataclass(frozen=True)
class Restart:
    every: int
    scale: float | None = None


@dataclass(frozen=True)
class Inner:
    rate: float
    kind: Literal["a", "b", 3]
    sizes: tuple[int, ...] = ()


@dataclass(frozen=True)
class Row:
    inner: Inner
    regulariser: Bias | Restart | None
    rows: tuple[Inner, ...]
    flag: bool
    limit: int | float | str
    only: Inner | None = None

    def __post_init__(self) -> None:
        if self.limit == -1:
            raise ValueError("limit must be >= 0, got -1")


inners = st.builds(
    Inner, st.floats(allow_nan=False), st.sampled_from(["a", "b", 3]), st.lists(st.integers(), max_size=3).map(tuple)
)
biases = st.builds(Bias, st.tuples(st.integers(), st.integers()), st.text())
restarts = st.builds(Restart, st.integers(), st.none() | st.floats(allow_nan=False))
limits = st.integers(0) | st.floats(0, 9) | st.text(min_size=4)
rows = st.builds(
    Row,
    inners,
    st.none() | biases | restarts,
    st.lists(inners, max_size=2).map(tuple),
    st.booleans(),
    limits,
    st.none() | inners,
)


@given(rows)
@settings(deadline=None, max_examples=80)
def test_a_config_comes_back_from_json_exactly(row):
    text = json.dumps(record.config_to_json(row), allow_nan=False)
    found = record.config_from_json(Row, json.loads(text))
    assert found == row
    assert repr(found) == repr(row)  # 3 is not 3.0, True is not 1


ROW = Row(Inner(1.5, "a"), Restart(5), (), True, 3)


def edited(*path: str, **changes: Any) -> Any:
    data = record.config_to_json(ROW)
    part = data
    for name in path:
        part = part[name]
    part.update(changes)
    return data


def without(data: Any, name: str) -> Any:
    del data[name]
    return data


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (edited(colour=3), "Row: unknown colour; the fields of Row are inner, regulariser"),
        (without(edited(), "flag"), "Row: missing flag"),
        (edited("inner", rate="fast"), r"Row\.inner\.rate: expected float, got 'fast'"),
        (edited("inner", kind="c"), r"Row\.inner\.kind: expected .*'a', 'b', 3.*, got 'c'"),
        (edited("inner", sizes=[1, 2.5]), r"Row\.inner\.sizes\[1\]: expected int, got 2\.5"),
        (edited(flag=1), r"Row\.flag: expected bool, got 1"),
        (edited(limit=True), r"Row\.limit: expected int \| float \| str, got True"),
        (edited("regulariser", type="Nudge"), r"Row\.regulariser: unknown type 'Nudge', known are Bias, Restart"),
        (edited(regulariser={"every": 3}), r"unknown type None, known are Bias, Restart"),
        (edited(regulariser={"type": "Bias", "t": [1], "name": ""}), r"Row\.regulariser\.t: expected 2 values, got 1"),
        (edited(inner=None), r"Row\.inner: expected Inner, got None"),
        (edited("inner", type="Row"), r"Row\.inner: expected Inner, got Row"),
        (edited(limit=-1), "limit must be >= 0"),
        ([], r"Row: expected Row, got \[\]"),
    ],
)
def test_a_config_that_does_not_fit_is_refused_and_the_place_named(data, message):
    with pytest.raises(ValueError, match=message):
        record.config_from_json(Row, data)


def test_the_type_may_be_left_out_where_only_one_fits():
    data = without(edited(), "type")
    data["inner"].pop("type")
    assert record.config_from_json(Row, data) == ROW


def test_what_a_config_cannot_hold_is_refused():
    for value in ([1], {"a": 1}, np.zeros(2), Inner):
        with pytest.raises(ValueError, match=r"cannot hold|is a dataclass"):
            record.config_to_json(Restart(value))
    with pytest.raises(ValueError, match="is a dataclass"):
        record.config_to_json({"a": 1})


class Clock:
    """time.monotonic, moved by hand."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(record.time, "monotonic", clock)
    return clock


def test_progress_off_a_terminal_is_a_plain_line_every_few_seconds(clock):
    stream = io.StringIO()
    with Progress(100_000, "maze/flat", stream, initial_step=20_000) as progress:
        for second in range(1, 13):
            clock.now = float(second)
            progress.update(20_000 + 1000 * second, {"reward": 1.23456})
    lines = stream.getvalue().splitlines()
    assert lines[0] == "maze/flat  25,000/100,000  25%  1,000 steps/s  0:01:15 left  reward 1.235"
    assert [line.split()[1] for line in lines] == ["25,000/100,000", "30,000/100,000", "32,000/100,000"]


def test_progress_on_a_terminal_stays_on_one_line(clock):
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    stream = Terminal()
    with Progress(1000, "walker", stream) as progress:
        for step in range(1, 1001, 111):
            clock.now += 0.3
            progress.update(step, {"speed": 2.0})
    assert stream.getvalue().count("\n") == 1
    assert "1,000/1,000  100%" in stream.getvalue()


def test_progress_on_a_narrow_terminal_goes_on_below_and_cuts_nothing(clock, monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setenv("COLUMNS", "60")
    stream = Terminal()
    with Progress(2_000_000, "maze/hrl/symmetric-interleaved", stream) as progress:
        clock.now += 0.3
        progress.update(1_000_000, {"success": 0.5, "episode progress m": 12.5})
    shown = stream.getvalue()
    assert "…" not in shown
    last = [line for line in re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", shown).replace("\r", "\n").splitlines() if line][-3:]
    assert max(map(len, last)) <= 60
    assert last[0].startswith("maze/hrl/symmetric-interleaved  1,000,000/2,000,000")
    assert "success 0.5" in last[1]
    assert last[2].strip() == "episode progress m 12.5"


@pytest.mark.parametrize(("width", "lines"), [(19, 1), (18, 2), (10, 3), (5, 3)])
def test_parts_go_on_below_only_where_they_do_not_fit(width, lines):
    folded = record._folded(["walker", "100%", "m/s 2"], width)  # 6 + 2 + 4 + 2 + 5 characters
    assert folded.split() == ["walker", "100%", "m/s", "2"]
    assert folded.count("\n") == lines - 1


def test_progress_that_was_never_updated_says_nothing():
    stream = io.StringIO()
    Progress(10, "x", stream).close()
    assert stream.getvalue() == ""
