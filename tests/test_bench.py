"""Laws of the benchmark: what a drifting machine, a missing library, a dying contestant or Ctrl-C must not spoil."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from footwork.doors import cli, tables
from footwork.learn import ppo
from footwork.learn.networks import gaussian_policy
from footwork.study import bench, entrants, workers
from footwork.study.bench import Bench, compare
from footwork.study.contest import Contestant, ContestantFailed, Record, Team, closing
from footwork.study.experiments import find_row
from footwork.train import compile_aside, fresh_learners, update_all
from footwork.types import Transition

PROMISED = ("ratio_sb3_antbullet", "ratio_sb3_antv5", "ratio_physics", "substeps", "update_efficiency", "compile_s")
ALSO_PROMISED = ("peak_mb", "master_over_physics", "time_to_walk_s", "time_to_bandit_s", "machine", "versions")


def record(*rates):
    return Record(samples={number: {"rate": rate} for number, rate in enumerate(rates)})


# ---------------------------------------------------------------- ratios


@settings(max_examples=20)
@given(st.lists(st.floats(0.1, 10.0), min_size=1, max_size=5))
def test_a_drifting_machine_changes_no_ratio(drift):
    steady = compare({entrants.FOUR: record(*[30.0] * len(drift)), entrants.PHYSICS_ALL: record(*[60.0] * len(drift))})
    drifting = compare(
        {
            entrants.FOUR: record(*[30.0 * d for d in drift]),
            entrants.PHYSICS_ALL: record(*[60.0 * d for d in drift]),
        }
    )
    for key in ("median", "low", "high"):
        assert drifting["ratio_physics"][key] == pytest.approx(steady["ratio_physics"][key]) == pytest.approx(0.5)


def test_the_best_setting_of_a_rival_counts_and_several_runs_of_it_are_another_figure():
    ratios = compare(
        {
            entrants.FOUR: record(1000.0, 1000.0),
            "sb3 Ant-v5, 1 env": record(10.0, 10.0),
            "sb3 Ant-v5, 8 envs": record(20.0, 25.0),
            "sb3 Ant-v5, 8 envs, a run per core": record(50.0, 50.0),
            "sb3 AntBulletEnv-v0, 1 env": Record(skipped="pybullet is not installed"),
        }
    )
    assert ratios["ratio_sb3_antv5"]["values"] == [50.0, 40.0]
    assert ratios["ratio_sb3_antv5_a_run_per_core"]["median"] == 20.0
    assert "ratio_sb3_antbullet" not in ratios


def test_only_rounds_in_which_both_were_measured_are_compared():
    four, alone = record(10.0, 20.0, 30.0), record(10.0, 10.0, 10.0)
    del four.samples[1], alone.samples[2]
    ratios = compare({entrants.FOUR: four, entrants.PHYSICS_ALL: alone})
    assert ratios["ratio_physics"]["values"] == [1.0]


# ---------------------------------------------------------------- running it


class FakeTeam:
    """A contestant of rate 100 that fails or is interrupted when told to."""

    asked = 0
    trouble: dict = {}  # noqa: RUF012
    closed: list = []  # noqa: RUF012

    def __init__(self, contestant, python, environ):
        self.contestant, self.facts = contestant, {"start_s": 2.0, "peak_mb": 50.0, "compile_s": 1.0}
        if contestant.rival and "sbx" in contestant.name:
            raise ContestantFailed("sbx is not installed")

    def sample(self, seconds):
        FakeTeam.asked += 1
        if FakeTeam.asked in self.trouble:
            raise self.trouble[FakeTeam.asked]
        return {"rate": 100.0, "seconds": 1.0, "efficiency": 0.25, "over_engine": 1.5, "decisions": 2.0}

    def close(self):
        FakeTeam.closed.append(self)


@pytest.fixture
def fake(monkeypatch):
    def measure(quick=False, learning=False, **trouble):
        FakeTeam.asked, FakeTeam.closed = 0, []
        FakeTeam.trouble = {int(when.removeprefix("at_")): what for when, what in trouble.items()}
        monkeypatch.setattr(bench, "Team", FakeTeam)
        monkeypatch.setattr(bench, "time_help", lambda: 0.3)
        said = []
        work = Bench(quick, learning, sys.executable, said.append)
        work.run()
        return work, work.report(), said

    return measure


def test_a_report_holds_all_that_was_promised_and_is_json(fake):
    _, report, said = fake(learning=True)
    assert report["complete"]
    assert all(report[key] is not None for key in (*PROMISED, *ALSO_PROMISED, "start_cold_s", "start_warm_s", "help_s"))
    assert report["ratio_physics"] == 1.0
    assert report["update_efficiency"] == 0.25
    assert report["targets"]["master_over_physics"]["reached"] is False
    assert set(report["growth"]) == {"rows", "runs", "walls", "k"}
    assert all("peak_mb" in point and "compile_s" in point for points in report["growth"].values() for point in points)
    json.dumps(report, allow_nan=False)
    assert any("sbx" in line and "not installed" in line for line in said)


def test_whoever_is_missing_is_skipped_by_name_in_the_table(fake, capsys):
    _, report, _ = fake()
    tables.show(*tables.bench_tables(report))
    lines = [line for line in capsys.readouterr().out.splitlines() if "sbx Ant-v5, 1 env" in line]
    assert len(lines) == 2
    assert "skipped" in lines[0]
    assert "skipped: sbx is not installed" in lines[1]  # below the table


def test_ctrl_c_keeps_what_was_measured(fake):
    contestants = len([c for c in entrants.contestants(False) if "sbx" not in c.name])
    _, report, _ = fake(**{f"at_{contestants + 5}": KeyboardInterrupt()})  # in the second round
    assert not report["complete"]
    assert report["ratio_physics"] == 1.0
    assert report["time_to_walk_s"] is None
    assert report["growth"] == {}
    assert len(FakeTeam.closed) == contestants + 2  # nobody is left behind, the two of the start included
    json.dumps(report, allow_nan=False)


def test_one_that_dies_does_not_end_the_others(fake):
    work, report, _ = fake(at_3=ContestantFailed("ended with status 1"))
    dead = [name for name, r in work.records.items() if r.skipped == "ended with status 1"]
    assert len(dead) == 1
    others = [r for r in work.records.values() if r.skipped is None]
    assert others
    assert all(len(r.samples) == work.rounds for r in others)
    assert report["complete"]


def test_a_missing_library_is_named_by_the_process_that_wants_it():
    spec = {"library": "no_such_library", "task": "Ant-v5", "num_envs": 1, "processes": False}
    with pytest.raises(ContestantFailed, match="no_such_library is not installed"):
        Team(Contestant("nobody", (spec,), rival=True), sys.executable, dict(os.environ))


def test_a_failing_process_is_reported_by_its_last_words():
    with pytest.raises(ContestantFailed, match=r"status 1: .*num_envs"):
        Team(Contestant("broken", ({"library": "json"},), rival=True), sys.executable, dict(os.environ))


CHATTY = """
import os, sys
sys.path.insert(0, {folder!r})
import rivals
def build():
    print("hello from a library")
    os.system("echo and from C")
    return lambda seconds: {{"steps": 6.0, "seconds": 2.0}}
rivals.serve(build)
"""


def test_what_libraries_print_is_not_taken_for_an_answer_and_processes_add_up(monkeypatch, tmp_path):
    script = tmp_path / "chatty.py"
    script.write_text(CHATTY.format(folder=os.path.dirname(bench.__file__)))
    monkeypatch.setattr("footwork.study.contest._command", lambda *_: [sys.executable, str(script)])
    team = Team(Contestant("two", ({}, {}), threads=1), sys.executable, dict(os.environ))
    with closing({"two": team}):
        assert team.sample(0.1)["rate"] == 6.0  # two processes of 3 per second
        assert team.facts["peak_mb"] > 2.0


# ---------------------------------------------------------------- what is measured


def test_the_physics_alone_counts_every_row():
    answer = workers.physics(rows=3, threads=1)(0.05)
    assert answer["steps"] > 0
    assert answer["steps"] % 3 == 0
    assert answer["seconds"] >= 0.05


def test_the_update_is_charged_for_the_products_that_xla_counts():
    """With wide layers and large minibatches nothing but the products counts."""
    config = replace(find_row("walker/plain").ppo, hidden_sizes=(96, 96), num_minibatches=1, update_epochs=1)
    policy = gaussian_policy(config, 32, 8)
    learners = jax.eval_shape(lambda key: fresh_learners(policy, config, key[None]), jax.random.key(0))
    rollout = jax.eval_shape(lambda: workers._some_rollout(policy, config, 1))
    one = lambda tree: jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), tree)  # noqa: E731

    def gradient(params, batch, mask):
        return jax.grad(lambda p: ppo.loss(policy, config, p, batch, mask, jnp.float32(1.0), jnp.float32(0.0))[0])(
            params
        )

    samples, valid, _ = jax.eval_shape(
        lambda params, transition: ppo.digest(policy, config, params, transition), one(learners.params), one(rollout)
    )
    counted = jax.jit(gradient).lower(one(learners.params), samples, valid).compile().cost_analysis()["flops"]
    critic_twice = 2 * 2.0 * (32 * 96 + 96 * 96 + 96) * config.batch_size
    assert workers.update_flops(policy, config) - critic_twice == pytest.approx(counted, rel=0.05)


def test_posts_are_as_many_as_asked_and_a_smaller_field_is_part_of_a_larger():
    assert workers.posts(0).walls == ()
    few, many = workers.posts(10).walls, workers.posts(200).walls
    assert len(set(many)) == 200
    assert few == many[:10]


def test_walking_wants_all_of_the_last_updates():
    slow, fast = ({"rollout/progress": np.full(4, speed)} for speed in (0.0, 1.6))
    assert not workers.walks([fast] * (workers.WALK_UPDATES - 1))
    assert workers.walks([slow] + [fast] * workers.WALK_UPDATES)
    assert not workers.walks([fast] * workers.WALK_UPDATES + [slow] * workers.WALK_UPDATES)


@pytest.mark.parametrize(("reached", "enough"), [(95, True), (94, False)])
def test_arriving_is_judged_over_enough_episodes(reached, enough):
    updates = [{"episode/count": np.array([100.0]), "count/reached": np.array([reached])}]
    assert not workers.arrives(updates)
    assert workers.arrives(updates * 2) is enough


def test_four_runs_are_dealt_out_whole(monkeypatch):
    for cores in (1, 2, 3, 4, 16):
        monkeypatch.setattr(entrants, "usable_cores", lambda cores=cores: list(range(cores)))
        shares = [spec["runs"] for spec in entrants.side_by_side("four", 4).specs]
        assert sum(shares) == 4
        assert len(shares) == min(cores, 4)
        assert max(shares) - min(shares) <= 1


# ---------------------------------------------------------------- what makes a start short


def test_what_is_compiled_aside_is_not_compiled_again():
    row = find_row("walker/plain")
    sizes = {"num_envs": 2, "num_steps": 3, "num_minibatches": 2, "update_epochs": 1, "hidden_sizes": (2,)}
    row = replace(row, ppo=replace(row.ppo, **sizes))
    policy, config = row.policy(), row.ppo
    learners = jax.eval_shape(lambda: fresh_learners(policy, config, jax.random.split(jax.random.key(0), 2)))
    learners = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), learners)
    shape = (2, 3, 2)
    obs, flags, numbers = jnp.zeros((*shape, 32)), jnp.zeros(shape, bool), jnp.zeros(shape)
    rollout = Transition(obs, jnp.zeros((*shape, 8)), numbers, numbers, flags, flags, obs, ~flags)
    jax.block_until_ready((rollout, learners))
    key = jax.random.key(0)
    compile_aside(row, 2).result()
    compiling = workers.Compiling()
    update_all(policy, config, learners, rollout, key)
    assert compiling.seconds == 0.0


def test_compiled_programs_are_kept_where_the_user_wants_them(monkeypatch, tmp_path):
    def place(**variables):
        for name in ("FOOTWORK_CACHE", "XDG_CACHE_HOME", "JAX_COMPILATION_CACHE_DIR"):
            monkeypatch.delenv(name, raising=False)
        for name, value in variables.items():
            monkeypatch.setenv(name, str(value))
        cli.keep_compiled()
        return os.environ.get("JAX_COMPILATION_CACHE_DIR")

    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")  # so that it is put back afterwards
    assert place(XDG_CACHE_HOME=tmp_path).startswith(str(tmp_path / "footwork" / "jax-"))
    assert place(FOOTWORK_CACHE=tmp_path / "x").startswith(str(tmp_path / "x" / "jax-"))
    assert place(FOOTWORK_CACHE="") is None
    assert place(FOOTWORK_CACHE=tmp_path, JAX_COMPILATION_CACHE_DIR="theirs") == "theirs"


def test_an_accelerator_is_left_alone_but_by_the_engine_that_computes_on_it(monkeypatch):
    def platforms(*arguments, theirs=None):
        monkeypatch.delenv("JAX_PLATFORMS", raising=False)
        if theirs:
            monkeypatch.setenv("JAX_PLATFORMS", theirs)
        cli.leave_accelerators(list(arguments))
        return os.environ.get("JAX_PLATFORMS")

    monkeypatch.setenv("JAX_PLATFORMS", "")  # so that it is put back afterwards
    assert platforms("train", "walker/plain") == "cpu"
    assert platforms("train", "walker/plain", "--runs", "/data/mjx-study", "--name", "no-mjx") == "cpu"
    assert platforms("train", "walker/plain", theirs="cuda") == "cuda"
    for named in (
        ("walker/plain", "--engine", "mjx"),
        ("walker/plain", "--engine=mjx"),
        ("mjx/walker/plain",),
        ("runs/mjx/walker/plain/seed-0",),
    ):
        assert platforms("train", *named) is None


@pytest.mark.parametrize("platforms", ["cuda", "nonsense"])
def test_a_device_that_jax_does_not_find_is_one_line(platforms, tmp_path):
    if platforms == "cuda" and importlib.util.find_spec("jax_plugins"):
        pytest.skip("JAX has CUDA here")
    command = [sys.executable, "-m", "footwork", "train", "walker/plain", "--runs", str(tmp_path)]
    done = subprocess.run(command, env={**os.environ, "JAX_PLATFORMS": platforms}, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith(f"footwork: JAX_PLATFORMS is {platforms!r}")
    assert "Traceback" not in done.stderr
