"""Laws of the tables that a terminal shows: at any usual width no cell is cut, and columns left out are named."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from footwork.doors import tables
from footwork.study import sweep
from footwork.study.experiments import EXPERIMENTS, find_row
from footwork.study.plan import FULL, Study, plan

LONGEST = max(EXPERIMENTS, key=len)


def printed(table, width):
    console = Console(width=width, file=io.StringIO())
    tables.fit(table, console)
    console.print(table)
    return console.file.getvalue()


def cells_of(table, column):
    return [str(cell) for cell in table.columns[column].cells]


def all_rows():
    return tables.rows_table([find_row(name) for name in EXPERIMENTS], dict.fromkeys(EXPERIMENTS, "packaged"), True)


def whole_plan():
    jobs = plan(Study("runs", FULL))
    return tables.plan_table(dict.fromkeys(jobs, 0), set(jobs), "full")


def evaluated(row, success):
    report = {"row": row, "engine": "mujoco", "episodes": 1000, "episode_steps": 2000, "progress_m": 17.25}
    report |= {"success": success, "fall_rate": 1.0, "flip_rate": 0.5, "time_to_goal_s": 16.25}
    interval = {"fall_rate": [0.996, 1.0], "flip_rate": [0.469, 0.531]}
    if success:
        interval["success"] = {radius: [0.996, 1.0] for radius in success}
    return report | {"interval": interval, "speed_mps": {name: [2.5] for name in tables.DIRECTIONS}}


def two_masters():
    success = dict.fromkeys(map(str, tables.SUCCESS_RADII), 1.0)
    rows = ("maze/hrl/symmetric-interleaved", "maze/flat/free")
    return tables.evaluation_table([evaluated(row, success) for row in rows])


def walker():
    return tables.evaluation_table([evaluated("walker/symmetric-interleaved", None)])


def switched():
    figures = {"speed_mps": 2.08, "idle": 1.0, "upside_down": 1.0, "fallen": 1.0}
    row = "walker/symmetric-interleaved"
    return tables.switching_table(
        {"row": row, "engine": "mujoco", "orthogonal": True, "switching": {"25": figures, "200": figures}}
    )


@pytest.mark.parametrize("make", [all_rows, whole_plan, two_masters, walker, switched])
@pytest.mark.parametrize("width", [60, 80, 100, 200])
def test_a_terminal_cuts_no_cell(make, width):
    table = make()
    shown = printed(table, width)
    assert "…" not in shown
    assert max(map(len, shown.splitlines())) <= width
    words = "".join(shown.split())
    for column in range(1, len(table.columns)):
        for cell in cells_of(table, column):
            assert all(word in words for word in cell.split())


def test_what_a_narrow_terminal_does_without_is_named_and_a_wide_one_has_it():
    narrow = printed(all_rows(), 80)
    assert "want of width without: S, needs, task, trains, k" in narrow
    assert all(name in "".join(narrow.split()) for name in EXPERIMENTS)
    wide = printed(all_rows(), 200)
    assert "want of width" not in wide
    assert all(header in wide for header in ("S", "needs", "task", "trains", "k"))


def test_figures_stand_beside_their_names():
    shown = printed(two_masters(), 80).splitlines()
    (line,) = (line for line in shown if "within 0.5 m" in line)
    assert line.count("100.0 [99.6, 100.0]") == 2
    (line,) = (line for line in shown if "flip" in line)
    assert line.count("50.0 [46.9, 53.1]") == 2
    (line,) = (line for line in printed(walker(), 80).splitlines() if "left, m/s" in line)
    assert "2.50" in line


@pytest.mark.parametrize("failed", [False, True])
def test_the_live_table_of_a_sweep_fits_80_characters(tmp_path, failed):
    study = Study(tmp_path, FULL)
    jobs = [job for job in plan(study) if job.row in (LONGEST, "walker/plain")]
    board = sweep.Board(study, jobs)
    board.active.update(job for job in jobs if job.seed < 2)
    if failed:
        board.failed[jobs[-1]] = "no memory"
    console = Console(width=80, file=io.StringIO())
    console.print(sweep.board_table(board))
    shown = console.file.getvalue()
    assert "…" not in shown
    assert "walker/plain" in shown
    assert LONGEST[:40] in shown  # the end of a long name goes on below
    assert shown.count("seed 1:   0%") == 2
    lines = shown.splitlines()
    assert max(map(len, lines)) <= 80
    assert sum(line.endswith("failed") for line in lines[1:]) == failed
