"""What is filmed is what evaluation plays, and every control step of it."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

from footwork import evaluate as evaluating
from footwork.arena import Arena
from footwork.evaluate import play_episodes
from footwork.footage import NOBODY, film
from footwork.learn.config import PPOConfig
from footwork.study.experiments import ANT_BANDIT, ANT_WALKER, find_row
from footwork.tasks.terms import PENALISED_WEIGHTS
from footwork.train import Experiment, Trained
from test_evaluate import DT, TOP_SPEED, Glider, constant, walkers

CONFIG = PPOConfig(hidden_sizes=(4,))
MASTER = Experiment(
    "test/master", replace(ANT_BANDIT, episode_steps=27), CONFIG, 1, sub_policies="walker/plain", option_steps=10
)


def fresh(experiment, seed=0, runs=1):
    keys = jax.random.split(jax.random.key(seed), (1, runs))
    return Trained(experiment, (5,), jax.vmap(jax.vmap(experiment.policy().init))(keys), "nowhere")


def sub_policies():
    return fresh(Experiment("walker/test", ANT_WALKER, CONFIG, 1), runs=4).sub_policies()


def test_a_filmed_master_is_the_evaluated_one_bit_for_bit():
    trained, subs = fresh(MASTER), sub_policies()
    episodes = play_episodes(trained, subs, 3, seed=4, num_threads=1)
    footage = film(trained, subs, 3, seed=4, num_threads=1)
    for n, shot in enumerate(footage):
        assert (shot.row, shot.seed, shot.episode, shot.outcome) == ("test/master", 5, n, "truncated")
        assert shot.num_steps == 27  # the episode ends within its third option
        assert shot.qpos.shape == (28, 15)
        np.testing.assert_array_equal(shot.choice, np.repeat(episodes.choices[:, n], 10)[:27])
        np.testing.assert_array_equal(shot.qpos[::10, :2], episodes.paths[:-1, n])
        np.testing.assert_array_equal(shot.qpos[-1, :2], episodes.paths[-1, n])
        assert shot.distance.min() == episodes.closest[n]
        assert (shot.odds.shape, shot.value.shape) == ((3, 4), (3,))
        np.testing.assert_allclose(shot.odds.sum(axis=1), 1.0, rtol=1e-5)
    assert len({shot.qpos.tobytes() for shot in footage}) == 3


def test_rewards_of_control_steps_add_up_to_the_masters(monkeypatch):
    monkeypatch.setattr(evaluating, "physics_for", lambda engine, *rest: Glider(*rest))
    task = replace(ANT_BANDIT, arena=Arena("ahead", (0.0, 0.0), ((0.0, 3.0),)), episode_steps=200)
    experiment = replace(MASTER, task=replace(task, weights=PENALISED_WEIGHTS))
    trained = Trained(experiment, (0,), constant(experiment.policy(), [[[0.0, 5.0, 0.0, 0.0]]]), "")
    shot = film(trained, walkers([TOP_SPEED] * 4), 1, seed=0, deterministic=True)[0]
    assert shot.outcome == "reached"
    assert shot.num_steps == np.ceil((3.0 - 0.45) / TOP_SPEED / DT)  # not rounded up to a whole option
    assert (shot.choice == 1).all()
    np.testing.assert_allclose(np.diff(shot.qpos[:, 1]), DT * TOP_SPEED, atol=1e-5)
    np.testing.assert_allclose(shot.distance, 3.0 - shot.qpos[1:, 1], atol=1e-5)
    progress = (3.0 - shot.distance[-1]) / DT
    assert shot.reward.sum() >= progress - shot.num_steps * 2  # penalties are small beside it
    assert len(shot.odds) == np.ceil(shot.num_steps / 10)


def test_walkers_and_flat_policies_are_filmed_too():
    walker = Experiment("walker/test", replace(ANT_WALKER, episode_steps=6, fall_rule="none"), CONFIG, 1)
    shots = film(fresh(walker, runs=4), None, 4, num_threads=1, most_steps=4)
    assert [int(shot.choice[0]) for shot in shots] == [0, 1, 2, 3]
    assert {shot.num_steps for shot in shots} == {4}
    assert not shots[0].has_goal
    flat = Experiment("maze/test", replace(find_row("maze/flat/free").task, episode_steps=3), CONFIG, 1)
    shot = film(fresh(flat), None, 1, num_threads=1)[0]
    assert (shot.choice == NOBODY).all()
    assert (shot.num_steps, len(shot.odds), shot.has_goal) == (3, 0, True)
    np.testing.assert_allclose(shot.goal, flat.task.arena.goals[0])


def test_a_packaged_actor_has_no_value():
    trained = fresh(MASTER)
    actor_only = trained._replace(params={"actor": trained.params["actor"]})
    shot = film(actor_only, sub_policies(), 1, num_threads=1, most_steps=1)[0]
    assert shot.num_steps == 10  # a whole option
    assert len(shot.value) == 0
    assert len(shot.odds) == 1


@pytest.mark.parametrize("event", ["flipped", "fallen"])
def test_how_an_episode_ended(monkeypatch, event):
    monkeypatch.setattr(evaluating, "physics_for", lambda engine, *rest: Glider(*rest))
    rule = {"flipped": "flip", "fallen": "height"}[event]
    flat = Experiment("test/flat", replace(ANT_BANDIT, fall_rule=rule, episode_steps=5), CONFIG, 1)
    outputs = np.zeros((1, 1, 8))
    outputs[..., {"flipped": 2, "fallen": 3}[event]] = 1.0
    shot = film(Trained(flat, (0,), constant(flat.policy(), outputs), ""), None, 1, deterministic=True)[0]
    assert (shot.outcome, shot.num_steps) == (event, 1)
    assert getattr(shot, event).all()
