"""Contestants of ``footwork bench`` seen from outside: processes that are started once and asked in turn.

Nothing heavy is imported here: the one who asks must not disturb those who run.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from footwork.study import rivals

ANSWER_SECONDS = 900.0  # after which a silent contestant is given up


@dataclass(frozen=True)
class Contestant:
    """What is measured: one process, or one per core that are asked at the same time and whose rates add up.

    Args:
        name: its address in the report.
        specs: the arguments of each process.
        threads: per process; 0 means all cores. Processes of one thread have a core each to themselves.
        rival: somebody else's learner, in the interpreter that has it.
        seconds: how long a sample takes at least.
    """

    name: str
    specs: tuple[dict[str, Any], ...]
    threads: int = 0
    rival: bool = False
    seconds: float = 3.0


@dataclass
class Record:
    """All that was learned of a contestant."""

    facts: dict[str, float] = field(default_factory=dict)  # start_s, compile_s, peak_mb
    samples: dict[int, dict[str, float]] = field(default_factory=dict)  # by round
    skipped: str | None = None  # why it does not take part

    def series(self, name: str = "rate") -> dict[int, float]:
        """One figure of every round in which it was measured."""
        return {number: sample[name] for number, sample in self.samples.items() if name in sample}


class ContestantFailed(RuntimeError):
    """A contestant's process ended, was silent too long, or lacks a library; the message is for the report."""


class Team:
    """The running processes of one contestant."""

    def __init__(self, contestant: Contestant, python: str, environ: dict[str, str]):
        self.contestant = contestant
        begun = time.perf_counter()
        cores = usable_cores()
        self._processes: list[_Process] = []
        try:
            for number, spec in enumerate(contestant.specs):
                self._processes.append(_Process(contestant, spec, python, environ, cores[number % len(cores)]))
            ready = [process.answer() for process in self._processes]
        except BaseException:
            self.close()
            raise
        self.facts = {
            "start_s": time.perf_counter() - begun,
            "peak_mb": sum(answer["peak_mb"] for answer in ready),
        }

    def sample(self, seconds: float) -> dict[str, float]:
        """Ask all processes at once; their rates and memory add up, what is compiled side by side does not."""
        for process in self._processes:
            process.ask(seconds)
        answers = [process.answer() for process in self._processes]
        self.facts["peak_mb"] = sum(answer["peak_mb"] for answer in answers)
        if "compile_s" in answers[0]:
            self.facts["compile_s"] = max(answer["compile_s"] for answer in answers)
        return _added(answers)

    def close(self) -> None:
        """End these processes and their children."""
        for process in self._processes:
            process.close()


def _added(answers: Sequence[dict[str, float]]) -> dict[str, float]:
    rates = {"rate": sum(a["steps"] / a["seconds"] for a in answers), "seconds": max(a["seconds"] for a in answers)}
    if answers[0].get("decisions"):
        rates["decisions"] = sum(a["decisions"] / a["seconds"] for a in answers)
    if answers[0].get("engine_s"):
        rates["over_engine"] = sum(a["seconds"] for a in answers) / sum(a["engine_s"] for a in answers)
    if "flops" in answers[0]:
        rates["flops"], rates["product_flops"] = answers[0]["flops"], answers[0]["product_flops"]
        rates["efficiency"] = rates["flops"] / rates["product_flops"]
    return rates


class _Process:
    """One process of a contestant; it speaks the lines of :func:`footwork.study.rivals.serve`."""

    def __init__(self, contestant: Contestant, spec: dict[str, Any], python: str, environ: dict[str, str], core: int):
        one = contestant.threads == 1
        self._complaints = tempfile.TemporaryFile()  # noqa: SIM115 - closed in close(); a pipe would fill up
        self._popen = subprocess.Popen(
            _command(contestant, spec, python),
            env={**environ, **(_one_thread() if one else {}), "JAX_PLATFORMS": "cpu"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._complaints,
            text=True,
            start_new_session=True,  # Ctrl-C is for the one who asks
        )
        if one and hasattr(os, "sched_setaffinity"):
            with contextlib.suppress(ProcessLookupError):
                os.sched_setaffinity(self._popen.pid, {core})

    def ask(self, seconds: float) -> None:
        assert self._popen.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # the answer will tell
            self._popen.stdin.write(f"{seconds}\n")
            self._popen.stdin.flush()

    def answer(self) -> dict[str, float]:
        """The next line that it says."""
        assert self._popen.stdout is not None
        watchdog = threading.Timer(ANSWER_SECONDS, self._popen.kill)
        watchdog.start()
        try:
            line = self._popen.stdout.readline()
        finally:
            watchdog.cancel()
        if not line:
            raise ContestantFailed(self._last_words())
        answer = json.loads(line)
        if "absent" in answer:
            raise ContestantFailed(f"{answer['absent']} is not installed")
        return answer

    def _last_words(self) -> str:
        status = self._popen.wait()
        self._complaints.seek(0)
        lines = self._complaints.read().decode(errors="replace").strip().splitlines()
        return f"ended with status {status}: {lines[-1] if lines else 'no message'}"

    def close(self) -> None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._popen.pid, signal.SIGKILL)  # its own group: it was started in a session of its own
        self._popen.wait()
        for stream in (self._popen.stdin, self._popen.stdout, self._complaints):
            if stream is not None:
                with contextlib.suppress(BrokenPipeError):
                    stream.close()


def _command(contestant: Contestant, spec: dict[str, Any], python: str) -> list[str]:
    if contestant.rival:
        return [python, "-P", str(Path(rivals.__file__)), json.dumps(spec)]
    return [sys.executable, "-m", "footwork.study.workers", json.dumps(spec)]


def _one_thread() -> dict[str, str]:
    """Environment of a process that is to use one thread."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_multi_thread_eigen=false".strip()
    pools = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    return {"XLA_FLAGS": flags, **dict.fromkeys(pools, "1")}


@contextlib.contextmanager
def closing(teams: dict[str, Team]) -> Iterator[None]:
    """End whoever still runs."""
    try:
        yield
    finally:
        for team in teams.values():
            team.close()


def usable_cores() -> list[int]:
    """The cores this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))
