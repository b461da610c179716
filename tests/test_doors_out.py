"""Laws of policies going out and coming in: predict, export, ONNX, and Stable-Baselines3's door."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import jax
import numpy as np
import pytest

from footwork.arena import MAZES
from footwork.doors import cli
from footwork.doors.export import _own_fields, export
from footwork.doors.policies import load_policy, of_trained
from footwork.record import RunError
from footwork.study.experiments import find_row
from footwork.study.runs import find_needed, find_trained

NOWHERE = Path("nowhere")
OBS = np.random.default_rng(0).normal(size=(16, 34)).astype(np.float32)


# ---------------------------------------------------------------- predict


@pytest.mark.parametrize(("row", "size"), [("walker/plain", 32), ("walker/symmetric", 32), ("maze/flat/free", 34)])
def test_predict_gives_the_mode_or_a_sample_of_one_row_or_of_many(row, size):
    policy = load_policy(row, "up", runs=NOWHERE)
    obs = OBS[:, :size]
    action, state = policy.predict(obs, deterministic=True)
    assert action.shape == (16, 8)
    assert state is None
    np.testing.assert_allclose(policy.predict(obs[3], True)[0], action[3], rtol=1e-4, atol=1e-5)
    samples = [policy.predict(obs)[0] for _ in range(2)]
    assert not np.array_equal(*samples)
    again = load_policy(row, "up", runs=NOWHERE)
    again.predict(obs, True)
    assert np.array_equal(again.predict(obs, True)[0], action)


def test_a_walkers_directions_are_its_four_sub_policies():
    trained = find_trained("walker/symmetric-interleaved", NOWHERE)
    subs = trained.sub_policies(deterministic=True)
    for direction in range(4):
        ours = of_trained(trained, direction).predict(OBS[:, :32], True)[0]
        theirs = jax.jit(subs.act)(OBS, np.full(16, direction, np.int32), jax.random.key(0))
        np.testing.assert_allclose(ours, np.asarray(theirs), rtol=1e-5, atol=1e-6)


def test_a_master_predicts_choices():
    policy = load_policy("maze/hrl/plain", runs=NOWHERE)
    assert policy.chooses
    action, _ = policy.predict(OBS, deterministic=True)
    assert action.dtype == np.int32
    assert set(action) <= {0, 1, 2, 3}
    assert policy.predict(OBS[0], True)[0] in range(4)


def test_predict_refuses_what_it_cannot_read():
    policy = load_policy("maze/flat/free", runs=NOWHERE)
    with pytest.raises(ValueError, match=r"obs must be \[34\] or \[N, 34\], got shape \(16, 32\)"):
        policy.predict(OBS[:, :32])
    bad = OBS.copy()
    bad[5, 1] = np.nan
    with pytest.raises(ValueError, match="obs of row 5 is not finite"):
        policy.predict(bad)
    with pytest.raises(ValueError, match="unknown direction 'north'"):
        load_policy("walker/plain", "north", runs=NOWHERE)
    with pytest.raises(ValueError, match="seed_index must be in 0"):
        load_policy("walker/plain", seed_index=9, runs=NOWHERE)
    with pytest.raises(ValueError, match="unknown row"):
        load_policy("walker/none", runs=NOWHERE)


# ---------------------------------------------------------------- export


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A short export of a master, by the command."""
    to = tmp_path_factory.mktemp("exports") / "master"
    status = cli.run(["export", "maze/hrl/plain", "--to", str(to), "--episodes", "2", "--runs", str(to / "none")])
    assert status == 0
    return to


def test_an_export_is_accepted_wherever_a_row_is(exported):
    original = find_trained("maze/hrl/plain", NOWHERE)
    trained = find_trained(str(exported), NOWHERE)
    assert trained.experiment == original.experiment
    assert trained.seeds == original.seeds
    same = jax.tree.map(lambda a, b: bool((a == b).all()), trained.params, original.params)
    assert all(jax.tree.leaves(same))
    subs, theirs = find_needed(trained, NOWHERE), find_needed(original, NOWHERE)
    assert all(jax.tree.leaves(jax.tree.map(lambda a, b: bool((a == b).all()), subs.params, theirs.params)))
    assert np.array_equal(
        load_policy(str(exported)).predict(OBS, True)[0], load_policy("maze/hrl/plain").predict(OBS, True)[0]
    )


def test_the_card_says_what_was_measured(exported):
    card = (exported / "README.md").read_text(encoding="utf-8")
    report = json.loads((exported / "evaluation.json").read_text(encoding="utf-8"))
    assert f"{100 * report['success']['1.0']:.1f} %" in card
    assert "2 episodes" in card
    assert "footwork train maze/hrl/plain --seeds" in card
    assert str(exported.parent) not in card + json.dumps(report)  # no path of this machine
    named = set(re.findall(r"^\* .*$", card, re.MULTILINE))
    for file in exported.iterdir():
        assert file.name in ("README.md", "lock") or any(f"`{file.name}`" in line for line in named), file.name


def test_the_card_names_the_fields_that_are_not_the_rows():
    row = find_row("maze/hrl/plain")
    assert _own_fields(replace(row, total_steps=7)) == ""
    other = replace(row, option_steps=7, task=replace(row.task, arena=MAZES["spiral"]))
    assert _own_fields(other) == "Other than the row's: `option_steps`, `task.arena`. "


def test_an_export_shows_an_episode(exported):
    page = (exported / "replay.html").read_text(encoding="utf-8")
    data = json.loads(re.search(r'<script type="application/json"[^>]*>(.*?)</script>', page, re.DOTALL)[1])
    assert [episode["row"] for episode in data["episodes"]] == ["maze/hrl/plain"]
    assert not re.search(r"(src|href)=.https?:", page)


def test_an_export_does_not_write_over_anything(exported):
    with pytest.raises(RunError, match="holds something already: choose another folder with --to"):
        export("maze/hrl/plain", exported, NOWHERE, 1)


def test_exported_sub_policies_carry_a_master(exported, tmp_path, monkeypatch):
    gymnasium = pytest.importorskip("gymnasium", reason="needs the extra footwork[gym]")
    to = tmp_path / "walkers"
    measured = json.loads((exported / "evaluation.json").read_text(encoding="utf-8"))  # of another: nobody reads it
    monkeypatch.setattr("footwork.doors.export.evaluate", lambda *args, **fields: measured)
    export("walker/plain", to, NOWHERE, 4)
    folder = gymnasium.make("footwork/AntMazeOptions-v0", sub_policies=str(to), option_steps=2).unwrapped
    packaged = gymnasium.make("footwork/AntMazeOptions-v0", sub_policies="walker/plain", option_steps=2).unwrapped
    for env in (folder, packaged):
        env.reset(seed=0)
    assert np.array_equal(folder.step(1)[0], packaged.step(1)[0])
    master = gymnasium.make("footwork/AntMazeOptions-v0", sub_policies=str(exported), option_steps=2).unwrapped
    assert master.setting.sub_policies.policy == packaged.setting.sub_policies.policy


@pytest.mark.parametrize(
    ("row", "call"),
    [
        ("walker/interleaved", 'gymnasium.make("footwork/AntWalker-v0", direction="up", fall_rule="either")'),
        ("maze/hrl/plain", 'gymnasium.make("footwork/AntMazeOptions-v0", sub_policies="DIR")'),
        ("bandit/hrl/plain", None),  # there is no such id
        (
            "maze/flat/guided-free",
            'gymnasium.make("footwork/AntMaze-v0", potential="geodesic", goal_reward=200.0, xy_scale=0.125)',
        ),
    ],
)
def test_a_card_tells_how_to_make_the_rows_environment(row, call):
    from footwork.doors.export import _environment

    assert _environment(find_row(row), "DIR") == call


def test_a_missing_extra_is_named_in_one_line(monkeypatch, capsys, tmp_path):
    import sys

    monkeypatch.setitem(sys.modules, "onnx", None)
    monkeypatch.delitem(sys.modules, "footwork.doors.onnx", raising=False)
    assert cli.run(["export", "walker/plain", "--to", str(tmp_path / "x"), "--onnx"]) == 1
    error = capsys.readouterr().err
    assert "footwork[onnx]" in error
    assert error.count("\n") == 1
    assert not (tmp_path / "x").exists()


# ---------------------------------------------------------------- ONNX


@pytest.mark.skipif(not (find_spec("onnx") and find_spec("onnxruntime")), reason="needs the extra footwork[onnx]")
@pytest.mark.parametrize(
    "row", ["walker/plain", "walker/symmetric-interleaved", "maze/hrl/plain", "bandit/hrl/plain", "maze/flat/free"]
)
def test_onnx_files_act_as_the_policies_do(row, tmp_path):
    import onnxruntime

    from footwork.doors.onnx import write_onnx

    trained = find_trained(row, NOWHERE)
    obs = observations(trained.experiment)
    for direction, path in enumerate(write_onnx(trained, tmp_path)):
        ours, _ = of_trained(trained, direction).predict(obs, deterministic=True)
        session = onnxruntime.InferenceSession(str(path))
        theirs = session.run(["action"], {"obs": obs})[0]
        np.testing.assert_allclose(theirs, ours, rtol=1e-5, atol=1e-5)


def observations(experiment):
    """What ants of every posture see, upside down and at any heading."""
    from footwork.physics.batch import BatchPhysics

    generator = np.random.default_rng(1)
    task, n = experiment.task, 64
    physics = BatchPhysics(task.robot, task.arena, n, 1)
    state = physics.initial()
    quaternion = generator.normal(size=(n, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    qpos = np.concatenate([generator.uniform(-1, 1, (n, 3)), quaternion, generator.uniform(-1, 1, (n, 8))], axis=1)
    state = physics.reset(state, np.ones(n, bool), qpos, generator.normal(size=(n, 14)))
    return np.asarray(jax.jit(task.observe)(state, np.zeros((n, 2), np.float32)))


# ---------------------------------------------------------------- Stable-Baselines3


@pytest.fixture
def vec_env():
    pytest.importorskip("stable_baselines3", reason="needs the extra footwork[sb3]")
    from footwork.doors.sb3 import make_vec_env

    return make_vec_env("footwork/AntMaze-v0", 3, episode_steps=4)


def test_the_vec_env_tells_of_ends_as_stable_baselines3_reads_them(vec_env):
    vec_env.seed(3)
    obs = vec_env.reset()
    again = vec_env.env.reset(seed=3)[0]
    assert np.array_equal(obs, again)
    total = np.zeros(3)
    for step in range(4):
        obs, rewards, done, infos = vec_env.step(np.ones((3, 8), np.float32) * 0.1)
        total += rewards
        assert rewards.dtype == np.float32
        assert done.tolist() == [step == 3] * 3
    for row, info in enumerate(infos):
        assert info["TimeLimit.truncated"]
        assert info["terminal_observation"].shape == (34,)
        assert not np.array_equal(info["terminal_observation"], obs[row])
        assert info["episode"]["l"] == 4
        assert info["episode"]["r"] == pytest.approx(total[row], rel=1e-5)
        assert info["is_success"] is False


def test_the_vec_env_refuses_other_reset_modes(vec_env):
    from footwork.doors.gym import make_vector
    from footwork.doors.sb3 import FootworkVecEnv

    with pytest.raises(ValueError, match="autoreset_mode='SameStep'"):
        FootworkVecEnv(make_vector("footwork/AntWalker-v0", 2))
    with pytest.raises(ValueError, match="is not one of footwork/AntWalker-v0"):
        make_vector("CartPole-v1", 2)


def test_staggered_rows_are_not_in_step_and_a_cut_is_a_truncation(vec_env):
    from footwork.doors.sb3 import make_vec_env

    rows, length = 24, 4
    plain, staggered = (
        make_vec_env("footwork/AntMaze-v0", rows, episode_steps=length, staggered=s) for s in (False, True)
    )
    for env in (plain, staggered):
        env.seed(5)
        env.reset()
    first, ends = np.ones(rows, bool), []
    for _ in range(3 * length):
        obs, _, _, _ = plain.step(np.zeros((rows, 8), np.float32))
        new_obs, _, done, infos = staggered.step(np.zeros((rows, 8), np.float32))
        for row in np.flatnonzero(done):
            assert infos[row]["TimeLimit.truncated"]
            if first[row] and "episode" not in infos[row]:  # cut: the episode was the same so far
                np.testing.assert_array_equal(infos[row]["terminal_observation"], obs[row])
                assert not np.array_equal(new_obs[row], obs[row])
            else:
                assert infos[row]["episode"]["l"] == length
        first &= ~done
        ends.append(done)
    assert all(0 < done.sum() < rows for done in ends[length:])  # phases are spread
    assert (np.sum(ends[length : 2 * length], axis=0) == 1).all()


@pytest.mark.parametrize("kind", ["master", "flat"])
def test_the_example_trains(kind, monkeypatch):
    pytest.importorskip("stable_baselines3", reason="needs the extra footwork[sb3]")
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "examples"))
    import sb3_ppo

    monkeypatch.setattr(sb3_ppo, "FIELDS", {"episode_steps": 8} | ({"option_steps": 2} if kind == "master" else {}))
    figure = sb3_ppo.main([kind, "--steps", "64", "--rows", "4", "--episodes", "4"])
    assert np.isfinite(figure)
