"""Runs: what can be trained, training it, measuring it, giving it away."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from footwork.doors.commands import say

if TYPE_CHECKING:
    from footwork.train import Experiment, Trained

RowName = Annotated[str, tyro.conf.Positional]


@dataclass(frozen=True)
class List:
    """Show the table: every row that can be trained."""

    runs: Path = Path("runs")  # where runs are kept
    all: bool = False  # a line for every row of an ablation too

    def run(self) -> int:
        """Print the table."""
        from footwork.doors import tables
        from footwork.physics import ENGINES
        from footwork.study.experiments import EXPERIMENTS, find_row
        from footwork.study.runs import finished_runs, packaged, passed_over

        elsewhere = [f"{engine}/{name}" for engine in ENGINES for name in EXPERIMENTS if (self.runs / engine).is_dir()]
        runs = {name: len(finished_runs(name, self.runs)) for name in (*EXPERIMENTS, *elsewhere)}
        rows = [find_row(name) for name in runs if name in EXPERIMENTS or runs[name]]
        found = {row: f"{n} runs" if n else "packaged" if packaged(row).is_file() else "" for row, n in runs.items()}
        for name in runs:
            if others := sum(map(len, passed_over(find_row(name), self.runs))):
                found[name] = f"{found[name]} ({others} unfinished or unusable)".strip()
        tables.show(tables.rows_table(rows, found, self.all))
        return 0


@dataclass(frozen=True)
class Train:
    """Train a row. What it needs first is taken from runs or the package, else trained first.

    Any field of the row can be changed, for example `--ppo.learning-rate 1e-3`,
    `--total-steps 100000` or `--regulariser.steps 20`; `footwork train ROW --fields` lists them.
    """

    row: RowName  # its address, as `footwork list` shows it
    seeds: tuple[int, ...] = (0,)  # trained side by side in one batch
    engine: str | None = None  # the physics: mujoco, mjx, bullet or bullet-original; ROW then means ENGINE/ROW
    robot: str | None = None  # another ant: heavy, bullet, stiff or light
    maze: str | None = None  # another maze: a name, or a text file of rows of # . r g
    runs: Path = Path("runs")  # where runs are kept
    name: str | None = None  # folder of this run below its row's; default: the seeds
    resume: bool = False  # go on with a run that was stopped
    threads: int = 0  # of the physics; 0: all cores. Changes no number
    tensorboard: bool = False  # also write event files (extra footwork[tb])
    fields: bool = False  # list the fields of the row and stop

    def run(self, rest: list[str]) -> int:
        """Train; ``rest`` are the options that name fields of the row."""
        from footwork.record import config_to_json
        from footwork.study.runs import place_of, stands_on, train_row

        experiment = self._customised(rest)
        if self.fields:
            print(json.dumps(config_to_json(experiment), indent=2))
            return 0
        if any(option.startswith(("--total-steps", "--total_steps")) for option in rest):
            _say_rounding(experiment)
        seeds, physics_threads = tuple(self.seeds), self.threads
        place = place_of(self.runs, experiment, seeds, self.name)
        if self.resume and not (place / "config.json").is_file():
            say(f"{experiment.name}: nothing to resume in {place}: it begins there")
        trained = train_row(experiment, seeds, self.runs, self.name, self.resume, physics_threads, self.tensorboard)
        below = stands_on(trained)
        stands = "" if below is None else f", trained on those of {experiment.needs}: {below}"
        print(f"{experiment.name}: finished; policies in {trained.source}{stands}")
        return 0

    def _customised(self, rest: list[str]) -> Experiment:
        """The row with the robot, the maze and the fields that the command line asks for."""
        from dataclasses import replace

        from footwork.robot import ROBOTS
        from footwork.study.experiments import find_row, read_maze, with_engine, with_robot

        experiment = find_row(self.row)
        if self.engine is not None:
            experiment = with_engine(experiment, self.engine)
        if self.robot is not None:
            if self.robot not in ROBOTS:
                raise ValueError(f"unknown robot {self.robot!r}; known robots: {', '.join(ROBOTS)}")
            experiment = with_robot(experiment, ROBOTS[self.robot])
        if self.maze is not None:
            experiment = replace(experiment, task=replace(experiment.task, arena=read_maze(self.maze)))
        if not rest:
            return experiment
        prog, config = f"footwork train {self.row}", (tyro.conf.AvoidSubcommands,)  # the row has chosen its regulariser
        return tyro.cli(type(experiment), default=experiment, args=rest, prog=prog, config=config)


@dataclass(frozen=True)
class Evaluate:
    """Play episodes with a trained row: success at four radii, falls, flips, progress, time to goal."""

    row: RowName  # its address, as `footwork list` shows it, or the folder of a run
    runs: Path = Path("runs")  # where runs are kept; a row not found there comes from the package
    engine: str | None = None  # play on another physics than it was trained on: mujoco, mjx, bullet or bullet-original
    episodes: int = 1000  # per seed
    episode_steps: int | None = None  # control steps to the end of an episode; default: as many as in its training
    seed: int = 1_000_003  # of the episodes
    deterministic: bool = False  # act by the mode of the distribution instead of a sample
    threads: int = 0  # of the physics; 0: all cores. Changes no number
    json: bool = False  # print JSON instead of a table

    def run(self) -> int:
        """Evaluate, and print the figures."""
        from footwork.doors import tables
        from footwork.evaluate import evaluate
        from footwork.study.runs import find_needed, find_trained, which_policies

        trained = find_trained(self.row, self.runs)
        needed = find_needed(trained, self.runs)
        trained = _played_on(trained, self.engine, self.episode_steps)
        say(which_policies(trained))
        _at_least_one("episodes", self.episodes)
        report = evaluate(trained, needed, self.episodes, self.seed, self.deterministic, self.threads)
        if self.json:
            print(json.dumps(report))
        else:
            tables.show(tables.evaluation_table([report]))
        return 0


@dataclass(frozen=True)
class Transitions:
    """Test hand-overs between sub-policies: the 4 x 4 matrix, and random switching."""

    row: RowName  # a walker row, or the folder of a run of one
    runs: Path = Path("runs")  # where runs are kept; a row not found there comes from the package
    engine: str | None = None  # play on another physics than it was trained on: mujoco, mjx, bullet or bullet-original
    orthogonal: bool = False  # switch at right angles only
    ants: int = 256  # per period of switching, and a quarter of it per pair of the matrix
    seed: int = 1_000_003  # of the episodes
    deterministic: bool = False  # act by the mode of the distribution instead of a sample
    threads: int = 0  # of the physics; 0: all cores. Changes no number
    json: bool = False  # print JSON instead of tables

    def run(self) -> int:
        """Measure, and print the figures."""
        from footwork.doors import tables
        from footwork.evaluate import transitions
        from footwork.study.runs import find_trained, which_policies

        trained = _played_on(find_trained(self.row, self.runs), self.engine)
        say(which_policies(trained))
        _at_least_one("ants", self.ants)
        report = transitions(
            trained,
            self.ants,
            self.seed,
            self.deterministic,
            self.threads,
            orthogonal=self.orthogonal,
            report=say,
        )
        if self.json:
            print(json.dumps(report))
        else:
            tables.show(tables.handover_table(report), tables.switching_table(report))
        return 0


@dataclass(frozen=True)
class Quickstart:
    """Train a master on AntMaze from packaged sub-policies, and show what it learned."""

    to: Path = Path("quickstart")  # where table, pictures and the run are left
    seed: int = 0
    steps: int | None = None  # control steps; default: the quickstart's own
    threads: int = 0  # of the physics; 0: all cores. Changes no number

    def run(self) -> int:
        """Train, evaluate, draw."""
        from footwork.doors.quickstart import quickstart

        quickstart(self.to, self.seed, self.steps, self.threads)
        return 0


@dataclass(frozen=True)
class Export:
    """Write a row's policies into a folder with a model card; the folder is then as good as a row's name."""

    row: RowName  # its address, as `footwork list` shows it
    to: Path  # a folder that does not exist yet
    runs: Path = Path("runs")  # where runs are kept; a row not found there comes from the package
    episodes: int = 1000  # per seed, for the figures of the card
    seed: int = 1_000_003  # of the episodes
    onnx: bool = False  # also write ONNX files (extra footwork[onnx])
    threads: int = 0  # of the physics; 0: all cores. Changes no number

    def run(self) -> int:
        """Write the folder."""
        from footwork.doors.export import export

        _at_least_one("episodes", self.episodes)
        card = export(self.row, self.to, self.runs, self.episodes, self.seed, self.threads, self.onnx, say)
        print(f"{self.row}: exported; the model card is {card}")
        return 0


def _played_on(trained: Trained, engine: str | None, episode_steps: int | None = None) -> Trained:
    """The same policies on another physics, in episodes of another length."""
    from dataclasses import replace

    from footwork.physics import require_engine

    experiment = trained.experiment if engine is None else replace(trained.experiment, engine=engine)
    require_engine(experiment.engine, experiment.task.robot)
    if episode_steps is not None:
        experiment = replace(experiment, task=replace(experiment.task, episode_steps=episode_steps))
    return trained._replace(experiment=experiment)


def _say_rounding(experiment: Experiment) -> None:
    """How many control steps a run takes that was asked for a number which is not one of whole iterations."""
    from footwork.train import planned_steps, steps_per_iteration

    steps, one = planned_steps(experiment), steps_per_iteration(experiment)
    if steps != experiment.total_steps:
        say(f"{experiment.name}: takes {steps:,} control steps, whole iterations of {one:,}")


def _at_least_one(name: str, value: int) -> None:
    if value < 1:
        raise ValueError(f"{name} must be >= 1, got {value}")
