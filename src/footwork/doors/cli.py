"""The command line: ``footwork --help`` lists the commands.

Only what a command needs is imported, and only once it is known which command it is:
``footwork --help`` answers at once.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from footwork.doors.parity import Parity, parity

if TYPE_CHECKING:
    from footwork.train import Experiment, Trained

RowName = Annotated[str, tyro.conf.Positional]
RowNames = Annotated[tuple[str, ...], tyro.conf.Positional]


@dataclass(frozen=True)
class List:
    """Show the table: every row that can be trained."""

    runs: Path = Path("runs")  # where runs are kept
    all: bool = False  # a line for every row of an ablation too


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


@dataclass(frozen=True)
class Evaluate:
    """Play episodes with a trained row: success at four radii, falls, flips, progress, time to goal."""

    row: RowName  # its address, as `footwork list` shows it, or the folder of a run
    runs: Path = Path("runs")  # where runs are kept; a row not found there comes from the package
    engine: str | None = None  # play on another physics than it was trained on: mujoco, mjx, bullet or bullet-original
    episodes: int = 1000  # per seed
    seed: int = 1_000_003  # of the episodes
    deterministic: bool = False  # act by the mode of the distribution instead of a sample
    threads: int = 0  # of the physics; 0: all cores. Changes no number
    json: bool = False  # print JSON instead of a table


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


@dataclass(frozen=True)
class Quickstart:
    """Train a master on AntMaze from packaged sub-policies, and show what it learned."""

    to: Path = Path("quickstart")  # where table, pictures and the run are left
    seed: int = 0
    steps: int | None = None  # control steps; default: the quickstart's own
    threads: int = 0  # of the physics; 0: all cores. Changes no number


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


@dataclass(frozen=True)
class Figures:
    """Draw figures of the study, from files alone: all, or those that are named (5, or 05-maze-reward)."""

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    runs: Path = Path("runs")  # where runs are kept, or results/ of a report
    to: Path = Path("figures")
    under: str = ""  # another engine or ant, such as light: the same figures of the rows under it
    any_length: bool = False  # let runs of another length than their row's count too


@dataclass(frozen=True)
class Report:
    """Write the report of the runs that are there: claims, figures, rows, and what was left out."""

    runs: Path = Path("runs")  # where runs are kept, or results/ of a report
    to: Path = Path("report")
    any_length: bool = False  # let runs of another length than their row's count too


def main() -> None:
    """The entry point."""
    keep_compiled()
    sys.exit(run(sys.argv[1:]))


def keep_compiled() -> None:
    """Have JAX keep its compiled programs, so that only the first start of a kind has to wait for them.

    They lie in the user's cache directory, for each kind of processor apart: they are machine
    code. ``FOOTWORK_CACHE`` names another place, or is empty to keep nothing; JAX's own
    variables go before. JAX is told by its environment, so that nothing is imported here.
    """
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    place = os.environ.get("FOOTWORK_CACHE", str(Path(base, "footwork")))
    if place:
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(place, f"jax-{_processor()}")))
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")


def _processor() -> str:
    """A name for what this processor can execute."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        abilities = next(line for line in lines if line.startswith(("flags", "Features")))
    except (OSError, StopIteration):
        abilities = platform.processor()
    return f"{platform.machine()}-{hashlib.sha256(abilities.encode()).hexdigest()[:12]}"


def run(arguments: list[str]) -> int:
    """Run one command; what a user can mend is one line on stderr and exit status 1, 130 for an interrupt."""
    commands: Any = (
        List
        | Train
        | Evaluate
        | Transitions
        | Quickstart
        | Export
        | Replay
        | Video
        | Play
        | Bench
        | Reproduce
        | Figures
        | Report
        | Parity
    )
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
        Export: _export,
        Replay: _replay,
        Video: _video,
        Play: _play,
        Bench: _bench,
        Reproduce: _reproduce,
        Figures: _figures,
        Report: _report,
        Parity: parity,
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
        return 130 if type(error).__name__ in ("Interrupted", "SweepStopped") else 1


def _is_for_the_user(error: Exception) -> bool:
    from footwork.train import Interrupted, TrainingDiverged

    stopped = isinstance(error, Interrupted | TrainingDiverged) or type(error).__name__ == "SweepStopped"
    return stopped or isinstance(error, ValueError | OSError | ImportError)


def _list(command: List, rest: list[str]) -> int:
    from footwork.doors import tables
    from footwork.physics import ENGINES
    from footwork.study.experiments import EXPERIMENTS, find_row
    from footwork.study.runs import finished_runs, packaged

    elsewhere = [f"{engine}/{name}" for engine in ENGINES for name in EXPERIMENTS if (command.runs / engine).is_dir()]
    runs = {name: len(finished_runs(name, command.runs)) for name in (*EXPERIMENTS, *elsewhere)}
    rows = [find_row(name) for name in runs if name in EXPERIMENTS or runs[name]]
    found = {row: f"{n} runs" if n else "packaged" if packaged(row).is_file() else "" for row, n in runs.items()}
    tables.show(tables.rows_table(rows, found, command.all))
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
    from footwork.study.experiments import find_row, read_maze, with_engine, with_robot

    experiment = find_row(command.row)
    if command.engine is not None:
        experiment = with_engine(experiment, command.engine)
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
    trained = _played_on(trained, command.engine)
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

    trained = _played_on(find_trained(command.row, command.runs), command.engine)
    _at_least_one("ants", command.ants)
    report = transitions(
        trained,
        command.ants,
        command.seed,
        command.deterministic,
        command.threads,
        orthogonal=command.orthogonal,
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


def _played_on(trained: Trained, engine: str | None) -> Trained:
    """The same policies on another physics."""
    from dataclasses import replace

    from footwork.physics import require_engine

    experiment = trained.experiment if engine is None else replace(trained.experiment, engine=engine)
    require_engine(experiment.engine, experiment.task.robot)
    return trained._replace(experiment=experiment)


def _bench(command: Bench, rest: list[str]) -> int:
    from footwork.checkpoint import write_atomically
    from footwork.doors import tables  # all of it now: whoever presses Ctrl-C will not wait
    from footwork.study import bench, figures

    python = command.rivals_python or sys.executable
    work = bench.Bench(command.quick, command.learning, python, lambda line: print(line, file=sys.stderr))
    work.run()
    report = work.report()
    text = json.dumps(report, indent=2)
    if command.json:
        print(text)
    else:
        tables.show(*tables.bench_tables(report))
    command.to.mkdir(parents=True, exist_ok=True)
    write_atomically(command.to / "report.json", text.encode() + b"\n")
    print(f"wrote {figures.bench_figure(command.to / 'bench.png', report)}", file=sys.stderr)
    return 0 if work.complete else 130


def _reproduce(command: Reproduce, rest: list[str]) -> int:
    from footwork.doors import study

    return study.reproduce(command)


def _figures(command: Figures, rest: list[str]) -> int:
    from footwork.doors import study

    return study.figures(command.names, command.runs, command.to, command.under, command.any_length)


def _report(command: Report, rest: list[str]) -> int:
    from footwork.doors import study

    return study.report(command.runs, command.to, command.any_length)


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


def _export(command: Export, rest: list[str]) -> int:
    from footwork.doors.export import export

    _at_least_one("episodes", command.episodes)
    card = export(command.row, command.to, command.runs, command.episodes, command.seed, command.threads, command.onnx)
    print(f"{command.row}: exported; the model card is {card}")
    return 0


def _play(command: Play, rest: list[str]) -> int:
    from footwork.doors.play import play

    play(command.row, command.runs, command.host, command.port, command.seats, command.lesson_steps)
    return 0


def _at_least_one(name: str, value: int) -> None:
    if value < 1:
        raise ValueError(f"{name} must be >= 1, got {value}")
