"""The command line: ``footwork list | train | evaluate | transitions | quickstart | replay | video | play``.

Only what a command needs is imported, and only once it is known which command it is:
``footwork --help`` answers at once.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

if TYPE_CHECKING:
    from footwork.train import Experiment

RowName = Annotated[str, tyro.conf.Positional]
RowNames = Annotated[tuple[str, ...], tyro.conf.Positional]


@dataclass(frozen=True)
class List:
    """Show the table: every row that can be trained."""

    runs: Path = Path("runs")  # where runs are kept


@dataclass(frozen=True)
class Train:
    """Train a row. What it needs first is taken from runs or the package, else trained first.

    Any field of the row can be changed, for example `--ppo.learning-rate 1e-3`,
    `--total-steps 100000` or `--regulariser.steps 20`; `footwork train ROW --fields` lists them.
    """

    row: RowName  # its address, as `footwork list` shows it
    seeds: tuple[int, ...] = (0,)  # trained side by side in one batch
    robot: str | None = None  # another ant: heavy, bullet, stiff or light
    maze: str | None = None  # another maze: a name, or a text file of rows of # . r g
    runs: Path = Path("runs")  # where runs are kept
    name: str | None = None  # folder of this run below its row's; default: the seeds
    resume: bool = False  # go on with a run that was stopped
    threads: int = 0  # of the physics; 0: all cores. Changes no number
    tensorboard: bool = False  # also write event files (extra footwork[tb])
    fields: bool = False  # list the fields of the row and stop


@dataclass(frozen=True)
class Evaluate:
    """Play episodes with a trained row: success at four radii, falls, flips, progress, time to goal."""

    row: RowName  # its address, as `footwork list` shows it
    runs: Path = Path("runs")  # where runs are kept; a row not found there comes from the package
    episodes: int = 1000  # per seed
    seed: int = 1_000_003  # of the episodes
    deterministic: bool = False  # act by the mode of the distribution instead of a sample
    threads: int = 0  # of the physics; 0: all cores. Changes no number
    json: bool = False  # print JSON instead of a table


@dataclass(frozen=True)
class Transitions:
    """Test hand-overs between sub-policies: the 4 x 4 matrix, and random switching."""

    row: RowName  # a walker row
    runs: Path = Path("runs")  # where runs are kept; a row not found there comes from the package
    ants: int = 256  # per period of switching, and a quarter of it per pair of the matrix
    seed: int = 1_000_003  # of the episodes
    deterministic: bool = False  # act by the mode of the distribution instead of a sample
    threads: int = 0  # of the physics; 0: all cores. Changes no number
    json: bool = False  # print JSON instead of tables


@dataclass(frozen=True)
class Quickstart:
    """Train a master on AntMaze from packaged sub-policies, and show what it learned."""

    to: Path = Path("quickstart")  # where table, pictures and the run are left
    seed: int = 0
    steps: int | None = None  # control steps; default: the quickstart's own
    threads: int = 0  # of the physics; 0: all cores. Changes no number


@dataclass(frozen=True)
class Replay:
    """Write an HTML page that shows the ant in 3-D: play, scrub, follow. It opens from disk and fetches nothing."""

    rows: RowNames  # rows or run directories; several are shown side by side
    to: Annotated[Path, tyro.conf.arg(aliases=("-o",))] = Path("ant.html")  # the page
    runs: Path = Path("runs")  # where runs are kept; a row not found there comes from the package
    episodes: int = 1  # of each row; of sub-policies, in each direction
    seed: int = 0  # of the episodes
    steps: int | None = None  # control steps to show of each episode; default: all
    deterministic: bool = False  # act by the mode of the distribution instead of a sample
    threads: int = 0  # of the physics; 0: all cores. Changes no number


@dataclass(frozen=True)
class Video:
    """Write a video of the ant: .mp4 (extra footwork[video]), .webp or .gif."""

    rows: RowNames  # rows or run directories; several are shown side by side
    to: Annotated[Path, tyro.conf.arg(aliases=("-o",))] = Path("ant.webp")  # the file; its ending says which kind
    runs: Path = Path("runs")  # where runs are kept; a row not found there comes from the package
    episodes: int = 1  # of each row, side by side; of sub-policies, in each direction
    seed: int = 0  # of the episodes
    steps: int | None = None  # control steps to show of each episode; default: all
    deterministic: bool = False  # act by the mode of the distribution instead of a sample
    threads: int = 0  # of the physics; 0: all cores. Changes no number
    camera: Literal["follow", "arena", "above"] = "follow"
    width: int = 640  # px, of each episode
    height: int = 480  # px
    fps: int = 30
    speed: float = 1.0  # seconds of the ant per second of video
    quality: int = 80  # 1..100


@dataclass(frozen=True)
class Play:
    """Serve a page where one watches a master, is the master, draws a maze and lets a master learn it."""

    row: RowName = "maze/hrl/symmetric-interleaved"  # a master, or its run directory
    runs: Path = Path("runs")  # where runs are kept; a row not found there comes from the package
    host: str = "127.0.0.1"  # other addresses open the page to other machines
    port: int = 8765  # 0: any free one
    seats: int = 2  # visitors at once, each with ants of their own; others wait
    lesson_steps: int = 1_000_000  # control steps of a master that learns on the page


def main() -> None:
    """The entry point."""
    sys.exit(run(sys.argv[1:]))


def run(arguments: list[str]) -> int:
    """Run one command; what a user can mend is one line on stderr and exit status 1, 130 for an interrupt."""
    commands: Any = List | Train | Evaluate | Transitions | Quickstart | Replay | Video | Play
    chosen, rest = tyro.cli(commands, args=arguments, prog="footwork", return_unknown_args=True)
    if rest and not isinstance(chosen, Train):
        print(f"footwork: unknown options: {' '.join(rest)}; see footwork {arguments[0]} --help", file=sys.stderr)
        return 2
    actions: dict[type, Callable[..., int]] = {
        List: _list,
        Train: _train,
        Evaluate: _evaluate,
        Transitions: _transitions,
        Quickstart: _quickstart,
        Replay: _replay,
        Video: _video,
        Play: _play,
    }
    try:
        return actions[type(chosen)](chosen, rest)
    except KeyboardInterrupt:
        print("footwork: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        sys.stderr.close()
        return 0
    except Exception as error:
        if not _is_for_the_user(error):
            raise
        print(f"footwork: {error}", file=sys.stderr)
        return 130 if type(error).__name__ == "Interrupted" else 1


def _is_for_the_user(error: Exception) -> bool:
    from footwork.train import Interrupted, TrainingDiverged

    return isinstance(error, ValueError | OSError | ImportError | Interrupted | TrainingDiverged)


def _list(command: List, rest: list[str]) -> int:
    from footwork.doors import tables
    from footwork.study.experiments import EXPERIMENTS
    from footwork.study.runs import finished_runs, packaged

    found = {
        name: f"{len(finished_runs(name, command.runs))} runs"
        if finished_runs(name, command.runs)
        else ("packaged" if packaged(name).is_file() else "")
        for name in EXPERIMENTS
    }
    tables.show(tables.rows_table(list(EXPERIMENTS.values()), found))
    return 0


def _train(command: Train, rest: list[str]) -> int:
    from footwork.study.runs import train_row

    experiment = _customised(command, rest)
    if command.fields:
        from footwork.record import config_to_json

        print(json.dumps(config_to_json(experiment), indent=2))
        return 0
    trained = train_row(
        experiment,
        tuple(command.seeds),
        command.runs,
        command.name,
        command.resume,
        command.threads,
        command.tensorboard,
    )
    print(f"{experiment.name}: finished; policies in {trained.source}")
    return 0


def _customised(command: Train, rest: list[str]) -> Experiment:
    """The row with the robot, the maze and the fields that the command line asks for."""
    from dataclasses import replace

    from footwork.robot import ROBOTS
    from footwork.study.experiments import find_row, read_maze, with_robot

    experiment = find_row(command.row)
    if command.robot is not None:
        if command.robot not in ROBOTS:
            raise ValueError(f"unknown robot {command.robot!r}; known robots: {', '.join(ROBOTS)}")
        experiment = with_robot(experiment, ROBOTS[command.robot])
    if command.maze is not None:
        experiment = replace(experiment, task=replace(experiment.task, arena=read_maze(command.maze)))
    if not rest:
        return experiment
    prog, config = f"footwork train {command.row}", (tyro.conf.AvoidSubcommands,)  # the row has chosen its regulariser
    return tyro.cli(type(experiment), default=experiment, args=rest, prog=prog, config=config)


def _evaluate(command: Evaluate, rest: list[str]) -> int:
    from footwork.doors import tables
    from footwork.evaluate import evaluate
    from footwork.study.runs import find_needed, find_trained

    trained = find_trained(command.row, command.runs)
    needed = find_needed(trained, command.runs)
    _at_least_one("episodes", command.episodes)
    report = evaluate(trained, needed, command.episodes, command.seed, command.deterministic, command.threads)
    if command.json:
        print(json.dumps(report))
    else:
        tables.show(tables.evaluation_table([report]))
    return 0


def _transitions(command: Transitions, rest: list[str]) -> int:
    from footwork.doors import tables
    from footwork.evaluate import transitions
    from footwork.study.runs import find_trained

    trained = find_trained(command.row, command.runs)
    _at_least_one("ants", command.ants)
    report = transitions(
        trained,
        command.ants,
        command.seed,
        command.deterministic,
        command.threads,
        report=lambda line: print(line, file=sys.stderr),
    )
    if command.json:
        print(json.dumps(report))
    else:
        tables.show(tables.handover_table(report), tables.switching_table([report]))
    return 0


def _quickstart(command: Quickstart, rest: list[str]) -> int:
    from footwork.doors.quickstart import quickstart

    quickstart(command.to, command.seed, command.steps, command.threads)
    return 0


def _replay(command: Replay, rest: list[str]) -> int:
    from footwork.doors.replay import replay

    page = replay(
        *command.rows,
        episodes=command.episodes,
        seed=command.seed,
        runs=command.runs,
        deterministic=command.deterministic,
        most_steps=command.steps,
        num_threads=command.threads,
    )
    path = page.save(command.to)
    steps = sum(episode.num_steps for episode in page.footage)
    print(f"wrote {path}: {len(page.footage)} episodes, {steps} control steps, {path.stat().st_size / 1e6:.2f} MB")
    return 0


def _video(command: Video, rest: list[str]) -> int:
    from footwork.doors.replay import replay
    from footwork.doors.video import Look, check_suffix, video

    check_suffix(command.to.suffix)  # before the work
    look = Look(command.width, command.height, command.fps, command.speed, command.camera, command.quality)
    filmed = replay(
        *command.rows,
        episodes=command.episodes,
        seed=command.seed,
        runs=command.runs,
        deterministic=command.deterministic,
        most_steps=command.steps,
        num_threads=command.threads,
    )
    say: Callable[[str], None] = lambda line: print(f"footwork: {line}", file=sys.stderr)  # noqa: E731
    path = video(filmed.footage, command.to.suffix, look, say).save(command.to)
    print(f"wrote {path}: {path.stat().st_size / 1e6:.2f} MB")
    return 0


def _play(command: Play, rest: list[str]) -> int:
    from footwork.doors.play import play

    play(command.row, command.runs, command.host, command.port, command.seats, command.lesson_steps)
    return 0


def _at_least_one(name: str, value: int) -> None:
    if value < 1:
        raise ValueError(f"{name} must be >= 1, got {value}")
