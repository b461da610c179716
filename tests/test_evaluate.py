"""Figures of evaluation on policies whose behaviour is known."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from footwork.arena import Arena
from footwork.evaluate import evaluate, handover_matrix, random_switching, wilson
from footwork.options import SubPolicies
from footwork.study.experiments import find_row
from footwork.train import Trained


def still(policy, leading=()):
    """Parameters whose mode is no torque at all."""
    params = policy.init(jax.random.key(0))
    return jax.tree.map(lambda leaf: jnp.zeros((*leading, *leaf.shape)), params)


def test_wilson_interval_has_its_published_values():
    # Newcombe 1998, table I: 81 of 263 and 0 of 20
    np.testing.assert_allclose(wilson(np.arange(263) < 81), [0.2553, 0.3662], atol=5e-5)
    np.testing.assert_allclose(wilson(np.zeros(20, bool)), [0.0, 0.1611], atol=5e-5)


def test_ants_that_do_not_move_are_idle_and_hand_nothing_over():
    row = find_row("walker/symmetric")
    subs = SubPolicies(row.policy(), still(row.policy()), symmetric=True, deterministic=True)
    switching = random_switching(subs, row.task, 200, ants=3, num_threads=1)
    assert switching["idle"] == 1.0
    assert abs(switching["speed_mps"]) < 0.05
    assert switching["upside_down"] == 0.0
    matrix = handover_matrix(subs, row.task, ants=1, num_threads=1)
    assert [len(line) for line in matrix] == [4] * 4
    assert all(abs(entry["speed_mps"]) < 0.05 and entry["flip"] == 0.0 for line in matrix for entry in line)


@pytest.mark.parametrize(("distance", "hits"), [(0.47, 3), (0.9, 2), (3.0, 1), (7.0, 0)])
def test_success_is_judged_at_four_radii_from_the_closest_approach(distance, hits):
    row = find_row("maze/flat/free")
    task = replace(row.task, arena=Arena("near", (0.0, 0.0), ((distance, 0.0),)), episode_steps=40)
    row = replace(row, task=task)
    trained = Trained(row, (0,), still(row.policy(), (1, 1)), "made up")
    report = evaluate(trained, None, num_episodes=2, deterministic=True, num_threads=1)
    assert list(report["success"]) == ["0.45", "0.5", "1.0", "5.0"]
    assert sum(report["success"].values()) == hits
    assert (report["time_to_goal_s"] is None) == (distance > task.goal_radius)
    assert abs(report["progress_m"]) < 0.2
