"""Tables for a terminal of any width, plain where there is none."""

from __future__ import annotations

from typing import Any, Literal

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Column, Table

from footwork.arena import DIRECTIONS
from footwork.physics import DEFAULT_ENGINE, ENGINES
from footwork.study.experiments import group_of
from footwork.study.judging import Judgement
from footwork.study.plan import Job
from footwork.tasks.task import SUCCESS_RADII
from footwork.train import Experiment

# What a narrow terminal does without, the first of these first.
LEFT_OUT_FIRST = ("S", "needs", "task", "trains", "k", "peak MB", "compiling s", "to first\nupdate s", "decisions/s")


def show(*tables: Table) -> None:
    """Print tables to standard output: a pipe gets all columns, a narrow terminal those that fit, no cell cut."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=200)
    for table in tables:
        fit(table, console)
        console.print(table)


def fit(table: Table, console: Console) -> None:
    """Make a table fit the width of a console: fewer lines between its cells, then fewer columns, which are named."""
    if _least_width(table, console) > console.width:
        table.box, table.pad_edge, table.show_edge = box.SIMPLE_HEAD, False, False
    left_out = []
    for header in LEFT_OUT_FIRST:
        if _least_width(table, console) <= console.width:
            break
        if any(column.header == header for column in table.columns):
            table.columns = [column for column in table.columns if column.header != header]
            left_out.append(header)
    if left_out:
        names = ", ".join(header.replace("\n", " ") for header in left_out)
        table.caption = f"for want of width without: {names}"
        table.caption_justify = "left"


def _least_width(table: Table, console: Console) -> int:
    """Characters that a table takes if its columns are as narrow as they may be: whole cells, or words."""
    unbound = console.options.update(width=100_000)

    def spare(column: Column) -> int:
        if column.no_wrap:
            return 0
        sizes = [Measurement.get(console, unbound, text) for text in (column.header, *column.cells)]
        return max(size.maximum for size in sizes) - max(size.minimum for size in sizes)

    return Measurement.get(console, unbound, table).maximum - sum(spare(column) for column in table.columns)


def rows_table(experiments: list[Experiment], found: dict[str, str], every_row: bool = False) -> Table:
    """What each row trains, on what, and whether trained policies are at hand; variations in short."""
    title = "rows" if every_row else "rows (variations in short: --all shows them)"
    table = Table(title=title, title_justify="left")
    for column in ("row", "trains", "task", "needs", "S", "k", "control\nsteps", "trained"):
        justify: Literal["left", "right"] = "right" if column in ("S", "k", "control\nsteps") else "left"
        table.add_column(column, justify=justify, no_wrap=column not in ("row", "trained"), overflow="fold")
    groups: dict[str, list[Experiment]] = {}
    for row in experiments:
        groups.setdefault(group_of(row.name), []).append(row)
    last = ""
    for group, rows in groups.items():
        short = not every_row and _in_one_line(group)
        section = group.partition("/")[0] if short and not group.endswith("-penalised") else group
        if last and section != last:
            table.add_section()
        last = section
        if short and len(rows) > 1:
            values = ", ".join(row.name.rpartition("/")[2] for row in rows)
            name = f"{group}/{{{values}}}" if len(values) < 24 else f"{group}/... ({len(rows)})"
            trained = sum(bool(found[row.name]) for row in rows)
            cells = _row_cells(rows[0], name, f"{trained} of {len(rows)}" if trained else "")
            table.add_row(*_where_they_agree(cells, [_row_cells(row, "", "") for row in rows]))
            continue
        for row in rows:
            table.add_row(*_row_cells(row, row.name, found[row.name]))
    return table


def _in_one_line(group: str) -> bool:
    """Whether a group is a variation of others, and listed in short."""
    return group.partition("/")[0] in ("ablation", "light") or group.endswith("-penalised")


def _where_they_agree(cells: tuple[str, ...], others: list[tuple[str, ...]]) -> tuple[str, ...]:
    """Cells of a line that stands for several rows: dots where the rows differ; its name and what is trained stay."""
    same = [len({other[i] for other in others}) == 1 for i in range(len(cells))]
    return tuple(
        cell if agree or i in (0, len(cells) - 1) else "..."
        for i, (cell, agree) in enumerate(zip(cells, same, strict=True))
    )


def _row_cells(row: Experiment, name: str, found: str) -> tuple[str, ...]:
    """One line of the table of rows."""
    kind = "master" if row.is_master else "sub-policies" if row.is_walker else "flat policy"
    k = str(row.option_steps) if row.is_master else ""
    steps = f"{row.total_steps / 1e6:g} M" + (" x 4" if row.runs_per_seed > 1 else "")
    return name, kind, row.task.name, row.needs or "", str(row.ppo.batch_size), k, steps, found


def plan_table(taken: dict[Job, int], done: set[Job], size: str) -> Table:
    """What a study would run, and how much of it is there: seeds and control steps of each row.

    Args:
        taken: its runs, with the control steps that each has taken, less a share while it is to be measured.
        done: those that are complete.
        size: the study's.
    """
    jobs, total = list(taken), sum(job.steps for job in taken)
    left = total - sum(taken.values())
    title = f"{size} study: {len(jobs)} runs, {total:,} control steps\n{len(done)} runs done, {left:,} steps to do"
    table = Table(title=title, title_justify="left")
    for column in ("row", "seeds\ndone", "control\nsteps"):
        is_name = column == "row"
        table.add_column(column, justify="left" if is_name else "right", no_wrap=not is_name, overflow="fold")
    for row in dict.fromkeys(job.row for job in jobs):
        mine = [job for job in jobs if job.row == row]
        there = sum(job in done for job in mine)
        table.add_row(row, f"{there} of {len(mine)}", f"{sum(job.steps for job in mine):,}")
    return table


def claims_table(judgements: list[Judgement], size: str) -> Table:
    """Verdicts, one line per claim and setting."""
    table = Table(title="claims" if size == "full" else f"claims ({size} study)", title_justify="left")
    for column in ("", "claim", "where", "verdict", "because"):
        table.add_column(column, justify="right" if column == "" else "left")
    for j in judgements:
        table.add_row(str(j.claim.number), j.claim.words, j.where, j.verdict, j.why)
    return table


def evaluation_table(reports: list[dict[str, Any]]) -> Table:
    """Rows side by side, a line per figure: rates in per cent with their 95 % intervals."""
    walkers = all(report["success"] is None for report in reports)
    lengths = " or ".join(str(steps) for steps in sorted({report["episode_steps"] for report in reports}))
    title = f"evaluation, episodes of {lengths} control steps\n95 % intervals in brackets"
    table = Table(title=title, title_justify="left")
    table.add_column("", no_wrap=True)
    for report in reports:
        table.add_column(_played(report), justify="right", overflow="fold")
    within = [f"within {radius} m, %" for radius in SUCCESS_RADII]
    speeds = [f"{name}, m/s" for name in DIRECTIONS]
    names = ["episodes", *(speeds if walkers else within), "fall, %", "flip, %", "progress, m", "time to goal, s"]
    for name, *cells in zip(names, *(_evaluation_cells(report, walkers) for report in reports), strict=True):
        table.add_row(name, *cells)
    return table


def _evaluation_cells(report: dict[str, Any], walkers: bool) -> list[str]:
    """A row's figures, from top to bottom."""
    interval = report["interval"]
    if walkers:
        cells = [f"{sum(speeds) / len(speeds):.2f}" for speeds in report["speed_mps"].values()]
    elif report["success"] is None:
        cells = ["-" for _ in SUCCESS_RADII]
    else:
        cells = [_rate(report["success"][r], interval["success"][r]) for r in report["success"]]
    return [
        str(report["episodes"]),
        *cells,
        _rate(report["fall_rate"], interval["fall_rate"]),
        _rate(report["flip_rate"], interval["flip_rate"]),
        f"{report['progress_m']:.2f}",
        "-" if report["time_to_goal_s"] is None else f"{report['time_to_goal_s']:.1f}",
    ]


def handover_table(report: dict[str, Any]) -> Table:
    """Who hands over to whom: speed after, falls, flips."""
    table = Table(title=f"{_played(report)}: hand-over, m/s after (fall %, flip %)", title_justify="left")
    table.add_column("from \\ to")
    for name in DIRECTIONS:
        table.add_column(name, justify="right", no_wrap=True)
    for name, row in zip(DIRECTIONS, report["handover"], strict=True):
        cells = (f"{c['speed_mps']:.2f} ({100 * c['fall']:.0f}, {100 * c['flip']:.0f})" for c in row)
        table.add_row(name, *cells)
    return table


def switching_table(report: dict[str, Any]) -> Table:
    """Random switching, one line per period."""
    how = " between orthogonal directions" if report["orthogonal"] else ""
    title = f"{_played(report)}:\nrandom switching{how} for 2000 control steps"
    table = Table(title=title, title_justify="left")
    for column in ("k", "m/s per option", "idle %", "upside down %", "fallen %"):
        table.add_column(column, justify="right", no_wrap=True)
    for k, figures in report["switching"].items():
        shares = (f"{100 * figures[name]:.1f}" for name in ("idle", "upside_down", "fallen"))
        table.add_row(k, f"{figures['speed_mps']:.2f}", *shares)
    return table


def _played(report: dict[str, Any]) -> str:
    """The row, and the engine it was played on where that is another than its own."""
    row, engine = report["row"], report["engine"]
    own = row.partition("/")[0] if row.partition("/")[0] in ENGINES else DEFAULT_ENGINE
    return row if engine == own else f"{row} on {engine}"


def bench_tables(report: dict[str, Any]) -> list[Table]:
    """Contestants, what was asked for, and how cost grows."""
    machine = report["machine"]
    note = f"{machine['processor']}, {machine['cores']} cores, {machine['memory_gb']} GB, load {machine['load']}"
    note += "; " + ", ".join(f"{name} {report['versions'][name]}" for name in ("footwork", "jax", "mujoco", "python"))
    found = [_contestants_table(report["contestants"], note), _targets_table(report)]
    return [*found, *(_growth_table(axis, points) for axis, points in report["growth"].items())]


def _contestants_table(contestants: dict[str, Any], note: str) -> Table:
    table = Table(title=f"control steps per second, median (least, largest)\n{note}", title_justify="left")
    table.add_column("contestant", overflow="fold")
    for name in ("steps/s", "decisions/s", "over its\nphysics", "to first\nupdate s", "compiling s", "peak MB"):
        table.add_column(name, justify="right", no_wrap=True)
    for name, record in contestants.items():
        if "skipped" in record:
            table.add_row(escape(f"{name}: skipped: {record['skipped']}"))
            continue
        rates = (_spread(record.get(key), form) for key, form in CONTESTANT_FIGURES)
        table.add_row(name, *rates, *(_number(record.get(key)) for key in ("start_s", "compile_s", "peak_mb")))
    return table


CONTESTANT_FIGURES = (("steps_per_second", ",.0f"), ("decisions_per_second", ",.0f"), ("over_engine", ".2f"))


def _targets_table(report: dict[str, Any]) -> Table:
    table = Table(title="ratios, within each round", title_justify="left")
    for name in ("figure", "median\n(least, largest)", "asked\nfor", "reached"):
        is_name = name == "figure"
        table.add_column(name, justify="left" if is_name else "right", no_wrap=not is_name, overflow="fold")
    figures = {**{key: report[key] for key in report["targets"]}, "compile_s": report["compile_s"]}
    for key in {**figures, "peak_mb": 0, **report["ratios"]}:
        if report.get(key) is None:
            continue
        ratio, target = report["ratios"].get(key), report["targets"].get(key, {"asked": "", "reached": None})
        shown = _number(report[key], ".2f") if ratio is None else _spread(ratio, ".2f")
        table.add_row(key, shown, target["asked"], {True: "yes", False: "no", None: ""}[target["reached"]])
    return table


def _growth_table(axis: str, points: list[dict[str, Any]]) -> Table:
    table = Table(title=f"how cost grows with {axis}", title_justify="left")
    table.add_column(axis, overflow="fold")
    for name in ("steps/s", "over\nphysics alone", "to first\nupdate s", "compiling s", "peak MB"):
        table.add_column(name, justify="right", no_wrap=True)
    for point in points:
        if "skipped" in point:
            table.add_row(escape(f"{point['size']}: skipped: {point['skipped']}"))
            continue
        rates = (_spread(point["steps_per_second"], ",.0f"), _spread(point["over_reference"], ".2f"))
        table.add_row(
            str(point["size"]), *rates, *(_number(point.get(key)) for key in ("start_s", "compile_s", "peak_mb"))
        )
    return table


def _spread(figures: dict[str, Any] | None, form: str) -> str:
    if figures is None:
        return ""
    return f"{figures['median']:{form}} ({figures['low']:{form}}, {figures['high']:{form}})"


def _number(value: float | None, form: str = ",.1f") -> str:
    return "" if value is None else f"{value:{form}}"


def _rate(rate: float, interval: list[float]) -> str:
    return f"{100 * rate:.1f} [{100 * interval[0]:.1f}, {100 * interval[1]:.1f}]"
