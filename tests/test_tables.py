"""Laws of the tables that a terminal shows: at any usual width no cell is cut, and columns left out are named."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path

import pytest
from rich.console import Console

from footwork.doors import tables
from footwork.doors.tables import Column, Sheet
from footwork.study import sweep
from footwork.study.experiments import EXPERIMENTS, find_row
from footwork.study.plan import FULL, Study, plan

BENCHMARK = Path(__file__).parents[1] / "docs/bench/report.json"
LONGEST = max(EXPERIMENTS, key=len)


def shown(sheet, width, terminal=True):
    console = Console(width=width, file=io.StringIO(), force_terminal=terminal, no_color=True, highlight=False)
    tables.show(sheet, console=console)
    return re.sub(r"\x1b\[[0-9;]*m", "", console.file.getvalue())


def all_rows():
    return tables.rows_table([find_row(name) for name in EXPERIMENTS], dict.fromkeys(EXPERIMENTS, "packaged"), True)


def rows_in_short():
    return tables.rows_table([find_row(name) for name in EXPERIMENTS], dict.fromkeys(EXPERIMENTS, "3 runs"))


def whole_plan():
    jobs = plan(Study("runs", FULL))
    return tables.plan_table(dict.fromkeys(jobs, 0), set(jobs[::2]), "full")


def evaluated(row, success):
    report = {"row": row, "engine": "mujoco", "episodes": 1000, "episode_steps": 2000, "progress_m": 17.25}
    report |= {"success": success, "fall_rate": 1.0, "flip_rate": 0.5, "time_to_goal_s": 16.25}
    interval = {"fall_rate": [0.996, 1.0], "flip_rate": [0.469, 0.531]}
    if success:
        interval["success"] = {radius: [rate - 0.125, rate] for radius, rate in success.items()}
    return report | {"interval": interval, "speed_mps": {name: [2.5] for name in tables.DIRECTIONS}}


def two_masters():
    radii = [str(radius) for radius in tables.SUCCESS_RADII]
    one, other = dict(zip(radii, (0.7, 0.8, 0.9, 1.0), strict=True)), dict.fromkeys(radii, 0.2)
    rows = (("maze/hrl/symmetric-interleaved", one), ("maze/flat/free", other))
    return tables.evaluation_table([evaluated(row, success) for row, success in rows])


def walker():
    return tables.evaluation_table([evaluated("walker/symmetric-interleaved", None)])


def switched():
    figures = {"speed_mps": 2.08, "idle": 1.0, "upside_down": 0.5, "fallen": 0.25}
    report = {"row": "walker/symmetric-interleaved", "engine": "mujoco", "orthogonal": True}
    return tables.switching_table(report | {"switching": {"25": figures, "200": figures}})


def handed_over():
    cells = [{"speed_mps": 1.64 + share, "fall": share, "flip": 1.0} for share in (0.0, 0.12, 0.5, 1.0)]
    return tables.handover_table({"row": "walker/plain", "engine": "bullet", "handover": [cells, cells[::-1]] * 2})


def benchmark(which):
    def make():
        return tables.bench_tables(json.loads(BENCHMARK.read_text()))[which]

    make.__name__ = f"benchmark-{which}"
    return make


ALL = [all_rows, rows_in_short, whole_plan, two_masters, walker, switched, handed_over, *map(benchmark, range(6))]


@pytest.mark.parametrize("make", ALL, ids=lambda make: make.__name__)
@pytest.mark.parametrize("width", [60, 80, 100, 120, 200])
def test_a_terminal_cuts_no_cell(make, width):
    """Each row begins with its name; its figures stand beside that, and words that do not fit go on below."""
    sheet = make()
    text = shown(sheet, width)
    assert max(map(len, text.splitlines())) <= width
    assert "…" not in text
    left_out = re.search(r"left out for want of width: ([^;]*);", " ".join(text.split()))
    names = left_out.group(1).split(", ") if left_out else []
    kept = [i for i, column in enumerate(sheet.columns) if column.header.replace("\n", " ") not in names]
    assert 0 in kept
    assert len(kept) + len(names) == len(sheet.columns)
    lines = [line.replace("│", " ").rstrip() for line in text.splitlines()]
    at = 0
    for row in sheet.rows:  # in their order
        begin = row[0].split()[0][:15]  # a long name goes on below
        at = next((k for k in range(at, len(lines)) if lines[k].lstrip().startswith(begin)), len(lines))
        assert at < len(lines), row
        end = lines[at].index(begin) + len(begin)
        for i in kept[1:]:
            if sheet.columns[i].may_wrap:
                block = " ".join(lines[at : at + 12])
                assert all(word in block for word in row[i].split()), (row, lines[at])
            elif row[i]:
                place = lines[at].find(row[i], end)
                assert place >= 0, (row, lines[at])
                end = place + len(row[i])
        at += 1


def test_a_narrow_terminal_keeps_what_fits_and_names_the_rest_and_a_pipe_has_all():
    narrow = shown(all_rows(), 80)
    assert "left out for want of width: trains, task, needs, S, k; a wider terminal" in " ".join(narrow.split())
    pipe = shown(all_rows(), 80, terminal=False)
    assert "left out" not in pipe
    assert all(name in pipe for name in EXPERIMENTS)
    assert all(re.search(rf"\b{header}\b", pipe) for header in ("S", "needs", "task", "trains", "k"))


def test_columns_leave_in_their_order_and_the_rest_is_measured_without_them():
    columns = (Column("name", is_text=True), Column("first", spare=2), Column("second", spare=1), Column("third"))
    sheet = Sheet("", columns, [("a", "1" * 10, "2" * 10, "3" * 10)])
    whole = len("name") + 3 * 10
    assert tables.fitted(sheet, whole + 4 * 3 + 1)[1] == []  # with a frame
    assert tables.fitted(sheet, whole + 3 * 3)[1] == []  # without
    assert tables.fitted(sheet, whole + 3 * 3 - 1)[1] == ["second"]
    assert tables.fitted(sheet, whole + 2 * 3 - 10)[1] == ["second"]
    assert tables.fitted(sheet, whole + 2 * 3 - 11)[1] == ["first", "second"]
    assert tables.fitted(sheet, 1)[1] == ["first", "second"]  # what is not spare stays
    narrow = Sheet("", (Column("name"), Column("s", spare=1), Column("wide", spare=2)), [("a", "1", "2" * 10)])
    assert tables.fitted(narrow, len("name") + 3 + 10)[1] == ["s"]
    assert tables.fitted(narrow, len("name") + 3 + 9)[1] == ["wide"]  # without it the other fits after all


def test_figures_stand_beside_their_names():
    lines = shown(two_masters(), 80).splitlines()
    (line,) = (line for line in lines if "within 0.5 m" in line)
    assert re.search(r"80\.0 \[67\.5, 80\.0\]\D+20\.0 \[7\.5, 20\.0\]", line)
    (line,) = (line for line in shown(walker(), 80).splitlines() if "left, m/s" in line)
    assert "2.50" in line


@pytest.mark.parametrize("width", [60, 80])
@pytest.mark.parametrize("failed", [False, True])
def test_the_live_table_of_a_sweep_fits(tmp_path, failed, width):
    study = Study(tmp_path, FULL)
    jobs = [job for job in plan(study) if job.row in (LONGEST, "walker/plain")]
    board = sweep.Board(study, jobs)
    board.active.update(job for job in jobs if job.seed < 2)
    board.done.add(next(job for job in jobs if job.row == "walker/plain" and job.seed == 2))
    if failed:
        board.fail(next(job for job in jobs if job.row == LONGEST and job.seed == 2), "no memory")
    console = Console(width=width, file=io.StringIO())
    console.print(sweep.board_table(board))
    lines = console.file.getvalue().splitlines()
    assert "…" not in console.file.getvalue()
    (plain,) = (line for line in lines if line.startswith("walker/plain"))
    assert re.search(r"1 of 10   seed 0:   0%\s*$", plain)
    (longest,) = (line for line in lines if line.startswith(LONGEST[: width // 3]))
    assert re.search(r"0 of 3   seed 0:   0%" + (r"\s+1$" if failed else r"\s*$"), longest)
    assert sum("seed 1:   0%" in line for line in lines) == 2
