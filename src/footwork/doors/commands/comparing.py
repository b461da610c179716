"""The engines beside each other."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from footwork.doors.commands import say


@dataclass(frozen=True)
class Parity:
    """Measure how far the engines agree: bodies, single steps, random torque, hand-overs, speed; and write a report.

    Engines that are not installed are skipped by name (extras footwork[bullet], footwork[mjx]).
    """

    to: Path = Path("parity")  # where parity.json, the pictures and PARITY.md are left
    quick: bool = False  # little of everything: minutes
    states: int | None = None  # per arena, from which C and MJX each take a step; default: 10240, or 128 with --quick
    curves: Path | None = None  # a folder of runs: learning curves of walker/plain on each engine, and their transfer

    def run(self) -> int:
        """Measure, and write the report of what is known; 130 if it was interrupted."""
        if self.states is not None and self.states < 1:
            raise ValueError(f"states must be >= 1, got {self.states}")
        if self.curves is not None and not self.curves.is_dir():
            raise ValueError(f"there is no folder of runs at {self.curves}")
        if self.to.exists() and not self.to.is_dir():
            raise ValueError(f"{self.to} is not a folder")
        from footwork.study import parity
        from footwork.study.parity_page import write_parity

        size = parity.QUICK if self.quick else parity.FULL
        size = size if self.states is None else replace(size, states=self.states)
        work = parity.Parity(size, self.curves, say)
        work.run()
        for path in write_parity(work.found, self.to):
            print(f"wrote {path}")
        return 0 if work.complete else 130
