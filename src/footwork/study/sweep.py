"""Run a study: every run a process of its own on a core of its own, on this machine or on a Ray cluster.

There is nothing to remember but the run directories: what is finished is found there, what was
killed goes on there. So a sweep may be stopped or killed at any moment and called again.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import math
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import timedelta
from itertools import islice
from pathlib import Path
from typing import Any

from footwork.physics import ENGINES, free_megabytes
from footwork.record import RunError
from footwork.study.job import STOPPED, completed
from footwork.study.plan import Job, Size, Study
from footwork.study.runs import run_path
from footwork.train import planned_steps

POLL = 0.25  # s between two looks at the processes
PLAIN_EVERY = 60.0  # s between two lines of progress where there is no terminal
STOP_WITHIN = 60.0  # s that processes get to end in good order
LAUNCHERS = ("local", "ray")
RETRIES = 3  # of a run whose process, or whose node in a cluster, was lost
_MEASURING = 0.15  # of a run's time, that comes after its last control step
_MEGABYTES = 800  # of memory that a run takes at most, beside ants that are large
_TAIL = 1 << 16  # bytes of metrics in which the last whole line lies


@dataclass
class Board:
    """Where a sweep stands: what the table and the last line are made of."""

    study: Study
    jobs: Sequence[Job]
    done: set[Job] = field(default_factory=set)
    active: set[Job] = field(default_factory=set)
    failed: dict[Job, str] = field(default_factory=dict)  # with the reason
    killed: dict[Job, int] = field(default_factory=dict)  # how often a run's process was killed, or asked to stop
    begun: float = field(default_factory=time.monotonic)
    waiting: dict[Job, int] = field(default_factory=dict)  # steps that runs have taken that are not at work now
    steps_at_begin: int = 0

    @classmethod
    def of(cls, study: Study, jobs: Sequence[Job], done: set[Job]) -> Board:
        """The board of a sweep that begins: what earlier ones did is not this one's speed."""
        board = cls(study, jobs, done)
        board.waiting = {job: steps for job in jobs if job not in done and (steps := steps_of(study, job))}
        board.steps_at_begin = board.steps_done()
        return board

    def ready(self) -> Iterator[Job]:
        """Runs that could start now, in the order of the plan."""
        finished = {(job.row, job.seed) for job in self.done}
        for job in self.jobs:
            waiting = job not in self.done and job not in self.active and job not in self.failed
            if waiting and (job.needs is None or (job.needs, job.seed) in finished):
                yield job

    def begin(self, job: Job) -> None:
        """Note that a run is at work."""
        self.waiting.pop(job, None)
        self.active.add(job)

    def put_back(self, job: Job) -> None:
        """Note that a run has to go on later."""
        self.active.discard(job)
        self.waiting[job] = steps_of(self.study, job)

    def fail(self, job: Job, reason: str) -> None:
        """Note that a run failed, and all that would have stood on it."""
        self.active.discard(job)
        self.failed[job] = reason
        for other in self.jobs:
            if other.needs == job.row and other.seed == job.seed and other not in self.done:
                self.fail(other, f"needs {job.name}, which failed")

    def succeed(self, job: Job) -> None:
        """Note that a run is complete."""
        self.active.discard(job)
        self.done.add(job)

    def steps_done(self) -> int:
        """Control steps of all runs, finished, under way and begun earlier."""
        finished, under_way = sum(job.steps for job in self.done), sum(steps_of(self.study, job) for job in self.active)
        return finished + under_way + sum(self.waiting.values())

    def rate(self) -> float:
        """Control steps per second since this sweep began."""
        return max(self.steps_done() - self.steps_at_begin, 0) / max(time.monotonic() - self.begun, 1e-9)

    def seconds_left(self) -> float | None:
        """Of the whole; None until something has moved."""
        rate = self.rate()
        left = sum(job.steps for job in self.jobs if job not in self.failed) - self.steps_done()
        return None if rate <= 0 else max(left, 0) / rate

    def line(self) -> str:
        """Everything in one line."""
        left = self.seconds_left()
        parts = [
            f"{len(self.done)} of {len(self.jobs)} runs done",
            f"{len(self.active)} running",
            *([f"{len(self.failed)} failed"] if self.failed else []),
            f"{self.rate():,.0f} steps/s",
            "time left unknown" if left is None else f"{timedelta(seconds=round(left))} left",
        ]
        label = "" if self.study.size.name == "full" else f"[{self.study.size.name} study] "
        return label + ", ".join(parts)


Display = Callable[[Board], None]


class SweepStopped(RuntimeError):
    """The sweep was asked to stop; every run has stopped, and goes on where it was saved."""


def run_study(
    study: Study,
    jobs: Sequence[Job],
    workers: int = 0,
    launcher: str = "local",
    address: str = "auto",
    log: Callable[[str], None] = print,
) -> Board:
    """Make all runs that are not complete, and return how it went.

    Args:
        study: the folder and its size.
        jobs: from :func:`footwork.study.plan.plan`.
        workers: runs at once; 0: one per core of this machine, or of the cluster.
        launcher: ``local`` or ``ray``.
        address: of the Ray cluster.
        log: gets a line for everything that happens.

    Raises:
        RunError: another sweep is at work in the folder.
        ValueError: unknown launcher, or the cluster does not answer.
        ImportError: the extra ``footwork[ray]`` is missing.
        SweepStopped: SIGINT or SIGTERM came.
    """
    if launcher not in LAUNCHERS:
        raise ValueError(f"unknown launcher {launcher!r}; known launchers: {', '.join(LAUNCHERS)}")
    if workers < 0:
        raise ValueError(f"workers must be >= 0, got {workers}")
    with _only_one(study.runs):
        done, problems = completed(study, jobs)
        for problem in problems:
            log(problem)
        board = Board.of(study, jobs, done)
        log(board.line().partition(",")[0] + f"; {sum(job.steps for job in jobs):,} control steps in all")
        if len(board.done) < len(jobs):
            if launcher == "ray":
                _run_on_ray(board, workers, address, log)
            else:
                _run_local(board, workers, log)
    return board


@contextlib.contextmanager
def _only_one(runs: Path) -> Iterator[None]:
    """Keep every other sweep out of the folder; a killed one lets go by dying."""
    runs.mkdir(parents=True, exist_ok=True)
    with (runs / "sweep.lock").open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RunError(f"another footwork reproduce is at work in {runs}") from None
        yield


def steps_of(study: Study, job: Job) -> int:
    """Control steps that an unfinished run has taken, less a share for the time that measuring it will take."""
    path = run_path(study.runs, job.row, (job.seed,)) / "metrics.jsonl"
    try:
        with path.open("rb") as file:
            file.seek(0, os.SEEK_END)
            file.seek(max(file.tell() - _TAIL, 0))
            lines = file.read().split(b"\n")
        step = int(json.loads(lines[-2])["step"])
    except (OSError, ValueError, KeyError, IndexError):
        return 0
    row = study.row(job.row)
    return round((1 - _MEASURING) * job.steps * min(1.0, step / planned_steps(row)))


def megabytes_of(study: Study, job: Job) -> int:
    """Memory that a run takes at most, as far as its ants decide it: in training, and when it is measured."""
    row, size = study.row(job.row), study.size
    measured = max(size.walker_episodes, size.ants) if row.is_walker else size.episodes
    ants = max(row.ppo.num_envs * row.runs_per_seed, measured)
    return _MEGABYTES + ants * ENGINES[row.engine].megabytes


# The processes --------------------------------------------------------------------------------------------------------


def job_command(study: Study, job: Job, core: int | None) -> list[str]:
    """What starts a run."""
    asked = {**_as_json(study), "row": job.row, "seed": job.seed, "core": core}
    return [sys.executable, "-m", "footwork.study.job", json.dumps(asked)]


def _as_json(study: Study) -> dict[str, Any]:
    return {"runs": str(study.runs.resolve()), "size": asdict(study.size)}


def job_environment(base: Mapping[str, str], cache: Path) -> dict[str, str]:
    """One thread for everything, and compiled programs kept for the runs that come after."""
    flags = f"{base.get('XLA_FLAGS', '')} --xla_cpu_multi_thread_eigen=false".strip()
    environment = {**base, "XLA_FLAGS": flags, "OMP_NUM_THREADS": "1"}
    environment.setdefault("JAX_PLATFORMS", "cpu")
    environment.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache))
    environment.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    environment.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
    return environment


def log_path(study: Study, job: Job) -> Path:
    """Where a run's own output goes."""
    return study.runs / "logs" / f"{job.row}-seed-{job.seed}.log"


@dataclass
class _Worker:
    """A process on a core."""

    job: Job
    process: subprocess.Popen[bytes]
    begun: float


def _start(study: Study, job: Job, core: int | None, cache: Path) -> _Worker:
    path = log_path(study, job)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("ab") as output:
        process = subprocess.Popen(
            job_command(study, job, core),
            stdin=subprocess.PIPE,  # never written to: it closes when we are gone
            stdout=output,
            stderr=output,
            env=job_environment(os.environ, cache),
            start_new_session=True,  # Ctrl-C is for the sweep, which asks its runs to stop
        )
    return _Worker(job, process, time.monotonic())


def _reason(study: Study, job: Job, status: int) -> str:
    """Why a run failed: the last line that it wrote."""
    path = log_path(study, job)
    with contextlib.suppress(OSError):
        lines = path.read_text(errors="replace").strip().splitlines()
        if lines:
            return f"{lines[-1]} (exit status {status}, {path})"
    return f"exit status {status}"


def _run_local(board: Board, workers: int, log: Callable[[str], None]) -> None:
    at_work: dict[int, _Worker] = {}
    try:
        with _signals_stop(), _cores(workers) as cores, _display(board, log) as show:
            memory, said = free_megabytes(), False
            while len(board.done) + len(board.failed) < len(board.jobs):
                lacking = _start_ready(board, cores, at_work, memory)
                if lacking and not said:
                    need, free = megabytes_of(board.study, lacking) / 1e3, (memory or 0) / 1e3
                    log(
                        f"{lacking.name}, and perhaps others, waits: it takes {need:.1f} GB, and of the {free:.1f} GB "
                        f"that were free at the start there is not enough memory left beside what runs here"
                    )
                    said = True
                time.sleep(POLL)
                _collect_finished(board, at_work, log)
                show(board)
    except KeyboardInterrupt:
        _stop_all([worker.process for worker in at_work.values()])
        raise _stopped(board) from None
    finally:
        _stop_all([worker.process for worker in at_work.values()])


@contextlib.contextmanager
def _cores(workers: int) -> Iterator[list[int | None]]:
    """The core of each worker, that no other sweep has; None where there are not enough, or they cannot be chosen."""
    available = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    count = workers or len(available) or os.cpu_count() or 1
    place = Path(tempfile.gettempdir()) / f"footwork-cores-{os.getuid()}"
    with contextlib.ExitStack() as held:
        mine: list[int] = []
        with contextlib.suppress(OSError):  # nowhere to say which are taken: the system shares them out
            place.mkdir(exist_ok=True)
            for core in available:
                file = (place / str(core)).open("a")
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    file.close()
                    continue
                held.enter_context(file)
                mine.append(core)
                if len(mine) == count:
                    break
        yield list(mine) if len(mine) == count else [None] * count


def _start_ready(
    board: Board, cores: Sequence[int | None], at_work: dict[int, _Worker], memory: float | None
) -> Job | None:
    """Give every idle core the next run for which there is room beside the others.

    Room is what was free at the start less what this sweep's runs will take, and no more than what is free now: other
    programs, another sweep among them, may have taken some of it since.

    Args:
        board: knows which runs are ready.
        cores: one for each place.
        at_work: by place; those that start are added.
        memory: MB that were free at the start; None where it is not known.

    Returns:
        A run that a core is idle for, but no memory.
    """
    if len(at_work) == len(cores):
        return None
    free, room = free_megabytes(), math.inf
    if memory is not None and free is not None:
        room = min(memory - sum(megabytes_of(board.study, job) for job in board.active), free)
    for place, core in enumerate(cores):
        if place in at_work:
            continue
        ready = list(board.ready())
        job = next((job for job in ready if not at_work or megabytes_of(board.study, job) <= room), None)
        if job is None:
            return ready[0] if ready else None
        room -= megabytes_of(board.study, job)
        at_work[place] = _start(board.study, job, core, board.study.runs / "cache")
        board.begin(job)
    return None


def _collect_finished(board: Board, at_work: dict[int, _Worker], log: Callable[[str], None]) -> None:
    for place, worker in list(at_work.items()):
        status = worker.process.poll()
        if status is None:
            continue
        del at_work[place]
        _settle(board, worker.job, status, time.monotonic() - worker.begun, log)


def _settle(board: Board, job: Job, status: int, seconds: float, log: Callable[[str], None]) -> None:
    if status == 0:
        board.succeed(job)
        log(f"{job.name}: done in {seconds:.0f} s; {board.line()}")
        return
    if (status < 0 or status == STOPPED) and board.killed.get(job, 0) < RETRIES:  # it goes on from its checkpoint
        board.killed[job] = board.killed.get(job, 0) + 1
        board.put_back(job)
        log(f"{job.name}: its process was ended (status {status}); it goes on")
        return
    before = set(board.failed)
    board.fail(job, _reason(board.study, job, status))
    for failed in board.failed.keys() - before:
        log(f"{failed.name}: FAILED: {board.failed[failed]}")


def _stop_all(processes: Sequence[subprocess.Popen[bytes]]) -> None:
    """Ask for an end, wait until everything that can be is saved, and only then insist."""
    for process in processes:
        with contextlib.suppress(OSError):
            process.terminate()
    deadline = time.monotonic() + STOP_WITHIN
    for process in processes:
        try:
            process.wait(max(deadline - time.monotonic(), 0.1))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _stopped(board: Board) -> SweepStopped:
    """What is said when all runs have been stopped."""
    for job in list(board.active):
        board.put_back(job)
    return SweepStopped(f"stopped: {board.line()}; call it again to go on")


@contextlib.contextmanager
def _signals_stop() -> Iterator[None]:
    """SIGTERM means what Ctrl-C means."""

    def stop(number: int, frame: Any) -> None:
        raise KeyboardInterrupt

    try:
        old = signal.signal(signal.SIGTERM, stop)
    except ValueError:  # not in the main thread
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, old)


# What one sees --------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _display(board: Board, log: Callable[[str], None]) -> Iterator[Display]:
    """A live table on a terminal, elsewhere a plain line now and then."""
    if not sys.stdout.isatty():
        shown = [time.monotonic()]

        def plain(board: Board) -> None:
            if time.monotonic() - shown[0] >= PLAIN_EVERY:
                shown[0] = time.monotonic()
                log(board.line())

        yield plain
        return
    from rich.live import Live  # only a terminal needs it

    with Live(board_table(board), refresh_per_second=1, transient=True) as live:
        yield lambda board: live.update(board_table(board))


def board_table(board: Board) -> Any:
    """Rows with something to do or to report: seeds done, how far the running ones are; fits 60 characters."""
    from rich import box
    from rich.table import Table

    table = Table(title=board.line(), title_justify="left", box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    table.add_column("row", overflow="fold")
    for column in ("seeds\ndone", "running", "failed") if board.failed else ("seeds\ndone", "running"):
        table.add_column(column, justify="right", no_wrap=True)
    for row in dict.fromkeys(job.row for job in board.jobs):
        jobs = [job for job in board.jobs if job.row == row]
        running = [job for job in jobs if job in board.active]
        failed = sum(job in board.failed for job in jobs)
        if running or failed:
            shares = (f"seed {job.seed}: {steps_of(board.study, job) / job.steps:4.0%}" for job in running)
            done = sum(job in board.done for job in jobs)
            cells = (f"{done} of {len(jobs)}", "\n".join(shares), str(failed) if failed else "")
            table.add_row(row, *cells[: len(table.columns) - 1])
    return table


# Ray ------------------------------------------------------------------------------------------------------------------


def _run_on_ray(board: Board, workers: int, address: str, log: Callable[[str], None]) -> None:
    """The same processes as tasks of a Ray cluster that shares the folder; Ray decides where they run.

    As many are with Ray as the cluster has cores, so that nodes may come and go; each says what memory it takes,
    so that Ray lets those wait for which no node has room. The task of a node that is lost starts again
    elsewhere, and goes on from the run's checkpoint.
    """
    ray = _connect(address)
    remote = ray.remote(num_cpus=1, max_retries=RETRIES)(run_job)
    at_work: dict[Any, Job] = {}
    try:
        with _signals_stop(), _display(board, log) as show:
            while len(board.done) + len(board.failed) < len(board.jobs):
                places = workers or int(ray.cluster_resources().get("CPU", 0))
                for job in list(islice(board.ready(), max(0, places - len(at_work)))):
                    asked = (_as_json(board.study), job.row, job.seed, job.steps, job.needs)
                    memory = _memory_to_ask_for(board.study, job, ray.nodes())
                    at_work[remote.options(name=job.name, memory=memory).remote(*asked)] = job
                    board.begin(job)
                _collect_tasks(ray, board, at_work, log)
                show(board)
    except KeyboardInterrupt:
        for reference in at_work:
            ray.cancel(reference, force=True)
        raise _stopped(board) from None


def _memory_to_ask_for(study: Study, job: Job, nodes: Iterable[Mapping[str, Any]]) -> int | None:
    """Bytes, at most what the largest node with cores has: where no node has room for a run, the largest tries.

    Small nodes beside it are not asked to hold what they cannot, and a run waits for a lost node that alone could.

    Args:
        study: the run's.
        job: the run.
        nodes: of the cluster, as ``ray.nodes()`` tells them.
    """
    there = [node["Resources"] for node in nodes if node["Alive"] and node["Resources"].get("CPU")]
    largest = max((resources.get("memory", 0) for resources in there), default=0)
    return int(min(megabytes_of(study, job) * 10**6, largest)) or None


def _collect_tasks(ray: Any, board: Board, at_work: dict[Any, Job], log: Callable[[str], None]) -> None:
    if not at_work:
        time.sleep(POLL)  # a cluster without cores, for now
        return
    finished, _ = ray.wait(list(at_work), num_returns=1, timeout=1.0)
    for reference in finished:
        job = at_work.pop(reference)
        try:
            status, seconds = ray.get(reference)
        except ray.exceptions.RayError as error:
            status, seconds = -1, 0.0
            log(f"{job.name}: {str(error).strip().splitlines()[-1]}")
        _settle(board, job, status, seconds, log)


def _connect(address: str) -> Any:
    try:
        import ray
    except ImportError:
        raise ImportError("--launcher ray needs an extra: pip install 'footwork[ray]'") from None
    if ray.is_initialized():
        return ray
    try:
        _knock(address)
        ray.init(address=address, log_to_driver=False, logging_level="ERROR")
    except (OSError, RuntimeError, ValueError) as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise ValueError(f"no Ray cluster answers at {address!r}: {reason}") from None
    return ray


def _knock(address: str) -> None:
    """Refuse a host and port where nobody listens, on which Ray would wait for minutes.

    Raises:
        OSError: nobody answers, or the host is unknown.
        ValueError: the port is no number.
    """
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if colon:
        socket.create_connection((host, int(port)), timeout=5.0).close()


def run_job(study: Mapping[str, Any], row: str, seed: int, steps: int, needs: str | None) -> tuple[int, float]:
    """A run's process on a node of the cluster; its exit status and seconds."""
    begun = time.monotonic()
    job = Job(row, seed, needs, steps)
    here = Study(Path(study["runs"]), Size.from_json(study["size"]))
    cache = Path(tempfile.gettempdir()) / f"footwork-cache-{os.getuid()}"  # of this node: others may have another CPU
    worker = _start(here, job, None, cache)
    try:
        status = worker.process.wait()
    finally:
        _stop_all([worker.process])
    return status, time.monotonic() - begun


__all__ = [
    "Board",
    "SweepStopped",
    "board_table",
    "job_command",
    "job_environment",
    "log_path",
    "run_job",
    "run_study",
    "steps_of",
]
