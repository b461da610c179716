"""``footwork reproduce``, ``figures`` and ``report``: the study at the command line."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from footwork.checkpoint import check_writable
from footwork.doors import tables
from footwork.physics import require_engine
from footwork.record import RunError
from footwork.study.experiments import in_braces, is_row, match_rows
from footwork.study.figures import draw_figures, find_figures
from footwork.study.job import completed
from footwork.study.judging import judge_all
from footwork.study.plan import FULL, QUICK, Study, check_mark, mark, plan, read_mark
from footwork.study.report import write_report
from footwork.study.report_files import check_place
from footwork.study.results import Results, all_rows, strays
from footwork.study.sweep import run_study, steps_of

if TYPE_CHECKING:
    from footwork.doors.commands.studying import Reproduce


def reproduce(command: Reproduce) -> int:
    """Run what is missing of the study, then write its report; 1 if a run failed."""
    size = QUICK if command.quick else FULL
    ending = "-quick" if command.quick else ""
    study = Study(command.runs or Path(f"runs{ending}"), size)
    jobs = plan(study, match_rows(command.rows) if command.rows else (), command.seeds)
    if command.plan:
        check_mark(study)
        done, problems = completed(study, jobs)
        for problem in [*strays(study), *problems]:
            _say(problem)
        taken = {job: job.steps if job in done else steps_of(study, job) for job in jobs}
        tables.show(tables.plan_table(taken, done, size.name))
        return 0
    for row in {study.row(job.row) for job in jobs}:
        require_engine(row.engine, row.task.robot)
    to = command.to or Path(f"report{ending}")
    check_place(study, to)
    mark(study)
    board = run_study(study, jobs, command.workers, command.launcher, command.address, log=_say)
    if board.failed:
        _say(f"FAILED: {', '.join(job.name for job in board.failed)}; the reasons are above, and in {study.runs}/logs")
    status = report(study.runs, to, command=_line(command))
    return 1 if board.failed else status


def _line(command: Reproduce) -> str:
    """The command line that asks for the same."""
    parts = ["footwork reproduce"]
    parts += ["--quick"] if command.quick else []
    parts += ["--rows", *command.rows] if command.rows else []
    parts += [f"--seeds {command.seeds}"] if command.seeds else []
    return " ".join(parts)


def figures(names: tuple[str, ...], runs: Path, to: Path, under: str, any_length: bool) -> int:
    """Draw figures, and say of each what it lacks."""
    chosen = find_figures(names)
    results = _results(runs, any_length)
    prefix = f"{under.strip('/')}/" if under else ""
    if prefix and not is_row(f"{prefix}walker/plain"):
        raise ValueError(f"there are no rows under {under!r}: there is no {prefix}walker/plain")
    check_writable(to / f"{chosen[0].name}.png")
    every = draw_figures(results, chosen, to, prefix)
    if not every:
        raise RunError(f"no finished runs under {under!r} of which there are figures in {runs}")
    for drawn in every:
        lacks = f"; no finished runs of {in_braces(drawn.without)}" if drawn.without else ""
        _say(f"wrote {drawn.files[0]} and {drawn.files[1].name}{lacks}")
    _say_problems(results)
    return 0


def report(runs: Path, to: Path, any_length: bool = False, command: str = "") -> int:
    """Write the report, and show its claims."""
    results = _results(runs, any_length)
    if not any(results.samples(row) for row in all_rows(results)):
        _say_problems(results)
        raise RunError(f"no finished run of any row counts in {runs}: there is nothing to report")
    pages = write_report(results, to, command or f"footwork report{' --any-length' if any_length else ''}")
    tables.show(tables.claims_table(judge_all(results), results.study.size.name))
    _say_problems(results)
    for page in pages:
        _say(f"wrote {page}")
    return 0


def _results(runs: Path, any_length: bool) -> Results:
    if not runs.is_dir():
        raise RunError(f"there is no folder of runs at {runs}")
    results = Results(Study(runs, read_mark(runs)), any_length)
    results.problems.update(dict.fromkeys(strays(results.study)))
    return results


def _say_problems(results: Results) -> None:
    for line in results.said():
        _say(line)


def _say(line: str) -> None:
    print(line, flush=True)
