"""What a study consists of: which runs, how long, how many seeds, in which order.

A run is (row, seed) and lies in ``RUNS/ROW/seed-SEED``. Seed i of a master, or of a
regulariser that needs partners, stands on seed i of its sub-policies: so each seed is
a replication of the whole system, and intervals over seeds hold all of its luck.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import footwork
from footwork import checkpoint
from footwork.evaluate import SWITCHING_PERIODS
from footwork.record import RunError
from footwork.study.claims import rows_read
from footwork.study.experiments import ANTS, GRIDS, find_row, match_rows
from footwork.train import Experiment, planned_steps

STUDY_FILE = "study.json"
_FORMAT = 1


@dataclass(frozen=True)
class Size:
    """How much of everything a study takes.

    Args:
        name: stands on every table, figure and page.
        seeds: of rows that a claim reads.
        other_seeds: of all other rows.
        episodes: per seed, of masters and flat policies.
        walker_episodes: per seed, of sub-policies.
        ants: per seed and period of random switching, and a quarter of it per pair of the hand-over matrix.
        periods: of random switching, control steps.
        short: most control steps of sub-policies (each direction), of symmetric ones, of masters, of flat policies.
    """

    name: str
    seeds: int
    other_seeds: int
    episodes: int
    walker_episodes: int
    ants: int
    periods: tuple[int, ...]
    short: tuple[int, int, int, int] | None = None

    @classmethod
    def from_json(cls, fields: dict[str, Any]) -> Size:
        """The inverse of ``dataclasses.asdict``, whatever JSON made of tuples."""
        given: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in fields.items()}
        return cls(**given)


FULL = Size("full", 10, 3, 200, 64, 128, SWITCHING_PERIODS)
QUICK = Size("quick", 2, 1, 16, 8, 16, (50,), short=(12_288, 24_576, 25_600, 20_480))
SIZES = {size.name: size for size in (FULL, QUICK)}


@dataclass(frozen=True)
class Study:
    """A folder of runs and the size of the study in it."""

    runs: Path
    size: Size = FULL

    def row(self, name: str) -> Experiment:
        """The row as this study trains it.

        Raises:
            ValueError: there is no such row.
        """
        row = find_row(name)
        return row if self.size.short is None else _shortened(row, self.size.short)


@dataclass(frozen=True)
class Job:
    """One run of a study, and the run that must be there first."""

    row: str
    seed: int
    needs: str | None
    steps: int  # control steps of all its learners together

    @property
    def name(self) -> str:
        """What it is called in messages."""
        return f"{self.row} seed {self.seed}"


def _shortened(row: Experiment, most: tuple[int, int, int, int]) -> Experiment:
    """A few updates of the row; schedules end with the run, as they do in the whole one."""
    kind = (1 if row.symmetric else 0) if row.is_walker else 2 if row.is_master else 3
    steps = min(most[kind], row.total_steps)
    anneal = None if row.ppo.anneal_updates is None else max(1, steps // row.ppo.batch_size)
    return replace(row, total_steps=steps, ppo=replace(row.ppo, anneal_updates=anneal))


def default_rows(size: Size) -> list[str]:
    """All rows; of a short study those of the default ant that a claim reads, and the ends of each grid."""
    if size.short is None:
        return match_rows(())
    ends = [f"{grid.name}/{value}" for grid in GRIDS for value in dict.fromkeys((grid.values[0], grid.values[-1]))]
    return [*rows_read(), *ends, "light/walker/plain"]


def plan(study: Study, rows: Iterable[str] = (), seeds: int | None = None) -> list[Job]:
    """The runs of some rows and of all that they stand on, in an order in which they can be made.

    First seed 0 of every row, then seed 1: a study that is stopped early has every row. A row that a claim reads, of
    whichever ant of the table, gets the study's full number of seeds.

    Args:
        study: whose folder and size.
        rows: addresses; none for :func:`default_rows`.
        seeds: of every row, in place of the size's own numbers.

    Raises:
        ValueError: a row is unknown, or ``seeds`` is not >= 1.
    """
    if seeds is not None and seeds < 1:
        raise ValueError(f"seeds must be >= 1, got {seeds}")
    wanted: dict[str, int] = {}
    read = set(rows_read(ANTS))
    for row in tuple(rows) or default_rows(study.size):
        count = seeds or (study.size.seeds if row in read else study.size.other_seeds)
        for name in _with_needed(study, row):
            wanted[name] = max(count, wanted.get(name, 0))
    ordered = list(dict.fromkeys(name for row in wanted for name in _with_needed(study, row)))
    most = max(wanted.values(), default=0)
    return [_job(study, name, seed) for seed in range(most) for name in ordered if seed < wanted[name]]


def _with_needed(study: Study, row: str) -> list[str]:
    """The row, after all that it stands on."""
    needs = study.row(row).needs
    return [*(_with_needed(study, needs) if needs else ()), row]


def _job(study: Study, name: str, seed: int) -> Job:
    row = study.row(name)
    return Job(name, seed, row.needs, planned_steps(row) * row.runs_per_seed)


def mark(study: Study) -> None:
    """Write into the folder which study it holds, or check that it holds this one.

    Raises:
        RunError: it holds a study of another size, its mark is damaged, or runs that no study marked.
    """
    check_mark(study)
    path = study.runs / STUDY_FILE
    if path.is_file():
        return
    study.runs.mkdir(parents=True, exist_ok=True)
    content = {"format": _FORMAT, "size": study.size.name, "footwork": footwork.__version__, "machine": _machine()}
    checkpoint.write_atomically(path, json.dumps(content).encode() + b"\n")


def check_mark(study: Study) -> None:
    """Refuse a folder that holds another study than this one.

    Raises:
        RunError: it holds a study of another size, its mark is damaged, or runs that no study marked.
    """
    if (study.runs / STUDY_FILE).is_file():
        found = read_mark(study.runs)
        if found != study.size:
            held, asked = found.name, study.size.name
            raise RunError(f"{study.runs} holds the {held} study, not the {asked} one: choose another --runs")
    elif study.size.short is not None and any(study.runs.glob("*/**/config.json")):
        raise RunError(f"{study.runs} holds runs of their full length, not of the quick study: choose another --runs")


def read_mark(runs: Path) -> Size:
    """The size of the study in a folder; full where nothing is marked.

    Raises:
        RunError: the mark is damaged, or of a version with other sizes.
    """
    path = runs / STUDY_FILE
    if not path.is_file():
        return FULL
    try:
        content = json.loads(path.read_bytes())
        if content["format"] != _FORMAT:
            raise ValueError
        return SIZES[content["size"]]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        raise RunError(f"{path} is damaged or of another version of footwork") from None


def read_machine(runs: Path) -> str:
    """The machine on which the study there was begun, in words; empty where that is not known."""
    try:
        return str(json.loads((runs / STUDY_FILE).read_bytes()).get("machine", ""))
    except (OSError, ValueError, AttributeError, RecursionError):
        return ""


def _machine() -> str:
    """Processor, cores, memory and system, without names of anybody's."""
    model = platform.processor() or platform.machine()
    with contextlib.suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        model = next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return f"{model}, {os.cpu_count()} cores, {memory:.0f} GiB, {platform.system()}"
