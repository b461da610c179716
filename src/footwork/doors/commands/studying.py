"""The study: its speed, its runs, its figures and its report."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from footwork.doors.commands import say


@dataclass(frozen=True)
class Bench:
    """Measure how fast all this is on this machine: beside the physics alone, and beside what others use.

    Takes some ten minutes of a machine that has nothing else to do. Other libraries come
    with the extra footwork[bench]; those that are not installed are skipped by name.
    """

    quick: bool = False  # about two minutes: fewer rounds, contestants and points
    learning: bool = False  # also how long it takes to learn to walk, and to find the goal: minutes more
    json: bool = False  # print JSON instead of tables
    to: Path = Path("bench")  # where report.json and bench.png are left
    rivals_python: str | None = None  # an interpreter that has the other libraries; default: this one

    def run(self) -> int:
        """Measure, print, and leave report and picture; 130 if it was interrupted."""
        from footwork.checkpoint import write_atomically
        from footwork.doors import tables  # all of it now: whoever presses Ctrl-C will not wait
        from footwork.study import bench, figures

        python = self.rivals_python or sys.executable
        work = bench.Bench(self.quick, self.learning, python, say)
        work.run()
        report = work.report()
        text = json.dumps(report, indent=2)
        if self.json:
            print(text)
        else:
            tables.show(*tables.bench_tables(report))
        self.to.mkdir(parents=True, exist_ok=True)
        write_atomically(self.to / "report.json", text.encode() + b"\n")
        say(f"wrote {figures.bench_figure(self.to / 'bench.png', report)}")
        return 0 if work.complete else 130


@dataclass(frozen=True)
class Reproduce:
    """Run the whole study, every run on a core of its own, and write the report; called again, it goes on.

    A finished run is not run again, a killed one continues. Seed i of a master stands on seed i of its sub-policies.
    """

    runs: Path | None = None  # where runs are kept; default: runs, or runs-quick
    to: Path | None = None  # where the report goes; default: report, or report-quick
    rows: tuple[str, ...] = ()  # addresses or patterns such as 'maze/*'; default: the whole table
    seeds: int | None = None  # of every row; default: 10 where a claim reads the row, else 3
    quick: bool = False  # the same in small: runs of a few updates, few seeds, the ends of each ablation
    workers: int = 0  # runs at once; 0: one per core
    launcher: str = "local"  # or ray (extra footwork[ray]): the same runs on a cluster that shares the folder
    address: str = "auto"  # of the Ray cluster
    plan: bool = False  # show what would be run, and stop

    def run(self) -> int:
        """Run what is missing, and report."""
        from footwork.doors import study

        return study.reproduce(self)


@dataclass(frozen=True)
class Figures:
    """Draw figures of the study, from files alone: all, or those that are named (5, or 05-maze-reward)."""

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    runs: Path = Path("runs")  # where runs are kept, or results/ of a report
    to: Path = Path("figures")
    under: str = ""  # another engine or ant, such as light: the same figures of the rows under it
    any_length: bool = False  # let runs of another length than their row's count too

    def run(self) -> int:
        """Draw."""
        from footwork.doors import study

        return study.figures(self.names, self.runs, self.to, self.under, self.any_length)


@dataclass(frozen=True)
class Report:
    """Write the report of the runs that are there: claims, figures, rows, and what was left out."""

    runs: Path = Path("runs")  # where runs are kept, or results/ of a report
    to: Path = Path("report")
    any_length: bool = False  # let runs of another length than their row's count too

    def run(self) -> int:
        """Write."""
        from footwork.doors import study

        return study.report(self.runs, self.to, self.any_length)
