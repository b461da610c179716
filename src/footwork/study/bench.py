"""``footwork bench``: how fast Footwork is beside the physics it stands on and beside what others use.

All contestants run as processes of their own, are started once, and are then asked in turn,
round after round. A figure that compares two of them is the ratio of their rates within
a round, and what is reported is the median over the rounds with the least and the largest: a
machine that slows down for a while so does it to both.
"""

from __future__ import annotations

import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from footwork.record import versions
from footwork.robot import HEAVY
from footwork.study.contest import Contestant, ContestantFailed, Record, Team, closing, usable_cores
from footwork.study.entrants import (
    BATCHED,
    FOUR,
    LIBRARIES,
    MASTER,
    ONE,
    PHYSICS_ALL,
    TASKS,
    UPDATE,
    contestants,
    growth_axes,
    physics_alone,
)

# What the project set out to reach on two cores; (key, at least or at most, number).
TARGETS = (
    ("ratio_sb3_antbullet", ">=", 40.0),
    ("ratio_sb3_antv5", ">=", 30.0),
    ("ratio_physics", ">=", 0.60 if HEAVY.substeps >= 4 else 0.45),
    ("master_over_physics", "<=", 1.25),
    ("start_cold_s", "<=", 12.0),
    ("start_warm_s", "<=", 5.0),
    ("help_s", "<=", 0.4),
    ("time_to_walk_s", "<=", 240.0),
    ("time_to_bandit_s", "<=", 20.0),
)

BUSY = 0.3  # load per core above which a machine has something else to do

Say = Callable[[str], None]


@dataclass
class Bench:
    """A benchmark in progress: what it is to do, and what it knows so far.

    Args:
        quick: fewer rounds, contestants and points.
        learning: also how long learning takes.
        rivals_python: the interpreter that has the other libraries.
        say: told what is being done.
    """

    quick: bool
    learning: bool
    rivals_python: str
    say: Say
    records: dict[str, Record] = field(default_factory=dict)
    growth: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    single: dict[str, float] = field(default_factory=dict)  # measured once: key of the report to number
    complete: bool = False
    begun: float = field(default_factory=time.monotonic)
    load: float = field(default_factory=lambda: os.getloadavg()[0])  # of the machine, before this

    @property
    def rounds(self) -> int:
        """How often every contestant is asked."""
        return 2 if self.quick else 5

    def run(self) -> None:
        """Measure everything; a KeyboardInterrupt ends it early, and what is known stays known."""
        if self.load > BUSY * len(usable_cores()):
            self.say(f"this machine is busy (load {self.load:.1f}): times will be too long, and ratios less sure")
        try:
            with tempfile.TemporaryDirectory(prefix="footwork-bench-") as cache:
                for stage in (self._measure_start, self._compete, self._grow, self._learn):
                    stage(cache)
            self.complete = True
        except ContestantFailed as failure:
            self.say(f"cannot go on: {failure}")
        except KeyboardInterrupt:
            self.say("interrupted: this is what was measured so far")

    def _environ(self, cache: str | None) -> dict[str, str]:
        """Contestants compile everything themselves, but in a quick run, where what one compiled serves the next."""
        return {**os.environ, **cache_settings(cache if self.quick else None)}

    def _measure_start(self, cache: str) -> None:
        """From nothing to the first update, without compiled programs and with them; and the command line alone."""
        self.single["help_s"] = min(time_help() for _ in range(3))  # the first reads the disk
        contestant = next(c for c in contestants(self.quick) if c.name == BATCHED)
        for key in ("start_cold_s", "start_warm_s"):
            self.say(key)
            team = Team(contestant, sys.executable, {**os.environ, **cache_settings(cache)})
            with closing({contestant.name: team}):
                self.single[key] = team.facts["start_s"]
                if key == "start_cold_s":
                    team.sample(0.0)
                    self.single["compile_s"] = team.facts["compile_s"]
                    self.single["peak_mb"] = team.facts["peak_mb"]

    def _compete(self, cache: str) -> None:
        """The rounds."""
        teams: dict[str, Team] = {}
        with closing(teams):
            for contestant in contestants(self.quick):
                self._admit(contestant, teams, self._environ(cache))
            for number in range(self.rounds):
                self.say(f"round {number + 1} of {self.rounds}")
                names = list(teams)
                for name in names[number % len(names) :] + names[: number % len(names)]:
                    self._ask(teams, name, number)

    def _admit(self, contestant: Contestant, teams: dict[str, Team], environ: dict[str, str]) -> None:
        self.say(f"starting {contestant.name}")
        record = self.records.setdefault(contestant.name, Record())
        try:
            teams[contestant.name] = Team(contestant, self.rivals_python, environ)
            record.facts = teams[contestant.name].facts
        except ContestantFailed as failure:
            record.skipped = str(failure)
            self.say(f"skipping {contestant.name}: {failure}")

    def _ask(self, teams: dict[str, Team], name: str, number: int) -> None:
        team, record = teams[name], self.records[name]
        try:
            record.samples[number] = team.sample(team.contestant.seconds / (2 if self.quick else 1))
        except ContestantFailed as failure:
            record.skipped = str(failure)
            self.say(f"going on without {name}: {failure}")
            teams.pop(name).close()

    def _grow(self, cache: str) -> None:
        """How cost grows along each axis, every point beside the engine alone."""
        teams: dict[str, Team] = {}
        with closing(teams):
            teams["reference"] = Team(physics_alone("reference", 1), sys.executable, os.environ.copy())
            for axis, points in growth_axes(self.quick).items():
                for size, contestant in points.items():
                    self.say(f"{axis} {size}")
                    found = self._point(contestant, teams["reference"], self._environ(cache))
                    self.growth.setdefault(axis, []).append({"size": size, **found})

    def _point(self, contestant: Contestant, reference: Team, environ: dict[str, str]) -> dict[str, Any]:
        try:
            team = Team(contestant, sys.executable, environ)
        except ContestantFailed as failure:
            return {"skipped": str(failure)}
        with closing({contestant.name: team}):
            pairs = []
            for _ in range(1 if self.quick else 2):
                alone = reference.sample(1.0)["rate"]
                pairs.append((team.sample(1.0 if self.quick else 2.0)["rate"], alone))
        over = spread([mine / alone for mine, alone in pairs])
        return {"steps_per_second": spread([mine for mine, _ in pairs]), "over_reference": over, **team.facts}

    def _learn(self, cache: str) -> None:
        """From nothing to a walking ant and to a master that finds its goal, where asked for: it takes minutes."""
        if not self.learning:
            return
        for key, row, most in (
            ("time_to_bandit_s", "bandit/hrl/symmetric-interleaved", 300.0),
            ("time_to_walk_s", "walker/plain", 900.0),
        ):
            self.say(key)
            contestant = Contestant(key, ({"kind": "learn", "row": row},))
            team = Team(contestant, sys.executable, {**os.environ, **cache_settings(None)})
            with closing({key: team}):
                answer = team.sample(most)
            if answer["rate"] > 0:  # else it did not get there
                self.single[key] = team.facts["start_s"] + answer["seconds"]

    def report(self) -> dict[str, Any]:
        """Everything known, as JSON."""
        ratios = compare(self.records)
        figures = {**{name: ratio["median"] for name, ratio in ratios.items()}, **self.single}
        keys = dict.fromkeys([*(key for key, _, _ in TARGETS), "update_efficiency", "compile_s", "peak_mb"])
        return {
            **keys,
            **figures,
            "substeps": HEAVY.substeps,
            "complete": self.complete,
            "quick": self.quick,
            "rounds": self.rounds,
            "seconds": time.monotonic() - self.begun,
            "machine": {**machine(), "load": round(self.load, 2)},
            "versions": versions(),
            "ratios": ratios,
            "targets": {
                key: {"asked": f"{sign} {bound:g}", "reached": _reached(figures.get(key), sign, bound)}
                for key, sign, bound in TARGETS
            },
            "contestants": {name: describe(record) for name, record in self.records.items()},
            "growth": self.growth,
        }


def time_help() -> float:
    """Seconds that the command line alone takes to answer."""
    begun = time.perf_counter()
    subprocess.run([sys.executable, "-m", "footwork", "--help"], capture_output=True, check=True)
    return time.perf_counter() - begun


def cache_settings(folder: str | None) -> dict[str, str]:
    """Environment that makes JAX keep what it compiled in ``folder``, all of it, or keep nothing."""
    if folder is None:
        return {"JAX_ENABLE_COMPILATION_CACHE": "false"}
    return {
        "JAX_ENABLE_COMPILATION_CACHE": "true",
        "JAX_COMPILATION_CACHE_DIR": folder,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }


def spread(values: list[float]) -> dict[str, Any]:
    """Median, least and largest of what was measured."""
    return {"median": statistics.median(values), "low": min(values), "high": max(values), "values": values}


def ratio(above: dict[int, float], below: dict[int, float]) -> dict[str, Any] | None:
    """The spread of a ratio, taken within each round that has both; None where there is none."""
    values = [above[number] / below[number] for number in sorted(above.keys() & below.keys())]
    return spread(values) if values else None


def compare(records: dict[str, Record]) -> dict[str, dict[str, Any]]:
    """The ratios that the report is about; those whose contestants were not measured are left out."""
    series = {name: record.series() for name, record in records.items()}
    four = series.get(FOUR, {})
    found = {
        "ratio_physics": ratio(four, series.get(PHYSICS_ALL, {})),
        "ratio_one_run": ratio(four, series.get(ONE, {})),
        "ratio_batched": ratio(four, series.get(BATCHED, {})),
    }
    for key, task in TASKS.items():
        for library in LIBRARIES:
            together = {name: s for name, s in series.items() if name.startswith(f"{library} {task}") and s}
            alone = {name: s for name, s in together.items() if not name.endswith("a run per core")}
            found[f"ratio_{library}_{key}"] = ratio(four, best(alone))
            found[f"ratio_{library}_{key}_a_run_per_core"] = ratio(four, best(together))
    if MASTER in records:
        found["master_over_physics"] = _spread_of(records[MASTER].series("over_engine"))
    if UPDATE in records:
        found["update_efficiency"] = _spread_of(records[UPDATE].series("efficiency"))
    return {name: value for name, value in found.items() if value is not None}


def best(series: dict[str, dict[int, float]]) -> dict[int, float]:
    """The setting that is fastest in the median; the others' rounds are left out."""
    return max(series.values(), key=lambda rates: statistics.median(rates.values()), default={})


def _spread_of(series: dict[int, float]) -> dict[str, Any] | None:
    return spread(list(series.values())) if series else None


def _reached(value: float | None, sign: str, bound: float) -> bool | None:
    if value is None:
        return None
    return value >= bound if sign == ">=" else value <= bound


def describe(record: Record) -> dict[str, Any]:
    """A contestant's own figures."""
    found: dict[str, Any] = {**record.facts}
    if record.skipped is not None:
        found["skipped"] = record.skipped
    names = {"steps_per_second": "rate", "decisions_per_second": "decisions", "over_engine": "over_engine"}
    for key, name in {**names, "flops": "flops", "product_flops": "product_flops"}.items():
        if series := record.series(name):
            found[key] = spread(list(series.values()))
    return found


def machine() -> dict[str, Any]:
    """What it was measured on."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return {
        "processor": _processor(),
        "cores": len(usable_cores()),
        "memory_gb": round(memory, 1),
        "system": f"{platform.system()} {platform.machine()}",
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
