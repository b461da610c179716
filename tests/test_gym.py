"""Laws of the Gymnasium environments: Gymnasium's own checks, a vector does what its rows do alone, refusals."""

from __future__ import annotations

import subprocess
import sys
import warnings
from pathlib import Path

import jax
import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium", reason="needs the extra footwork[gym]")

from gymnasium.utils.env_checker import check_env, data_equivalence  # noqa: E402
from gymnasium.utils.env_match import check_environments_match  # noqa: E402
from gymnasium.vector import AutoresetMode  # noqa: E402

from footwork.arena import MAZES  # noqa: E402
from footwork.doors import settings  # noqa: E402
from footwork.doors.gym import IDS  # noqa: E402
from footwork.tasks.terms import RewardWeights  # noqa: E402

QUICK = {"AntMazeOptions-v0": {"option_steps": 2}}
U = [[1, 1, 1, 1, 1], [1, "g", 0, 0, 1], [1, 1, 1, 0, 1], [1, "r", 0, 0, 1], [1, 1, 1, 1, 1]]


def make(name, **fields):
    return gymnasium.make(f"footwork/{name}", **{**QUICK.get(name, {}), **fields})


def make_vec(name, num_envs, **fields):
    return gymnasium.make_vec(f"footwork/{name}", num_envs, **{**QUICK.get(name, {}), **fields})


def same(one, other):
    """Bit for bit, types included."""
    return data_equivalence(one, other, exact=True)


# ---------------------------------------------------------------- registration


@pytest.mark.parametrize(
    "code",
    [
        "import footwork, gymnasium",
        "import gymnasium, footwork",
        "import gymnasium.spaces\nimport footwork.arena\nimport gymnasium",
        "import gymnasium; gymnasium.spec",
        "import footwork, importlib.util; importlib.util.find_spec('gymnasium'); import gymnasium",  # asked for only
    ],
)
def test_ids_are_known_whatever_is_imported_first_and_nothing_heavy_comes_along(code):
    check = """
import sys, gymnasium
known = [name for name in gymnasium.registry if name.startswith("footwork/")]
print(len(known), "jax" in sys.modules, "mujoco" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code + check], capture_output=True, text=True, check=True)
    assert done.stdout.split() == [str(len(IDS)) if "footwork" in code else "0", "False", "False"]


def test_importing_footwork_does_not_import_gymnasium():
    code = "import sys, footwork; print([name for name in ('gymnasium', 'numpy', 'jax') if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"


# ---------------------------------------------------------------- Gymnasium's own checks


@pytest.mark.parametrize("name", IDS)
def test_check_env_is_clean(name, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disable")  # what OpenGL there is does not belong to this law
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message="no OpenGL here")
        check_env(make(name).unwrapped)


def test_check_env_is_clean_with_goals():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = make("AntMaze-v0", goal_conditioned=True, reward="sparse")
        check_env(env.unwrapped, skip_render_check=True)


class OnlyRow(gymnasium.Env):
    """A vector environment of one row as a single environment."""

    def __init__(self, vector):
        self.vector, self.render_mode = vector, None
        self.action_space, self.observation_space = vector.single_action_space, vector.single_observation_space

    def reset(self, *, seed=None, options=None):
        obs, infos = self.vector.reset(seed=seed)
        return obs[0], self.only(infos)

    def step(self, action):
        obs, reward, terminated, truncated, infos = self.vector.step(np.array([action]))
        return obs[0], reward[0].item(), bool(terminated[0]), bool(truncated[0]), self.only(infos)

    @staticmethod
    def only(infos):
        return {name: value[0].item() for name, value in infos.items() if not name.startswith("_")}


@pytest.mark.parametrize("name", IDS)
def test_a_vector_of_one_matches_the_single_environment(name):
    vector = make_vec(name, 1, autoreset_mode=AutoresetMode.DISABLED)
    check_environments_match(make(name).unwrapped, OnlyRow(vector), num_steps=30)


# ---------------------------------------------------------------- a vector does what its rows do alone


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize(
    ("name", "num_envs", "fields"),
    [
        ("AntWalker-v0", 11, {"episode_steps": 9, "direction": "left"}),
        ("AntMaze-v0", 3, {"episode_steps": 7, "goal_conditioned": True, "reward": "dense"}),
        ("AntMazeOptions-v0", 3, {"episode_steps": 7}),
    ],
)
def test_a_vector_answers_like_gymnasiums_own_over_single_environments(name, num_envs, fields, mode):
    ours = make_vec(name, num_envs, autoreset_mode=mode, **fields)
    theirs = make_vec(name, num_envs, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, **fields)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.metadata["autoreset_mode"] is mode
    assert same(ours.reset(seed=5), theirs.reset(seed=5))
    ours.action_space.seed(1)
    for _ in range(24):
        action = ours.action_space.sample()
        assert same(ours.step(action), theirs.step(action))
    assert same(ours.reset(), theirs.reset())


def test_rows_equal_single_environments_over_1000_steps():
    vector = make_vec("AntWalker-v0", 11, autoreset_mode="SameStep", num_threads=2)
    generator = np.random.default_rng(0)
    actions = generator.uniform(-1.3, 1.3, (1000, 11, 8)).astype(np.float32)
    obs, _ = vector.reset(seed=7)
    seen, ends = [(obs,)], 0
    for action in actions:
        seen.append(vector.step(action)[:4])
        ends += int(np.sum(seen[-1][2] | seen[-1][3]))
    assert ends >= 11
    for row in (0, 10):
        env = make("AntWalker-v0").unwrapped
        obs, _ = env.reset(seed=7 + row)
        assert same(obs, seen[0][0][row])
        for action, step in zip(actions[:, row], seen[1:], strict=True):
            obs, reward, terminated, truncated, _ = env.step(action)
            assert (reward, terminated, truncated) == tuple(part[row] for part in step[1:])
            obs = env.reset()[0] if terminated or truncated else obs
            assert same(obs, step[0][row])


def test_sampling_sub_policies_do_not_know_how_many_rows_there_are():
    fields = {"autoreset_mode": "SameStep", "episode_steps": 7}
    few, many = (make_vec("AntMazeOptions-v0", n, **fields) for n in (3, 11))
    assert same(few.reset(seed=3)[0], many.reset(seed=3)[0][:3])
    for choice in np.random.default_rng(0).integers(0, 4, (8, 11)):
        assert same(few.step(choice[:3])[:2], tuple(part[:3] for part in many.step(choice)[:2]))


def test_disabled_autoreset_waits_for_a_mask():
    env = make_vec("AntMaze-v0", 3, autoreset_mode="Disabled", episode_steps=7)
    obs, _ = env.reset(seed=0)
    nothing = np.zeros((3, 8), np.float32)
    for _ in range(7):
        last, _, _, truncated, _ = env.step(nothing)
    assert truncated.all()
    with pytest.raises(gymnasium.error.ResetNeeded, match="row 0"):
        env.step(nothing)
    mask = np.array([True, False, True])
    again, infos = env.reset(seed=0, options={"reset_mask": mask})
    assert same(again[mask], obs[mask])
    assert same(again[1], last[1])
    assert infos["_x_position"].tolist() == mask.tolist()
    with pytest.raises(gymnasium.error.ResetNeeded, match="row 1"):
        env.step(nothing)


def test_what_was_returned_is_never_changed_afterwards():
    env = make_vec("AntMaze-v0", 3, autoreset_mode="SameStep", episode_steps=7)
    kept = [env.reset(seed=0)[0]]
    copies = [kept[0].copy()]
    for _ in range(9):
        obs = env.step(np.ones((3, 8)))[0]
        kept.append(obs)
        copies.append(obs.copy())
    assert all(same(a, b) for a, b in zip(kept, copies, strict=True))
    kept[-1][:] = 0.0  # and it is the caller's to change


# ---------------------------------------------------------------- what the fields mean


def test_reward_is_the_sum_of_its_terms_and_the_obs_stays_in_bounds():
    env = make_vec("AntMaze-v0", 8, penalties=True, goal_reward=5.0, autoreset_mode="SameStep")
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(40):
        obs, reward, _, _, infos = env.step(env.action_space.sample())
        total = sum(value for name, value in infos.items() if name.startswith("reward_"))
        np.testing.assert_allclose(reward, total, rtol=1e-4, atol=1e-4)
        assert obs in env.observation_space
    assert {"success", "fallen", "flipped", "diverged", "goal_distance"} <= set(infos)


@pytest.mark.parametrize("reward", ["sparse", "dense"])
def test_compute_reward_gives_the_rewards_that_were_paid(reward):
    env = make_vec(
        "AntMaze-v0", 4, goal_conditioned=True, reward=reward, goal_radius=8.0, start_noise=0.5, goal=[(-4, 4), (4, 4)]
    )
    obs, _ = env.reset(seed=1)
    paid = []
    for _ in range(30):
        obs, rewards, terminated, _, infos = env.step(np.random.default_rng(0).uniform(-1, 1, (4, 8)))
        stepped = infos["_success"]
        again = env.compute_reward(obs["achieved_goal"], obs["desired_goal"], {})
        assert (again[stepped] == rewards[stepped]).all()
        ended = env.compute_terminated(obs["achieved_goal"], obs["desired_goal"], {})
        assert (ended[stepped] == terminated[stepped]).all()
        paid.append(rewards[stepped])
    assert len(np.unique(np.concatenate(paid))) >= 2
    assert env.compute_reward(np.zeros(2), np.zeros(2), {}) == (1.0 if reward == "sparse" else 0.0)


def test_maze_maps_of_every_kind_give_the_same_maze(tmp_path):
    text = "#####\n#g..#\n###.#\n#r..#\n#####"
    (tmp_path / "my.txt").write_text(text, encoding="utf-8")
    arenas = [settings.ant_maze(maze_map=m).task.arena for m in ("u", U, text, str(tmp_path / "my.txt"))]
    assert len({(arena.walls, arena.start, arena.goals) for arena in arenas}) == 1


def test_several_goals_are_drawn_and_observed():
    env = make_vec("AntMaze-v0", 8, goal=[(-4.0, 4.0), (4.0, 4.0)])
    obs, _ = env.reset(seed=0)
    assert obs.shape == (8, 36)
    assert {tuple(goal) for goal in obs[:, -2:]} == {(-4.0, 4.0), (4.0, 4.0)}


def test_weights_directions_and_lengths_are_fields():
    setting = settings.ant_walker(direction="down", reward_weights={"alive": 0.0}, episode_steps=12)
    assert "alive" not in settings.term_names(setting.task)
    assert settings.ant_walker().task.weights == RewardWeights()
    env = make_vec("AntWalker-v0", 1, max_episode_steps=2)
    assert env.setting.task.episode_steps == 2
    assert make_vec("AntMazeOptions-v0", 1, max_episode_steps=3).setting.task.episode_steps == 6


def test_numbers_of_numpy_are_numbers():
    setting = settings.read_fields(
        "AntMazeOptions", {"option_steps": np.int64(7), "cell": np.float32(3), "penalties": np.True_}
    )
    assert (setting.option_steps, setting.task.arena.cell) == (7, 3.0)
    assert setting.task.weights.electricity < 0
    assert make_vec("AntMaze-v0", np.int64(2)).num_envs == 2


def test_a_master_brings_the_sub_policies_that_it_stands_on():
    given = settings.read_fields("AntMazeOptions", {"sub_policies": "maze/hrl/plain"}).sub_policies
    own = settings.read_fields("AntMazeOptions", {"sub_policies": "walker/plain"}).sub_policies
    assert jax.tree.all(jax.tree.map(np.array_equal, given.params, own.params))


# ---------------------------------------------------------------- pictures


def test_frames_where_there_is_no_opengl(monkeypatch):
    from footwork import render
    from footwork.doors import frames

    monkeypatch.setenv("MUJOCO_GL", "disable")
    render.choose_platform.cache_clear()
    env = make("AntMaze-v0", render_mode="rgb_array")
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="no OpenGL here"):
        image = env.render()
    render.choose_platform.cache_clear()
    assert image.shape == (frames.HEIGHT, frames.WIDTH, 3)
    assert image.dtype == np.uint8
    assert len(np.unique(image.reshape(-1, 3), axis=0)) >= 5  # floor, wall, legs, shins, torso


def test_vectors_render_every_row():
    env = make_vec("AntWalker-v0", 2, render_mode="rgb_array")
    env.reset(seed=0)
    assert [image.shape for image in env.render()] == [(480, 640, 3)] * 2
    env.close()


# ---------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("name", "fields", "words"),
    [
        ("AntWalker-v0", {"direction": "north"}, "unknown direction 'north'; known: right, up, left, down"),
        ("AntWalker-v0", {"robot": "cat"}, "unknown robot 'cat'"),
        ("AntWalker-v0", {"reward_weights": {"alve": 1.0}}, "unknown reward_weights 'alve'; known: progress"),
        (
            "AntWalker-v0",
            {"reward_weights": {"alive": np.nan}},
            "'alive'. must be a finite number",
        ),
        ("AntWalker-v0", {"reward_weights": {"alive": None}}, "must be a finite number .*, got None"),
        ("AntWalker-v0", {"reward_weights": 3}, "must be weights by name"),
        ("AntWalker-v0", {"robot": ["heavy"]}, "robot must be a word"),
        ("AntWalker-v0", {"episode_steps": 1.5}, "episode_steps must be a whole number >= 1, got 1.5"),
        ("AntWalker-v0", {"episode_steps": True}, "episode_steps must be a whole number"),
        ("AntMaze-v0", {"goal_reward": np.nan}, "goal_reward must be a finite number .*, got nan"),
        (
            "AntMaze-v0",
            {"goal_radius": np.inf},
            "goal_radius must be a finite number > 0 .*, or None, got inf",
        ),
        ("AntMaze-v0", {"xy_scale": 0}, "xy_scale must be a finite number > 0"),
        ("AntMaze-v0", {"cell": "wide"}, "cell must be a finite number > 0 .*, or None, got 'wide'"),
        ("AntMaze-v0", {"start_noise": -1.0}, "start_noise must be a finite number >= 0"),
        ("AntMaze-v0", {"penalties": "no"}, "penalties must be True or False, got 'no'"),
        ("AntMaze-v0", {"maze_map": "nowhere"}, "no maze 'nowhere': neither a file nor one of u, spiral"),
        ("AntMaze-v0", {"maze_map": [[1, 1, 1], [1, 1], [1, 1, 1]]}, r"equally long, got lengths \[3, 2, 3\]"),
        ("AntMaze-v0", {"maze_map": [[1, 1, 1], [1, 7, 1], [1, 1, 1]]}, "unknown maze cell 7"),
        ("AntMaze-v0", {"maze_map": U[:3]}, "start"),
        ("AntMaze-v0", {"goal": (0.0, 0.0)}, "must not be in a wall"),
        ("AntMaze-v0", {"goal": (50.0, 0.0)}, "no way"),
        ("AntMaze-v0", {"goal": "here"}, "goal must be"),
        ("AntMaze-v0", {"goal_conditioned": True}, "needs reward='sparse' or 'dense'"),
        ("AntMaze-v0", {"reward": "rich"}, "reward must be task, sparse or dense"),
        ("AntMazeOptions-v0", {"option_steps": 0}, "option_steps must be a whole number >= 1"),
        ("AntMazeOptions-v0", {"option_steps": "5"}, "option_steps must be a whole number >= 1, got '5'"),
        ("AntMazeOptions-v0", {"sub_policies": None}, "sub_policies must be a row"),
        ("AntMazeOptions-v0", {"sub_policies": "walker/none"}, "walker/none"),
        ("AntMazeOptions-v0", {"sub_policies": "maze/flat/free"}, "must walk in four directions"),
        ("AntMazeOptions-v0", {"robot": "light"}, "the environment has ant 'light'"),
        ("AntBandit-v0", {"half_size": 0.0}, "half_size must be a finite number > 0"),
        ("AntBandit-v0", {"render_mode": "ascii"}, "render_mode must be"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*render_mode")
def test_bad_fields_are_refused_in_clear_words(name, fields, words):
    with pytest.raises(ValueError, match=words):
        make(name, **fields)


def test_unknown_ids_and_fields_are_named():
    with pytest.raises(gymnasium.error.NameNotFound, match="AntWalker"):
        gymnasium.make("footwork/AntWlker-v0")
    with pytest.raises(TypeError, match="AntMaze has no field 'maze_mp'; its fields: maze_map, goal, "):
        make("AntMaze-v0", maze_mp=U)
    with pytest.raises(ValueError, match="autoreset_mode must be one of"):
        make_vec("AntMaze-v0", 2, autoreset_mode="Never")
    with pytest.raises(ValueError, match="num_envs"):
        make_vec("AntMaze-v0", 0)
    with pytest.raises(ValueError, match="num_envs must be a whole number"):
        make_vec("AntMaze-v0", True)
    with pytest.raises(ValueError, match="num_threads must be a whole number >= 0"):
        make_vec("AntMaze-v0", 1, num_threads=1.5)
    with pytest.raises(ValueError, match=r"seed must be a number or 1 of them, got 1\.5"):
        make_vec("AntMaze-v0", 1).reset(seed=1.5)
    with pytest.raises(ValueError, match="xy_scale must be a finite number"):
        make_vec("AntMaze-v0", 1, xy_scale=1e300)
    with pytest.raises(ValueError, match="max_episode_steps must be a whole number"):
        make_vec("AntMaze-v0", 1, max_episode_steps=2.5)


def test_bad_actions_are_refused_naming_the_row_and_nothing_is_lost():
    env = make_vec("AntWalker-v0", 3)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros((3, 8)))
    env.reset(seed=0)
    bad = np.zeros((3, 8))
    bad[2, 4] = np.nan
    with pytest.raises(ValueError, match="action of row 2 is not finite"):
        env.step(bad)
    for shape in ((3, 7), (2, 8), (8,)):
        with pytest.raises(ValueError, match=r"actions must have shape \(3, 8\), got"):
            env.step(np.zeros(shape))
    with pytest.raises(ValueError, match="actions must be an array"):
        env.step("left")
    fresh = make_vec("AntWalker-v0", 3)
    fresh.reset(seed=0)
    assert same(env.step(np.ones((3, 8))), fresh.step(np.ones((3, 8))))


def test_bad_choices_of_a_master_are_refused():
    env = make_vec("AntMazeOptions-v0", 3)
    env.reset(seed=0)
    for choice, words in (
        ([0, 1, 7], "row 2 must be 0, 1, 2 or 3, got 7"),
        ([0, 1.5, 1], "row 1 must be"),
        ([0], "shape"),
    ):
        with pytest.raises(ValueError, match=words):
            env.step(np.array(choice))


def test_a_single_environment_refuses_too():
    env = make("AntMaze-v0", episode_steps=7).unwrapped
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(8))
    with pytest.raises(ValueError, match="unknown reset options 'goal'; known: none"):
        env.reset(options={"goal": 1})
    env.reset()
    with pytest.raises(ValueError, match=r"action must have shape \(8,\), got \(4,\)"):
        env.step(np.zeros(4))
    with pytest.raises(ValueError, match="action is not finite"):
        env.step(np.full(8, np.inf))
    assert [env.step(np.zeros(8))[3] for _ in range(7)] == [False] * 6 + [True]
    with pytest.raises(gymnasium.error.ResetNeeded, match="ended"):
        env.step(np.zeros(8))


def test_resets_refuse_what_they_do_not_know():
    env = make_vec("AntWalker-v0", 3)
    for options, words in (
        ({"gaol": 1}, "unknown reset options 'gaol'; known: reset_mask"),
        ({"reset_mask": [True]}, "3 bools"),
    ):
        with pytest.raises(ValueError, match=words):
            env.reset(options=options)
    with pytest.raises(ValueError, match="seed must be a number or 3"):
        env.reset(seed=[1])


# ---------------------------------------------------------------- the numbers' meanings


@pytest.mark.parametrize("fields", [{}, {"goal": [(-4.0, 4.0), (4.0, 4.0)]}, {"maze_map": "medium"}])
def test_every_number_of_an_observation_has_a_meaning_and_bounds(fields):
    task = settings.ant_maze(**fields).task
    low, high = settings.bounds(task)
    assert len(settings.observed(task)) == task.obs_size == len(low)
    assert (low < high).all()
    assert np.isfinite([low, high]).all()
    assert set(MAZES) >= {"u"}


@pytest.mark.parametrize("name", IDS)
def test_the_pages_of_the_environments_are_those_the_code_makes(name, monkeypatch):
    root = Path(__file__).parents[1]
    monkeypatch.syspath_prepend(str(root / "tools"))
    import environment_pages

    written = (root / "docs" / "environments" / f"{name}.md").read_text(encoding="utf-8")
    assert written == environment_pages.page(name), "run tools/environment_pages.py"
