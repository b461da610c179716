"""Stable-Baselines3's PPO on Footwork: as a master that chooses sub-policies, or as a flat policy that walks.

    pip install 'footwork[sb3]'
    python examples/sb3_ppo.py master                # AntMazeOptions-v0: minutes on two cores
    python examples/sb3_ppo.py flat --steps 2000000  # AntWalker-v0

Prints what the trained policy does over fresh episodes: of a master how often it came within
1.0 m of the goal, of a flat policy how fast it walked.
"""

import argparse
import time

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from footwork.doors.sb3 import make_vec_env
from footwork.statistics import wilson

MASTER, FLAT = "footwork/AntMazeOptions-v0", "footwork/AntWalker-v0"
NEAR = 1.0  # m
FIELDS = {}  # of the environments, such as {"maze_map": "medium", "option_steps": 25}
NETWORK = {"net_arch": {"pi": [64, 64], "vf": [64, 64]}}


def master(args):
    """A master makes few decisions, 40 per episode, each worth the sum of 50 rewards.

    Rewards are scaled, and rows staggered: short rollouts of rows in step would show one part of the maze at a time.
    A discount of 0.9, since progress is paid at once: nearer to 1, a detour near the goal costs next to nothing.
    """
    env = make_vec_env(MASTER, args.rows or 64, staggered=True, num_threads=args.threads, **FIELDS)
    env = VecNormalize(env, norm_obs=False, gamma=0.9)
    settings = {"n_steps": 8, "batch_size": 64, "learning_rate": 1e-3, "ent_coef": 0.01, "gamma": 0.9}
    model = learn(env, settings, args.steps or 20_000, args)
    seen = make_vec_env(MASTER, args.episodes, every_info=True, num_threads=args.threads, **FIELDS)
    closest, flipped = play(model, seen, "goal_distance", np.minimum, "flipped")
    near = closest <= NEAR
    low, high = wilson(near.sum(), near.size)
    within = f"{100 * near.mean():.1f} % [{100 * low:.1f}, {100 * high:.1f}] within {NEAR} m"
    print(f"{args.episodes} episodes: {within}, {100 * flipped.mean():.1f} % turned over")
    return near.mean()


def flat(args):
    """The paper's batch of 2048 steps, in minibatches of 64."""
    env = make_vec_env(FLAT, args.rows or 32, num_threads=args.threads, **FIELDS)
    settings = {"n_steps": 64, "batch_size": 64, "learning_rate": 3e-4}
    model = learn(env, settings, args.steps or 1_000_000, args)
    seen = make_vec_env(FLAT, args.episodes, every_info=True, num_threads=args.threads, **FIELDS)
    progress, fallen = play(model, seen, "reward_progress", np.add, "fallen")
    task = seen.env.setting.task
    speed = np.mean(progress) / task.episode_steps  # time after a fall counts
    print(f"{args.episodes} episodes: {speed:.2f} m/s, {100 * np.mean(fallen):.1f} % fell")
    return speed


def learn(env, settings, steps, args):
    """Train and say how fast."""
    settings = {"policy_kwargs": NETWORK, "seed": args.seed, "device": "cpu", "verbose": args.verbose, **settings}
    model = PPO("MlpPolicy", env, **settings)
    begun = time.monotonic()
    model.learn(steps)
    seconds = time.monotonic() - begun
    print(f"PPO: {model.num_timesteps} steps in {seconds:.0f} s, {model.num_timesteps / seconds:.0f} per second")
    env.close()
    return model


def play(model, env, figure, combine, flag):
    """The first episode of every row: ``figure`` combined over its steps, and whether ``flag`` was ever up."""
    env.seed(1_000_003)
    obs, total, flagged = env.reset(), None, np.zeros(env.num_envs, bool)
    playing = np.ones(env.num_envs, bool)
    while playing.any():
        action, _ = model.predict(obs)
        obs, _, done, infos = env.step(action)
        now = np.array([info[figure] for info in infos])
        total = now if total is None else np.where(playing, combine(total, now), total)
        flagged |= playing & np.array([info[flag] for info in infos])
        playing &= ~done
    env.close()
    return total, flagged


def main(arguments=None):
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kind", choices=("master", "flat"))
    parser.add_argument("--steps", type=int, help="of the environment: decisions of a master, control steps else")
    parser.add_argument("--rows", type=int, help="environments side by side")
    parser.add_argument("--threads", type=int, default=0, help="of the physics; 0: all cores")
    parser.add_argument("--episodes", type=int, default=200, help="of the evaluation")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--verbose", type=int, default=0)
    args = parser.parse_args(arguments)
    return master(args) if args.kind == "master" else flat(args)


if __name__ == "__main__":
    main()
