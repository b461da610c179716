"""The study's table, plan, results, claims, figures and report, on folders written in milliseconds."""

from __future__ import annotations

import itertools
import json
import re
import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fake_study import fake_run, write
from footwork.arena import MAZES
from footwork.doors.cli import run
from footwork.evaluate import Episodes
from footwork.learn.config import PAPER
from footwork.record import RunDir, RunError, read_metrics
from footwork.regularisers import Interleaved
from footwork.statistics import Effect, iqm
from footwork.study import (
    answers,
    association,
    claims,
    judging,
    measure,
    plan,
    report,
    report_files,
    results,
    row_tables,
    training_curves,
)
from footwork.study.experiments import (
    ANTS,
    EXPERIMENTS,
    FLAT_GRIDS,
    GRIDS,
    GRIDS_BY_NAME,
    INTERLEAVED_WITHOUT,
    LIGHT_WITH_BONUS,
    MAIN,
    MORE_REGULARISED_MASTERS,
    PAPER_MASTERS_VARIED,
    SCHEDULES,
    find_row,
    is_row,
    match_rows,
)
from footwork.study.figures import FIGURES, curves, draw_figures, find_figures, measures, style
from footwork.study.metrics import METRICS
from footwork.study.plan import FULL, QUICK, Study
from footwork.study.runs import run_path
from footwork.train import planned_steps, steps_per_iteration

WALKERS = ("walker/plain", "walker/random-start", "walker/random-repeated", "walker/appropriate-bias")
KINDS = ("plain", "random-start", "random-repeated", "appropriate-bias")


@pytest.fixture
def study(tmp_path):
    return Study(tmp_path / "runs")


@pytest.fixture
def one_figure(monkeypatch):
    """Reports have one figure only, one that is quickly drawn."""
    (figure,) = find_figures(["4"])
    monkeypatch.setattr(report, "FIGURES", (figure,))
    return figure


def fill(study, rows, seeds, **how):
    for row in rows:
        for seed in range(seeds):
            fake_run(study, row, seed, **how)


# ---------------------------------------------------------------- the table


def test_grids_are_rows_that_differ_in_one_field():
    for grid in GRIDS:
        for row in grid.rows():
            assert EXPERIMENTS[row.name] == row
            assert row != MAIN[grid.base]
        assert grid.base in grid.points().values()
    points = GRIDS_BY_NAME["ablation/maze/k"].points()
    assert [*points] == [10, 20, 50, 100, 200, 400]
    assert find_row(points[100]).option_steps == 100
    assert find_row("ablation/random-start/t/25").regulariser.steps == 25
    bonus = GRIDS_BY_NAME["ablation/bandit/flat-free-bonus"].points()
    assert bonus == {0.0: "ablation/bandit/flat-free-bonus/0.0", 0.02: "bandit/flat/free"}
    annealed = find_row("ablation/bandit/flat-free-annealing/4882")
    assert annealed.ppo.anneal_updates == planned_steps(annealed) // steps_per_iteration(annealed)


def test_rows_of_another_ant_stand_on_rows_of_that_ant():
    row = find_row("light/maze/hrl/appropriate-bias")
    assert row.task.robot.name == "light"
    assert row.needs == "light/walker/appropriate-bias"
    assert find_row(row.needs).needs == "light/walker/plain"


def test_patterns_mean_rows():
    assert match_rows(()) == list(EXPERIMENTS)
    assert match_rows(["maze/flat/*"]) == [
        f"maze/flat/{k}" for k in ("penalised", "free", "guided-penalised", "guided-free")
    ]
    with pytest.raises(ValueError, match=r"no row matches 'maze/fast/\*'; known rows: walker/\*, "):
        match_rows(["maze/fast/*"])
    with pytest.raises(ValueError, match=r"unknown row 'maze/hrl/plian'; nearest: .*maze/hrl/plain"):
        match_rows(["maze/hrl/plian"])


# ---------------------------------------------------------------- the plan


def test_a_plan_makes_what_a_run_stands_on_first_and_every_row_before_the_second_seed(study):
    few = "ablation/walker/bonus/0.0"
    jobs = plan.plan(study, ["maze/hrl/appropriate-bias", few])
    first = [job.row for job in jobs if job.seed == 0]
    assert first == ["walker/plain", "walker/appropriate-bias", "maze/hrl/appropriate-bias", few]
    assert [job.seed for job in jobs] == sorted(job.seed for job in jobs)
    seeds = {row: sum(job.row == row for job in jobs) for row in first}
    assert seeds == {
        "walker/plain": 10,
        "walker/appropriate-bias": 10,
        "maze/hrl/appropriate-bias": 10,
        few: 3,
    }
    assert {job.steps for job in jobs if job.row == "walker/plain"} == {4 * 1_998_848}
    assert len(plan.plan(study, ["walker/plain"], seeds=2)) == 2
    with pytest.raises(ValueError, match="seeds must be >= 1, got 0"):
        plan.plan(study, ["walker/plain"], seeds=0)


def test_rows_that_a_claim_reads_get_ten_seeds_on_every_ant_of_the_table(study):
    assert {name.partition("/")[0] for name in EXPERIMENTS} - {name.partition("/")[0] for name in MAIN} == {
        "ablation",
        *(ant.rstrip("/") for ant in ANTS if ant),
    }
    seeds = Counter(job.row for job in plan.plan(study))
    assert {seeds[row] for row in claims.rows_read(ANTS)} == {10}
    assert {seeds["light/bandit/hrl/interleaved"], seeds["light/ablation/annealed/plain"]} == {3}


def test_the_quick_study_is_short_and_has_every_row_of_a_claim(tmp_path):
    quick = Study(tmp_path, QUICK)
    jobs = plan.plan(quick)
    assert set(claims.rows_read()) <= {job.row for job in jobs}
    assert [job.row for job in jobs if job.row.startswith("light/")] == ["light/walker/plain"] * QUICK.seeds
    assert max(job.steps for job in jobs) < 200_000
    annealed = quick.row("walker/interleaved")
    assert annealed.ppo.anneal_updates * annealed.ppo.batch_size == annealed.total_steps


def test_a_folder_holds_one_study(tmp_path):
    plan.mark(Study(tmp_path / "a", QUICK))
    assert plan.read_mark(tmp_path / "a") == QUICK
    with pytest.raises(RunError, match="holds the quick study, not the full one"):
        plan.mark(Study(tmp_path / "a", FULL))
    fake_run(Study(tmp_path / "b"), "walker/plain", 0)
    with pytest.raises(RunError, match="not of the quick study"):
        plan.mark(Study(tmp_path / "b", QUICK))
    (tmp_path / "a" / plan.STUDY_FILE).write_text("{")
    with pytest.raises(RunError, match=r"study\.json is damaged"):
        plan.read_mark(tmp_path / "a")


# ---------------------------------------------------------------- measurements


def test_the_straight_line_of_the_u_maze_stops_at_its_wall():
    np.testing.assert_allclose(measure.straight_line_stop(MAZES["u"]), (-4.0, -2.4), atol=0.02)
    assert measure.straight_line_stop(find_row("bandit/flat/free").task.arena) is None


def test_arrivals_by_hand():
    """Four episodes in the U maze: in the goal, at the wall, at the wall after the goal, still at the start."""
    ends = np.array([(-4.0, 4.0), (-4.0, -2.5), (-4.0, -2.5), (-4.0, -4.0)])
    episodes = Episodes(
        closest=np.array([0.1, 6.5, 0.4, 8.0]),
        fallen=np.zeros(4, bool),
        flipped=np.zeros(4, bool),
        progress=np.zeros(4),
        distance=np.zeros(4),
        time_to_goal=np.array([10.0, np.nan, 20.0, np.nan]),
        paths=np.stack([np.broadcast_to((-4.0, -4.0), (4, 2)), ends]),
        choices=np.zeros((0, 4), np.int32),
        ended=np.zeros((1, 4), bool),
    )
    found = measure.arrivals(find_row("maze/flat/free"), episodes)
    assert found["way"] == pytest.approx((8 + 1.5 + 1.5 + 0) / 4 / 8)
    assert found["stuck"] == 0.25
    assert found["success"]["1.0"] == 0.5
    assert found["time_to_goal_s"] == 15.0


def test_success_is_counted_within_a_radius(study):
    path = fake_run(study, "bandit/flat/free", 0) / "evaluation.json"
    content = json.loads(path.read_text())
    content["by_seed"][0]["success"] |= {"0.5": 0.25, "1.0": 0.5}
    path.write_text(json.dumps(content))
    held = results.Results(study)
    assert [held.scores("bandit/flat/free", name).item() for name in ("success", "success close")] == [0.5, 0.25]


# ---------------------------------------------------------------- results


def test_metrics_of_where_episodes_end(study):
    """At the goal, at the wall, half-way around it, at the start: the straight line and the way around disagree."""
    path = fake_run(study, "maze/flat/free", 0)
    content = json.loads((path / "evaluation.json").read_text())
    content["by_seed"][0]["ends"] = [[-4.0, 4.0], [-4.0, -2.5], [4.0, -4.0], [-4.0, -4.0]]
    write(path / "evaluation.json", content)
    score = {name: results.Results(study).scores("maze/flat/free", name) for name in ("route", "stuck close")}
    score["at the start"] = results.Results(study).scores("maze/flat/free", "at the start")
    whole = 17.99  # m around the wall
    after_eight = 1 - (whole - 8) / whole
    assert score["route"] == pytest.approx((1 + 0 + after_eight + 0) / 4, abs=0.05)
    assert score["stuck close"] == 0.25
    assert score["at the start"] == 0.25
    fake_run(study, "bandit/flat/free", 0)
    assert len(results.Results(study).scores("bandit/flat/free", "route")) == 0


def test_fluctuation_is_not_fooled_by_a_trend(study, monkeypatch):
    """Noise of a known deviation on a steep line: the line does not count."""
    fake_run(study, "walker/plain", 0)
    noise = np.random.default_rng(0).normal(0, 20.0, (100, 4))
    line = np.linspace(0, 400, 100)[:, None] + noise
    curve = results.Curve(np.arange(100.0), np.arange(100.0), np.ones((100, 4)), {"return": line})
    monkeypatch.setattr(results, "read_curve", lambda run, experiment: curve)
    (found,) = results.Results(study).scores("walker/plain", "fluctuation")
    np.testing.assert_allclose(found, 20.0, rtol=0.35)


def test_curves_are_the_runs_metrics_in_bins(study):
    path = fake_run(study, "walker/plain", 0, lines=40)
    run, experiment = RunDir(path), find_row("walker/plain")
    curve = training_curves.read_curve(run, experiment)
    lines = read_metrics(run.metrics_path)
    assert curve.step[-1] == run.summary()["steps"]
    np.testing.assert_array_equal(curve.episodes.sum(axis=0), np.sum([line["episode/count"] for line in lines], axis=0))
    late = lines[-4:]
    counts = np.array([line["episode/count"] for line in late])
    returns = np.nan_to_num(np.array([line["episode/return"] for line in late]))
    np.testing.assert_allclose(
        training_curves.mean_between(curve, "return", 0.9, 1.0),
        (counts * returns).sum(axis=0) / counts.sum(axis=0),
        rtol=1e-4,
    )
    run.metrics_path.unlink()  # what is kept of the curve is enough, and nearly the same
    kept = training_curves.read_curve(run, experiment)
    np.testing.assert_allclose(kept.values["return"], curve.values["return"], rtol=1e-4)
    other = fake_run(study, "walker/plain", 1)  # a curve of another run is no curve of this one
    training_curves.read_curve(RunDir(other), experiment)
    shutil.copyfile(other / training_curves.CURVE, path / training_curves.CURVE)
    for _ in range(2):
        with pytest.raises(RunError, match=r"curve\.json is damaged, or of another run.*metrics\.jsonl is not there"):
            training_curves.read_curve(run, experiment)
        (path / training_curves.CURVE).write_bytes((other / training_curves.CURVE).read_bytes()[:-9])
    (path / training_curves.CURVE).unlink()
    with pytest.raises(RunError, match=r"curve\.json is missing, and .*metrics\.jsonl is not there"):
        training_curves.read_curve(run, experiment)


def side_by_side(paths):
    """One run of the seeds of several, in place of those: twice as fast a run as each, in the control steps of all."""
    together = paths[0].with_name("seeds-" + "-".join(path.name.rpartition("-")[2] for path in paths))
    shutil.copytree(paths[0], together)
    files = [{name: json.loads((path / name).read_text()) for name in ("DONE", "evaluation.json")} for path in paths]
    done, evaluation = files[0]["DONE"], files[0]["evaluation.json"]
    config = json.loads((together / "config.json").read_text())
    done["seeds"] = config["config"]["seeds"] = [seed for file in files for seed in file["DONE"]["seeds"]]
    evaluation["by_seed"] = [entry for file in files for entry in file["evaluation.json"]["by_seed"]]
    for name, content in (("DONE", done), ("evaluation.json", evaluation), ("config.json", config)):
        write(together / name, content)
    with (together / "metrics.jsonl").open("w") as file:
        for lines in zip(*(read_metrics(path / "metrics.jsonl") for path in paths), strict=True):
            line = {name: lines[0][name] for name in ("step", "time/steps_per_second")}
            line["time/steps_per_second"] *= 2
            for name in lines[0].keys() - line.keys():
                line[name] = [*itertools.chain(*(other[name] for other in lines))]
            file.write(json.dumps(line).replace("NaN", '"nan"') + "\n")
    for path in paths:
        shutil.rmtree(path)
    return together


def test_seeds_that_trained_side_by_side_count_as_they_would_alone(study):
    row = "maze/flat/free"
    paths = [fake_run(study, row, seed) for seed in (3, 4, 5)]
    fake_run(study, row, 0)
    alone = results.Results(study)
    ways, curves = alone.scores_by_seed(row, "way"), alone.curves(row)
    seconds = alone.training_seconds(row)
    side_by_side(paths)
    together = results.Results(study)
    assert together.scores_by_seed(row, "way") == ways
    for (_, one), (sample, other) in zip(curves, together.curves(row), strict=True):
        np.testing.assert_array_equal(one.values["progress"], other.values["progress"])
        if sample.seed:  # at twice the rate, each takes half of what it would alone
            np.testing.assert_allclose(other.seconds[-1], curves[1][1].seconds[-1] / 2, rtol=1e-2)
    assert together.training_seconds(row)[0] == seconds[0]
    assert not together.said()
    made = "\n".join(str(block) for block in report._made(together, [row], "footwork report"))
    train, reproduce = made.index("footwork train maze/flat/free --seeds 3 4 5  #"), made.index("footwork reproduce")
    assert train < reproduce
    assert "footwork reproduce --rows maze/flat/free --seeds 6" in made


def test_what_does_not_count_is_left_out_by_name(study):
    row = "maze/flat/free"
    paths = [fake_run(study, row, seed) for seed in range(6)]
    (paths[1] / "DONE").unlink()
    config = json.loads((paths[2] / "config.json").read_text())
    config["config"]["experiment"]["task"]["xy_scale"] = 0.5
    write(paths[2] / "config.json", config)
    write(paths[3] / "DONE", {"row": row, "seeds": [3], "steps": 500_000})
    config = json.loads((paths[4] / "config.json").read_text())
    config["config"]["experiment"]["wings"] = 2
    config["versions"]["footwork"] = "9.9"
    write(paths[4] / "config.json", config)
    shutil.copytree(paths[5], paths[5].with_name("seeds-5"))
    write(fake_run(study, row, 6) / "DONE", {})
    for name in ("DONE", "evaluation.json"):  # of another row, and whole
        shutil.copy(fake_run(study, "maze/flat/penalised", 7) / name, fake_run(study, row, 7 if name == "DONE" else 8))
        shutil.rmtree(study.runs / "maze/flat/penalised")
    config = json.loads((fake_run(study, row, 9) / "config.json").read_text())
    config["config"]["seeds"] = []
    write(study.runs / row / "seed-9/config.json", config)
    (study.runs / row / "seed-10").write_text("no folder")
    found = results.Results(study)
    assert [sample.seed for sample in found.samples(row)] == [0, 5, 8]
    assert len(found.scores(row, "way")) == 2
    for words in (
        "seed-1 is not finished",
        "seed-2 was trained with other fields than maze/flat/free",
        "seed-3 is 500,000 steps long, maze/flat/free takes 9,998,336",
        "seed-4 is of another version of footwork (9.9)",
        f"seeds-5: seed 5 is in {paths[5]} too",
        "seed-6/DONE is damaged or of another version of footwork: it does not say steps",
        "seed-7/DONE is of maze/flat/penalised seeds [7], the run was begun as maze/flat/free [7]",
        "seed-8/evaluation.json is of maze/flat/penalised, the run is of maze/flat/free",
        "seed-9/config.json is damaged: its seeds are []",
        "seed-10 is a file where a folder of runs was to be",
    ):
        assert any(words in problem for problem in found.problems), words
    assert [sample.seed for sample in results.Results(study, any_length=True).samples(row)] == [0, 3, 5, 8]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: path.unlink(), "is missing"),
        (lambda path: path.write_bytes(path.read_bytes()[:-20]), "is truncated or damaged"),
        (lambda path: write(path, {**json.loads(path.read_text()), "format": 99}), "of another version"),
        (lambda path: write(path, {**json.loads(path.read_text()), "steps": 1}), "is of a policy 1 steps old"),
        (
            lambda path: write(path, {**json.loads(path.read_text()), "row": "maze/flat/penalised"}),
            "the run is of maze",
        ),
        (lambda path: write(path, {**json.loads(path.read_text()), "size": "quick"}), "is of the quick study"),
        (
            lambda path: write(path, {**json.loads(path.read_text()), "by_seed": [{"seed": 0, "way": 0.5}]}),
            "of another version of footwork: it does not say fall_rate",
        ),
        (lambda path: with_entry(path, success={}), "of another version of footwork: it does not say 0.45"),
        (lambda path: with_entry(path, way="far"), "is damaged: a number in it is none, or out of its bounds"),
        (lambda path: path.write_text("[" * 100_000), "is truncated or damaged"),
        (lambda path: with_entry(path, ends=[[1.0, float("nan")]]), "a number in it is none, or out of its bounds"),
        (lambda path: with_entry(path, way=7), "a number in it is none, or out of its bounds"),
        (lambda path: with_entry(path, way=True), "a number in it is none, or out of its bounds"),
        (lambda path: with_entry(path, stuck=None), "a number in it is none, or out of its bounds"),
        (lambda path: with_entry(path, speed_mps={}, ends=None), "a number in it is none, or out of its bounds"),
        (
            lambda path: with_entry(path, ends=[[1.0, 2.0], [3.0]]),
            "is damaged: a number in it is none, or out of its bounds",
        ),
        (
            lambda path: with_entry(path, paths=[{"xy": 3, "choices": []}]),
            "is damaged: a number in it is none, or out of its bounds",
        ),
        (lambda path: write(path, {**json.loads(path.read_text()), "by_seed": [3]}), "holds no entries"),
    ],
)
def test_damaged_measurements_are_named_and_how_to_make_them_again(study, damage, message):
    path = fake_run(study, "maze/flat/free", 0)
    damage(path / "evaluation.json")
    found = results.Results(study)
    assert len(found.scores("maze/flat/free", "way")) == 0
    (problem,) = found.problems
    assert message in problem
    again = f"footwork reproduce --rows maze/flat/free --runs {study.runs}"
    assert f"delete {path}, and {again} trains it again" in problem  # it has no policy


def with_entry(path, **fields):
    content = json.loads(path.read_text())
    content["by_seed"][0] |= fields
    write(path, content)


def test_a_damaged_matrix_of_hand_overs_is_named(study):
    path = fake_run(study, "walker/plain", 0) / "transitions.json"
    (entry,) = json.loads(path.read_text())["by_seed"]
    cells = entry["handover"]
    for damaged in (
        {"handover": cells[:3]},
        {"handover": [[{**cell, "success": -3} for cell in line] for line in cells]},
        {"handover": [[{**cell, "success": "0.5"} for cell in line] for line in cells]},
        {"switching": {}},
        {"seed": 0.5},
    ):
        with_entry(path, **{**entry, **damaged})
        found = results.Results(study)
        assert len(found.scores("walker/plain", "handover")) == 0
        assert any("transitions.json is damaged" in problem for problem in found.problems)
    some = {k: figures for k, figures in entry["switching"].items() if k != "50"}
    with_entry(path, **{**entry, "switching": some})
    found = results.Results(study)
    assert len(found.scores("walker/plain", "moving")) == 0
    assert any("does not say how random switching every 50 steps went" in problem for problem in found.problems)


def test_half_a_curve_is_none(study):
    path = fake_run(study, "walker/plain", 0)
    training_curves.read_curve(RunDir(path), find_row("walker/plain"))
    content = json.loads((path / training_curves.CURVE).read_text())
    half = {name: content[name][:50] for name in ("step", "seconds", "episodes")}
    values = {name: value[:50] for name, value in content["values"].items()}
    write(path / training_curves.CURVE, {**content, **half, "values": values})
    (path / "metrics.jsonl").unlink()
    with pytest.raises(RunError, match=r"curve\.json is damaged"):
        training_curves.read_curve(RunDir(path), find_row("walker/plain"))


@pytest.mark.parametrize("values", [[], {}, {"return": [[1.0]], "progress": [[1.0]], "success": [[1.0]]}, None])
def test_a_damaged_curve_is_made_again_where_the_metrics_are_and_named_where_they_are_not(study, values):
    path = fake_run(study, "walker/plain", 0)
    run, experiment = RunDir(path), find_row("walker/plain")
    whole = training_curves.read_curve(run, experiment)
    content = json.loads((path / training_curves.CURVE).read_text())
    write(path / training_curves.CURVE, {**content, "values": values})
    np.testing.assert_array_equal(training_curves.read_curve(run, experiment).step, whole.step)
    write(path / training_curves.CURVE, {**content, "values": values})
    run.metrics_path.unlink()
    found = results.Results(study)
    assert len(found.scores("walker/plain", "return")) == 0
    assert any("curve.json is damaged" in problem for problem in found.problems)


def test_folders_that_no_row_would_find_are_named(study):
    fake_run(study, "maze/flat/free", 0)
    fake_run(study, "maze/flat/free", 1).joinpath("config.json").unlink()
    fake_run(study, "walker/plain", 0).rename(study.runs / "walker" / "plainn")
    shutil.copytree(study.runs / "maze", study.runs / "mase")
    (study.runs / "maze/flat/free/seed-3").symlink_to(study.runs / "nowhere")
    found = results.strays(study)
    assert len(found) == 5
    assert any("maze/flat/free/seed-3 is a link to nothing" in problem for problem in found)
    for words in ("seed-1 has no config.json", "walker/plainn lies where no row", "mase/flat/free/seed-0 lies where"):
        assert any(words in problem for problem in found), words
    assert not any("/maze/flat/free/seed-0" in problem for problem in found)


@pytest.mark.parametrize("inside", ["results", "results/full", "results/a/b"])
def test_a_report_never_costs_the_runs_that_it_is_made_from(study, inside, tmp_path, capsys, one_figure):
    fill(study, ("walker/plain",), 2)
    (tmp_path / "out" / inside).parent.mkdir(parents=True)
    runs = study.runs.rename(tmp_path / "out" / inside)
    before = sorted(path for path in runs.rglob("*") if path.is_file())
    status = run(["report", "--runs", str(runs), "--to", str(tmp_path / "out")])
    assert status == (0 if inside == "results" else 1)
    if status:
        assert "would be replaced, and the runs in" in capsys.readouterr().err
    assert set(before) <= {path for path in runs.rglob("*") if path.is_file()}


def test_a_report_replaces_what_a_report_wrote_and_nothing_else(study, tmp_path, capsys, one_figure):
    fill(study, ("walker/plain",), 2)
    to = tmp_path / "out"
    (to / "results").mkdir(parents=True)
    (to / "results" / "mine.txt").write_text("years of work")
    assert run(["report", "--runs", str(study.runs), "--to", str(to)]) == 1
    assert "holds results, and no report wrote it" in capsys.readouterr().err
    (to / "results" / "mine.txt").unlink()
    (to / "REPORT.md").write_text("my own")
    assert run(["report", "--runs", str(study.runs), "--to", str(to)]) == 1
    assert "holds REPORT.md, and no report wrote it" in capsys.readouterr().err
    assert (to / "REPORT.md").read_text() == "my own"
    (to / "REPORT.md").unlink()
    (study.runs / "walker/plain/seed-1/policy.safetensors").write_bytes(b"torn")  # it is missed, and said, no more
    for _ in range(2):
        assert run(["report", "--runs", str(study.runs), "--to", str(to)]) == 0
        assert len(list((to / "results").rglob("DONE"))) == 2
        assert not list(to.glob(".results*"))
        assert "the report's results lack it" in (to / "REPORT.md").read_text()


def test_a_report_takes_away_older_figures_and_nobody_elses(study, tmp_path, one_figure):
    fill(study, ("walker/plain",), 1)
    figures = tmp_path / "figures"
    name = f"{one_figure.name}.png"
    for folder in ("", "light", "mine", "mine/light"):
        (figures / folder).mkdir(parents=True, exist_ok=True)
        (figures / folder / name).write_text("before")
    report.write_report(results.Results(study), tmp_path, "footwork report")
    assert (figures / "light" / name).exists()  # no report had written there
    report.write_report(results.Results(study), tmp_path, "footwork report")
    assert not (figures / "light").exists()
    assert (figures / name).read_bytes() != b"before"
    assert (figures / "mine" / name).read_text() == (figures / "mine/light" / name).read_text() == "before"


def test_a_report_of_fewer_runs_never_replaces_one_of_more(study, tmp_path, capsys, one_figure):
    fill(study, ("walker/plain",), 3)
    to = tmp_path / "out"
    assert run(["report", "--runs", str(study.runs), "--to", str(to)]) == 0
    few = Study(tmp_path / "few")
    fill(few, ("walker/plain",), 1)
    asked = ["--rows", "walker/plain", "--seeds", "1", "--runs", str(few.runs), "--to", str(to)]
    for command in (["report", "--runs", str(few.runs), "--to", str(to)], ["reproduce", *asked]):
        assert run(command) == 1
        said = capsys.readouterr().err
        assert "it holds 2 finished runs that" in said
        assert "lacks (walker/plain/seed-1)" in said
        assert f"(mkdir -p {few.runs} && cp -rn {to / 'results'}/. {few.runs})" in said
    assert len(list((to / "results").rglob("DONE"))) == 3
    shutil.copytree(to / "results", few.runs, dirs_exist_ok=True)  # what was advised, works
    assert run(["report", "--runs", str(few.runs), "--to", str(to)]) == 0
    for damage in ("config.json", "evaluation.json", "transitions.json"):
        path = study.runs / "walker/plain/seed-2" / damage
        whole = path.read_bytes()
        path.write_bytes(whole[:50])
        assert run(["report", "--runs", str(study.runs), "--to", str(to)]) == 1
        assert re.search(r"would lose \d+ of its files, walker/plain/seed-2/", capsys.readouterr().err)
        path.write_bytes(whole)
    assert (to / "results/walker/plain/seed-2/config.json").read_bytes() == (
        study.runs / "walker/plain/seed-2/config.json"
    ).read_bytes()


def test_studies_of_different_sizes_do_not_replace_each_other(study, tmp_path, capsys, one_figure):
    fill(study, ("walker/plain",), 1)
    assert run(["report", "--runs", str(study.runs), "--to", str(tmp_path / "out")]) == 0
    quick = Study(tmp_path / "quick", QUICK)
    plan.mark(quick)
    fake_run(quick, "walker/plain", 0, size=QUICK)
    assert run(["report", "--runs", str(quick.runs), "--to", str(tmp_path / "out")]) == 1
    assert "is of the full study, not of the quick one" in capsys.readouterr().err
    assert run(["report", "--runs", str(quick.runs), "--to", str(quick.runs)]) == 1
    assert "is the folder of the runs" in capsys.readouterr().err
    (tmp_path / "file").touch()
    asked = ["reproduce", "--rows", "walker/plain", "--runs", str(study.runs), "--to", str(tmp_path / "file")]
    assert run(asked) == 1  # before anything is trained
    assert "file is a file, and a folder is wanted" in capsys.readouterr().err
    assert run(["figures", "4", "--runs", str(study.runs), "--to", str(tmp_path / "file")]) == 1
    assert "file is a file, and a folder is wanted" in capsys.readouterr().err


def test_results_that_a_killed_report_had_put_aside_come_back(study, tmp_path, one_figure):
    fill(study, ("walker/plain",), 2)
    to = tmp_path / "out"
    assert run(["report", "--runs", str(study.runs), "--to", str(to)]) == 0
    (to / "results").rename(to / ".results.old")  # as a kill between the two renames leaves it
    fill(Study(tmp_path / "few"), ("walker/plain",), 1)
    assert run(["report", "--runs", str(tmp_path / "few"), "--to", str(to)]) == 1
    assert len(list((to / "results").rglob("DONE"))) == 2
    assert not (to / ".results.old").exists()


def test_runs_on_another_engine_are_found_whatever_they_are_and_keep_what_others_stand_on(study, tmp_path, monkeypatch):
    fill(study, ("bullet/maze/flat/free",), 2)
    found = results.Results(study)
    assert results.prefixes_at_hand(found) == ("", "bullet/")
    assert "bullet/maze/flat/free" in results.all_rows(found)
    fill(study, ("bullet/walker/plain",), 2)
    (study.runs / "bullet/walker/plain/seed-1/policy.safetensors").write_bytes(b"torn")
    found = results.Results(study)
    found.samples("bullet/walker/plain")
    report_files.export(found, tmp_path / "out/results")
    assert any("the report's results lack it" in problem for problem in found.problems)  # the second seed's is wanted


def test_a_report_of_nothing_is_refused_with_the_reasons(study, tmp_path, capsys):
    study.runs.mkdir(parents=True, exist_ok=True)
    fake_run(study, "walker/plain", 0).joinpath("DONE").unlink()
    assert run(["report", "--runs", str(study.runs), "--to", str(tmp_path / "out")]) == 1
    said = capsys.readouterr()
    assert "no finished run of any row counts in" in said.err
    assert "seed-0 is not finished" in said.out


def test_a_figure_is_saved_with_its_layout_rounded(tmp_path):
    """The last digits of a layout differ between processes, and an SVG names its parts after them."""
    figure, axes = style.panels(3, 3, 3.3)
    for ax in axes.flat:
        ax.set_xlabel("a label\nof two lines")
    style.save(figure, tmp_path / "figure")
    places = np.array([ax.get_position(original=True).bounds for ax in figure.axes])
    np.testing.assert_allclose(places, places.round(6), rtol=0, atol=1e-12)
    assert len(np.unique(places[:, 0])) == 3  # laid out, not piled up


def test_every_comparison_has_rows_in_some_setting():
    """One that is only shown is left out where there are no such rows: an address with a slip of the pen everywhere."""
    for claim in claims.CLAIMS:
        settings = claims.settings_of(claim, ("",))
        for compared in claim.contrasts:
            assert any(all(is_row(setting.fill(row)) for row in compared.rows) for setting in settings), compared


def test_masters_that_vary_a_field_differ_from_the_papers_in_nothing_else():
    assert len(PAPER_MASTERS_VARIED) == 8
    for row in PAPER_MASTERS_VARIED:
        _, place, _, kind = row.name.split("/")
        paper = find_row(f"{place}/paper/{kind}")
        assert row != replace(paper, name=row.name)
        if place == "maze":
            assert replace(row, name=paper.name, option_steps=50) == paper
        else:
            assert replace(row, name=paper.name, ppo=replace(row.ppo, minibatch_size=None)) == paper


def test_mixed_runs_are_named(study):
    for row in ("maze/flat/penalised", "maze/flat/free"):
        paths = [fake_run(study, row, seed) for seed in range(2)]
        config = json.loads((paths[0] / "config.json").read_text())
        config["versions"] |= {"mujoco": "3.3.0", "device": "NVIDIA H200"}
        write(paths[0] / "config.json", config)
    shutil.copy(paths[0] / "evaluation.json", paths[1])
    found = results.Results(study)
    assert len(found.scores("maze/flat/free", "way")) == 1
    found.samples("maze/flat/penalised")
    rows = "runs of maze/flat/{free,penalised} were made"  # one line for both
    assert sum(f"{rows} with different versions of mujoco: 3.3.0, " in line for line in found.said()) == 1
    assert f"{rows} on different devices: NVIDIA H200, the CPU" in found.said()
    assert any("evaluation.json is of seeds [0], the run has [1]: delete" in problem for problem in found.problems)


def test_truncated_metrics_are_named(study):
    path = fake_run(study, "walker/plain", 0) / "metrics.jsonl"
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[:-3]))
    found = results.Results(study)
    assert len(found.scores("walker/plain", "return")) == 0
    assert any("metrics.jsonl is truncated" in problem for problem in found.problems)


# ---------------------------------------------------------------- claims


@pytest.mark.parametrize(
    ("rule", "bound", "effect", "verdict"),
    [
        ("greater", 0.05, (0.2, 0.1, 0.3), "holds"),
        ("greater", 0.05, (0.02, 0.01, 0.04), "does not hold"),
        ("greater", 0.05, (0.04, 0.01, 0.07), "undecided"),
        ("greater", 0.05, (0.2, -0.1, 0.5), "undecided"),
        ("not worse", 0.05, (0.0, -0.04, 0.04), "holds"),
        ("not worse", 0.05, (-0.2, -0.3, -0.1), "does not hold"),
        ("not worse", 0.05, (-0.03, -0.06, 0.01), "undecided"),
        ("same", 0.05, (0.0, -0.04, 0.04), "holds"),
        ("same", 0.05, (0.2, 0.1, 0.3), "does not hold"),
        ("same", 0.05, (0.04, -0.02, 0.1), "undecided"),
        ("at least", 0.95, (0.97, 0.96, 0.98), "holds"),
        ("at least", 0.95, (0.9, 0.88, 0.94), "does not hold"),
        ("at most", 0.5, (0.4, 0.3, 0.5), "holds"),
        ("at most", 0.5, (0.4, 0.3, 0.6), "undecided"),
        ("at most", 0.5, (0.7, 0.6, 0.8), "does not hold"),
    ],
)
def test_the_rules(rule, bound, effect, verdict):
    assert judging.decide(rule, bound, Effect(*effect)) == verdict


def test_claims_read_rows_that_exist_with_metrics_that_exist():
    assert [claim.number for claim in claims.CLAIMS] == list(range(1, 16))
    assert set(claims.rows_read()) <= set(MAIN)
    for claim in claims.CLAIMS:
        assert claims.settings_of(claim)
        assert claim.min_seeds >= 10
        for what in claim.contrasts:
            assert what.metric in METRICS
            assert len(what.rows) == len(what.weights)
    everywhere = {claim.number for claim in claims.CLAIMS if claim.everywhere}
    assert everywhere == {7, 8, 9, 10, 11, 12, 14}


def verdicts(study, number):
    found = results.Results(study)
    return {j.where: j for j in judging.judge_all(found) if j.claim.number == number}


def test_verdicts_need_ten_seeds_and_say_so(study):
    rows = ("maze/paper/appropriate-bias", "maze/flat/free", "maze/flat/penalised")
    fill(study, rows, 4)
    where = "mujoco, heavy ant, the paper's reward and schedule"
    few = verdicts(study, 2)[where]
    assert few.verdict == "undecided"
    assert few.why == "4 seeds, 10 are asked for; so far: holds"
    for row in rows:
        for seed in range(4, 10):
            fake_run(study, row, seed)
    enough = verdicts(study, 2)[where]
    assert enough.verdict == "holds"
    against_free = next(f for f in enough.findings if f.contrast.words == "against flat, free")
    assert against_free.effect.low > 0.2
    assert against_free.probability == 1.0
    assert against_free.seeds == (10, 10)
    assert verdicts(study, 2)[where] == enough  # the intervals are the same each time
    missing = verdicts(study, 2)["mujoco, heavy ant, our reward, our masters' schedule"]
    assert missing.verdict == "undecided"
    assert "no runs of maze/hrl/appropriate-bias" in missing.why


def test_a_difference_of_the_other_sign_is_told_from_one_that_is_too_small(study):
    fill(study, ("maze/flat/free", "bandit/flat/free", "bandit/flat/penalised"), 10, quality=0.3)
    fill(study, ("maze/flat/penalised",), 10, quality=0.8)
    found = verdicts(study, 3)["mujoco, heavy ant, the paper's reward and schedule"]
    assert found.verdict == "does not hold"
    assert found.why == "10 seeds or more on every side; the other way round: maze"
    assert {f.contrast.metric for f in found.findings} == {"way", "success", "route"}


def test_shown_comparisons_do_not_decide_and_rows_of_ablations_do_not_ask_for_ten_seeds(study):
    fourteen = claims.CLAIMS[13]
    shown = {row for c in fourteen.contrasts if not c.decides for row in c.rows if row.startswith("ablation/annealed/")}
    assert shown == {f"ablation/annealed/{kind}" for kind in claims.PAPER_REGULARISERS}
    assert all(find_row(row).ppo.anneal_updates == find_row("walker/interleaved").ppo.anneal_updates for row in shown)
    assert find_row("ablation/annealed/appropriate-bias").needs == "ablation/annealed/plain"
    master = find_row("ablation/maze/hrl-annealed/random-start")
    assert master.needs == "ablation/annealed/random-start"
    assert replace(master, name="", sub_policies="") == replace(
        find_row("maze/hrl/random-start"), name="", sub_policies=""
    )
    assert not any(row.startswith("ablation/") for row in claims.rows_read())
    assert {"walker/plain", "walker/interleaved"} <= set(claims.rows_read())
    fill(study, ("light/walker/plain",), 2)
    light = verdicts(study, 14)["mujoco, light ant, our reward, our masters' schedule"]
    annealed = {row for f in light.findings if "annealed" in f.contrast.words for row in f.rows if "annealed" in row}
    assert {f"light/ablation/maze/hrl-annealed/{kind}" for kind in claims.PAPER_REGULARISERS} < annealed
    assert find_row("light/ablation/annealed/appropriate-bias").regulariser.partners == "light/ablation/annealed/plain"
    assert find_row("light/ablation/maze/hrl-annealed/plain").needs == "light/ablation/annealed/plain"
    assert not any("ablation" in row for row in claims.rows_read(("", "light/")))


def test_each_part_of_interleaving_is_left_out_alone():
    whole, plain = find_row("walker/interleaved"), find_row("walker/plain")
    lost = {
        "cooperation": {"regulariser": Interleaved(cooperative=False)},
        "annealing": {"ppo": PAPER},
        "ends-on-the-back": {"task": plain.task},
    }
    lost["all-three"] = {field: value for part in lost.values() for field, value in part.items()}
    assert [row.name.rpartition("/")[2] for row in INTERLEAVED_WITHOUT] == list(lost)
    for row in INTERLEAVED_WITHOUT:
        part = row.name.rpartition("/")[2]
        assert row == replace(whole, name=row.name, **lost[part])
        assert all(getattr(row, field) != getattr(whole, field) for field in lost[part])
        for place in ("bandit", "maze"):
            master, on_it = (
                find_row(f"{place}/hrl/interleaved"),
                find_row(f"ablation/{place}/hrl-interleaved-without/{part}"),
            )
            assert on_it == replace(master, name=on_it.name, sub_policies=row.name)
    assert replace(row, name=plain.name, regulariser=None) == plain  # nothing is left but the exchange


def test_masters_on_more_regularised_sub_policies_are_those_of_their_kind():
    assert len(MORE_REGULARISED_MASTERS) == 4
    for row in MORE_REGULARISED_MASTERS:
        _, place, rest = row.name.split("/", 2)
        assert row.sub_policies == f"ablation/{rest.removeprefix('hrl-')}"
        of_its_kind = find_row(f"{place}/{rest.replace('hrl-', 'hrl/').partition('/t/')[0]}")
        assert row == replace(of_its_kind, name=row.name, sub_policies=row.sub_policies)


def test_the_light_ants_sub_policies_get_no_bonus():
    light = [row for name, row in EXPERIMENTS.items() if name.startswith("light/")]
    assert {row.ppo.ent_coef for row in light if row.is_walker and row != LIGHT_WITH_BONUS} == {0.0}
    assert {row.ppo.ent_coef for row in light if not row.is_walker} == {PAPER.ent_coef}
    plain = find_row("light/walker/plain")
    assert LIGHT_WITH_BONUS.ppo == PAPER
    assert replace(LIGHT_WITH_BONUS, name=plain.name, ppo=plain.ppo) == plain


def test_every_comparison_has_its_rows_in_some_setting():
    for claim in claims.CLAIMS:
        settings = claims.settings_of(claim, ("", "light/", "bullet/"))
        for c in claim.contrasts:
            assert any(all(is_row(setting.fill(row)) for row in c.rows) for setting in settings), c.words


def test_on_another_engine_the_papers_setting_is_judged_once_it_has_masters(study):
    ours, papers = (f"bullet, heavy ant, {schedule}" for schedule in (SCHEDULES["hrl"], SCHEDULES["paper"]))
    fill(study, ("bullet/walker/plain",), 1)
    assert set(verdicts(study, 12)) == {"mujoco, heavy ant", "bullet, heavy ant"}
    assert {ours, papers} & set(verdicts(study, 7)) == {ours}
    fill(study, ("bullet/bandit/paper/plain",), 1)
    assert {ours, papers} <= set(verdicts(study, 7))
    assert {ours, papers} & set(verdicts(study, 8)) == {ours}


def test_flat_policies_made_otherwise_are_shown_in_the_papers_setting_only(study):
    fill(study, ("bandit/paper/appropriate-bias",), 2, quality=0.9)
    fill(study, ("ablation/bandit/flat-free-bonus/0.0",), 2, quality=0.3)
    found = {
        setting: [f for f in judgement.findings if "ablation" in f.rows[1]]
        for setting, judgement in verdicts(study, 1).items()
    }
    paper, ours = found["mujoco, heavy ant, the paper's reward and schedule"], [*found.values()]
    assert [f.rows[1].rpartition("/")[0] for f in paper] == list(FLAT_GRIDS)
    assert paper[0].contrast.words == "against flat, free, without an entropy bonus"
    assert paper[0].so_far == "holds"
    assert [len(findings) for findings in ours] == [4, 0]


def test_verdicts_name_engine_and_ant_and_one_failing_comparison_is_enough(study):
    fill(study, ("walker/appropriate-bias", "walker/random-start"), 10)
    fill(study, ("walker/random-repeated",), 10, quality=0.8)
    fill(study, ("light/walker/plain",), 10, quality=0.2)
    assert verdicts(study, 10)["mujoco, heavy ant"].verdict == "does not hold"
    light = verdicts(study, 12)["mujoco, light ant"]
    assert light.verdict == "holds"
    assert verdicts(study, 12)["mujoco, heavy ant"].why == "no runs of walker/plain"


def test_masters_on_the_same_sub_policies_are_compared_seed_by_seed(study):
    """Each penalised master does 3 points worse than the free one that stands on the same sub-policies."""
    quality = dict(enumerate(np.linspace(0.2, 0.9, 10)))
    for seed, good in quality.items():
        for kind in ("plain", "appropriate-bias"):
            exactly(fake_run(study, f"bandit/paper/{kind}", seed), good)
            exactly(fake_run(study, f"bandit/paper-penalised/{kind}", seed), good - 0.03)
    found = verdicts(study, 13)["mujoco, heavy ant, the paper's reward and schedule"].findings
    plain = next(f for f in found if f.contrast.words == "bandit, plain" and f.contrast.metric == "way")
    assert plain.effect == pytest.approx((-0.03, -0.03, -0.03))
    assert plain.verdict == "holds"
    exactly(fake_run(study, "bandit/paper/plain", 10), 0.1)  # has no counterpart, and is left out by name
    held = results.Results(study)
    found = next(j for j in judging.judge_all(held) if j.claim.number == 13 and j.setting.schedule == "paper").findings
    again = next(f for f in found if f.contrast.words == "bandit, plain" and f.contrast.metric == "way")
    assert (again.effect, again.seeds) == (plain.effect, (10, 10))
    assert any("claim 13 compares bandit/paper/plain seed by seed" in problem for problem in held.problems)
    for row, way in {"bandit/paper/interleaved": 0.8, "bandit/paper-penalised/interleaved": 0.9}.items():
        exactly(fake_run(study, row, 0), way)
    exactly(fake_run(study, "bandit/paper/interleaved", 1), 0.1)  # likewise, but nothing is decided on it
    held = results.Results(study)
    whole = next(j for j in judging.judge_all(held) if j.claim.number == 13 and j.setting.schedule == "paper")
    shown = next(f for f in whole.findings if f.contrast.words == "bandit, interleaved")
    assert (shown.contrast.decides, shown.seeds, shown.effect.estimate) == (False, (1, 1), pytest.approx(0.1))
    assert shown.probability == 1.0
    assert whole.verdict == "undecided"  # AntMaze has no runs
    assert not any("random-start" in f.contrast.words for f in whole.findings)  # nor it, and nothing is decided on it
    assert "bandit/paper-penalised/interleaved" not in claims.rows_read()  # so that it gets no more seeds for it
    assert not any("paper/interleaved" in problem for problem in held.problems)


def test_a_verdict_rests_on_what_decided_and_names_what_is_missing(study):
    fill(study, ("bandit/flat/free",), 10, quality=0.3)
    fill(study, ("bandit/flat/penalised",), 10, quality=0.9)
    found = verdicts(study, 3)["mujoco, heavy ant, the paper's reward and schedule"]
    assert found.verdict == "does not hold"
    said = "10 seeds or more on every side; the other way round: bandit; no runs of maze/flat/{free,penalised}"
    assert found.why == said


def test_a_difference_that_had_no_room_is_said_to_have_had_none(study):
    fill(study, ("walker/random-repeated",), 10, quality=0.99)
    fill(study, ("walker/random-start", "walker/appropriate-bias"), 10, quality=0.5)
    assert re.search(
        r"against random-repeated, no more than \d\.\d points were possible",
        verdicts(study, 10)["mujoco, heavy ant"].why,
    )
    metrics = {f.contrast.metric for f in verdicts(study, 10)["mujoco, heavy ant"].findings}
    assert metrics == {"handover", "moving"}


def test_where_all_stand_at_the_wall_it_is_said_that_nothing_more_was_possible(study):
    """On AntMaze the straight line ends 1.59 m from the start, after 19.9 % of the way."""
    for kind, way in (("appropriate-bias", 0.16), ("plain", 0.17)):
        fill(study, (f"maze/paper/{kind}",), 10)
        for seed in range(10):
            end_at(study.runs / f"maze/paper/{kind}/seed-{seed}", (-4.0, -2.3))
            exactly(study.runs / f"maze/paper/{kind}/seed-{seed}", way)
    why = verdicts(study, 8)["mujoco, heavy ant, the paper's reward and schedule"].why
    assert "plain, about 2.9 points were possible up to the wall, and no episode ended over 0.25 m nearer" in why
    end_at(study.runs / "maze/paper/plain/seed-3", (-4.0, -2.18))  # 0.23 m nearer
    assert "possible" in verdicts(study, 8)["mujoco, heavy ant, the paper's reward and schedule"].why
    end_at(study.runs / "maze/paper/plain/seed-3", (-4.0, -2.14))  # 0.27 m nearer
    assert "possible" not in verdicts(study, 8)["mujoco, heavy ant, the paper's reward and schedule"].why
    end_at(study.runs / "maze/paper/plain/seed-3", study.row("maze/paper/plain").task.arena.goals[0])  # somebody did
    assert "possible" not in verdicts(study, 8)["mujoco, heavy ant, the paper's reward and schedule"].why


def end_at(path, place):
    """A fake run's episodes, all of which end at a place."""
    content = json.loads((path / "evaluation.json").read_text())
    content["by_seed"][0]["ends"] = [list(place)] * 60
    (path / "evaluation.json").write_text(json.dumps(content))


def exactly(path, good):
    """A fake run's way, with nothing by chance."""
    content = json.loads((path / "evaluation.json").read_text())
    content["by_seed"][0]["way"] = good
    (path / "evaluation.json").write_text(json.dumps(content))


def test_a_claim_about_variance_compares_spreads(study):
    for i, row in enumerate(WALKERS):
        for seed in range(10):
            fake_run(study, row, seed, quality=0.5 + (0.0 if i == 0 else 0.4 * (seed % 2) - 0.2))
    found = verdicts(study, 6)["mujoco, heavy ant"]
    assert found.verdict == "holds"
    assert all(finding.probability > 0.7 for finding in found.findings if finding.contrast.decides)
    few = results.Results(Study(study.runs))
    spreads = claims.CLAIMS[5].contrasts[0]
    assert judging._probability(spreads, [np.zeros((2, 4)), np.zeros((10, 4))]) is None
    assert few.scores("walker/plain", "fluctuation").shape == (10, 4)


# ---------------------------------------------------------------- figures and the report


def test_figures_are_drawn_from_files_alone(study, tmp_path):
    rows = {row for figure in find_figures(["7", "11-handovers", "16", "17"]) for row in figure.rows}
    fill(study, sorted(rows - {"walker/symmetric"}), 2)
    found = results.Results(study)
    names = ["3", "7", "11", "16", "17"]
    drawn = draw_figures(found, find_figures(names), tmp_path / "once")
    for one in drawn:
        assert [path.suffix for path in one.files] == [".png", ".svg"]
        assert one.files[0].read_bytes().startswith(b"\x89PNG")
    shown = {one.figure.name: one.files[1].read_text() for one in drawn}
    for name, words in {
        "07-unregularised": ("control steps per direction", ">down<", "(2 seeds)"),
        "11-handovers": ("symmetric-interleaved", "2 seeds", "no finished runs yet"),
        "16-paths": ("sub-policy up", "maze/flat/free", "within 1 m"),
        "17-flat-ends": ("% in the circle, 2 seeds", "end of an episode"),
    }.items():
        assert all(word in shown[name] for word in words), name
    assert {d.figure.name: d.without for d in drawn}["11-handovers"] == ("walker/symmetric",)
    (again,) = draw_figures(results.Results(study), find_figures(["7"]), tmp_path / "twice")
    assert [path.read_bytes() for path in again.files] == [path.read_bytes() for path in drawn[1].files]


@pytest.mark.parametrize("prefix", ["light/", "bullet/"])
def test_every_figure_can_be_drawn_of_another_ant_or_engine(study, tmp_path, prefix):
    fill(study, [prefix + row for row in ("walker/plain", "walker/interleaved", "maze/hrl/plain")], 2)
    drawn = draw_figures(results.Results(study), FIGURES, tmp_path, prefix)
    names = {one.figure.name for one in drawn}
    assert {"11-handovers", "12-switching"} <= names
    assert "19-choices" not in names  # it sets one ant beside the other: there is one of it
    (lengths,) = (one for one in drawn if one.figure.name == "22-safety-against-speed")
    assert f"{prefix}walker/random-start" in lengths.without
    assert not any("/t/" in row for row in lengths.without)  # that nobody planned there
    assert all(path.is_file() and path.parent.name == prefix.strip("/") for one in drawn for path in one.files)


def test_figures_name_what_could_mislead(study, tmp_path):
    """Rows with unequal seeds say so, maps of different rows have one scale, and grids of one point are no grids."""
    fill(study, ("walker/plain",), 3)
    fill(study, ("walker/random-start",), 1, quality=0.9)
    draw_figures(results.Results(study), find_figures(["12", "14"]), tmp_path)
    switched = (tmp_path / "12-switching.svg").read_text()
    assert "plain (3 seeds)" in switched
    assert "random-start (1 seed)" in switched
    assert "no finished runs yet of other values" in (tmp_path / "14-regulariser-length.svg").read_text()
    maps = measures.handover_maps(results.Results(study), WALKERS)
    assert {image.get_clim() for ax in maps.axes for image in ax.get_images()} == {(0.0, 1.0)}
    fill(study, ("ablation/random-start/t/10",), 1)
    draw_figures(results.Results(study), find_figures(["14"]), tmp_path)
    lengths = (tmp_path / "14-regulariser-length.svg").read_text()
    assert "random-start/t" in lengths
    assert "random-repeated/t" not in lengths
    weak = {"quality": 0.2}  # far from the goal
    fill(study, ("maze/paper/plain", "maze/hrl/plain", "bandit/paper/plain", "bandit/hrl/plain"), 2, **weak)
    for place, same in {"maze": False, "bandit": True}.items():
        rows = tuple(f"{place}/{schedule}/plain" for schedule in ("paper", "hrl"))
        left, right = curves.task_curves(results.Results(study), rows).axes[:2]
        assert left.get_shared_y_axes().joined(left, right) == same
        lines = [1.0 in line.get_ydata() and len(line.get_ydata()) == 2 for line in left.lines]
        assert any(lines) or any("off this scale" in text.get_text() for text in left.texts)


def test_ants_that_are_driven_back_are_not_cut_off(study, tmp_path):
    fill(study, ("walker/plain",), 2)
    for path in study.runs.rglob("transitions.json"):
        content = json.loads(path.read_text())
        content["by_seed"][0]["switching"]["25"]["speed_mps"] = -0.5
        write(path, content)
    speed = measures.switching(results.Results(study), ("walker/plain",)).axes[0]
    assert speed.get_ylim()[0] < -0.5


def test_every_figure_is_drawn_where_there_is_nothing_yet(study, tmp_path):
    study.runs.mkdir()
    numbers = [int(figure.name.partition("-")[0]) for figure in FIGURES]
    assert numbers == list(range(1, len(FIGURES) + 1))
    assert [figure.paper for figure in FIGURES[:10]] == [f"Figure {i}" for i in range(1, 11)]
    for one in draw_figures(results.Results(study), [figure for figure in FIGURES if figure.rows], tmp_path):
        assert one.without == one.figure.rows
        assert re.search("no (finished )?runs|no finished", one.files[1].read_text()), one.figure.name


def test_the_report_answers_the_paper_and_can_be_made_again_from_its_own_files(study, tmp_path, monkeypatch):
    fill(study, (*WALKERS, "maze/flat/free"), 3)
    (study.runs / "walker/plain/seed-2/DONE").unlink()
    monkeypatch.setattr(report, "FIGURES", find_figures(["4", "7", "12"]))
    found = results.Results(study)
    pages = report.write_report(found, tmp_path / "report", "footwork reproduce")
    text, page = (path.read_text() for path in pages)
    for words in (
        "## Claims",
        "* **Undecided, too few seeds**: 4, 5, 6, 10, 11, 12",
        "## Each claim in each setting",
        "## The paper, in its order",
        "### What the paper leaves open, and what we took",
        "entropy bonus 0.02",
        "2 of 10: walker/plain; 3 of 10: walker/{random-start,",
        "ablation/maze/k/{10,20,100,200,400}",  # rows that nobody has run are named
        "light/walker/{plain,",
        "footwork reproduce --rows walker/plain --seeds 2",
        "## Figures",
        "## Rows",
    ):
        assert words in text, words
    assert "seed-2 is not finished" not in text  # "2 of 10" says it, now and when the report is made again
    assert any("seed-2 is not finished" in problem for problem in found.problems)
    assert text.index("## Claims") < text.index("## The paper") < text.index("## Figures")
    assert not re.search(r'(src|href)="(?!data:)', page)  # nothing but what is in the page itself
    assert page.count("data:image/png;base64,") == 3
    assert all(f"| {claim.number} | {claim.words}" in text for claim in claims.CLAIMS)
    assert '<b class="undecided">undecided</b>' in page
    (eleven,) = (j.findings[0] for j in judging.judge_all(found) if j.claim.number == 11)
    estimate, low, high = re.findall(r"[\d.]+", judging.show_effect(eleven))
    assert f"| {estimate} [{low}, {high}] % |" in text  # the row's line says the same of the same runs
    kept = Study(tmp_path / "report/results")
    assert not list(kept.runs.rglob("metrics.jsonl"))
    figures = {path.name: path.read_bytes() for path in (tmp_path / "report/figures").iterdir()}
    for one in draw_figures(results.Results(kept), find_figures(["7", "12"]), tmp_path / "again"):
        assert all(path.read_bytes() == figures[path.name] for path in one.files)
    again = judging.judge_all(results.Results(kept))
    for one, other in zip(judging.judge_all(found), again, strict=True):
        assert (one.verdict, one.why) == (other.verdict, other.why)
        for a, b in zip(one.findings, other.findings, strict=True):
            assert a.effect is b.effect is None or a.effect == pytest.approx(b.effect, rel=1e-3)


def test_the_readme_shows_the_tables_of_the_report(monkeypatch):
    """Copied line by line, so that neither can say what the other does not."""
    root = Path(__file__).parents[1]
    monkeypatch.syspath_prepend(str(root / "tools"))
    import readme_tables

    readme, said = ((root / name).read_text(encoding="utf-8") for name in ("README.md", "report/REPORT.md"))
    assert readme_tables.with_tables(readme, said) == readme, "run tools/readme_tables.py"
    otherwise = said.replace("**holds**", "**stands**").replace("| plain | ", "| plain | once ")
    changed = readme_tables.with_tables(readme, otherwise)
    assert changed.count("**stands**") == readme.count("**holds**") > 0
    assert "| plain | once " in changed
    for other in ("| light/plain |", "| plain, annealed |", "| interleaved without cooperation |", "against flat"):
        assert other in said
        assert other not in changed  # the README shows the default ant's main rows, and verdicts without comparisons


def test_the_documentation_shows_the_lengths_that_were_measured(study, monkeypatch):
    root = Path(__file__).parents[1]
    monkeypatch.syspath_prepend(str(root / "tools"))
    import study_tables

    page = (root / "docs/study.md").read_text(encoding="utf-8")
    assert study_tables.with_lengths(page, results.Results(Study(root / "report/results"))) == page, (
        "run tools/study_tables.py"
    )
    fill(study, ("walker/random-start",), 4)
    fill(study, ("ablation/interleaved/t/16",), 1)
    write_switching(study, "ablation/interleaved/t/16", 0, 0.25, 0.125)
    changed = study_tables.with_lengths(page, results.Results(study)).splitlines()
    start = next(i for i, line in enumerate(changed) if line.startswith(study_tables.HEAD)) + 2
    assert changed[start].startswith("| random start | 50 | 4, their range | ")
    assert " to " in changed[start]
    assert changed[start + 1].startswith("| interleaved | 16 | 0 | ")
    assert "| 25.0 | 12.5 | " in changed[start + 1]
    assert not changed[start + 2].startswith("|")


def write_switching(study, row, seed, idle, upside_down):
    """What random switching every 50 control steps showed of a fake run."""
    path = study.runs / row / f"seed-{seed}" / "transitions.json"
    content = json.loads(path.read_text())
    content["by_seed"][0]["switching"]["50"] |= {"idle": idle, "upside_down": upside_down}
    write(path, content)


def write_success(study, row, seed, success):
    path = study.runs / row / f"seed-{seed}" / "evaluation.json"
    content = json.loads(path.read_text())
    content["by_seed"][0]["success"] |= {"1.0": success}
    content["by_seed"][0] |= {"flip_rate": 0.07}
    write(path, content)


def test_kinds_of_sub_policies_stand_side_by_side_with_their_masters(study):
    fill(study, ("walker/plain", "bandit/hrl/plain", "light/walker/plain", "maze/flat/guided-free"), 3)
    fill(study, ("maze/paper/plain",), 1)
    fill(study, ("bandit/flat/free", "ablation/annealed/plain"), claims.MIN_SEEDS)
    fill(study, ("ablation/maze/hrl-annealed/plain",), 2)
    fill(study, ("ablation/random-repeated/t/25", "ablation/maze/hrl-random-repeated/t/25"), 1)
    for seed, idle in enumerate((0.30, 0.40, 0.50)):
        write_switching(study, "walker/plain", seed, idle, 0.1)
        write_switching(study, "light/walker/plain", seed, 0.0, 0.2)
    for seed in range(claims.MIN_SEEDS):
        write_switching(study, "ablation/annealed/plain", seed, 0.6, 0.9)
        write_success(study, "bandit/flat/free", seed, 0.25)
    for seed in range(3):
        write_success(study, "bandit/hrl/plain", seed, (0.5, 0.6, 0.7)[seed])
        write_success(study, "maze/flat/guided-free", seed, 0.75)
    for seed in range(2):
        write_success(study, "ablation/maze/hrl-annealed/plain", seed, 0.125)
    write_success(study, "maze/paper/plain", 0, 0.0)
    write_success(study, "ablation/maze/hrl-random-repeated/t/25", 0, 0.375)
    found = results.Results(study)
    table = row_tables.side_by_side(found)
    assert table.header[:5] == ("sub-policies", "m/s", "hand-overs", "idle, k = 50", "upside down, k = 50")
    assert table.header[5:] == (
        "AntBandit, our reward",
        "AntMaze, our reward",
        "AntBandit, the paper's",
        "AntMaze, the paper's",
    )
    lines = {line[0]: [*line[3:]] for line in table.rows}
    assert list(lines) == ["plain", "plain, annealed", "random-repeated, t = 25", "flat policy, free", "light/plain"]
    assert lines["random-repeated, t = 25"][2:] == ["-", "37.5 (1)", "", ""]
    assert lines["plain"][0].startswith("40.0 [30.0, 50.0]")
    assert lines["plain"][1:] == ["10.0 [10.0, 10.0] (3)", "60.0 [50.0, 70.0] (3)", "-", "-", "0.0 (1)"]
    assert lines["plain, annealed"] == ["60.0 [60.0, 60.0]", "90.0 [90.0, 90.0]", "-", "12.5 [12.5, 12.5] (2)", "", ""]
    assert lines["flat policy, free"] == ["", "", "-", "75.0 [75.0, 75.0] (3)", "25.0 [25.0, 25.0]", "-"]
    assert lines["light/plain"][:2] == ["0.0 [0.0, 0.0] (3)", "20.0 [20.0, 20.0] (3)"]
    assert (
        "four sub-policies 8 M (those of appropriate bias stand on as many of plain ones), a symmetric one 4 M"
        in row_tables.side_by_side_caption(found)
    )


def test_rows_have_a_table_for_sub_policies_and_one_for_those_that_use_them(study):
    fill(study, ("walker/plain", "bandit/hrl/plain"), 3)
    for seed in range(3):
        write_switching(study, "walker/plain", seed, 0.4, 0.1)
        write_success(study, "bandit/hrl/plain", seed, (0.5, 0.6, 0.1)[seed])
    found, rows = results.Results(study), ("walker/plain", "bandit/hrl/plain")
    (walker,) = row_tables.sub_policies(found, rows).rows
    assert walker[:3] == ("walker/plain", "3", "7,995,392")
    assert walker[-2:] == ("40.0 [40.0, 40.0] %", "10.0 [10.0, 10.0] %")
    table = row_tables.task_policies(found, rows)
    (master,) = (dict(zip(table.header, line, strict=True)) for line in table.rows)
    assert master["around walls"] == "-"
    assert master["within 1 m"] == "40.0 [10.0, 60.0] %"
    assert master["turned over"] == "7.0 [7.0, 7.0] %"
    assert master["worst seed, within 1 m"] == "10.0 %"
    (study.runs / "walker/plain/seed-0/transitions.json").unlink()
    (walker,) = row_tables.sub_policies(results.Results(study), rows).rows
    assert walker[-1] == "10.0 [10.0, 10.0] % (2)"


def test_figures_of_which_there_is_one_are_not_drawn_under_another_ant(study, tmp_path):
    fill(study, ("light/walker/plain", "light/maze/hrl/interleaved"), 1)
    drawn = draw_figures(results.Results(study), find_figures(["12", "13", "14", "20"]), tmp_path, "light/")
    assert [one.figure.name for one in drawn] == ["12-switching"]


def test_masters_beside_their_sub_policies_are_not_drawn_where_there_are_no_masters(study, tmp_path):
    fill(study, ("bullet/walker/plain",), 1)
    both = find_figures(["11", "21"])
    drawn = draw_figures(results.Results(study), both, tmp_path, "bullet/")
    assert [one.figure.name for one in drawn] == ["11-handovers"]
    fill(study, ("bullet/maze/hrl/plain",), 1)
    assert len(draw_figures(results.Results(study), both, tmp_path, "bullet/")) == 2


def test_a_way_that_was_lost_lies_within_its_panel(study):
    fill(study, ("bandit/hrl/interleaved",), 2)
    for k, seed in itertools.product((10, 400), (0, 1)):
        path = fake_run(study, f"ablation/bandit/k/{k}", seed) / "evaluation.json"
        content = json.loads(path.read_text())
        content["by_seed"][0]["way"] = 0.9 if k == 10 else -1.4 - seed / 10
        write(path, content)
    panels = measures.k_grids(results.Results(study), ()).axes
    (way,) = (ax for ax in panels if ax.dataLim.y0 < 0)
    assert way.get_ylim()[0] < -1.5
    assert way.get_ylim()[1] > 1.0


def test_lengths_of_a_regulariser_make_a_line_from_safe_to_fast(study):
    rows = ("ablation/random-repeated/t/25", "walker/random-repeated", "ablation/annealed/random-repeated")
    fill(study, rows, 2)
    for row, idle in zip(rows, (0.2, 0.4, 0.6), strict=True):
        write_switching(study, row, 0, idle, 0.1)
        write_switching(study, row, 1, idle, 0.1)
    (ax, _) = measures.safety_against_speed(results.Results(study), measures.LENGTHS_AND_KINDS).axes
    lengths, annealed = (line for line in ax.lines if line.get_marker() != "None" and len(line.get_xdata()))
    assert [*lengths.get_ydata()] == pytest.approx([0.2, 0.4])
    assert [text.get_text() for text in ax.texts] == ["25", "100"]
    assert [*annealed.get_ydata()] == pytest.approx([0.6])
    assert (lengths.get_mfc(), annealed.get_mfc()) == (lengths.get_color(), "white")
    assert lengths.get_color() == annealed.get_color()


def test_what_penalties_cost_is_drawn_seed_by_seed(study):
    for seed, way in enumerate((0.9, 0.5, 0.1)):
        exactly(fake_run(study, "bandit/hrl/interleaved", seed), way)
        if seed < 2:
            exactly(fake_run(study, "bandit/hrl-penalised/interleaved", seed), way - 0.2)
    found = results.Results(study)
    axes = measures.cost_of_penalties(found, measures.PENALISED_OR_NOT).axes
    drawn = [ax for ax in axes if any(line.get_marker() != "None" for line in ax.lines)]
    assert [ax.get_xlabel().split()[0] for ax in drawn] == ["share", "episodes"]
    (cost,) = (line for line in drawn[0].lines if line.get_marker() != "None")
    assert [*cost.get_xdata()] == pytest.approx([-20.0])  # the third seed has no counterpart
    assert [label.get_text() for label in drawn[0].get_yticklabels()].count("(2)") == 1
    assert sum("no finished runs" in text.get_text() for ax in axes for text in ax.texts) == len(axes) - 2


def test_masters_are_set_beside_their_own_sub_policies(study):
    """By seed, whichever seeds are there; and a kind of which nothing can be said leaves the others alone."""
    bandit = association.ASSOCIATIONS[0]
    for seed, quality in enumerate((0.2, 0.5, 0.8)):
        fake_run(study, "walker/plain", seed, quality)
        if seed:
            fake_run(study, "bandit/hrl/plain", seed, 1 - quality)
    found = results.Results(study)
    pairs = association.seed_pairs(found, bandit)["plain"]
    assert pairs[:, 1] == pytest.approx([found.scores_by_seed("bandit/hrl/plain", "success")[seed] for seed in (1, 2)])
    assert pairs[0, 0] < pairs[1, 0]
    assert association.strength(found, bandit) is None  # two seeds say nothing
    fake_run(study, "bandit/hrl/plain", 0, 0.9)
    fill(study, ("bandit/hrl/interleaved",), 3)  # without its sub-policies
    found = results.Results(study)
    assert list(association.seed_pairs(found, bandit)) == ["plain"]
    assert association.strength(found, bandit).estimate == pytest.approx(-1)
    assert association.strength(found, bandit, "light/") is None
    answer = next(answer for answer in answers.ANSWERS if answer.associations)
    text = answers.said(answer, [], found)
    assert "AntBandit, our reward (mujoco, heavy ant): -1.00 [-1.00, " in text
    assert "AntMaze, our reward (mujoco, heavy ant): no runs that say it" in text
    assert "light ant" not in text  # no runs: nothing to say
    for seed, quality in enumerate((0.2, 0.5, 0.8)):
        fake_run(study, "light/walker/plain", seed, quality)
        fake_run(study, "light/bandit/hrl/plain", seed, quality)
    text = answers.said(answer, [], results.Results(study))
    assert "AntBandit, our reward (mujoco, heavy ant): -1.00 [-1.00, " in text
    assert "AntBandit, our reward (mujoco, light ant): 1.00 [" in text


def test_panels_say_how_many_seeds(study):
    fill(study, ("maze/paper/plain",), 2)
    fill(study, ("maze/hrl/plain",), 1)
    found = results.Results(study)
    assert style.seeds_of(found, ("maze/paper/plain", "maze/flat/free")) == "2 seeds"
    assert style.seeds_of(found, ("maze/paper/plain", "maze/hrl/plain")) == "1 to 2 seeds"
    assert style.seeds_of(found, ("maze/hrl/plain",)) == "1 seed"
    assert style.seeds_of(found, ("maze/flat/free",)) == ""


def test_logarithmic_axes_are_as_long_as_the_runs(study, tmp_path):
    """A quick study's curves, of some 20,000 steps, fill their panels."""
    quick = Study(study.runs, QUICK)
    for row in ("bandit/hrl/appropriate-bias", "bandit/flat/free"):
        fake_run(quick, row, 0, size=QUICK)
    (drawn,) = draw_figures(results.Results(quick), find_figures(["6"]), tmp_path)
    text = drawn.files[1].read_text()
    assert ">10 k<" in text
    assert ">10 M<" not in text


def test_answers_name_claims_and_figures_that_exist():
    assert {n for answer in answers.ANSWERS for n in answer.claims} == {claim.number for claim in claims.CLAIMS}
    assert {n for answer in answers.ANSWERS for n in answer.figures} == set(range(1, len(FIGURES) + 1))
    rows = {row for answer in answers.ANSWERS for shown in answer.shows for _, row in shown.rows}
    assert {row.removeprefix("bullet/") for row in rows} <= set(EXPERIMENTS)


def test_an_answer_shows_its_rows_and_names_those_that_have_no_runs(study):
    fill(study, ("walker/plain",), 3)
    found = results.Results(study)
    sentence = next(answer for answer in answers.ANSWERS if answer.section == "3.4")
    speed, handover = answers.said(sentence, judging.judge_all(found), found).splitlines()[1:]
    mean = METRICS["speed"].show(float(iqm(found.scores("walker/plain", "speed"))))
    assert f"walker/plain {mean} (3 seeds); no runs of light/walker/plain bullet/walker/plain" in speed
    assert handover.startswith(METRICS["handover"].words)


def test_one_seed_has_no_interval(study):
    fill(study, ("walker/plain", "walker/random-start"), 1)
    (judgement,) = (j for j in judging.judge_all(results.Results(study)) if j.claim.number == 12)
    assert re.fullmatch(r"[\d.]+ %", judging.show_effect(judgement.findings[0]))
    assert judgement.why.startswith("1 seed, 10 are asked for")
    (variance,) = (j for j in judging.judge_all(results.Results(study)) if j.claim.number == 6)
    assert judging.show_effect(variance.findings[0]) == "-"


def test_few_seeds_show_no_probability_and_versions_only_of_what_took_part(study, one_figure):
    fill(study, ("walker/plain", "walker/random-start"), 2)
    fill(study, ("bullet/walker/plain", "bullet/walker/random-start"), 1)
    for path in study.runs.rglob("config.json"):
        config = json.loads(path.read_text())
        config["versions"] |= {"pybullet": "3.2.7", "commit": "abc1234"}
        if path.parent.name == "seed-1" and "random-start" in str(path):
            config["versions"]["commit"] = "def5678"
        if "bullet" in path.parts:
            del config["versions"]["commit"]
        write(path, config)
    found = results.Results(study)
    judgements = judging.judge_all(found)
    compared = [f for j in judgements for f in j.findings if len(f.rows) > 1 and min(f.seeds) in (1, 2)]
    assert compared
    assert all(judging.show_chance(finding) is None for finding in compared)
    said = report.write_report(found, study.runs.parent / "out", "footwork report")[0].read_text()
    assert "| pybullet | 3.2.7 | 2 |" in said  # not the runs on MuJoCo
    table = said[said.index("Which runs were made at which commit") :].split("\n\n")[1]
    assert table.splitlines()[2:] == [
        "| abc1234 | all | 2 | walker/plain |",
        "| abc1234 | 0 | 1 | walker/random-start |",
        "| not recorded | all | 2 | bullet/walker/{plain,random-start} |",
        "| def5678 | 1 | 1 | walker/random-start |",
    ]
    assert re.search(r"\* bullet: undecided, too few seeds: (\d+, )*12(, \d+)*; runs missing: \d+", said)
    assert re.search(r"1 of 10: [^;]*bullet/walker/{plain,random-start}", said)
    for row in ("walker/plain", "walker/random-start"):
        fake_run(study, row, 2)
    judgements = judging.judge_all(results.Results(study))
    compared = [f for j in judgements for f in j.findings if len(f.rows) > 1 and min(f.seeds) == 3]
    assert any(judging.show_chance(finding) for finding in compared)


def test_a_plan_says_what_is_done(study, capsys):
    fill(study, ("walker/plain",), 2)
    shorter = ["reproduce", "--plan", "--seeds", "3", "--rows", "walker/plain", "walker/random-start"]
    assert run([*shorter, "--runs", str(study.runs)]) == 0
    said = capsys.readouterr().out
    assert "6 runs, " in said
    assert "2 runs done, " in said
    assert re.search(r"walker/plain +│ +2 of 3 │", said)
    assert re.search(r"walker/random-start +│ +0 of 3 │", said)
    one = planned_steps(find_row("walker/plain")) * 4
    assert f" {4 * one:,} steps to do" in said
    (run_path(study.runs, "walker/plain", (1,)) / "transitions.json").unlink()  # measuring is left of it
    torn = run_path(study.runs, "walker/plain", (0,)) / "config.json"
    torn.write_text("{")
    assert run([*shorter, "--runs", str(study.runs)]) == 0
    said = capsys.readouterr().out
    assert "config.json is damaged" in said.replace("\n", " ")
    left = int(re.search(r"([\d,]+) steps to do", said)[1].replace(",", ""))
    assert 4.1 * one < left < 5.5 * one
    plan.mark(Study(study.runs))
    assert run([*shorter, "--quick", "--runs", str(study.runs)]) == 1
    assert "holds the full study, not the quick one" in capsys.readouterr().err


def test_a_study_on_an_engine_that_is_missing_is_refused_before_anything_is_begun(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("footwork.physics.find_spec", lambda name: None)
    assert run(["reproduce", "--rows", "bullet/walker/symmetric", "--runs", str(tmp_path / "runs")]) == 1
    assert "engine bullet needs an extra" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["figures", "nope"], "unknown figure 'nope'; known figures: 01-walker, "),
        (["figures", "--runs", ".", "--under", "feather"], "there are no rows under 'feather'"),
        (["figures", "--runs", ".", "--under", "light"], "no finished runs under 'light'"),
        (["figures", "--runs", "nowhere"], "there is no folder of runs at nowhere"),
        (["report", "--runs", "nowhere"], "there is no folder of runs at nowhere"),
        (["reproduce", "--rows", "maze/none"], "unknown row 'maze/none'; nearest: "),
        (["reproduce", "--launcher", "slurm", "--rows", "walker/plain"], "known launchers: local, ray"),
        (["reproduce", "--seeds", "0"], "seeds must be >= 1"),
        (["reproduce", "--workers", "-1", "--rows", "walker/plain"], "workers must be >= 0"),
    ],
)
def test_bad_input_is_one_clear_line(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert run(arguments) == 1
    captured = capsys.readouterr().err
    assert message in captured
    assert captured.count("\n") == 1
