"""``footwork parity`` at the command line."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path


@dataclass(frozen=True)
class Parity:
    """Measure how far the engines agree: bodies, single steps, random torque, hand-overs, speed; and write a report.

    Engines that are not installed are skipped by name (extras footwork[bullet], footwork[mjx]).
    """

    to: Path = Path("parity")  # where parity.json, the pictures and PARITY.md are left
    quick: bool = False  # little of everything: minutes
    states: int | None = None  # per arena, from which C and MJX each take a step; default: 10240, or 128 with --quick
    curves: Path | None = None  # a folder of runs: learning curves of walker/plain on each engine, and their transfer


def parity(command: Parity, rest: list[str]) -> int:
    """Measure, and write the report of what is known; 130 if it was interrupted."""
    if command.states is not None and command.states < 1:
        raise ValueError(f"states must be >= 1, got {command.states}")
    if command.curves is not None and not command.curves.is_dir():
        raise ValueError(f"there is no folder of runs at {command.curves}")
    if command.to.exists() and not command.to.is_dir():
        raise ValueError(f"{command.to} is not a folder")
    from footwork.study.parity import FULL, QUICK
    from footwork.study.parity import Parity as Work
    from footwork.study.parity_page import write_parity

    size = QUICK if command.quick else FULL
    size = size if command.states is None else replace(size, states=command.states)
    work = Work(size, command.curves, lambda line: print(line, file=sys.stderr, flush=True))
    work.run()
    for path in write_parity(work.found, command.to):
        print(f"wrote {path}")
    return 0 if work.complete else 130
