"""Tables for a terminal of any width, plain where there is none."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

from rich import box
from rich.cells import cell_len
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from footwork.arena import DIRECTIONS
from footwork.physics import DEFAULT_ENGINE, ENGINES
from footwork.study.experiments import group_of
from footwork.study.judging import Judgement
from footwork.study.plan import Job
from footwork.tasks.task import SUCCESS_RADII
from footwork.train import Experiment

PIPE_WIDTH = 200  # characters, where no terminal says how wide it is


@dataclass(frozen=True)
class Column:
    """A column of a table."""

    header: str
    is_text: bool = False  # flush left, and it may wrap: else its cells are figures, flush right and whole
    wraps: bool | None = None  # whether it may wrap; None: text does
    spare: int = 0  # in which order a narrow terminal leaves it out, 1 first; 0: never

    @property
    def may_wrap(self) -> bool:
        """Whether its cells may go on below."""
        return self.is_text if self.wraps is None else self.wraps


@dataclass(frozen=True)
class Sheet:
    """What a table holds, before it is known how wide it may be."""

    title: str
    columns: tuple[Column, ...]
    rows: Sequence[tuple[str, ...]]
    section_ends: Collection[int] = ()  # rows with a line below them
    notes: Sequence[str] = ()  # lines below the table


def show(*sheets: Sheet, console: Console | None = None) -> None:
    """Print tables to standard output, no cell cut: all columns to a pipe, those that fit to a narrow terminal."""
    console = Console() if console is None else console
    if not console.is_terminal:
        console.width = PIPE_WIDTH
    for sheet in sheets:
        table, left_out = fitted(sheet, console.width)
        console.print(table)
        if left_out:
            console.print(f"left out for want of width: {', '.join(left_out)}; a wider terminal or a pipe shows them")
        for note in sheet.notes:
            console.print(escape(note))


def fitted(sheet: Sheet, width: int) -> tuple[Table, list[str]]:
    """A table of at most ``width`` characters, and the headers of columns that it had to leave out.

    What gives way first are lines between the cells, then spare columns. Text goes on below; where that is not enough,
    in terminals of fewer than some 50 characters, cells are cut.
    """
    kept = list(range(len(sheet.columns)))
    if _least_width(sheet, kept, framed=True) <= width:
        return _table(sheet, kept, framed=True), []
    left_out: list[int] = []
    for i in sorted((i for i in kept if sheet.columns[i].spare), key=lambda i: sheet.columns[i].spare):
        if _least_width(sheet, kept, framed=False) <= width:
            break
        kept.remove(i)
        left_out.append(i)
    for i in reversed(left_out):  # what fits beside those that stay after all
        if _least_width(sheet, [*kept, i], framed=False) <= width:
            kept.append(i)
    missing = [column.header.replace("\n", " ") for i, column in enumerate(sheet.columns) if i not in kept]
    return _table(sheet, sorted(kept), framed=False), missing


def _least_width(sheet: Sheet, kept: Sequence[int], framed: bool) -> int:
    """Characters that columns take at least: figures whole, of text the longest word, and what is between them."""
    widths = []
    for i in kept:
        cells = (sheet.columns[i].header, *(row[i] for row in sheet.rows))
        pieces = (
            piece for cell in cells for piece in (cell.split() if sheet.columns[i].may_wrap else cell.split("\n"))
        )
        widths.append(max(map(cell_len, pieces), default=0))
    return sum(widths) + (3 * len(kept) + 1 if framed else 3 * (len(kept) - 1))


def _table(sheet: Sheet, kept: Sequence[int], framed: bool) -> Table:
    table = Table(title=escape(sheet.title), title_justify="left")
    if not framed:
        table.box, table.pad_edge, table.show_edge = box.SIMPLE_HEAD, False, False
    for i in kept:
        column = sheet.columns[i]
        table.add_column(
            escape(column.header),
            justify="left" if column.is_text else "right",
            no_wrap=not column.may_wrap,
            overflow="fold",
        )
    for number, row in enumerate(sheet.rows):
        table.add_row(*(escape(row[i]) for i in kept), end_section=number in sheet.section_ends)
    return table


def rows_table(experiments: list[Experiment], found: dict[str, str], every_row: bool = False) -> Sheet:
    """What each row trains, on what, and whether trained policies are at hand; variations in short."""
    columns = (
        Column("row", is_text=True),
        Column("trains", is_text=True, wraps=False, spare=4),
        Column("task", is_text=True, wraps=False, spare=3),
        Column("needs", is_text=True, wraps=False, spare=2),
        Column("S", spare=1),
        Column("k", spare=5),
        Column("control\nsteps"),
        Column("trained", is_text=True),
    )
    groups: dict[str, list[Experiment]] = {}
    for row in experiments:
        groups.setdefault(group_of(row.name), []).append(row)
    lines: list[tuple[str, ...]] = []
    ends, last = [], ""
    for group, rows in groups.items():
        short = not every_row and _in_one_line(group)
        section = group.partition("/")[0] if short and not group.endswith("-penalised") else group
        if last and section != last:
            ends.append(len(lines) - 1)
        last = section
        if short and len(rows) > 1:
            values = ", ".join(row.name.rpartition("/")[2] for row in rows)
            name = f"{group}/{{{values}}}" if len(values) < 24 else f"{group}/... ({len(rows)})"
            trained = sum(bool(found[row.name]) for row in rows)
            cells = _row_cells(rows[0], name, f"{trained} of {len(rows)}" if trained else "")
            lines.append(_where_they_agree(cells, [_row_cells(row, "", "") for row in rows]))
            continue
        lines += [_row_cells(row, row.name, found[row.name]) for row in rows]
    title = "rows" if every_row else "rows (variations in short: --all shows them)"
    return Sheet(title, columns, lines, ends)


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


def plan_table(taken: dict[Job, int], done: set[Job], size: str) -> Sheet:
    """What a study would run, and how much of it is there: seeds and control steps of each row.

    Args:
        taken: its runs, with the control steps that each has taken, less a share while it is to be measured.
        done: those that are complete.
        size: the study's.
    """
    jobs, total = list(taken), sum(job.steps for job in taken)
    left = total - sum(taken.values())
    title = f"{size} study: {len(jobs)} runs, {total:,} control steps\n{len(done)} runs done, {left:,} steps to do"
    lines = []
    for row in dict.fromkeys(job.row for job in jobs):
        mine = [job for job in jobs if job.row == row]
        there = sum(job in done for job in mine)
        lines.append((row, f"{there} of {len(mine)}", f"{sum(job.steps for job in mine):,}"))
    return Sheet(title, (Column("row", is_text=True), Column("seeds\ndone"), Column("control\nsteps")), lines)


def claims_table(judgements: list[Judgement], size: str) -> Sheet:
    """Verdicts, one line per claim and setting."""
    columns = (Column(""), *(Column(name, is_text=True) for name in ("claim", "where", "verdict", "because")))
    lines = [(str(j.claim.number), j.claim.words, j.where, j.verdict, j.why) for j in judgements]
    return Sheet("claims" if size == "full" else f"claims ({size} study)", columns, lines)


def evaluation_table(reports: list[dict[str, Any]]) -> Sheet:
    """One row or two side by side, a line per figure: rates in per cent with their 95 % intervals."""
    walkers = all(report["success"] is None for report in reports)
    lengths = " or ".join(str(steps) for steps in sorted({report["episode_steps"] for report in reports}))
    within = [f"within {radius} m, %" for radius in SUCCESS_RADII]
    speeds = [f"{name}, m/s" for name in DIRECTIONS]
    names = ["episodes", *(speeds if walkers else within), "fall, %", "flip, %", "progress, m", "time to goal, s"]
    figures = (_evaluation_cells(report, walkers) for report in reports)
    return Sheet(
        f"evaluation, episodes of {lengths} control steps\n95 % intervals in brackets",
        (Column("", is_text=True, wraps=False), *(Column(_played(report), wraps=True) for report in reports)),
        list(zip(names, *figures, strict=True)),
    )


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


def handover_table(report: dict[str, Any]) -> Sheet:
    """Who hands over to whom: speed after, falls, flips."""
    columns = (
        Column("from \\ to", is_text=True, wraps=False),
        *(Column(name, wraps=True) for name in DIRECTIONS),
    )
    lines = [
        (name, *(f"{c['speed_mps']:.2f} ({100 * c['fall']:.0f}, {100 * c['flip']:.0f})" for c in row))
        for name, row in zip(DIRECTIONS, report["handover"], strict=True)
    ]
    return Sheet(f"{_played(report)}: hand-over, m/s after (fall %, flip %)", columns, lines)


def switching_table(report: dict[str, Any]) -> Sheet:
    """Random switching, one line per period."""
    how = " between orthogonal directions" if report["orthogonal"] else ""
    title = f"{_played(report)}:\nrandom switching{how} for 2000 control steps"
    columns = (Column("k"), *(Column(name) for name in ("m/s per\noption", "idle %", "upside\ndown %", "fallen %")))
    lines = []
    for k, figures in report["switching"].items():
        shares = (f"{100 * figures[name]:.1f}" for name in ("idle", "upside_down", "fallen"))
        lines.append((k, f"{figures['speed_mps']:.2f}", *shares))
    return Sheet(title, columns, lines)


def _played(report: dict[str, Any]) -> str:
    """The row, and the engine it was played on where that is another than its own."""
    row, engine = report["row"], report["engine"]
    own = row.partition("/")[0] if row.partition("/")[0] in ENGINES else DEFAULT_ENGINE
    return row if engine == own else f"{row} on {engine}"


def bench_tables(report: dict[str, Any]) -> list[Sheet]:
    """Contestants, what was asked for, and how cost grows."""
    machine = report["machine"]
    note = f"{machine['processor']}, {machine['cores']} cores, {machine['memory_gb']} GB, load {machine['load']}"
    note += "; " + ", ".join(f"{name} {report['versions'][name]}" for name in ("footwork", "jax", "mujoco", "python"))
    found = [_contestants_table(report["contestants"], note), _targets_table(report)]
    return [*found, *(_growth_table(axis, points) for axis, points in report["growth"].items())]


COSTS = (
    Column("to first\nupdate s", spare=3),
    Column("compiling s", spare=2),
    Column("peak MB", spare=1),
)  # of a contestant or a point


def _contestants_table(contestants: dict[str, Any], note: str) -> Sheet:
    names = (Column("contestant", is_text=True), Column("steps/s"), Column("decisions/s", spare=4))
    lines = []
    for name, record in contestants.items():
        rates = (_spread(record.get(key), form) for key, form in CONTESTANT_FIGURES)
        lines.append((name, *rates, *_costs(record)) if "skipped" not in record else _skipped(name, len(COSTS) + 3))
    return Sheet(
        f"control steps per second, median (least, largest)\n{note}",
        (*names, Column("over its\nphysics"), *COSTS),
        lines,
        notes=[f"{name}: skipped: {record['skipped']}" for name, record in contestants.items() if "skipped" in record],
    )


CONTESTANT_FIGURES = (("steps_per_second", ",.0f"), ("decisions_per_second", ",.0f"), ("over_engine", ".2f"))


def _targets_table(report: dict[str, Any]) -> Sheet:
    columns = (
        Column("figure", is_text=True),
        Column("median\n(least, largest)"),
        Column("asked\nfor"),
        Column("reached"),
    )
    figures = {**{key: report[key] for key in report["targets"]}, "compile_s": report["compile_s"]}
    lines = []
    for key in {**figures, "peak_mb": 0, **report["ratios"]}:
        if report.get(key) is None:
            continue
        ratio, target = report["ratios"].get(key), report["targets"].get(key, {"asked": "", "reached": None})
        shown = _number(report[key], ".2f") if ratio is None else _spread(ratio, ".2f")
        lines.append((key, shown, target["asked"], {True: "yes", False: "no", None: ""}[target["reached"]]))
    return Sheet("ratios, within each round", columns, lines)


def _growth_table(axis: str, points: list[dict[str, Any]]) -> Sheet:
    lines = []
    for point in points:
        size = str(point["size"])
        if "skipped" in point:
            lines.append(_skipped(size, len(COSTS) + 2))
            continue
        rates = (_spread(point["steps_per_second"], ",.0f"), _spread(point["over_reference"], ".2f"))
        lines.append((size, *rates, *_costs(point)))
    return Sheet(
        f"how cost grows with {axis}",
        (Column(axis), Column("steps/s"), Column("over\nphysics alone"), *COSTS),
        lines,
        notes=[f"{axis} {point['size']}: skipped: {point['skipped']}" for point in points if "skipped" in point],
    )


def _skipped(name: str, cells: int) -> tuple[str, ...]:
    """The line of something that was not measured; why stands below the table."""
    return (name, "skipped", *("" for _ in range(cells - 1)))


def _costs(record: dict[str, Any]) -> tuple[str, ...]:
    return tuple(_number(record.get(key)) for key in ("start_s", "compile_s", "peak_mb"))


def _spread(figures: dict[str, Any] | None, form: str) -> str:
    if figures is None:
        return ""
    return f"{figures['median']:{form}} ({figures['low']:{form}}, {figures['high']:{form}})"


def _number(value: float | None, form: str = ",.1f") -> str:
    return "" if value is None else f"{value:{form}}"


def _rate(rate: float, interval: list[float]) -> str:
    return f"{100 * rate:.1f} [{100 * interval[0]:.1f}, {100 * interval[1]:.1f}]"
